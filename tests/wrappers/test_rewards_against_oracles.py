"""Each reward against another way to compute it, on at least 1,000 random cases."""

from __future__ import annotations

import math
from collections.abc import Iterator
from fractions import Fraction

import numpy as np
import ot
import pytest
from regil_wrappers import rewards
from regil_wrappers.alignment import squared_distances
from regil_wrappers.transport import band, context_costs, cosine_costs, transport_plan

CASES = 1_000


def pair(rng: np.random.Generator, t: int, n: int, dims: int) -> tuple[np.ndarray, np.ndarray]:
    """An episode (t, dims) and a demonstration (n, dims): random walks that may share frames."""
    demonstration = rng.normal(size=(n, dims)).cumsum(axis=0)
    episode = rng.normal(size=(t, dims)).cumsum(axis=0)
    shared = min(t, n) * rng.integers(0, 2)
    episode[:shared] = demonstration[:shared]
    if rng.integers(0, 2):  # equal frames, and zeros
        episode, demonstration = np.round(episode), np.round(demonstration)
    return episode.astype(np.float32), demonstration.astype(np.float32)


def trajectories() -> Iterator[tuple[np.random.Generator, np.ndarray, np.ndarray]]:
    for seed in range(CASES):
        rng = np.random.default_rng(seed)
        yield rng, *pair(rng, *rng.integers(1, 16, 2), rng.integers(1, 6))


def cosine(x: np.ndarray, y: np.ndarray) -> float:
    norms = math.hypot(*x.tolist()) * math.hypot(*y.tolist())
    return sum(a * b for a, b in zip(x.tolist(), y.tolist(), strict=True)) / norms if norms else 0.0


def test_cos() -> None:
    for _, episode, demo in trajectories():
        x = episode[-1]
        distances = squared_distances(x, demo)
        nearest = max(range(len(demo)), key=lambda j: (-distances[j], j))
        assert rewards.cos_reward(x, demo, distances) == pytest.approx(
            cosine(x, demo[nearest]), abs=1e-12
        )


def test_orca() -> None:
    for rng, episode, demo in trajectories():
        tau = float(rng.uniform(0.5, 20))
        n = len(demo)
        covered, rows, expected = None, [], []
        before = [0.0] * n
        for x in episode:
            distances = squared_distances(x, demo)
            covered = rewards.orca_step(covered, distances, tau)
            now: list[float] = []
            for j in range(n):
                onward = (now[j - 1] if j else 1.0) * math.exp(-distances[j] / tau)
                now.append(onward if j == n - 1 else max(before[j], onward))
            before = now
            rows.append([*np.exp(covered), rewards.orca_reward(covered)])
            expected.append([*now, now[-1]])
        np.testing.assert_allclose(rows, expected, rtol=1e-9, atol=1e-300)


def test_pwil() -> None:
    alpha, beta = 5.0, 5.0
    for rng, episode, demo in trajectories():
        if not np.ptp(demo, axis=0).any():
            continue
        n, horizon = len(demo), int(rng.integers(1, 20))
        scale = rewards.standard_scale(demo)
        deviation = demo.astype(np.float64).std(axis=0)
        moving = [d for d in range(demo.shape[1]) if np.ptp(demo[:, d]) > 0]
        np.testing.assert_allclose(
            scale[moving], 1 / (deviation[moving] * math.sqrt(len(moving))), rtol=1e-6
        )
        assert np.count_nonzero(scale) == len(moving)

        remaining = np.full(n, horizon)
        atoms = {j: Fraction(1, n) for j in range(n)}
        for x in episode:
            distances = np.sqrt(squared_distances(x * scale, demo * scale))
            remaining, cost = rewards.pwil_step(remaining, distances, horizon)
            weight, expected = Fraction(1, horizon), 0.0
            while weight > 0 and atoms:
                j = min(atoms, key=lambda j: (distances[j], j))
                moved = min(weight, atoms[j])
                expected += float(moved) * distances[j]
                weight -= moved
                atoms[j] -= moved
                if not atoms[j]:
                    del atoms[j]
            if weight > 0:
                assert rewards.pwil_reward(cost, horizon) == 0
            else:
                assert cost == pytest.approx(expected, rel=1e-12, abs=1e-15)
                reward = alpha * math.exp(-beta * horizon * expected)
                assert rewards.pwil_reward(cost, horizon) == pytest.approx(reward, rel=1e-9)
        assert remaining.tolist() == [atoms.get(j, 0) * n * horizon for j in range(n)]


