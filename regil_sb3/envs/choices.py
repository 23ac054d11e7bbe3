"""What the simulators' environments let a user choose alike.

* ``check_choices`` - what is observed, by which camera, and what is rendered
* ``check_positive`` - sizes and counts
"""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["check_choices", "check_positive"]


def check_choices(obs: str, camera: str, cameras: Sequence[str], render_mode: str | None) -> None:
    """Refuse what none of these environments offers.

    Args:
        obs: "pixels" or "state".
        camera: one of ``cameras``.
        cameras: the environment's.
        render_mode: None or "rgb_array".

    Raises:
        ValueError: one of them is something else.
    """
    if obs not in ("pixels", "state"):
        raise ValueError(f"obs {obs!r} must be 'pixels' or 'state'")
    if camera not in cameras:
        raise ValueError(f"camera {camera!r} is not one of {', '.join(cameras)}")
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode {render_mode!r} must be 'rgb_array' or None")


def check_positive(**values: int) -> None:
    """Refuse what is below 1, by name.

    Raises:
        ValueError: one of them is.
    """
    for name, value in values.items():
        if value < 1:
            raise ValueError(f"{name} {value!r} must be at least 1")
