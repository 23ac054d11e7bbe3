"""What a reward remembers while an episode goes on; the equations are in `rewards`.

* ``Signal`` - rewards one episode after the other, from what a `Retriever` has seen
* ``make_signal`` - one by name
* ``AT_EVERY_STEP``, ``AT_EPISODE_END`` - the names
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from regil_wrappers import rewards
from regil_wrappers.alignment import squared_distances
from regil_wrappers.retrieval import Retriever

__all__ = ["AT_EPISODE_END", "AT_EVERY_STEP", "Signal", "make_signal"]


class Signal:
    """Rewards the frames that a retriever is given. The first frame of an episode earns nothing.

    Args:
        retriever: whose current frame is rewarded.
    """

    def __init__(self, retriever: Retriever) -> None:
        self.retriever = retriever

    @property
    def scale(self) -> float:
        """What makes a typical step's reward about 1 in size, from the demonstration alone."""
        return 1.0

    def begin(self) -> None:
        """Begin an episode; the retriever has seen its first frame."""

    def step(self) -> float:
        """The reward of the step that led to the current frame, once for each; 0 if not yet known.

        Raises:
            ValueError: before the first frame of an episode.
        """
        raise NotImplementedError

    def end(self) -> NDArray[np.float64] | None:
        """(steps,) float64: the episode's rewards, where `step` could not know them; else None."""
        return None


class _Sdtw(Signal):
    def __init__(self, retriever: Retriever, horizon: int | None) -> None:
        super().__init__(retriever)
        self._horizon = horizon

    @cached_property
    def scale(self) -> float:
        return 1 / rewards.demonstration_tau(self.retriever.embeddings)

    def step(self) -> float:
        return rewards.sdtw_reward(self.retriever.alignment, self._horizon)


class _Progress(Signal):
    def __init__(self, retriever: Retriever) -> None:
        super().__init__(retriever)
        self._tau = rewards.demonstration_tau(retriever.embeddings)
        self._phi = rewards.arc_length(retriever.embeddings)

    def step(self) -> float:
        return rewards.progress_reward(self.retriever.end_costs(), self._phi, self._tau)


class _Cos(Signal):
    def step(self) -> float:
        r = self.retriever
        return rewards.cos_reward(r.embedding, r.embeddings, r.distances)


class _Orca(Signal):
    def __init__(self, retriever: Retriever) -> None:
        super().__init__(retriever)
        self._tau = rewards.demonstration_tau(retriever.embeddings)

    def begin(self) -> None:
        self._coverage = rewards.orca_step(None, self.retriever.distances, self._tau)

    def step(self) -> float:
        self._coverage = rewards.orca_step(self._coverage, self.retriever.distances, self._tau)
        return rewards.orca_reward(self._coverage)


class _Pwil(Signal):
    """T is the demonstration's length: a longer episode has nothing left to match, and earns 0."""

    def __init__(self, retriever: Retriever) -> None:
        super().__init__(retriever)
        self._standard = rewards.standard_scale(retriever.embeddings)
        self._frames = retriever.embeddings * self._standard
        self._horizon = len(self._frames)

    @property
    def scale(self) -> float:
        return 1 / rewards.pwil_reward(0.0, self._horizon)

    def begin(self) -> None:
        self._remaining = np.full(len(self._frames), self._horizon, np.int64)
        self.step()

    def step(self) -> float:
        x = self.retriever.embedding * self._standard
        distances = np.sqrt(squared_distances(x, self._frames))
        self._remaining, cost = rewards.pwil_step(self._remaining, distances, self._horizon)
        return rewards.pwil_reward(cost, self._horizon)


class _Transport(Signal):
    def __init__(
        self,
        retriever: Retriever,
        of: Callable[[NDArray[np.float32], NDArray[np.float32]], NDArray[np.float64]],
    ) -> None:
        super().__init__(retriever)
        self._of = of
        self._episode: list[NDArray[np.float32]] = []

    @property
    def scale(self) -> float:
        # `episode_scale` makes an episode's rewards sum to -10
        return len(self.retriever.embeddings) / 10

    def begin(self) -> None:
        self._episode = [self.retriever.embedding.copy()]

    def step(self) -> float:
        self._episode.append(self.retriever.embedding.copy())
        return 0.0

    def end(self) -> NDArray[np.float64]:
        return self._of(np.stack(self._episode), self.retriever.embeddings)[1:]


_STEPWISE: dict[str, Callable[[Retriever], Signal]] = {
    "progress": _Progress,
    "cos": _Cos,
    "orca": _Orca,
    "pwil": _Pwil,
}
_TRANSPORT = {"ot": rewards.ot_rewards, "tot": rewards.tot_rewards}

AT_EVERY_STEP = ("sdtw", *_STEPWISE)
"""Rewards known at once, by name."""
AT_EPISODE_END = tuple(_TRANSPORT)
"""Rewards that need the whole episode, by name."""


def make_signal(name: str, retriever: Retriever, horizon: int | None = None) -> Signal:
    """A reward by name.

    Args:
        name: one of `AT_EVERY_STEP` or `AT_EPISODE_END`.
        retriever: whose frames are rewarded.
        horizon: for "sdtw": H, to divide by H + 1 from the first step on.

    Raises:
        ValueError: if there is no such reward, or the demonstration does not move and the reward
            needs it to.
    """
    if name == "sdtw":
        return _Sdtw(retriever, horizon)
    if name in _STEPWISE:
        return _STEPWISE[name](retriever)
    if name in _TRANSPORT:
        return _Transport(retriever, _TRANSPORT[name])
    raise ValueError(f"reward={name!r}: choose one of {[*AT_EVERY_STEP, *AT_EPISODE_END]}")
