"""What the guide's arguments must fit: the environment's actions, and what it says of itself."""

from __future__ import annotations

import warnings
from typing import Any, cast

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from regil_wrappers.correction import Servo
from regil_wrappers.demonstration import Demonstration

__all__ = ["fitting_actions", "make_servo"]


def fitting_actions(env: gym.Env[Any, Any], demo: Demonstration, label: str) -> NDArray[np.float32]:
    """The demonstration's actions, once they are known to fit the environment."""
    space = env.action_space
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
        raise ValueError(
            f"the action space is {space}: a guide needs continuous actions, a Box of shape (A,)"
        )
    if demo.actions is None:
        raise ValueError(f"{label} has no actions, so it cannot guide: record one that has")
    if demo.actions.shape[1:] != space.shape:
        raise ValueError(
            f"{label} has actions of size {demo.actions.shape[1]} but the environment takes "
            f"{space.shape[0]}: record it in this environment"
        )
    low, high = space.low.astype(np.float32), space.high.astype(np.float32)
    outside = np.argwhere((demo.actions < low) | (demo.actions > high))
    if len(outside):
        i, a = outside[0]
        raise ValueError(
            f"{label} has action {demo.actions[i, a]:g} in dimension {a} of step {i} but the "
            f"environment takes [{low[a]:g}, {high[a]:g}]: record it in this environment"
        )
    return demo.actions


_DECLARED = {
    "translation_dims": [0, 1, 2],
    "gripper_dim": 3,
    "plane": [10.0, 10.0, 0.5],
    "mirror": "auto",
}


def make_servo(
    env: gym.Env[Any, Any],
    size: tuple[int, int],
    actions: NDArray[np.float32],
    declared: dict[str, Any],
    disturbance: float,
) -> Servo | None:
    """A correction with what the user declared, else what the environment says, else defaults."""
    said = env.unwrapped.metadata.get("regil") or {}
    chosen = {
        name: value if value is not None else said.get(name, _DECLARED[name])
        for name, value in declared.items()
    }
    if chosen["gripper_dim"] == "none":
        chosen["gripper_dim"] = None
    space = cast("gym.spaces.Box", env.action_space)
    low, high = space.low.astype(np.float32), space.high.astype(np.float32)
    rate = said.get("control_rate")
    try:
        return Servo(size, actions, low, high, control_rate=rate, disturbance=disturbance, **chosen)
    except ValueError as error:
        if any(value is not None for value in declared.values()):
            raise
        # Nobody declared anything: the environment is not one that correction is made for
        warnings.warn(f"{error}; the guide replays without correction", stacklevel=3)
        return None
