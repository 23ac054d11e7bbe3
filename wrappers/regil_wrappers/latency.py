"""How long each step of retrieval takes, and whether that is in time.

* ``Latency`` - keeps the last times, tells their percentiles, counts steps that came too late
"""

from __future__ import annotations

import math
import warnings
from collections import deque

import numpy as np

__all__ = ["Latency"]

_KEPT = 10_000  # steps that percentiles are of
_PARTS = ("encode", "search", "alignment")


class Latency:
    """Times of encoding, search and alignment, for a camera that gives a picture every 1 / rate s.

    Example:
        >>> latency = Latency(deadline_ms=33.3)
        >>> for ms in range(1, 11):
        ...     latency.add(encode=ms / 1000, search=0.0002, alignment=0.0001)
        >>> latency.percentiles()["encode"]
        {'p50': 5.5, 'p99': 9.91}
        >>> latency.steps, latency.misses
        (10, 0)

    Args:
        deadline_ms: what encoding, search and alignment of a step may take together, in
            milliseconds; None: anything.

    Attributes:
        deadline_ms: as given.
        steps: how many steps were timed.
        misses: how many of them took longer than the deadline. The first one is said in a warning.

    Raises:
        ValueError: if the deadline is not a positive number.
    """

    def __init__(self, deadline_ms: float | None = None) -> None:
        if deadline_ms is not None and (
            isinstance(deadline_ms, bool)
            or not isinstance(deadline_ms, (int, float))
            or not 0 < deadline_ms < math.inf
        ):
            raise ValueError(
                f"deadline_ms={deadline_ms!r}: it must be a positive number of milliseconds, or "
                "None; a camera of 30 Hz leaves 33"
            )
        self.deadline_ms = deadline_ms
        self.steps = 0
        self.misses = 0
        self._times: deque[tuple[float, float, float]] = deque(maxlen=_KEPT)

    def add(self, encode: float, search: float, alignment: float) -> None:
        """Take the times of one step, in seconds."""
        self._times.append((encode, search, alignment))
        self.steps += 1
        if self.deadline_ms is None:
            return
        total = 1000 * (encode + search + alignment)
        if total <= self.deadline_ms:
            return
        self.misses += 1
        if self.misses == 1:
            warnings.warn(
                f"retrieval took {total:.1f} ms, more than deadline_ms={self.deadline_ms:g} "
                f"(encode {1000 * encode:.1f}, search {1000 * search:.1f}, alignment "
                f"{1000 * alignment:.1f}): later steps that do are only counted, in latency.misses",
                stacklevel=3,
            )

    @property
    def last(self) -> tuple[float, float, float]:
        """The last step's encoding, search and alignment, in seconds.

        Raises:
            ValueError: before the first step.
        """
        self._check()
        return self._times[-1]

    def _check(self) -> None:
        if self.steps == 0:
            raise ValueError("no step has been timed yet")

    def percentiles(self) -> dict[str, dict[str, float]]:
        """p50 and p99 (ms) of "encode", "search", "alignment", "total" over the last 10,000 steps.

        Raises:
            ValueError: before the first step.
        """
        self._check()
        times = 1000 * np.array(self._times)
        columns = dict(zip(_PARTS, times.T, strict=True)) | {"total": times.sum(axis=1)}
        return {
            name: {f"p{q}": round(float(np.percentile(column, q)), 4) for q in (50, 99)}
            for name, column in columns.items()
        }

    def __str__(self) -> str:
        """One line, with the percentiles of each part."""
        if self.steps == 0:
            return "no step timed"
        parts = ", ".join(
            f"{name} {p['p50']:.2f} / {p['p99']:.2f}" for name, p in self.percentiles().items()
        )
        late = "" if self.deadline_ms is None else f"; {self.misses} over {self.deadline_ms:g} ms"
        return f"p50 / p99 ms of {self.steps} steps: {parts}{late}"
