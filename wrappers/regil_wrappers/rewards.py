"""Rewards from an alignment.

* ``sdtw_reward`` - minus the cost of the alignment for each frame, Eq. 3
* ``demonstration_tau`` - the demonstration's own scale of distances
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from regil_wrappers.alignment import squared_distances
from regil_wrappers.retrieval import Alignment

__all__ = ["demonstration_tau", "sdtw_reward"]


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