def same_shapes() -> Iterator[tuple[np.random.Generator, list[tuple[np.ndarray, np.ndarray]]]]:
    """Cases 40 at a time, which POT solves at once."""
    for seed in range(CASES // 40):
        rng = np.random.default_rng(seed)
        t, n, dims = *rng.integers(1, 24, 2), rng.integers(1, 6)
        yield rng, [pair(rng, t, n, dims) for _ in range(40)]


def pot(costs: np.ndarray) -> np.ndarray:
    """POT's plans, for costs (B, t, n). Its batches begin with rows and ours with columns."""
    log_kernel = np.swapaxes(-costs / 0.01, 1, 2)
    solved = ot.batch.bregman_log_projection_batch(log_kernel, max_iter=100, tol=0)
    return np.swapaxes(solved["T"], 1, 2)


def centred(episode: np.ndarray, demo: np.ndarray) -> np.ndarray:
    mean = demo.astype(np.float64).mean(axis=0)
    return np.array([[1 - cosine(x, y) for y in demo - mean] for x in episode - mean])


def test_ot_against_pot() -> None:
    for _, pairs in same_shapes():
        costs = np.stack([centred(*both) for both in pairs])
        plans = pot(costs)
        ours = [rewards.ot_rewards(*both) for both in pairs]
        np.testing.assert_allclose(ours, -(plans * costs).sum(axis=2), atol=1e-6)


def test_ot_against_pot_one_by_one() -> None:
    for rng, pairs in list(same_shapes())[:10]:
        costs = cosine_costs(*pairs[0]) * rng.choice([1, 50])
        t, n = costs.shape
        plan = ot.sinkhorn(
            np.full(t, 1 / t),
            np.full(n, 1 / n),
            costs,
            0.01,
            method="sinkhorn_log",
            numItermax=100,
            stopThr=0,
            warn=False,
        )
        np.testing.assert_allclose(transport_plan(costs), plan, atol=1e-6)


def test_cosine_costs() -> None:
    for _, episode, demo in trajectories():
        expected = [[1 - cosine(x, y) for y in demo] for x in episode]
        np.testing.assert_allclose(cosine_costs(episode, demo), expected, atol=1e-12)


def test_tot_against_pot() -> None:
    for rng, pairs in same_shapes():
        context, width = int(rng.integers(1, 5)), float(rng.integers(0, 6))
        (t, _), (n, _) = pairs[0][0].shape, pairs[0][1].shape
        single = np.stack([centred(*both) for both in pairs])
        costs = np.zeros((len(pairs), t, n))
        forbidden = np.ones((t, n), bool)
        for i in range(t):
            for j in range(n):
                for h in range(context):
                    costs[:, i, j] += single[:, min(i + h, t - 1), min(j + h, n - 1)] / context
                forbidden[i, j] = abs(Fraction(int(i * n), int(t)) - j) > max(
                    width, Fraction(int(n), int(t)), 1
                )
        ours = [context_costs(c, context) for c in single]
        np.testing.assert_allclose(ours, costs, atol=1e-12)
        np.testing.assert_array_equal(band(t, n, width), ~forbidden)
        plans = pot(np.where(forbidden, 1e9, costs))
        ours = [rewards.tot_rewards(*both, context, width) for both in pairs]
        np.testing.assert_allclose(ours, -(plans * costs).sum(axis=2), atol=1e-6)


@pytest.mark.parametrize(("t", "n"), [(1, 1), (1, 200), (200, 1), (5, 150), (150, 5), (125, 33)])
def test_every_frame_within_the_band_has_a_match(t: int, n: int) -> None:
    allowed = band(t, n)
    assert allowed.any(axis=0).all()
    assert allowed.any(axis=1).all()
    plan = transport_plan(np.zeros((t, n)), iterations=2_000, allowed=allowed)
    np.testing.assert_allclose(plan.sum(axis=1), 1 / t, rtol=1e-9)
    np.testing.assert_allclose(plan.sum(axis=0), 1 / n, rtol=0.02)
