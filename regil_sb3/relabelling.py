"""Replay buffers for rewards that are known only when an episode has ended.

``RetrievalRewardWrapper(reward="ot")`` and ``"tot"`` return placeholders, and the rewards with the
last step's ``info``. The buffers here hold an open episode aside and take it in when it ends, with
its rewards: a transition that can be sampled has its reward.

* ``EpisodeRewardReplayBuffer``, ``EpisodeRewardNStepReplayBuffer``,
  ``EpisodeRewardDictReplayBuffer``, ``EpisodeRewardFrameReplayBuffer`` - twins of SB3's buffers and
  of ``FrameReplayBuffer``
* ``AfterFirstEpisode`` - a callback: no update before an episode has ended
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from regil_sb3.replay_buffer import FrameReplayBuffer

__all__ = [
    "AfterFirstEpisode",
    "EpisodeRewardDictReplayBuffer",
    "EpisodeRewardFrameReplayBuffer",
    "EpisodeRewardNStepReplayBuffer",
    "EpisodeRewardReplayBuffer",
    "EpisodeRewards",
    "episode_reward_class",
    "rewards_come_late",
]

Observation = npt.NDArray[Any] | dict[str, npt.NDArray[Any]]


class EpisodeRewards:
    """Turns the replay buffer that follows it among the bases into one that waits for rewards.

    Episodes are stored whole, one behind the other in the order in which they end, whatever
    environment they come from: the buffer below sees one environment. So n-step returns, wrapping
    around and ``optimize_memory_usage`` are its own. A reward is what the step returned plus
    ``scale`` times its share of ``info["retrieval"]["episode_rewards"]``.

    An episode that is given up (the environment was reset before its end) is never stored.

    Args:
        buffer_size: transitions of ended episodes, all environments together. Open episodes, of at
            most that length, are held besides.
        observation_space: as for the buffer below.
        action_space: as for the buffer below.
        device: where batches go.
        n_envs: environments that step together.
        scale: factor on episode rewards; None takes ``info["retrieval"]["episode_scale"]`` of the
            first episode that ends in any environment, for itself and all others.
        **kwargs: for the buffer below.

    Raises:
        ValueError: from ``add``, where an episode ends without rewards, or does not end; from
            ``sample``, where none has ended yet.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: th.device | str = "auto",
        n_envs: int = 1,
        scale: float | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(  # type: ignore[call-arg]
            buffer_size, observation_space, action_space, device, n_envs=1, **kwargs
        )
        self.scale = scale
        self._open: list[list[tuple[Any, ...]]] = [[] for _ in range(n_envs)]

    def add(
        self,
        obs: Observation,
        next_obs: Observation,
        action: npt.NDArray[Any],
        reward: npt.NDArray[Any],
        done: npt.NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> None:
        """Hold one transition of each environment; arguments as in SB3's ``ReplayBuffer.add``."""
        for env, (episode, info) in enumerate(zip(self._open, infos, strict=True)):
            one = slice(env, env + 1)
            late = {"TimeLimit.truncated": info.get("TimeLimit.truncated", False)}
            seen, following = _part(obs, one), _part(next_obs, one)
            episode.append((seen, following, action[one].copy(), reward[env], done[one], [late]))
            if done[env]:
                self._store(env, info.get("retrieval", {}))
                episode.clear()
            elif len(episode) >= self.buffer_size:  # type: ignore[attr-defined]
                raise ValueError(
                    f"an episode of environment {env} has not ended after {len(episode)} steps, "
                    "as many as the replay buffer holds: give the environment a time limit, or a "
                    "larger buffer_size"
                )

    def _store(self, env: int, retrieval: dict[str, Any]) -> None:
        rewards = retrieval.get("episode_rewards")
        if rewards is None:
            raise ValueError(
                f"an episode of environment {env} ended without info['retrieval']"
                "['episode_rewards']: wrap it in RetrievalRewardWrapper(reward='ot' or 'tot'), "
                "time limits inside it, or leave out this replay_buffer_class"
            )
        first = retrieval.get("episode_scale", 1.0)
        if self.scale is None and math.isfinite(first):
            self.scale = float(first)
        # Without a scale all rewards are 0. What was held before the episode began was given up.
        episode = self._open[env][-len(rewards) :]
        if len(episode) < len(rewards):
            return  # its beginning is not here
        shares = np.asarray(rewards, np.float64) * (1.0 if self.scale is None else self.scale)
        for (obs, following, action, returned, done, info), share in zip(
            episode, shares, strict=True
        ):
            total = np.array([returned + share], np.float32)
            super().add(obs, following, action, total, done, info)  # type: ignore[misc]

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Any:
        """A batch of ended episodes; see SB3's ``ReplayBuffer.sample``."""
        if not self.size():  # type: ignore[attr-defined]
            raise ValueError(
                "no episode has ended yet, so no reward is known: pass callback="
                "AfterFirstEpisode() of regil_sb3.relabelling to learn(), or set learning_starts "
                "to the steps of the longest episode, times the number of environments"
            )
        if env is not None and env.norm_reward:
            raise ValueError(
                "VecNormalize measures rewards when steps return them, and these are placeholders: "
                "set norm_reward=False"
            )
        return super().sample(batch_size, env=env)  # type: ignore[misc]

    def reset(self) -> None:
        """Forget everything but the scale."""
        super().reset()  # type: ignore[misc]
        self.forget_open_episodes()

    def forget_open_episodes(self) -> None:
        """Forget episodes that have not ended, because they never will."""
        self._open = [[] for _ in self._open]


def _part(observation: Observation, one: slice) -> Observation:
    if isinstance(observation, dict):
        return {key: value[one].copy() for key, value in observation.items()}
    part: npt.NDArray[Any] = observation[one].copy()
    return part


class EpisodeRewardReplayBuffer(EpisodeRewards, ReplayBuffer):
    """SB3's ``ReplayBuffer`` for rewards that are known when an episode has ended.

    Example:
        >>> from stable_baselines3 import SAC
        >>> from regil_sb3.relabelling import AfterFirstEpisode, EpisodeRewardReplayBuffer
        >>> model = SAC("MlpPolicy", env, replay_buffer_class=EpisodeRewardReplayBuffer)
        >>> model.learn(10_000, callback=AfterFirstEpisode())  # doctest: +SKIP
    """


class EpisodeRewardNStepReplayBuffer(EpisodeRewards, NStepReplayBuffer):
    """SB3's ``NStepReplayBuffer`` for rewards that are known when an episode has ended.

    SB3 hands ``n_steps`` only to buffers it chose itself: leave it out there, and give
    ``replay_buffer_kwargs={"n_steps": 3, "gamma": 0.99}``.
    """


class EpisodeRewardDictReplayBuffer(EpisodeRewards, DictReplayBuffer):
    """SB3's ``DictReplayBuffer`` for rewards that are known when an episode has ended."""


class EpisodeRewardFrameReplayBuffer(EpisodeRewards, FrameReplayBuffer):
    """``FrameReplayBuffer`` for rewards that are known when an episode has ended.

    Open episodes are held as they were observed, stacked.
    """

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Everything but open episodes as plain arrays, for ``numpy.savez``."""
        scale = np.nan if self.scale is None else self.scale
        return {**super().state(), "episode_scale": np.array(scale)}

    def load_state(self, state: dict[str, npt.NDArray[Any]]) -> None:
        """Take over what ``state`` returned.

        Raises:
            ValueError: the state is that of a buffer of another kind, size or shape.
        """
        if "episode_scale" not in state:
            raise ValueError(
                "a saved replay buffer without episode_scale holds rewards of another kind: use "
                "the same reward"
            )
        super().load_state(state)
        scale = float(state["episode_scale"])
        self.scale = None if math.isnan(scale) else scale

    def close_episodes(self) -> None:
        """Forget open episodes: their continuation will never be added."""
        super().close_episodes()
        self.forget_open_episodes()


def rewards_come_late(env: VecEnv) -> bool:
    """Whether an environment's steps return placeholders, and the last one the episode's rewards.

    Raises:
        ValueError: if only some of the environments do.
    """
    if not env.has_attr("rewards_at_episode_end"):
        return False
    late = env.get_attr("rewards_at_episode_end")
    if any(late) != all(late):
        raise ValueError(f"rewards_at_episode_end={late}: give all environments the same reward")
    return bool(late[0])


def episode_reward_class(observation_space: spaces.Space[Any], n_steps: int = 1) -> type[Any]:
    """Which of these buffers fits the observations."""
    if isinstance(observation_space, spaces.Dict):
        return EpisodeRewardDictReplayBuffer
    if is_image_space(observation_space):
        return EpisodeRewardFrameReplayBuffer
    return EpisodeRewardNStepReplayBuffer if n_steps > 1 else EpisodeRewardReplayBuffer


class AfterFirstEpisode(BaseCallback):
    """Puts off the first update until an episode has ended; random actions go on meanwhile.

    SB3 asks the replay buffer for a batch as soon as ``learning_starts`` is over, and these have
    nothing to give before an episode has ended. ``TD3BC`` needs no such callback.
    """

    def _on_step(self) -> bool:
        assert isinstance(self.model, OffPolicyAlgorithm)
        assert self.model.replay_buffer is not None
        if not self.model.replay_buffer.size():
            self.model.learning_starts = max(self.model.learning_starts, self.num_timesteps)
        return True
