"""What the guide's arguments must fit: the environment's actions, and what it says of itself."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any, cast

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from regil_wrappers.correction import Servo
from regil_wrappers.demonstration import Demonstration
from regil_wrappers.demonstrations import labels_of, outlines

__all__ = ["check_guide", "fitting_actions", "make_servo", "warn_of_rate"]


def check_guide(
    guide_offset: int,
    guide_patience: int | None,
    correction: str,
    disturbance: float,
    demonstrations: int,
) -> None:
    """Refuse values that mean nothing, before any long work.

    Raises:
        ValueError: naming the argument, its value and what would be right.
    """
    if type(guide_offset) is not int:
        raise ValueError(f"guide_offset={guide_offset!r}: it must be a whole number of frames")
    if guide_patience is not None and (type(guide_patience) is not int or guide_patience < 1):
        raise ValueError(f"guide_patience={guide_patience!r}: it must be at least 1 step, or None")
    if correction not in ("none", "servo"):
        raise ValueError(f"correction={correction!r}: choose one of ['none', 'servo']")
    if not isinstance(disturbance, (int, float)) or not 0 <= disturbance < math.inf:
        raise ValueError(f"disturbance={disturbance!r}: it must be a number of at least 0")
    if disturbance > 0 and correction == "none":
        raise ValueError(
            f"disturbance={disturbance}: a guide without correction would not find its way "
            "back, so set correction='servo' or disturbance=0"
        )
    if correction == "servo" and demonstrations > 1:
        raise ValueError(
            f"correction='servo' corrects the path of one demonstration and there are "
            f"{demonstrations}: give one, or correction='none'"
        )


def fitting_actions(
    space: gym.Space[Any], demos: Sequence[Demonstration], given: Any
) -> list[NDArray[np.float32]]:
    """The demonstrations' actions, once they are known to fit the action space.

    Args:
        space: of one environment.
        demos: the demonstrations.
        given: what ``demo=`` was, for messages.
    """
    actions = [outline.actions for outline in outlines(demos)]
    return [_fitting(space, *one) for one in zip(actions, labels_of(given), strict=True)]


def _fitting(
    space: gym.Space[Any], actions: NDArray[np.float32] | None, label: str
) -> NDArray[np.float32]:
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
        raise ValueError(
            f"the action space is {space}: a guide needs continuous actions, a Box of shape (A,)"
        )
    if actions is None:
        raise ValueError(f"{label} has no actions, so it cannot guide: record one that has")
    if actions.shape[1:] != space.shape:
        raise ValueError(
            f"{label} has actions of size {actions.shape[1]} but the environment takes "
            f"{space.shape[0]}: record it in this environment"
        )
    low, high = space.low.astype(np.float32), space.high.astype(np.float32)
    outside = np.argwhere((actions < low) | (actions > high))
    if len(outside):
        i, a = outside[0]
        raise ValueError(
            f"{label} has action {actions[i, a]:g} in dimension {a} of step {i} but the "
            f"environment takes [{low[a]:g}, {high[a]:g}]: record it in this environment"
        )
    return actions


def warn_of_rate(said: dict[str, Any], demos: Sequence[Demonstration], given: Any) -> None:
    """Warn of the first demonstration whose actions were executed at another rate.

    Args:
        said: ``metadata["regil"]`` of the environment.
        demos: the demonstrations.
        given: what ``demo=`` was, for the message.
    """
    here = said.get("control_rate")
    for outline, label in zip(outlines(demos), labels_of(given), strict=True):
        rate = outline.metadata["control_rate"]
        if rate is not None and here is not None and not np.isclose(rate, here):
            warnings.warn(
                f"{label} was recorded at {rate:g} actions a second and the environment takes "
                f"{here:g}: the guide's actions are made for another speed, so record it again "
                f"or resample it (regil_wrappers.formats.read(..., fps={here:g}, actions=...))",
                stacklevel=3,
            )
            return


_DECLARED = {
    "translation_dims": [0, 1, 2],
    "gripper_dim": 3,
    "plane": [10.0, 10.0, 0.5],
    "mirror": "auto",
}

_SAID_ONLY = ("control_rate", "settle_time", "rotation_dims", "start_std", "crowded")


def make_servo(
    said: dict[str, Any],
    space: gym.Space[Any],
    size: tuple[int, int],
    actions: NDArray[np.float32],
    declared: dict[str, Any],
    disturbance: float,
) -> Servo | None:
    """A correction with what the user declared, else what the environment says, else defaults.

    Args:
        said: ``metadata["regil"]`` of the environment.
        space: of its actions, a Box.
        size: (height, width) px of the pictures.
        actions: (T, A) float32, the demonstrator's.
        declared: the user's own values by name; None for those not declared.
        disturbance: as for `Servo`.
    """
    chosen = {
        name: value if value is not None else said.get(name, _DECLARED[name])
        for name, value in declared.items()
    }
    if chosen["gripper_dim"] == "none":
        chosen["gripper_dim"] = None
    box = cast("gym.spaces.Box", space)
    low, high = box.low.astype(np.float32), box.high.astype(np.float32)
    chosen |= {name: said[name] for name in _SAID_ONLY if name in said}
    try:
        return Servo(size, actions, low, high, disturbance=disturbance, **chosen)
    except ValueError as error:
        if any(value is not None for value in declared.values()):
            raise
        # Nobody declared anything: the environment is not one that correction is made for
        warnings.warn(f"{error}; the guide replays without correction", stacklevel=3)
        return None
