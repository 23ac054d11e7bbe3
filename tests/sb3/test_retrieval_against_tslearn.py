"""tslearn's subsequence DTW as an oracle; `regil bench retrieval` measures who is faster."""

from __future__ import annotations

import numpy as np
import pytest
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
