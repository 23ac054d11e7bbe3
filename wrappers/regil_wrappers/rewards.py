"""Rewards of following a demonstration: equations on alignments, distances and embeddings.

Step by step; they depend on nothing that comes later:

* ``sdtw_reward`` - minus the cost of the alignment for each frame, Eq. 3
* ``progress_reward`` - how far along the demonstration the recent frames are, as far as they fit
* ``cos_reward`` - cosine similarity with the nearest frame
* ``orca_step``, ``orca_reward`` - ordered coverage of the demonstration's frames
* ``pwil_step``, ``pwil_reward`` - greedy transport to the demonstration's frames

At the episode's end:

* ``ot_rewards`` - optimal transport of the whole episode
* ``tot_rewards`` - the same within a band around the diagonal
* ``episode_scale`` - the factor that the first episode fixes for both

What they are made of:

* ``demonstration_tau`` - the demonstration's own scale of distances
* ``arc_length`` - the share of the demonstration's way that lies behind each frame
* ``standard_scale`` - the demonstration's own scale of each dimension
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from regil_wrappers.alignment import nearest, squared_distances
from regil_wrappers.retrieval import Alignment
from regil_wrappers.transport import band, context_costs, cosine_costs, transport_plan

__all__ = [
    "arc_length",
    "cos_reward",
    "demonstration_tau",
    "episode_scale",
    "orca_reward",
    "orca_step",
    "ot_rewards",
    "progress_reward",
    "pwil_reward",
    "pwil_step",
    "sdtw_reward",
    "standard_scale",
    "tot_rewards",
]


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


def cos_reward(
    embedding: NDArray[np.float32],
    embeddings: NDArray[np.float32],
    distances: NDArray[np.float64],
) -> float:
    """COS of ReGIL's ablation: r = cos(x, y_j), j the single nearest frame, in [-1, 1].

    Args:
        embedding: (D,) float32, x: the current frame.
        embeddings: (N, D) float32, y: the demonstration's.
        distances: (N,) float64, of the current frame to each of them; among equal ones the later
            frame is nearest.
    """
    j = nearest(distances, 1)[0]
    return 1.0 - float(cosine_costs(embedding[None], embeddings[j][None])[0, 0])


def orca_step(
    coverage: NDArray[np.float64] | None, distances: NDArray[np.float64], tau: float
) -> NDArray[np.float64]:
    """One row of ordered coverage: G_ij = max(G_{i-1,j}, G_{i,j-1} p_ij), p_ij = exp(-C_ij / tau).

    G_ij: how likely the episode has covered frames 0 to j in this order by its frame i; G_i,-1 is
    1. The last column goes without the max: the episode has to be there still. Kept as logarithms,
    since products over a long demonstration are small; by rows, a cumulative sum and a running
    maximum.

    ORCA: Huey et al., Imitation Learning from a Single Temporally Misaligned Video, ICML 2025.

    Args:
        coverage: (N,) float64, ln G of the frame before; None for an episode's first.
        distances: (N,) float64, C_i: of the current frame to each of the demonstration.
        tau: temperature, > 0, in the unit of the distances. The wrapper's is N `demonstration_tau`,
            so that a demonstration of any length, followed as far off as it moves in 5 frames,
            comes to exp(-1).

    Returns:
        (N,) float64, ln G of this frame, not rising with j.
    """
    steps = np.cumsum(distances / tau)
    best = np.zeros(len(distances))  # of G_i,-1 = 1 ..., relative to going all the way at once
    if coverage is not None:
        np.maximum(best, coverage + steps, out=best)
    np.maximum.accumulate(best, out=best)
    covered: NDArray[np.float64] = np.minimum(best - steps, 0.0)  # rounding must not pass 1
    before = covered[-2] if len(covered) > 1 else 0.0
    covered[-1] = before - distances[-1] / tau
    return covered


def orca_reward(coverage: NDArray[np.float64]) -> float:
    """r_i = G_i,N-1 in [0, 1]: the last column of `orca_step`. It is positive: it pays survival."""
    return math.exp(coverage[-1])


def standard_scale(embeddings: NDArray[np.float32]) -> NDArray[np.float32]:
    """What PWIL's distance multiplies each dimension by: 1 / (std_d sqrt(D)).

    Dimensions that never change in the demonstration have no standard deviation: they get 0, and D
    counts the others.

    Args:
        embeddings: (N, D) float32, the demonstration's.

    Returns:
        (D,) float32: |scale * (x - y)| is PWIL's standardised Euclidean distance, over sqrt(D).

    Raises:
        ValueError: if no dimension changes.
    """
    deviation = embeddings.std(axis=0, dtype=np.float64)
    moving = np.ptp(embeddings, axis=0) > 0
    if not moving.any():
        raise ValueError("the demonstration's frames are all the same: record one that moves")
    scale = np.zeros(len(deviation))
    scale[moving] = 1.0 / (deviation[moving] * math.sqrt(moving.sum()))
    return scale.astype(np.float32)


def pwil_step(
    remaining: NDArray[np.int64], distances: NDArray[np.float64], horizon: int
) -> tuple[NDArray[np.int64], float]:
    """Move one frame of the episode, 1 / T of its mass, onto the nearest mass that remains.

    Greedy transport: c_i = sum_j theta_ij d_ij, theta_ij taken from the nearest frame first (among
    equal ones from the earlier), as much as it has left of its 1 / N. Masses are whole numbers of
    1 / (N T), so that they run out exactly.

    PWIL: Dadashi et al., Primal Wasserstein Imitation Learning, ICLR 2021, algorithm 1.

    Args:
        remaining: (N,) int64, what each demonstration frame has left; T each at the start.
        distances: (N,) float64, d_i: of the current frame to each of the demonstration.
        horizon: T, frames of an episode.

    Returns:
        what remains afterwards, and c_i; infinite where less than 1 / T was left.
    """
    order = np.argsort(distances, kind="stable")
    mass = len(distances)
    left = remaining[order]
    before = np.cumsum(left) - left
    taken = np.clip(mass - before, 0, left)
    after = remaining.copy()
    after[order] -= taken
    if taken.sum() < mass:
        return after, math.inf
    return after, float(taken @ distances[order]) / (mass * horizon)


def pwil_reward(cost: float, horizon: int, alpha: float = 5.0, beta: float = 5.0) -> float:
    """r_i = alpha exp(-beta T c_i / sqrt(D)), in [0, alpha]: positive, it pays survival.

    Args:
        cost: c_i of `pwil_step`, of distances with `standard_scale`, which holds the sqrt(D).
        horizon: T, frames of an episode.
        alpha: the most a step earns.
        beta: how fast it falls.
    """
    return alpha * math.exp(-beta * horizon * cost)


def ot_rewards(
    episode: NDArray[np.float32], demonstration: NDArray[np.float32]
) -> NDArray[np.float64]:
    """r_i = -sum_j mu_ij C_ij with cosine costs and `transport_plan`; times `episode_scale`.

    C_ij = 1 - cos(x_i - m, y_j - m) with m the demonstration's mean. What all frames share, most of
    a picture, would leave costs far below the plan's entropy, and a plan that is nearly uniform.

    ROT: Haldar et al., Watch and Match: Supercharging Imitation with Regularized Optimal
    Transport, CoRL 2022.

    Args:
        episode: (T, D) float32, all frames, the first one included.
        demonstration: (N, D) float32.

    Returns:
        (T,) float64, <= 0: of each frame.
    """
    costs = _centred_costs(episode, demonstration)
    rewards: NDArray[np.float64] = 0.0 - (transport_plan(costs) * costs).sum(axis=1)
    return rewards


def tot_rewards(
    episode: NDArray[np.float32],
    demonstration: NDArray[np.float32],
    context: int = 3,
    width: float = 10.0,
) -> NDArray[np.float64]:
    """r_i = -sum_j mu_ij C_ij with `context_costs` and transport within `band`.

    Embeddings are centred as in `ot_rewards`.

    TOT: Fu et al., Robot Policy Learning with Temporal Optimal Transport Reward, NeurIPS 2024.

    Args:
        episode: (T, D) float32, all frames, the first one included.
        demonstration: (N, D) float32.
        context: frames in a group.
        width: of the band, in frames of the demonstration.

    Returns:
        (T,) float64, <= 0: of each frame; times `episode_scale`, as for `ot_rewards`.
    """
    costs = context_costs(_centred_costs(episode, demonstration), context)
    plan = transport_plan(costs, allowed=band(len(episode), len(demonstration), width))
    rewards: NDArray[np.float64] = 0.0 - (plan * costs).sum(axis=1)
    return rewards


def _centred_costs(
    episode: NDArray[np.float32], demonstration: NDArray[np.float32]
) -> NDArray[np.float64]:
    mean = demonstration.mean(axis=0, dtype=np.float64)
    return cosine_costs(episode - mean, demonstration - mean)


def episode_scale(rewards: NDArray[np.float64]) -> float:
    """ROT's s = 10 / |sum_i r_i|; the first episode's holds from then on, for itself too.

    Args:
        rewards: (T,) float64, of `ot_rewards` or `tot_rewards`.

    Returns:
        s; infinite where all rewards are 0, which then fix no scale.
    """
    total = abs(float(rewards.sum()))
    return 10.0 / total if total > 0 else math.inf


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


def demonstration_tau(
    embeddings: NDArray[np.float32] | Sequence[NDArray[np.float32]], gap: int = 5
) -> float:
    """A demonstration's own scale: tau = sum d_i^2 / sum d_i with d_i = |y_i - y_{i+gap}|^2.

    Args:
        embeddings: (N, D) float32, N >= 2; or several such, whose sums are taken together.
        gap: in frames; at most N - 1 is used.

    Returns:
        tau > 0, in squared units of the embedding.

    Raises:
        ValueError: if there is only one frame, or frames that far apart never differ.
    """
    parts = [embeddings] if isinstance(embeddings, np.ndarray) else embeddings
    if min(len(part) for part in parts) < 2:
        raise ValueError(
            "the demonstration has 1 frame, so the reward has no scale: record at least 2"
        )
    gap = min(gap, min(len(part) for part in parts) - 1)
    d = np.array(
        [
            squared_distances(y, later[None])[0]
            for part in parts
            for y, later in zip(part[:-gap], part[gap:], strict=True)
        ]
    )
    if not d.sum() > 0:
        raise ValueError(
            f"the demonstration's frames are the same as those {gap} frames later, so the reward "
            f"has no scale: record one that moves"
        )
    return float((d * d).sum() / d.sum())
