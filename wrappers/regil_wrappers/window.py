"""Distances between an episode's last H + 1 frames and a memory's.

* ``Window`` - what a retriever asks of them
* ``make_window`` - keeps them for every frame of memory, or for the demonstrations that are near
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from regil_wrappers.alignment import nearest
from regil_wrappers.memory import Memory

__all__ = ["Window", "make_window"]

Rows = NDArray[np.float64]
Frames = NDArray[np.intp]

_SPARE_BYTES = 8 * 1024**2


class Window(Protocol):
    """The recent frames."""

    def __len__(self) -> int:
        """How many there are, at most H + 1."""
        ...

    def clear(self) -> None:
        """Forget them: an episode begins."""
        ...

    def take(self, embedding: NDArray[np.float32], k: int, distances: Rows | None) -> Frames | None:
        """Take the next frame, (D,) float32, and its (N,) distances to memory if they are known.

        Returns:
            the k frames of memory nearest to it, ascending; None: it has no finite distance.
        """
        ...

    def nearest(self) -> int:
        """The one that is nearest; among equal ones the later."""
        ...

    def costs(self, demonstration: int, columns: int) -> Rows:
        """(frames, columns) float64: distances to the demonstration's first frames."""
        ...

    def last(self) -> Rows:
        """(N,) float64: of the last frame to all of memory.

        Raises:
            ValueError: where not all were looked at.
        """
        ...


def make_window(memory: Memory, horizon: int) -> Window:
    """The window that fits how memory is searched."""
    return _Whole(memory, horizon) if memory.exact else _Near(memory, horizon)


class _Whole:
    """Rows of distances to all of memory, newest last; moved back to the top at the bottom."""

    def __init__(self, memory: Memory, horizon: int) -> None:
        self._memory = memory
        self._horizon = horizon
        spare = max(1, min(64, _SPARE_BYTES // (8 * len(memory))))
        self._rows = np.empty((spare + horizon, len(memory)))
        self.clear()

    def clear(self) -> None:
        self._top = self._bottom = 0

    def __len__(self) -> int:
        return self._bottom - self._top

    def take(self, embedding: NDArray[np.float32], k: int, distances: Rows | None) -> Frames | None:
        if distances is None:
            distances = self._memory.distances(embedding)
        if not np.isfinite(distances.sum()):
            return None
        frames = nearest(distances, k)
        if self._bottom == len(self._rows):
            kept = self._rows[self._bottom - self._horizon :].copy()
            self._rows[: self._horizon] = kept
            self._top, self._bottom = 0, self._horizon
        elif self._bottom - self._top > self._horizon:
            self._top += 1
        self._rows[self._bottom] = distances
        self._bottom += 1
        self._frames = frames
        return frames

    def nearest(self) -> int:
        return _nearest_of(self._frames, self._rows[self._bottom - 1][self._frames])

    def costs(self, demonstration: int, columns: int) -> Rows:
        first = self._memory.starts[demonstration]
        costs: Rows = self._rows[self._top : self._bottom, first : first + columns]
        return costs

    def last(self) -> Rows:
        row: Rows = self._rows[self._bottom - 1]
        return row


class _Near:
    """Embeddings, and rows of distances to a demonstration for as long as it is asked for."""

    def __init__(self, memory: Memory, horizon: int) -> None:
        self._memory = memory
        self._horizon = horizon
        self.clear()

    def clear(self) -> None:
        self._frames: list[NDArray[np.float32]] = []
        self._rows: dict[int, list[Rows | None]] = {}
        self._asked: set[int] = set()

    def __len__(self) -> int:
        return len(self._frames)

    def take(self, embedding: NDArray[np.float32], k: int, distances: Rows | None) -> Frames | None:
        frames, apart = self._memory.nearest(embedding, k)
        if len(frames) == 0 or not np.isfinite(apart.sum()):
            return None
        # Demonstrations that were not asked for since the last frame are not near any more
        self._rows = {demo: [*self._rows[demo], None] for demo in self._asked}
        self._asked = set()
        self._frames.append(embedding)
        if len(self._frames) > self._horizon + 1:
            del self._frames[0]
            for rows in self._rows.values():
                del rows[0]
        self._found = frames, apart
        return frames

    def nearest(self) -> int:
        return _nearest_of(*self._found)

    def costs(self, demonstration: int, columns: int) -> Rows:
        self._asked.add(demonstration)
        rows = self._rows.setdefault(demonstration, [None] * len(self._frames))
        for i, row in enumerate(rows):
            if row is None:
                rows[i] = self._memory.distances_within(self._frames[i], demonstration)
        return np.stack([row[:columns] for row in rows if row is not None])

    def last(self) -> Rows:
        raise ValueError(
            "search='faiss' looks at a part of memory only: set search='exact' for the distances "
            "to all of it"
        )


def _nearest_of(frames: NDArray[np.intp], distances: Rows) -> int:
    """Among equal ones the later."""
    return int(frames[len(frames) - 1 - distances[::-1].argmin()])
