"""Rewards from an alignment.

* ``sdtw_reward`` - minus the cost of the alignment for each frame, Eq. 3
* ``progress_reward`` - how far along the demonstration the recent frames are, as far as they fit
* ``demonstration_tau`` - the demonstration's own scale of distances
* ``arc_length`` - the share of the demonstration's way that lies behind each frame
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from regil_wrappers.alignment import squared_distances
from regil_wrappers.retrieval import Alignment

__all__ = ["arc_length", "demonstration_tau", "progress_reward", "sdtw_reward"]


def sdtw_reward(alignment: Alignment, horizon: int | None = None) -> float:
    """Eq. 3: r = -D(H+1, j*) / divisor, in (-inf, 0]; 0 along an exact replay.

    Args:
        alignment: the current alignment.
        horizon: H, to divide by H + 1 from the first step on as the paper does; None divides by the
            frames actually in the window, the same thing once H + 1 frames have been seen.

    Returns:
        the reward, in squared units of the embedding.
    """
    divisor = alignment.window if horizon is None else horizon + 1
    return 0.0 - alignment.cost / divisor  # 0.0 - 0.0 is 0.0, where -0.0 would print as -0.0


def progress_reward(costs: NDArray[np.float64], phi: NDArray[np.float64], tau: float) -> float:
    """r = max_j phi_j exp(-C(j) / tau) - 1, in [-1, 0]: ours, past the paper.

    Standing still looks like the demonstration's beginning, where phi is 0, so it earns -1; an
    exact replay earns phi_j - 1, rising to 0.

    Args:
        costs: (m,) float64, C(j): S-DTW cost of the recent frames ending at frame j, for each
            recent frame; infinite where no path ends.
        phi: (m,) float64 in [0, 1], from `arc_length`.
        tau: from `demonstration_tau`.
    """
    return float((phi * np.exp(-costs / tau)).max()) - 1.0


def arc_length(embeddings: NDArray[np.float32]) -> NDArray[np.float64]:
    """phi_j = sum_{i<j} |y_i - y_{i+1}| / total: idle frames count for nothing.

    Args:
        embeddings: (N, D) float32, N >= 2.

    Returns:
        (N,) float64, from 0 to 1, not falling.

    Raises:
        ValueError: if all frames are the same.
    """
    ways = np.sqrt([squared_distances(y, z[None])[0] for y, z in pairwise(embeddings)])
    if not ways.sum() > 0:
        raise ValueError("the demonstration's frames are all the same: record one that moves")
    phi: NDArray[np.float64] = np.concatenate([[0.0], np.cumsum(ways)])
    phi /= phi[-1]
    return phi


def demonstration_tau(embeddings: NDArray[np.float32], gap: int = 5) -> float:
    """A demonstration's own scale: tau = sum d_i^2 / sum d_i with d_i = |y_i - y_{i+gap}|^2.

    Args:
        embeddings: (N, D) float32, N >= 2.
        gap: in frames; at most N - 1 is used.

    Returns:
        tau > 0, in squared units of the embedding.

    Raises:
        ValueError: if frames that far apart never differ.
    """
    gap = min(gap, len(embeddings) - 1)
    d = np.array(
        [
            squared_distances(y, later[None])[0]
            for y, later in zip(embeddings[:-gap], embeddings[gap:], strict=True)
        ]
    )
    if not d.sum() > 0:
        raise ValueError(
            f"the demonstration's frames are the same as those {gap} frames later, so the reward "
            f"has no scale: record one that moves"
        )
    return float((d * d).sum() / d.sum())
