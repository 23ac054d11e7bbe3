"""Record an environment's scripted expert as a `Demonstration`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from regil_wrappers.demonstration import Demonstration

from regil_sb3.envs import EVALUATION_SEEDS

__all__ = ["EVALUATION_SEEDS", "record_expert"]

_PACKAGES = ("gymnasium", "metaworld", "mujoco", "numpy", "regil-sb3", "regil-wrappers")


def record_expert(
    env_id: str,
    seed: int = 0,
    env_kwargs: dict[str, Any] | None = None,
    encoder_frame_size: int | None = None,
    max_seeds: int = 20,
    progress: Callable[[str], None] | None = None,
) -> Demonstration:
    """Play the scripted expert until it succeeds, and keep that episode.

    The expert is asked once per agent step; its action is clipped to the action space, then
    executed and stored. The recording ends with the frame after the first success. Where an
    episode ends without one, the next seed is tried.

    Args:
        env_id: id of an environment that offers `expert_action() -> (A,) float32`.
        seed: first seed to try; `seed + 1`, ... follow.
        env_kwargs: arguments for `gymnasium.make`.
        encoder_frame_size: height and width (pixels) of the larger pictures to keep beside the
            frames, for an encoder that wants them; `None` keeps none.
        max_seeds: how many seeds to try.
        progress: called with one line for each seed tried.

    Returns:
        T actions and T + 1 frames: the environment's observations, or, where these are no
        images, pictures of its `image_size`, with the observations beside them.

    Raises:
        ValueError: where the environment has no scripted expert, a seed belongs to evaluation,
            or no seed leads to success.
    """
    if seed < 0 or max_seeds < 1 or seed + max_seeds > EVALUATION_SEEDS:
        raise ValueError(
            f"seeds {seed} to {seed + max_seeds - 1} must lie between 0 and "
            f"{EVALUATION_SEEDS - 1}: those above are kept for evaluation"
        )
    try:
        env = gym.make(env_id, **(env_kwargs or {}))
    except TypeError as error:  # an argument that it does not have
        raise ValueError(f"{env_id} cannot be made with {env_kwargs}: {error}") from error
    try:
        if not hasattr(env.unwrapped, "expert_action"):
            raise ValueError(
                f"{env_id} has no scripted expert (no expert_action()): "
                "give a demonstration recorded elsewhere"
            )
        if not isinstance(env.action_space, gym.spaces.Box):
            raise ValueError(f"{env_id} has actions {env.action_space}: only Box can be recorded")
        for tried in range(1, max_seeds + 1):
            now = seed + tried - 1
            episode = _play(env, now, encoder_frame_size)
            solved = episode["successes"][-1]
            if progress is not None:
                outcome = "solved" if solved else "not solved"
                progress(f"seed {now}: {outcome} after {len(episode['actions'])} steps")
            if solved:
                return Demonstration(**episode, metadata=_metadata(env, env_id, now, tried))
        raise ValueError(
            f"the scripted expert of {env_id} solved none of the seeds {seed} to "
            f"{seed + max_seeds - 1}: try another seed, or more steps an episode"
        )
    finally:
        env.close()


def _play(env: gym.Env[Any, Any], seed: int, encoder_frame_size: int | None) -> dict[str, Any]:
    """Play one episode: the arrays of a `Demonstration`, by name."""
    ours: Any = env.unwrapped
    space = env.action_space
    assert isinstance(space, gym.spaces.Box)
    pixels = env.observation_space.dtype == np.uint8 and len(env.observation_space.shape or ()) == 3

    observations: list[npt.NDArray[Any]] = []
    frames: list[npt.NDArray[np.uint8]] = []
    encoder_frames: list[npt.NDArray[np.uint8]] = []
    actions: list[npt.NDArray[np.float32]] = []
    successes = [False]

    def see(observation: npt.NDArray[Any]) -> None:
        observations.append(observation)
        if not pixels:
            frames.append(ours.encoder_frame(ours.metadata["regil"]["image_size"][0]))
        if encoder_frame_size is not None:
            encoder_frames.append(ours.encoder_frame(encoder_frame_size))

    observation, _ = env.reset(seed=seed)
    see(observation)
    over = False
    while not over:
        action = np.clip(ours.expert_action(), space.low, space.high).astype(np.float32)
        observation, _, terminated, truncated, info = env.step(action)
        see(observation)
        actions.append(action)
        successes.append(bool(info["is_success"]))
        over = successes[-1] or terminated or truncated
    return {
        "frames": np.stack(observations if pixels else frames),
        "actions": np.stack(actions),
        "observations": None if pixels else np.stack(observations),
        "encoder_frames": np.stack(encoder_frames) if encoder_frames else None,
        "successes": np.array(successes),
    }


def _metadata(env: gym.Env[Any, Any], env_id: str, seed: int, tried: int) -> dict[str, Any]:
    space = env.action_space
    assert isinstance(space, gym.spaces.Box)
    ours = env.unwrapped.metadata.get("regil", {})
    kept = ("camera", "render", "image_size", "action_repeat", "control_rate")
    return {
        **{name: ours[name] for name in kept if name in ours},
        "env_id": env_id,
        "action_low": space.low.tolist(),
        "action_high": space.high.tolist(),
        "seed": seed,
        "seeds_tried": tried,
        # only what took part in this recording
        "versions": {
            name: version(name) for name in _PACKAGES if name.replace("-", "_") in sys.modules
        },
    }
