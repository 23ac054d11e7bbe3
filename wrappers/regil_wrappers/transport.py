"""Entropic optimal transport between two trajectories, on plain arrays.

* ``cosine_costs`` - one minus the cosine of each pair of embeddings
* ``context_costs`` - the same of groups of successive frames
* ``band`` - which pairs lie near the diagonal
* ``transport_plan`` - Sinkhorn's algorithm
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["band", "context_costs", "cosine_costs", "transport_plan"]


def cosine_costs(x: NDArray[np.floating], y: NDArray[np.floating]) -> NDArray[np.float64]:
    """C_ij = 1 - cos(x_i, y_j), in [0, 2]; 1 where either is zero.

    Args:
        x: (T, D) float, an episode.
        y: (N, D) float, a demonstration.

    Returns:
        (T, N) float64.
    """
    u, v = (
        z / np.maximum(np.linalg.norm(z, axis=1, keepdims=True), 1e-30)
        for z in (x.astype(np.float64), y.astype(np.float64))
    )
    costs: NDArray[np.float64] = np.clip(1.0 - u @ v.T, 0.0, 2.0)
    return costs


def context_costs(costs: NDArray[np.float64], context: int = 3) -> NDArray[np.float64]:
    """TOT's cost of a group: the mean of C_{i+h, j+h} over 0 <= h < context.

    Beyond the last frame of either, the last is repeated.

    Args:
        costs: (T, N) float64.
        context: frames in a group: the current one and those that follow.

    Returns:
        (T, N) float64.
    """
    t, n = costs.shape
    mean = np.zeros_like(costs)
    for h in range(context):
        rows, columns = (np.minimum(np.arange(size) + h, size - 1) for size in (t, n))
        mean += costs[np.ix_(rows, columns)]
    return mean / context


def band(steps: int, frames: int, width: float = 10.0) -> NDArray[np.bool_]:
    """TOT's mask: which pairs may be matched, |i N / T - j| <= width.

    The paper's |i - j| leaves rows without a match when the episode is longer than the
    demonstration. Where it is much shorter, columns would be left: the band is at least N / T wide,
    and at least 1.

    Args:
        steps: T, frames of the episode.
        frames: N, frames of the demonstration.
        width: in frames of the demonstration.

    Returns:
        (T, N) bool.
    """
    i, j = np.arange(steps)[:, None], np.arange(frames)
    near: NDArray[np.bool_] = np.abs(i * frames - j * steps) <= max(width * steps, frames, steps)
    return near


def transport_plan(
    costs: NDArray[np.float64],
    entropy: float = 0.01,
    iterations: int = 100,
    allowed: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64]:
    """Entropic optimal transport between uniform marginals, by Sinkhorn's algorithm.

    mu_ij = exp(f_i + g_j - C_ij / entropy), where by turns g makes the columns sum to 1 / N and f
    the rows to 1 / T, always as logarithms (Cuturi, 2013; Peyre and Cuturi, 2019, section 4.4).
    Rows are exact at the end, columns as far as it has converged.

    Args:
        costs: (T, N) float64, finite.
        entropy: in the unit of the costs.
        iterations: how often both take their turn.
        allowed: (T, N) bool, pairs that may be matched, at least one in each row and column; None
            is all.

    Returns:
        (T, N) float64, mu.
    """
    kernel = -costs / entropy
    if allowed is not None:
        kernel = np.where(allowed, kernel, -np.inf)
    t, n = costs.shape
    f = np.zeros((t, 1))
    g = np.zeros((1, n))
    for _ in range(iterations):
        g = -math.log(n) - _log_sum_exp(kernel + f, axis=0)
        f = -math.log(t) - _log_sum_exp(kernel + g, axis=1)
    plan: NDArray[np.float64] = np.exp(kernel + f + g)
    return plan


def _log_sum_exp(x: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    largest = x.max(axis=axis, keepdims=True)
    result: NDArray[np.float64] = np.log(np.exp(x - largest).sum(axis=axis, keepdims=True))
    result += largest
    return result
