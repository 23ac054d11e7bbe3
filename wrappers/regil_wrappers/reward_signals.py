"""What a reward remembers while an episode goes on; the equations are in `rewards`.

* ``Signal`` - rewards one episode after the other, from what a `Retriever` has seen
* ``make_signal`` - one by name
* ``check_search`` - whether it can be had with a way of searching
* ``check_reward`` - what else decides it
* ``AT_EVERY_STEP``, ``AT_EPISODE_END`` - the names
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from regil_wrappers import rewards
from regil_wrappers.alignment import squared_distances
from regil_wrappers.retrieval import Retriever

__all__ = [
    "AT_EPISODE_END",
    "AT_EVERY_STEP",
    "Signal",
    "check_inside",
    "check_reward",
    "check_search",
    "make_signal",
]


class Signal:
    """Rewards the frames that a retriever is given. The first frame of an episode earns nothing.

    With several demonstrations, "sdtw" is of the alignment that was chosen and "cos" of the nearest
    frame of all; "progress" is the best of those that have a candidate, "orca" the best of all;
    "pwil" transports to the frames of all together, "ot" and "tot" to the one that is cheapest.

    Args:
        retriever: whose current frame is rewarded.
    """

    def __init__(self, retriever: Retriever) -> None:
        self.retriever = retriever

    def another(self, retriever: Retriever) -> Signal:
        """The same for the frames of another retriever, `Retriever.another` of this one's."""
        twin = copy.copy(self)
        twin.retriever = retriever
        return twin

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
        return 1 / rewards.demonstration_tau(self.retriever.memory.parts)

    def step(self) -> float:
        return rewards.sdtw_reward(self.retriever.alignment, self._horizon)


class _Progress(Signal):
    def __init__(self, retriever: Retriever) -> None:
        super().__init__(retriever)
        parts = retriever.memory.parts
        self._tau = [rewards.demonstration_tau(part) for part in parts]
        self._phi = [rewards.arc_length(part) for part in parts]

    def step(self) -> float:
        return max(
            rewards.progress_reward(self.retriever.end_costs(d), self._phi[d], self._tau[d])
            for d in self.retriever.near
        )


class _Cos(Signal):
    def step(self) -> float:
        nearest = self.retriever.embeddings[self.retriever.nearest]
        return rewards.cos_reward(self.retriever.embedding, nearest[None], np.zeros(1))


class _Orca(Signal):
    def __init__(self, retriever: Retriever) -> None:
        super().__init__(retriever)
        self._tau = [len(part) * rewards.demonstration_tau(part) for part in retriever.memory.parts]

    def begin(self) -> None:
        self._coverage: list[NDArray[np.float64] | None] = [None] * len(self._tau)
        self.step()

    def step(self) -> float:
        distances = np.split(self.retriever.distances, self.retriever.memory.starts[1:-1])
        rows = zip(self._coverage, distances, self._tau, strict=True)
        covered = [rewards.orca_step(*row) for row in rows]
        self._coverage = [*covered]
        return max(rewards.orca_reward(coverage) for coverage in covered)


class _Pwil(Signal):
    """T is the longest demonstration: a longer episode has nothing left to match, and earns 0."""

    def __init__(self, retriever: Retriever) -> None:
        super().__init__(retriever)
        self._standard = rewards.standard_scale(retriever.embeddings)
        self._frames = retriever.embeddings * self._standard
        self._horizon = max(len(part) for part in retriever.memory.parts)

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
        memory = self.retriever.memory
        return len(memory) / len(memory.parts) / 10

    def begin(self) -> None:
        self._episode = [self.retriever.embedding.copy()]

    def step(self) -> float:
        self._episode.append(self.retriever.embedding.copy())
        return 0.0

    def end(self) -> NDArray[np.float64]:
        episode = np.stack(self._episode)
        of_each = [self._of(episode, part) for part in self.retriever.memory.parts]
        return max(of_each, key=np.sum)[1:]


_STEPWISE: dict[str, Callable[[Retriever], Signal]] = {
    "progress": _Progress,
    "cos": _Cos,
    "orca": _Orca,
    "pwil": _Pwil,
}
_TRANSPORT = {"ot": rewards.ot_rewards, "tot": rewards.tot_rewards}

_OF_ALL_FRAMES = ("orca", "pwil", *_TRANSPORT)

AT_EVERY_STEP = ("sdtw", *_STEPWISE)
"""Rewards known at once, by name."""
AT_EPISODE_END = tuple(_TRANSPORT)
"""Rewards that need the whole episode, by name."""


def check_search(name: str, search: str) -> None:
    """Refuse a reward that needs the distances to all frames where a search looks at some.

    Raises:
        ValueError: naming what would be right.
    """
    if search == "faiss" and name in _OF_ALL_FRAMES:
        raise ValueError(
            f"reward={name!r} compares with every frame of every demonstration and search='faiss' "
            "does not: set search='exact', or choose 'sdtw', 'progress' or 'cos'"
        )


def check_reward(reward: str, mode: str, weight: float, divisor: str, search: str) -> None:
    """Refuse values that mean nothing, before any long work.

    Raises:
        ValueError: naming the argument, its value and what would be right.
    """
    check_search(reward, search)
    for name, value, choices in (
        ("reward", reward, (*AT_EVERY_STEP, *AT_EPISODE_END)),
        ("mode", mode, ("replace", "add")),
        ("divisor", divisor, ("window", "horizon")),
    ):
        if value not in choices:
            raise ValueError(f"{name}={value!r}: choose one of {list(choices)}")
    if not isinstance(weight, (int, float)) or not math.isfinite(weight):
        raise ValueError(f"weight={weight!r}: it must be a finite number")


def check_inside(reward: str, late: bool | None) -> None:
    """Refuse a reward over another one where either comes at an episode's end.

    Args:
        reward: of the wrapper outside.
        late: whether that of a reward wrapper inside comes at an episode's end; None: there is
            none.

    Raises:
        ValueError: naming what would be right.
    """
    if late or (late is not None and reward in AT_EPISODE_END):
        raise ValueError(
            f"reward={reward!r} over another reward wrapper: {', '.join(AT_EPISODE_END)} come at "
            "an episode's end and cannot be stacked with others: take the other wrapper away"
        )


def make_signal(name: str, retriever: Retriever, horizon: int | None = None) -> Signal:
    """A reward by name.

    Args:
        name: one of `AT_EVERY_STEP` or `AT_EPISODE_END`.
        retriever: whose frames are rewarded.
        horizon: for "sdtw": H, to divide by H + 1 from the first step on.

    Raises:
        ValueError: if there is no such reward, a demonstration does not move and the reward needs
            it to, or the retriever does not look at all frames that the reward needs.
    """
    check_search(name, "exact" if retriever.memory.exact else "faiss")
    if name == "sdtw":
        return _Sdtw(retriever, horizon)
    if name in _STEPWISE:
        return _STEPWISE[name](retriever)
    if name in _TRANSPORT:
        return _Transport(retriever, _TRANSPORT[name])
    raise ValueError(f"reward={name!r}: choose one of {[*AT_EVERY_STEP, *AT_EPISODE_END]}")
