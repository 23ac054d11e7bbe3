"""A demonstration as the policy would have seen it: stacked observations and scaled actions."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from regil_wrappers import Demonstration
from stable_baselines3.common.preprocessing import is_image_space

from regil_sb3.success_buffer import Observations, stack_frames


def as_seen(
    demo: Demonstration,
    observation_space: spaces.Space[Any],
    action_space: spaces.Box,
    n_stack: int,
) -> tuple[Observations, npt.NDArray[np.float32]]:
    """Turn a demonstration into a policy's observations and actions.

    Args:
        demo: with T actions.
        observation_space: of the policy; images are channels first and ``n_stack`` frames deep. Of
            a dict, the one picture that ``demo.observations`` lack is what the frames show.
        action_space: of the environment.
        n_stack: frames that an image observation stacks.

    Returns:
        What was seen before each action, (T, ...) or a dict of such, and the actions (T, A) scaled
        to [-1, 1].

    Raises:
        ValueError: actions, frames or observations do not fit the spaces.
    """
    assert demo.actions is not None
    if demo.actions.shape[1:] != action_space.shape:
        raise ValueError(
            f"the demonstration has actions of shape {demo.actions.shape[1:]} but the environment "
            f"takes {action_space.shape}"
        )
    low, high = action_space.low, action_space.high
    outside = np.argwhere((demo.actions < low - 1e-6) | (demo.actions > high + 1e-6))
    if len(outside):
        step, i = outside[0]
        raise ValueError(
            f"the demonstration has action {demo.actions[step, i]:g} in dimension {i} of step "
            f"{step} but the environment takes [{low[i]:g}, {high[i]:g}]: "
            "record it in this environment"
        )
    actions = 2.0 * (np.clip(demo.actions, low, high) - low) / (high - low) - 1.0
    observations = _observations(demo, observation_space, n_stack)
    got = _shapes(observations)
    want = (
        {key: space.shape for key, space in observation_space.items()}
        if isinstance(observation_space, spaces.Dict)
        else observation_space.shape
    )
    if got != want:
        stacked = f", {n_stack} stacked: set frame_stack=1" if n_stack > 1 else ""
        raise ValueError(
            f"the demonstration's observations have shape {got} but the policy sees {want}{stacked}"
        )
    return observations, actions.astype(np.float32)


def _shapes(observations: Observations) -> Any:
    if isinstance(observations, dict):
        return {key: value.shape[1:] for key, value in observations.items()}
    return observations.shape[1:]


def _channels_first(values: npt.NDArray[Any], space: spaces.Space[Any]) -> npt.NDArray[Any]:
    """Images (T, H, W, C) as SB3 transposes them for its policies; other values as they are."""
    if is_image_space(space) and values.ndim == 4 and values.shape[1:] != space.shape:
        values = np.transpose(values, (0, 3, 1, 2))
    return values


def _observations(demo: Demonstration, space: spaces.Space[Any], n_stack: int) -> Observations:
    assert demo.actions is not None
    n = len(demo.actions)
    if isinstance(space, spaces.Dict):
        held = dict(demo.observations) if isinstance(demo.observations, dict) else {}
        missing = sorted(set(space.keys()) - set(held))
        if len(missing) == 1 and is_image_space(space[missing[0]]):
            held[missing.pop()] = demo.frames  # a recorder keeps this picture there alone
        if not missing:
            return {key: _channels_first(held[key][:n], one) for key, one in space.items()}
        if held:
            raise ValueError(f"the demonstration's observations lack {', '.join(missing)}")
    if isinstance(demo.observations, np.ndarray) and not is_image_space(space):
        return demo.observations[:n]
    if not is_image_space(space):
        raise ValueError(
            "the policy does not see the frame, so the BC term needs the demonstration's "
            "observations=: record it again in this environment, or set bc_coef=0 and demo=None"
        )
    assert space.shape is not None
    frames = demo.frames[:n].transpose(0, 3, 1, 2)
    if (frames.shape[1] * n_stack, *frames.shape[2:]) != space.shape:
        channels, height, width = space.shape
        raise ValueError(
            f"the demonstration has {frames.shape[2]}x{frames.shape[3]} frames with "
            f"{frames.shape[1]} channels but the policy sees {height}x{width} with {channels} "
            f"channels ({n_stack} stacked): record it again in this environment"
        )
    return stack_frames(frames, n_stack)
