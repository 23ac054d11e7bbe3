"""Success on unseen seeds, the same for every method.

Episode i uses seed ``EVALUATION_SEED + i`` in every run of every method; ``best_model`` is chosen
on ``SELECTION_SEED + i``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from regil_wrappers import Demonstration
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import (
    is_image_space,
    is_image_space_channels_first,
)
from stable_baselines3.common.vec_env import VecEnv

from regil_sb3.envs import EVALUATION_SEEDS

EVALUATION_SEED = EVALUATION_SEEDS
SELECTION_SEED = 2_000_000

METHODS = {
    "policy": "policy",
    "best_policy": "best policy",
    "corrected_guide": "corrected guide",
    "guide": "guided replay",
    "bc": "BC on the demo",
    "vinn": "VINN-style replay",
}
"""What ``evaluation.json`` may hold, and what people call it."""

Act = Callable[[Any, VecEnv, bool], npt.NDArray[Any]]
"""Observation, environment, and whether an episode begins with it -> action."""


@dataclass
class Evaluation:
    """What happened in the episodes of an evaluation."""

    successes: list[bool] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)
    first_frames: list[npt.NDArray[np.uint8]] = field(default_factory=list)
    first_actions: list[npt.NDArray[np.float32]] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """For ``evaluation.json``; returns are sums of the reward trained on."""
        return {
            "success": float(np.mean(self.successes)),
            "episodes": len(self.successes),
            "successes": self.successes,
            "returns": self.returns,
            "lengths": self.lengths,
        }

    def first_episode(self, metadata: dict[str, Any]) -> Demonstration | None:
        """The first episode in the format of a demonstration, or None without image frames."""
        if not self.first_frames:
            return None
        successes = np.zeros(len(self.first_frames), bool)
        successes[-1] = self.successes[0]
        return Demonstration(
            frames=np.stack(self.first_frames),
            actions=np.stack(self.first_actions),
            successes=successes,
            metadata={**metadata, "success": self.successes[0]},
        )


def policy_act(model: BaseAlgorithm) -> Act:
    """The deterministic policy, with what it remembers of an episode."""
    state: tuple[npt.NDArray[Any], ...] | None = None

    def act(obs: Any, env: VecEnv, first: bool) -> npt.NDArray[Any]:
        nonlocal state
        begins = np.full(env.num_envs, first)
        action, state = model.predict(obs, state, begins, deterministic=True)
        return action

    return act


def guide_act(obs: Any, env: VecEnv, first: bool) -> npt.NDArray[Any]:
    """Guided replay: what ``RetrievalGuideWrapper`` suggests, corrected where it corrects."""
    return np.stack(env.env_method("guide_action"))


class ResetWhenAsked(gym.Wrapper[Any, Any, Any, Any]):
    """For what exists once: nobody has to put a scene back for an episode that is not played.

    A reset without a seed returns what was seen last where no step came since another reset, as
    when SB3 begins to learn in an environment that was looked at. Where an episode of evaluation
    has ended, so do all resets without a seed of evaluation.

    Args:
        env: a robot's, or what is around it.
        evaluates: whether each episode that is played has a seed of evaluation.
    """

    def __init__(self, env: gym.Env[Any, Any], evaluates: bool) -> None:
        super().__init__(env)
        self.evaluates = evaluates
        self._seen: tuple[Any, dict[str, Any]] | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset, unless it is in vain."""
        asked = seed is not None and (seed >= EVALUATION_SEED or not self.evaluates)
        if self._seen is None or asked or options is not None:
            self._seen = None
            self._seen = super().reset(seed=seed, options=options)
        return self._seen

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step."""
        self._seen = None  # before it: it may be broken off
        observation, reward, terminated, truncated, info = super().step(action)
        if self.evaluates and (terminated or truncated):
            self._seen = observation, {}
        return observation, reward, terminated, truncated, info


def evaluate(
    act: Act,
    env: VecEnv,
    episodes: int,
    first_seed: int = EVALUATION_SEED,
    progress: Callable[[Evaluation], None] | None = None,
) -> Evaluation:
    """Run whole episodes, one after another, episode i reset with seed ``first_seed + i``.

    Args:
        act: see ``Act``.
        env: one environment, with the training environment's wrappers.
        episodes: how many.
        first_seed: see above.
        progress: called after each episode.

    Raises:
        ValueError: more than one environment, or no episode.
    """
    if env.num_envs != 1 or episodes < 1:
        raise ValueError(
            f"evaluation needs one environment and an episode, not {env.num_envs} and {episodes}"
        )
    result = Evaluation()
    shows = is_image_space(env.observation_space)
    for episode in range(episodes):
        env.seed(first_seed + episode)
        obs: Any = env.reset()
        total, length, success, done = 0.0, 0, False, False
        while not done:
            if episode == 0 and shows:
                result.first_frames.append(_newest_frame(obs[0], env))
            action = act(obs, env, length == 0)
            if episode == 0 and isinstance(env.action_space, spaces.Box):
                space = env.action_space  # float32 may put a bound outside by its last bit
                kept = np.clip(action[0], space.low, space.high).astype(np.float32)
                result.first_actions.append(kept)
            obs, rewards, dones, infos = env.step(action)
            total, length, done = total + float(rewards[0]), length + 1, bool(dones[0])
            success |= bool(infos[0].get("is_success", False))
        if episode == 0 and shows:
            result.first_frames.append(_newest_frame(infos[0]["terminal_observation"], env))
        result.successes.append(success)
        result.returns.append(total)
        result.lengths.append(length)
        if progress is not None:
            progress(result)
    return result


def _newest_frame(observation: Any, env: VecEnv) -> npt.NDArray[np.uint8]:
    """The newest RGB frame (H, W, 3) of one (stacked) image observation."""
    space = env.observation_space
    assert isinstance(space, spaces.Box)
    if is_image_space_channels_first(space):
        return np.array(observation[-3:].transpose(1, 2, 0), np.uint8)
    return np.array(observation[..., -3:], np.uint8)
