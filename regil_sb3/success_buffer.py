"""The success buffer: whole successful episodes, the demonstration pinned."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Observations = npt.NDArray[Any] | dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class _Episode:
    observations: Observations
    actions: npt.NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.actions)


class SuccessBuffer:
    """Observations and actions of successful episodes, for the behaviour-cloning term.

    It starts with the demonstration, which never leaves; of the other episodes the oldest goes
    first when the capacity is reached. Stacked images are kept as single frames.

    Args:
        capacity: steps, the demonstration's included.
        n_stack: frames that an image observation stacks along its first axis, newest last and
            zeros before the episode, as SB3's ``VecFrameStack`` does.
    """

    def __init__(self, capacity: int, n_stack: int = 1) -> None:
        if capacity < 1:
            raise ValueError(f"success_buffer_size is {capacity}: it must be at least 1 step")
        self.capacity = capacity
        self.n_stack = n_stack
        self._episodes: deque[_Episode] = deque()
        self._pinned: list[_Episode] = []
        self._settle()

    @property
    def steps(self) -> int:
        """Steps held, the demonstration's included."""
        episodes, ends = self._content
        return int(ends[-1]) if episodes else 0

    @property
    def episodes(self) -> int:
        """Episodes held, the demonstration included."""
        return len(self._content[0])

    def _newest(self, observations: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return observations[:, -(observations.shape[1] // self.n_stack) :]

    def add(
        self, observations: Observations, actions: npt.NDArray[np.float32], pinned: bool = False
    ) -> bool:
        """Add one whole episode.

        Args:
            observations: (T, ...) what the policy saw before each action, or a dict of such.
            actions: (T, A) float32, scaled to [-1, 1] as the policy's own.
            pinned: the episode never leaves; for the demonstration.

        Returns:
            Whether it was taken: an episode longer than what the demonstration leaves free is not.

        Raises:
            ValueError: a pinned episode is longer than the capacity.
        """
        kept: Observations
        if isinstance(observations, dict):
            kept = {key: np.array(value) for key, value in observations.items()}
        else:
            # a copy: a view would keep the whole stack in memory
            kept = np.array(self._newest(observations) if self.n_stack > 1 else observations)
        episode = _Episode(kept, np.array(actions, np.float32))
        if pinned:
            if len(episode) > self.capacity:
                raise ValueError(
                    f"success_buffer_size is {self.capacity}: the demonstration alone has "
                    f"{len(episode)} steps"
                )
            self._pinned.append(episode)
        elif len(episode) > self.capacity - sum(map(len, self._pinned)):
            return False
        else:
            self._episodes.append(episode)
        while self._episodes and sum(map(len, (*self._pinned, *self._episodes))) > self.capacity:
            self._episodes.popleft()
        self._settle()
        return True

    def _settle(self) -> None:
        """Make the episodes what is sampled from: at once, as another thread may be sampling."""
        episodes = (*self._pinned, *self._episodes)
        self._content = episodes, np.cumsum([len(e) for e in episodes])

    def _observation(self, episode: _Episode, step: int) -> npt.NDArray[Any]:
        frames = episode.observations
        assert not isinstance(frames, dict)
        if self.n_stack == 1:
            return np.asarray(frames[step])
        stack = frames[max(0, step + 1 - self.n_stack) : step + 1]
        channels = frames.shape[1]
        out = np.zeros((self.n_stack * channels, *frames.shape[2:]), frames.dtype)
        out[-len(stack) * channels :] = stack.reshape(-1, *frames.shape[2:])
        return out

    def sample(self, batch_size: int) -> tuple[Observations, npt.NDArray[np.float32]]:
        """Draw steps uniformly, with numpy's global generator as SB3's buffers do.

        Returns:
            Observations (batch_size, ...), or a dict of such, and actions (batch_size, A).

        Raises:
            ValueError: the buffer is empty.
        """
        episodes, ends = self._content
        if not episodes:
            raise ValueError("the success buffer is empty: TD3BC needs demo= for its BC term")
        drawn = np.random.randint(0, ends[-1], size=batch_size)
        which = np.searchsorted(ends, drawn, side="right")
        picks = [
            (episodes[e], int(i - ends[e] + len(episodes[e])))
            for i, e in zip(drawn, which, strict=True)
        ]
        actions = np.stack([episode.actions[step] for episode, step in picks])
        first = episodes[0].observations
        if isinstance(first, dict):
            batch = {k: np.stack([e.observations[k][s] for e, s in picks]) for k in first}
            return batch, actions
        return np.stack([self._observation(e, s) for e, s in picks]), actions

    def films(self) -> list[tuple[int, npt.NDArray[np.uint8] | None]]:
        """Steps of each episode, the demonstration first, and what it looks like.

        Returns:
            the steps, and (steps, H, W, 3) uint8, of the first picture in the observations; None
            where there is none.
        """
        return [(len(e), _film(e.observations)) for e in (*self._pinned, *self._episodes)]

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """The episodes that are not pinned as plain arrays, not copied."""
        out: dict[str, npt.NDArray[Any]] = {"episodes": np.array(len(self._episodes))}
        for i, episode in enumerate(self._episodes):
            out[f"{i}/actions"] = episode.actions
            if isinstance(episode.observations, dict):
                for key, value in episode.observations.items():
                    out[f"{i}/observations/{key}"] = value
            else:
                out[f"{i}/observations"] = episode.observations
        return out

    def load_state(self, state: dict[str, npt.NDArray[Any]]) -> None:
        """Take over what ``state`` returned, beside the pinned demonstration."""
        self._episodes.clear()
        for i in range(int(state["episodes"])):
            prefix = f"{i}/observations"
            observations: Observations = (
                state[prefix]
                if prefix in state
                else {
                    k[len(prefix) + 1 :]: v for k, v in state.items() if k.startswith(prefix + "/")
                }
            )
            self._episodes.append(_Episode(observations, state[f"{i}/actions"]))
        self._settle()


def _film(observations: Observations) -> npt.NDArray[np.uint8] | None:
    parts = observations.values() if isinstance(observations, dict) else [observations]
    for part in parts:
        if part.dtype == np.uint8 and part.ndim == 4 and part.shape[1] == 3:
            return np.moveaxis(part, 1, -1)
    return None


def stack_frames(frames: npt.NDArray[Any], n_stack: int) -> npt.NDArray[Any]:
    """Stack (T, C, H, W) frames as ``VecFrameStack`` does: (T, n_stack * C, H, W), newest last."""
    padded = np.concatenate([np.zeros((n_stack - 1, *frames.shape[1:]), frames.dtype), frames])
    return np.concatenate([padded[i : i + len(frames)] for i in range(n_stack)], axis=1)
