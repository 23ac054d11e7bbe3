"""Eq. 1-2 against the recursion as the paper writes it, cell by cell."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from regil_wrappers.alignment import (
    STEP_PATTERNS,
    accumulated_costs,
    best_end,
    nearest,
    squared_distances,
    warping_path,
)


def recursion(costs: np.ndarray) -> np.ndarray:
    """The (H + 2) x (q* + 2) table of Eq. 1, with its borders, 1-based."""
    n, m = costs.shape
    c = costs.tolist()
    D = [[0.0] * (m + 1)] + [[np.inf] * (m + 1) for _ in range(n)]
    for i in range(1, n + 1):
        for j in range(1, m + 1):
            D[i][j] = c[i - 1][j - 1] + min(D[i - 1][j - 1], D[i - 1][j], D[i][j - 1])
    return np.array(D)


def last_argmin(row: np.ndarray) -> int:
    return max(j for j in range(len(row)) if row[j] == row.min())


def cases(kind: str, count: int) -> list[np.ndarray]:
    """Costs of a window of 1 to 10 frames against 1 to 40 demonstration frames."""
    rng = np.random.default_rng(list(kind.encode()))
    made = []
    for _ in range(count):
        shape = (int(rng.integers(1, 11)), int(rng.integers(1, 41)))
        if kind == "real":
            costs = rng.random(shape) * 10.0 ** rng.integers(-6, 6)
        elif kind == "whole":
            costs = rng.integers(0, 4, shape).astype(float)
        elif kind == "idle":  # frames that stand still: equal columns, and real-valued ties
            costs = rng.random(shape)[:, np.sort(rng.integers(0, shape[1], shape[1]))]
        else:  # idle, with recent frames that are exactly in the demonstration
            y = rng.random((shape[1], 3)).astype(np.float32)[
                np.sort(rng.integers(0, shape[1], shape[1]))
            ]
            x = y[np.sort(rng.integers(0, shape[1], shape[0]))]
            x[: shape[0] // 2] += rng.random(3).astype(np.float32)
            costs = np.stack([squared_distances(row, y) for row in x])
        made.append(costs)
    return made


@pytest.mark.parametrize("kind", ["real", "whole", "idle", "replayed"])
def test_costs_and_ends_are_those_of_the_recursion(kind: str) -> None:
    for costs in cases(kind, 1000):
        D = recursion(costs)
        table = accumulated_costs(costs)
        np.testing.assert_allclose(table, D[1:, 1:], rtol=1e-12, atol=1e-13 * costs.max())
        end, cost = best_end(table)
        assert end == last_argmin(D[-1, 1:])
        assert cost == pytest.approx(D[-1, end + 1], rel=1e-12, abs=1e-13 * costs.max())


def test_whole_numbers_are_exact() -> None:
    for costs in cases("whole", 300):
        np.testing.assert_array_equal(accumulated_costs(costs), recursion(costs)[1:, 1:])


@pytest.mark.parametrize("kind", ["real", "whole", "idle"])
def test_the_path_costs_what_the_table_says(kind: str) -> None:
    for costs in cases(kind, 300):
        table = accumulated_costs(costs)
        end, cost = best_end(table)
        path = warping_path(table, end)
        assert path[0][0] == 0
        assert path[-1] == (len(costs) - 1, end)
        assert sum(costs[cell] for cell in path) == pytest.approx(cost, rel=1e-12)
        moves = {(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(path)}
        assert moves <= set(STEP_PATTERNS["symmetric"])


def test_ties_on_the_path_go_to_the_diagonal() -> None:
    costs = np.zeros((4, 6))
    assert warping_path(accumulated_costs(costs), 5) == [(0, 2), (1, 3), (2, 4), (3, 5)]


def strap_recursion(costs: np.ndarray) -> np.ndarray:
    n, m = costs.shape
    D = np.full((n, m), np.inf)
    for i in range(n):
        for j in range(m):
            before = [0.0] if i == 0 else []
            for a, b in ((1, 1), (2, 1), (1, 2)):
                if i - a >= 0 and j - b >= 0:
                    before.append(D[i - a, j - b])
            D[i, j] = costs[i, j] + min(before, default=np.inf)
    return D


@pytest.mark.parametrize("kind", ["real", "whole", "idle"])
def test_strap_steps(kind: str) -> None:
    for costs in cases(kind, 300):
        table = accumulated_costs(costs, "strap")
        np.testing.assert_array_equal(table, strap_recursion(costs))
        n, m = costs.shape
        # With n // 2 + 1 columns there is always a path, with fewer never.
        assert np.isfinite(best_end(table)[1]) == (m >= n // 2 + 1)
        if m >= n // 2 + 1:
            end, _ = best_end(table)
            path = warping_path(table, end, "strap")
            assert (path[0][0], path[-1]) == (0, (n - 1, end))
            moves = {(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(path)}
            assert moves <= set(STEP_PATTERNS["strap"])


@settings(max_examples=100, deadline=None)
@given(
    arrays(np.float64, st.tuples(st.integers(1, 6), st.integers(1, 12)), elements=st.floats(0, 9))
)
def test_any_costs(costs: np.ndarray) -> None:
    table = accumulated_costs(costs)
    assert (table >= 0).all()
    assert best_end(table)[0] <= costs.shape[1] - 1
    np.testing.assert_allclose(table, recursion(costs)[1:, 1:], rtol=1e-12, atol=1e-12)


def test_a_large_cost_elsewhere_leaves_small_ones_in_order() -> None:
    costs = np.array([[1e6, 0.3, 0.1, 1e6], [1e6, 1e6, 0.2, 0.1 + 1e-9]])
    table = accumulated_costs(costs)
    assert best_end(table)[0] == 3
    assert table[1, 3] == pytest.approx(0.2 + 1e-9, rel=1e-8)


@pytest.mark.parametrize(
    ("costs", "message"),
    [
        (np.empty((0, 3)), "neither of them 0"),
        (np.array([[1.0, np.nan]]), "finite"),
        (np.array([[1.0, np.inf]]), "finite"),
        (np.array([[1.0, -1.0]]), "negative"),
    ],
)
def test_bad_costs(costs: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        accumulated_costs(costs)


def test_unknown_step_pattern() -> None:
    with pytest.raises(ValueError, match=r"'wild'.*'strap', 'symmetric'"):
        accumulated_costs(np.zeros((2, 2)), "wild")  # type: ignore[arg-type]


def test_no_path_of_strap() -> None:
    with pytest.raises(ValueError, match="no path ends at frame 0"):
        warping_path(accumulated_costs(np.zeros((4, 2)), "strap"), 0, "strap")


def test_distances() -> None:
    rng = np.random.default_rng(1)
    y = rng.normal(size=(60, 2352)).astype(np.float32)
    d = squared_distances(y[7], y)
    assert d[7] == 0
    wanted = ((y.astype(float) - y[7].astype(float)) ** 2).sum(1)
    np.testing.assert_allclose(d, wanted, rtol=1e-5)
    assert d.dtype == np.float64
    with pytest.raises(ValueError, match="shapes"):
        squared_distances(y[7, :5], y)


def test_distances_of_near_twins_are_not_negative() -> None:
    y = np.full((3, 500), 1000, np.float32)
    x = np.nextafter(y[0], np.float32(2000))
    assert (squared_distances(x, y) > 0).all()


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, 4), min_size=1, max_size=30), st.data())
def test_nearest(values: list[int], data: st.DataObject) -> None:
    k = data.draw(st.integers(1, len(values)))
    wanted = sorted(sorted(range(len(values)), key=lambda i: (values[i], -i))[:k])
    assert nearest(np.array(values, float), k).tolist() == wanted


@pytest.mark.parametrize("k", [0, 4])
def test_nearest_k_out_of_range(k: int) -> None:
    with pytest.raises(ValueError, match=f"k={k}"):
        nearest(np.zeros(3), k)
