"""What a user declares of an arm and its targets, checked.

* ``checked_dims`` - the action dimensions that move the hand
* ``checked_plane`` - how far targets move
* ``check_gripper`` - the gripper's dimension

Unbounded actions are refused: nobody knows how far a full one moves.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["check_gripper", "checked_dims", "checked_plane"]


def checked_dims(
    translation_dims: Iterable[int], low: NDArray[np.float32], high: NDArray[np.float32]
) -> list[int]:
    """The three dimensions of actions within (A,) low and high that move the hand, as deltas.

    Raises:
        ValueError: if they are not three, do not exist, have no finite limits or cannot be deltas.
    """
    dims = list(translation_dims)
    if len(dims) != 3 or len(set(dims)) != 3 or not all(0 <= d < len(low) for d in dims):
        raise ValueError(
            f"translation_dims={dims}: name the three action dimensions (0 to {len(low) - 1}) "
            "that move the hand"
        )
    for d in dims:
        _check_finite(f"translation_dims={dims}", d, low, high)
        if not low[d] < 0 < high[d]:
            raise ValueError(
                f"translation_dims={dims}: dimension {d} takes [{low[d]:g}, {high[d]:g}], which "
                "cannot be a delta: correction='servo' needs deltas"
            )
    return dims


def checked_plane(plane: Iterable[float]) -> NDArray[np.float64]:
    """(3,) action units, the standard deviations of displacements along each axis.

    Raises:
        ValueError: if they are not three positive numbers.
    """
    checked = np.array(list(plane), float)
    if checked.shape != (3,) or not ((checked > 0) & (checked < np.inf)).all():
        raise ValueError(
            f"plane={list(plane)}: give three positive standard deviations, in action units"
        )
    return checked


def check_gripper(
    gripper_dim: int | None,
    dims: Sequence[int],
    low: NDArray[np.float32],
    high: NDArray[np.float32],
) -> None:
    """Refuse a gripper's dimension that is none of theirs, or moves the hand; None: no gripper.

    Raises:
        ValueError: naming what would be right.
    """
    if gripper_dim is None:
        return
    whole = isinstance(gripper_dim, (int, np.integer)) and not isinstance(gripper_dim, bool)
    if not whole or not 0 <= gripper_dim < len(low) or gripper_dim in dims:
        raise ValueError(
            f"gripper_dim={gripper_dim}: it must be a dimension of the actions that is not "
            f"one of translation_dims={list(dims)}"
        )
    _check_finite(f"gripper_dim={gripper_dim}", gripper_dim, low, high)


def _check_finite(named: str, d: int, low: NDArray[np.float32], high: NDArray[np.float32]) -> None:
    if not np.isfinite([low[d], high[d]]).all():
        raise ValueError(
            f"{named}: dimension {d} takes [{low[d]:g}, {high[d]:g}], and correction='servo' needs "
            "finite limits: give the environment a finite Box "
            "(gymnasium.wrappers.TransformAction(env, lambda action: action, Box(...)))"
        )
