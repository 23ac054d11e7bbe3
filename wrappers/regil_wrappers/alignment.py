"""Subsequence dynamic time warping and nearest neighbours, on plain arrays (ReGIL, Eq. 1-2).

* ``squared_distances`` - squared Euclidean distance of one embedding to many
* ``nearest`` - the k nearest frames, ties to the later one
* ``accumulated_costs`` - the table D of Eq. 1
* ``best_end`` - the minimum of its last row, Eq. 2
* ``warping_path`` - the path that ends there

Indices are 0-based: row ``i`` and column ``j`` here are ``i + 1`` and ``j + 1`` in the paper, whose
row 0 (all zeros: a match may start anywhere) and column 0 (infinite) are not stored.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "STEP_PATTERNS",
    "StepPattern",
    "accumulated_costs",
    "best_end",
    "nearest",
    "squared_distances",
    "warping_path",
]

StepPattern = Literal["symmetric", "strap"]

#: (rows, columns) a path may advance by, in the order in which ties are broken.
STEP_PATTERNS: dict[str, tuple[tuple[int, int], ...]] = {
    "symmetric": ((1, 1), (1, 0), (0, 1)),
    "strap": ((1, 1), (2, 1), (1, 2)),
}

# Differences are taken block by block, so that they stay in the processor's cache.
_BLOCK_BYTES = 256 * 1024
_FEW = 256  # distances that are sorted as they are


def squared_distances(x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.float64]:
    """Squared Euclidean distance of one embedding, or of each of a batch, to each of several.

    The difference is taken first, so that an embedding's distance to itself is exactly 0 (the
    expanded product gives small negatives).

    Args:
        x: (D,) float32, one embedding; or (B, D), of which each gets what it gets alone.
        y: (N, D) float32, the others.

    Returns:
        (N,) or (B, N) float64, not negative; summed in float32, so right to about 1e-6 of their
        value.

    Raises:
        ValueError: if the shapes do not fit.
    """
    if x.ndim not in (1, 2) or y.ndim != 2 or x.shape[-1] != y.shape[1]:
        raise ValueError(
            f"distances of shapes {x.shape} and {y.shape}: give (D,) or (B, D), and (N, D)"
        )
    distances = np.empty((*x.shape[:-1], len(y)))
    batch = [(x, distances)] if x.ndim == 1 else list(zip(x, distances, strict=True))
    rows = max(1, _BLOCK_BYTES // max(1, 4 * y.shape[1]))
    for first in range(0, len(y), rows):
        block = y[first : first + rows]
        for one, row in batch:
            difference = block - one
            row[first : first + rows] = np.einsum("nd,nd->n", difference, difference)
    return distances


def nearest(distances: NDArray[np.float64], k: int) -> NDArray[np.intp]:
    """The k nearest frames N_k, in ascending order of index; among equal ones the later.

    Args:
        distances: (N,) float64.
        k: how many, 1 to N.

    Returns:
        (k,) indices, ascending: the last one is q* of the paper.

    Raises:
        ValueError: if k is not in 1..N.
    """
    if not 1 <= k <= len(distances):
        raise ValueError(f"k={k} nearest of {len(distances)} frames: choose 1 to {len(distances)}")
    if len(distances) > _FEW:
        farthest = np.partition(distances, k - 1)[k - 1]
        nearer = np.flatnonzero(distances < farthest)
        ties = np.flatnonzero(distances == farthest)[len(nearer) - k :]
        return np.sort(np.concatenate([nearer, ties]))
    # A stable sort keeps equal ones in order: seen from the end, the later frame comes first.
    latest_first = np.argsort(distances[::-1], kind="stable")[:k]
    return np.sort(len(distances) - 1 - latest_first)


def accumulated_costs(
    costs: NDArray[np.float64], step_pattern: StepPattern = "symmetric"
) -> NDArray[np.float64]:
    """The table D of Eq. 1: D(i, j) = c(i, j) + min{D(i-1, j-1), D(i-1, j), D(i, j-1)}.

    Within a row, D(j) is the least of m(s) + c(s) + ... + c(j) over s <= j, where m(s) is
    min{D(i-1, s-1), D(i-1, s)}: a cumulative sum and a running minimum. To keep the recursion's
    ties every sum must be exact, so costs are first rounded to a power of two below 2**-50 (n + m)
    times the largest cost: float64 then holds every sum. 0 stays 0, whole numbers stay the same.

    Args:
        costs: (n, m) float64, c(i, j) >= 0 and finite: n recent frames against m demonstration
            frames.
        step_pattern: "symmetric" as in Eq. 1, or "strap" with D(i-2, j-1) and D(i-1, j-2) in place
            of D(i-1, j) and D(i, j-1); its paths need at least n // 2 + 1 columns.

    Returns:
        (n, m) float64; infinite where no path of "strap" ends.

    Raises:
        ValueError: if costs are empty, negative or not finite, or the step pattern is unknown.
    """
    if costs.ndim != 2 or costs.size == 0:
        raise ValueError(f"costs have shape {costs.shape}: give (n, m), neither of them 0")
    if step_pattern not in STEP_PATTERNS:
        raise ValueError(f"step_pattern={step_pattern!r}: choose one of {sorted(STEP_PATTERNS)}")
    largest = float(costs.max())
    if not (math.isfinite(largest) and costs.min() >= 0):
        raise ValueError("costs must be finite and not negative")
    if step_pattern == "strap":
        return _accumulated_strap(costs)

    exponent = math.frexp(largest)[1] + sum(costs.shape).bit_length()
    grid = math.ldexp(1.0, max(exponent - 52, -1000))
    table = np.rint(costs / grid)
    sums = np.zeros(costs.shape[1] + 1)
    for i in range(1, len(table)):
        row, above = table[i], table[i - 1]
        np.cumsum(row, out=sums[1:])
        enter = above.copy()
        np.minimum(above[1:], above[:-1], out=enter[1:])
        enter -= sums[:-1]
        np.minimum.accumulate(enter, out=enter)
        np.add(enter, sums[1:], out=row)
    table *= grid
    return table


def _accumulated_strap(costs: NDArray[np.float64]) -> NDArray[np.float64]:
    n, m = costs.shape
    table = np.full((n, m), np.inf)
    table[0] = costs[0]
    for i in range(1, n):
        before = np.full(m, np.inf)
        before[1:] = table[i - 1, :-1]
        if i >= 2:
            np.minimum(before[1:], table[i - 2, :-1], out=before[1:])
        np.minimum(before[2:], table[i - 1, :-2], out=before[2:])
        table[i] = costs[i] + before
    return table


def best_end(table: NDArray[np.float64]) -> tuple[int, float]:
    """Eq. 2: the column where the last row of D is smallest (the last such column), and D there.

    Args:
        table: (n, m) float64 from `accumulated_costs`.

    Returns:
        the 0-based column j* and the cost D(n - 1, j*), infinite if no path exists.
    """
    last = table[-1]
    end = len(last) - 1 - int(last[::-1].argmin())
    return end, float(last[end])


def warping_path(
    table: NDArray[np.float64], end: int, step_pattern: StepPattern = "symmetric"
) -> list[tuple[int, int]]:
    """The cheapest path that ends in the last row at column `end`.

    Where predecessors cost the same the first of `STEP_PATTERNS` is taken: the diagonal before all
    others.

    Args:
        table: (n, m) float64 from `accumulated_costs`, with the same step pattern.
        end: 0-based column, with a finite cost in the last row.
        step_pattern: "symmetric" or "strap".

    Returns:
        (row, column) pairs in order; the first has row 0, the last is (n - 1, end).

    Raises:
        ValueError: if no path ends there.
    """
    i, j = len(table) - 1, end
    if not math.isfinite(table[i, j]):
        raise ValueError(f"no path ends at frame {end}")
    steps = STEP_PATTERNS[step_pattern]
    path = [(i, j)]
    while i > 0:
        before = [(i - a, j - b) for a, b in steps if i >= a and j >= b]
        i, j = min(before, key=lambda cell: table.item(*cell))  # min keeps the first of equals
        path.append((i, j))
    return path[::-1]
