"""tslearn's subsequence DTW as an oracle, and as the one to be faster than."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from regil_wrappers import Demonstration, Retriever
from regil_wrappers.alignment import accumulated_costs, best_end

metrics = pytest.importorskip("tslearn.metrics", reason="tslearn is not installed")


def test_costs_and_ends() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        x, y = rng.random((5, 3)), rng.random((30, 3))
        costs = ((x[:, None] - y) ** 2).sum(2)
        path, root = metrics.dtw_subsequence_path(x, y)
        end, cost = best_end(accumulated_costs(costs))
        assert cost == pytest.approx(root**2)  # tslearn gives the square root
        assert end == path[-1][1]


class Rows:
    """Picture n is row n of a walk in 384 dimensions."""

    def __init__(self, walk: np.ndarray) -> None:
        self.walk = walk

    def encode(self, frames: np.ndarray) -> np.ndarray:
        return self.walk[frames[:, 0, 0, 0]]


def test_a_step_is_four_times_faster() -> None:
    """Distances, neighbours and alignment: 150 frames, 384 dimensions, without the encoder."""
    rng = np.random.default_rng(0)
    walk = rng.normal(size=(150, 384)).cumsum(axis=0).astype(np.float32)
    walk /= np.linalg.norm(walk, axis=1, keepdims=True)
    frames = np.zeros((150, 4, 4, 3), np.uint8)
    frames[:, 0, 0, 0] = np.arange(150)
    retriever = Retriever(Demonstration(frames), Rows(walk), k=5, horizon=4)
    seen = walk + rng.normal(scale=0.01, size=walk.shape).astype(np.float32)
    # All of the demonstration is searched: the last frame is its own nearest neighbour.
    seen[-5:] = walk[-5:]

    def seconds(call: Callable[[], Any]) -> float:
        begun = time.perf_counter()
        call()
        return time.perf_counter() - begun

    metrics.dtw_subsequence_path(seen[-5:], walk)  # compile
    for row in seen:
        retriever.step_embedding(row)
    ours, theirs = [], []
    for _ in range(200):  # in turn, so that a busy machine slows both
        ours.append(seconds(lambda: retriever.step_embedding(seen[-1])))
        theirs.append(seconds(lambda: metrics.dtw_subsequence_path(seen[-5:], walk)))
    assert retriever.alignment.q_star == 149
    assert np.median(theirs) >= 4 * np.median(ours)
