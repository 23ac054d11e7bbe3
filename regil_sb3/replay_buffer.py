"""Image replay without storing a frame twice.

SB3's ``ReplayBuffer`` keeps every stacked observation and its successor: 2 x n_stack frames a
transition. Here each frame is stored once, and stacks are put together when a batch is sampled.

* ``FrameReplayBuffer`` - it; ``frame_bytes`` - what it keeps of one observation
* ``truncate_newest`` - what ``FrameReplayBuffer.close_episodes`` is, for one of SB3's buffers
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import psutil
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize


def frame_bytes(observation_space: spaces.Space[Any], n_stack: int) -> int:
    """Bytes that ``FrameReplayBuffer`` keeps of one observation."""
    assert isinstance(observation_space, spaces.Box)
    return int(np.prod(observation_space.shape)) * observation_space.dtype.itemsize // n_stack


class FrameReplayBuffer(BaseBuffer):
    """Replay buffer that stores each frame once and serves n-step returns.

    Its content, and what ``sample`` draws after equal seeds, is that of SB3's ``NStepReplayBuffer``
    (``ReplayBuffer`` for ``n_steps=1``), at 1 / (2 n_stack) of the memory. Frames must be stacked
    by SB3's ``VecFrameStack`` (newest frame last on the channel axis, zeros before the episode).

    Args:
        buffer_size: transitions, all environments together.
        observation_space: stacked images, channels first: (n_stack * C, H, W). With
            ``n_stack=1`` any Box.
        action_space: a Box.
        device: where batches go.
        n_envs: environments that step together.
        optimize_memory_usage: must be False; this buffer does it always.
        n_stack: how many frames an observation stacks.
        n_steps: rewards summed in a return.
        gamma: discount factor of the return.

    Raises:
        ValueError: the observation does not divide into ``n_stack`` frames, or is no such stack
            when added.
        MemoryError: the buffer would need more memory than is available now; said before anything
            is allocated.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        n_stack: int = 1,
        n_steps: int = 1,
        gamma: float = 0.99,
    ) -> None:
        super().__init__(buffer_size, observation_space, action_space, device, n_envs=n_envs)
        assert isinstance(observation_space, spaces.Box)
        if optimize_memory_usage:
            raise ValueError(
                "FrameReplayBuffer never stores a frame twice: leave out optimize_memory_usage"
            )
        if observation_space.shape[0] % n_stack:
            raise ValueError(
                f"observations of shape {observation_space.shape} do not divide into "
                f"n_stack={n_stack} frames along their first axis"
            )
        self.buffer_size = max(buffer_size // n_envs, 1)
        self.n_stack, self.n_steps, self.gamma = n_stack, n_steps, gamma
        self.frame_shape = (observation_space.shape[0] // n_stack, *observation_space.shape[1:])
        # n_stack more frames than transitions: the oldest transition's history, and the newest's
        # next frame, are still there.
        self.n_frames = self.buffer_size + n_stack
        needed = frame_bytes(observation_space, n_stack) * self.n_frames * n_envs
        available = psutil.virtual_memory().available
        if needed > available:
            raise MemoryError(
                f"a replay buffer of {buffer_size} transitions needs {needed / 1e9:.1f} GB, but "
                f"{available / 1e9:.1f} GB are available: "
                f"set buffer_size to at most {int(0.8 * buffer_size * available / needed)}"
            )
        self.frames = np.zeros((self.n_frames, n_envs, *self.frame_shape), observation_space.dtype)
        self.ends: dict[tuple[int, int], npt.NDArray[Any]] = {}  # last frames of episodes
        self.actions = np.zeros((self.buffer_size, n_envs, self.action_dim), np.float32)
        self.rewards = np.zeros((self.buffer_size, n_envs), np.float32)
        self.dones = np.zeros((self.buffer_size, n_envs), np.float32)
        self.timeouts = np.zeros((self.buffer_size, n_envs), np.float32)
        self.ages = np.zeros((self.buffer_size, n_envs), np.int32)  # steps since the episode began
        self.total = 0  # transitions ever added, each environment
        self._age = np.zeros(n_envs, np.int32)

    @property
    def nbytes(self) -> int:
        """Bytes allocated for transitions."""
        arrays = (self.frames, self.actions, self.rewards, self.dones, self.timeouts, self.ages)
        return sum(a.nbytes for a in arrays) + sum(a.nbytes for a in self.ends.values())

    def _newest(self, observations: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return observations[:, -self.frame_shape[0] :]

    def _check_stack(self, observations: npt.NDArray[Any]) -> None:
        """Refuse observations that could not be put together again from single frames."""
        channels = self.frame_shape[0]
        for back in range(1, self.n_stack):
            stop = (self.n_stack - back) * channels
            older = observations[:, stop - channels : stop]
            stored = self.frames[(self.total - back) % self.n_frames]
            for env in range(self.n_envs):
                expected = stored[env] if self._age[env] >= back else np.zeros_like(stored[env])
                if not np.array_equal(older[env], expected):
                    raise ValueError(
                        f"observation {self.total} of environment {env} is not a stack of the last "
                        f"{self.n_stack} frames: stack them with SB3's VecFrameStack"
                    )

    def add(
        self,
        obs: npt.NDArray[Any],
        next_obs: npt.NDArray[Any],
        action: npt.NDArray[Any],
        reward: npt.NDArray[Any],
        done: npt.NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> None:
        """Add one transition of each environment; arguments as in SB3's ``ReplayBuffer.add``."""
        self._check_stack(obs)
        pos = self.total % self.buffer_size
        self.frames[self.total % self.n_frames] = self._newest(obs)
        following = self._newest(next_obs)
        # Overwritten by the first frame of the next episode when this one has ended.
        self.frames[(self.total + 1) % self.n_frames] = following
        self.actions[pos] = action.reshape(self.n_envs, self.action_dim)
        self.rewards[pos] = reward
        self.dones[pos] = done
        self.timeouts[pos] = [info.get("TimeLimit.truncated", False) for info in infos]
        self.ages[pos] = self._age
        for env in range(self.n_envs):
            self.ends.pop((pos, env), None)
            if done[env]:
                self.ends[pos, env] = following[env].copy()
        self._age = np.where(done, 0, self._age + 1).astype(np.int32)
        self.total += 1
        self.pos = self.total % self.buffer_size
        self.full = self.total >= self.buffer_size

    def _stack(
        self, time: npt.NDArray[Any], age: npt.NDArray[Any], env: npt.NDArray[Any]
    ) -> npt.NDArray[Any]:
        """Frames up to ``time``, (B, n_stack * C, H, W); zeros before the episode."""
        back = np.arange(self.n_stack - 1, -1, -1)
        stacked: npt.NDArray[Any] = self.frames[
            (time[:, None] - back) % self.n_frames, env[:, None]
        ]
        stacked[age[:, None] < back] = 0
        return stacked.reshape(len(time), -1, *self.frame_shape[1:])

    def _get_samples(
        self, batch_inds: npt.NDArray[Any], env: VecNormalize | None = None
    ) -> ReplayBufferSamples:
        envs = np.random.randint(0, self.n_envs, size=len(batch_inds))
        newest = (self.total - 1) % self.buffer_size
        age_in_buffer = (newest - batch_inds) % self.buffer_size  # 0 for the newest transition
        time = self.total - 1 - age_in_buffer

        # n-step return: stop at the episode's end or at the newest transition
        offsets = np.minimum(np.arange(self.n_steps), age_in_buffer[:, None])
        pos = (time[:, None] + offsets) % self.buffer_size
        rewards = self._normalize_reward(self.rewards[pos, envs[:, None]], env)
        ended = self.dones[pos, envs[:, None]].astype(bool)
        ended |= np.arange(self.n_steps) >= age_in_buffer[:, None]
        last = np.where(ended.any(axis=1), ended.argmax(axis=1), self.n_steps - 1)
        mask = np.arange(self.n_steps) <= last[:, None]
        powers = self.gamma ** np.arange(self.n_steps, dtype=np.float32)
        returns = (rewards * powers * mask).sum(axis=1, keepdims=True)
        discounts = self.gamma ** mask.sum(axis=1, keepdims=True).astype(np.float32)

        last_time = time + last
        last_pos = last_time % self.buffer_size
        done = self.dones[last_pos, envs]
        next_obs = self._stack(last_time + 1, self.ages[last_pos, envs] + 1, envs)
        for i in np.flatnonzero(done):
            self._newest(next_obs)[i] = self.ends[int(last_pos[i]), int(envs[i])]
        obs = self._stack(time, self.ages[batch_inds, envs], envs)
        terminal = done * (1.0 - self.timeouts[last_pos, envs])
        return ReplayBufferSamples(
            observations=self.to_torch(obs, copy=False),
            actions=self.to_torch(self.actions[batch_inds, envs]),
            next_observations=self.to_torch(next_obs, copy=False),
            dones=self.to_torch(terminal[:, None].astype(np.float32)),
            rewards=self.to_torch(returns.astype(np.float32)),
            discounts=self.to_torch(discounts.astype(np.float32)),
        )

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Everything in the buffer as plain arrays, not copied."""
        used = slice(0, min(self.total + 1, self.n_frames))
        filled = slice(0, min(self.total, self.buffer_size))
        keys = sorted(self.ends)
        ends = [self.ends[key] for key in keys]
        return {
            "frames": self.frames[used],
            "actions": self.actions[filled],
            "rewards": self.rewards[filled],
            "dones": self.dones[filled],
            "timeouts": self.timeouts[filled],
            "ages": self.ages[filled],
            "end_keys": np.array(keys, np.int64).reshape(-1, 2),
            "end_frames": np.array(ends, self.frames.dtype).reshape(-1, *self.frame_shape),
            "total": np.array(self.total),
            "age": self._age,
        }

    def load_state(self, state: dict[str, npt.NDArray[Any]]) -> None:
        """Take over what ``state`` returned, open episodes included.

        Raises:
            ValueError: the state is that of a buffer of another size or shape.
        """
        total = int(state["total"])
        frames = state["frames"]
        if frames.shape[1:] != self.frames.shape[1:] or len(frames) != min(
            total + 1, self.n_frames
        ):
            raise ValueError(
                f"a saved replay buffer of frames {frames.shape} does not fit one of "
                f"{self.frames.shape}: use the same buffer_size, environments and image size"
            )
        self.frames[: len(frames)] = frames
        for name in ("actions", "rewards", "dones", "timeouts", "ages"):
            getattr(self, name)[: len(state[name])] = state[name]
        self.ends = {
            (int(pos), int(env)): frame
            for (pos, env), frame in zip(state["end_keys"], state["end_frames"], strict=True)
        }
        self.total, self._age = total, state["age"].astype(np.int32)
        self.pos, self.full = total % self.buffer_size, total >= self.buffer_size

    def close_episodes(self) -> None:
        """End every open episode as truncated, because its continuation will never be added."""
        if not self.total:
            return
        pos = (self.total - 1) % self.buffer_size
        for env in np.flatnonzero(self._age > 0):
            self.dones[pos, env] = self.timeouts[pos, env] = 1
            self.ends[pos, int(env)] = self.frames[self.total % self.n_frames, env].copy()
        self._age[:] = 0


def truncate_newest(buffer: ReplayBuffer) -> None:
    """End what is open in one of SB3's buffers: the newest transitions are the last of theirs."""
    if buffer.full or buffer.pos:
        newest = (buffer.pos - 1) % buffer.buffer_size
        open_ones = buffer.dones[newest] == 0
        buffer.dones[newest][open_ones] = buffer.timeouts[newest][open_ones] = 1
