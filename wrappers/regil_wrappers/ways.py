"""Which way of replaying a demonstration is best, by the successes seen.

* ``Way`` - one way, and what came of it
* ``Ways`` - chooses between them: Thompson sampling on Beta distributions
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

__all__ = ["Way", "Ways"]

# Successes and failures that each way of replaying starts with, Beta(a, b): what is usually best is
# tried first, and given up when it fails.
_PRIORS = {"corrected": (4.0, 1.0), "released": (2.0, 1.0), "plain": (1.0, 1.5)}
_SEEN = 3.0  # episodes that weigh as much as pictures that show two things moved apart
_ENOUGH = 6  # corrected episodes before plain replay is said to be better


@dataclass
class Way:
    """One way of replaying, and what came of it.

    Attributes:
        kind: "corrected", "released" (after a grasp, corrected for where it is brought) or "plain".
        mirror: sign of the camera that corrects.
        won: successes, those that it starts with included.
        lost: failures, likewise.
    """

    kind: str
    mirror: int
    won: float
    lost: float

    @property
    def mean(self) -> float:
        """Of the successes to be expected."""
        return self.won / (self.won + self.lost)


class Ways:
    """The ways of replaying that there are; plain replay is always one.

    Args:
        mirrors: signs of the cameras, the better fit first; none: plain replay alone.
        grasps: whether the demonstration grasps something, so that what is brought may be released
            from the correction of what is taken.
    """

    def __init__(self, mirrors: Iterable[int], grasps: bool) -> None:
        kinds = ("corrected", "released") if grasps else ("corrected",)
        self.plain = Way("plain", 1, *_PRIORS["plain"])
        self.all = [Way(kind, m, *_PRIORS[kind]) for m in mirrors for kind in kinds] + [self.plain]

    def choose(self, rng: np.random.Generator, apart: bool = False) -> Way:
        """Draw each way's share of successes, and take the largest.

        Args:
            rng: draws.
            apart: whether pictures show that more has moved than what is taken up, which speaks for
                "released" and against "corrected", as a few episodes would.
        """
        speaks = {"released": (_SEEN, 0.0), "corrected": (0.0, _SEEN)} if apart else {}
        draws = []
        for way in self.all:
            won, lost = speaks.get(way.kind, (0.0, 0.0))
            draws.append(rng.beta(way.won + won, way.lost + lost))
        return self.all[int(np.argmax(draws))]

    def best(self, kind: str) -> Way:
        """The most successful of a kind.

        Raises:
            ValueError: if there is none of it.
        """
        ways = [way for way in self.all if way.kind == kind]
        if not ways:
            raise ValueError(f"there is no {kind!r} replay here")
        return max(ways, key=lambda way: way.mean)

    def verdict(self) -> str:
        """One line where plain replay has turned out to be better, else nothing."""
        corrected = [way for way in self.all if way.kind != "plain"]
        counts = [_seen(way) for way in corrected]
        won, tried = (sum(column) for column in zip(*counts, strict=True)) if counts else (0, 0)
        plain_won, plain_tried = _seen(self.plain)
        better = all(way.mean < self.plain.mean for way in corrected)
        if tried < _ENOUGH or plain_won < 1 or not better:
            return ""
        return (
            f"corrected replay succeeded in {won:.0f} of {tried:.0f} episodes, plain replay in "
            f"{plain_won:.0f} of {plain_tried:.0f}: the guide mostly replays without correction "
            "from here; are plane, mirror and translation_dims those of this task?"
        )

    def as_list(self) -> list[list[Any]]:
        """JSON values; `Ways.from_list` reads them."""
        return [[way.kind, way.mirror, way.won, way.lost] for way in self.all]

    @classmethod
    def from_list(cls, values: Any, mirrors: Iterable[int]) -> Ways:
        """What `as_list` gave.

        Raises:
            ValueError: if that is damaged, or needs a camera that is not there.
        """
        try:
            read = [Way(str(k), int(m), float(w), float(n)) for k, m, w, n in values]
        except (TypeError, ValueError) as error:
            raise ValueError(f"{values!r} are not ways of replaying ({error})") from error
        ways = cls((), False)
        ways.all = read
        if [way.kind for way in read].count("plain") != 1 or not all(
            way.kind in _PRIORS
            and (way.kind == "plain" or way.mirror in mirrors)
            and min(way.won, way.lost) > 0
            for way in read
        ):
            raise ValueError(f"{values!r} are not ways of replaying with these cameras")
        ways.plain = ways.best("plain")
        return ways


def _seen(way: Way) -> tuple[float, float]:
    """Successes and episodes, without those that a way starts with."""
    won, lost = _PRIORS[way.kind]
    return way.won - won, way.won + way.lost - won - lost
