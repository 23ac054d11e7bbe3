"""Search with Faiss: the same alignments as the exact one where demonstrations are far apart."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from regil_wrappers import Demonstration, Retriever, memory
from regil_wrappers.latency import Latency
from regil_wrappers.retrieval import step_together

pytest.importorskip("faiss", reason="faiss-cpu is not installed")


class Table:
    """Picture n is row n."""

    def __init__(self, rows: NDArray[np.float32]) -> None:
        self.rows = rows

    def encode(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        numbers = frames.reshape(len(frames), 3).astype(int) @ (1, 256, 65536)
        rows: NDArray[np.float32] = self.rows[numbers]
        return rows


def numbered(first: int, count: int) -> Demonstration:
    numbers = np.arange(first, first + count)
    frames = np.stack([numbers & 255, numbers >> 8 & 255, numbers >> 16], axis=1)
    return Demonstration(frames.astype(np.uint8).reshape(count, 1, 1, 3))


def walks(count: int, length: int, dims: int = 16) -> NDArray[np.float32]:
    """Smooth ways, far from each other."""
    rng = np.random.default_rng(0)
    steps = rng.normal(size=(count, length, dims))
    steps[:, 0] *= 200
    return steps.cumsum(axis=1).reshape(-1, dims).astype(np.float32)


COUNT, LENGTH = 20, 300  # 77 cells, of which 16 are looked into


@pytest.fixture(scope="module")
def both() -> tuple[Retriever, Retriever, NDArray[np.float32]]:
    rows = walks(COUNT, LENGTH)
    rows[LENGTH : LENGTH + 4] = rows[LENGTH + 4]  # idle at its beginning: equal frames
    demos = [numbered(i * LENGTH, LENGTH) for i in range(COUNT)]
    exact, near = (Retriever(demos, Table(rows), search=s) for s in ("exact", "faiss"))
    return exact, near, rows


def test_alignments_are_those_of_the_exact_search(
    both: tuple[Retriever, Retriever, NDArray[np.float32]],
) -> None:
    exact, near, rows = both
    assert exact.memory.exact
    assert not near.memory.exact
    noise = np.random.default_rng(1).normal(scale=0.3, size=rows.shape).astype(np.float32)
    episode = rows + noise
    used = set()
    for first in range(0, len(rows), LENGTH):
        exact.reset()
        near.reset()
        for row in episode[first : first + 20]:
            want, got = exact.step_embedding(row), near.step_embedding(row)
            assert got == replace(want, cost=got.cost)
            assert got.cost == pytest.approx(want.cost, rel=1e-6)
            assert near.nearest == exact.nearest
            assert near.near == exact.near
            np.testing.assert_allclose(near.end_costs(), exact.end_costs(), rtol=1e-6)
            used.add(got.demonstration)
    assert used == set(range(COUNT))


def test_the_candidates_follow_when_the_episode_jumps(
    both: tuple[Retriever, Retriever, NDArray[np.float32]],
) -> None:
    """Rows of distances that were not needed while another demonstration was near are made up."""
    exact, near, rows = both
    exact.reset()
    near.reset()
    jumps = np.random.default_rng(2).integers(0, len(rows), 60)
    for row in rows[np.repeat(jumps, 2)]:
        want, got = exact.step_embedding(row), near.step_embedding(row)
        assert got == replace(want, cost=got.cost)
        assert got.cost == pytest.approx(want.cost, rel=1e-6)


def test_episodes_stepped_together_are_each_alone(
    both: tuple[Retriever, Retriever, NDArray[np.float32]],
) -> None:
    _, near, _ = both
    together, alone = ([near.another() for _ in range(3)] for _ in range(2))
    latency = Latency()
    for step in range(6):
        frames = [numbered(700 * i + step, 1).frames[0] for i in range(3)]
        step_together(together, frames, latency)
        for a, b, frame in zip(together, alone, frames, strict=True):
            assert a.alignment == b.step(frame)
    assert latency.steps == 6


class OneRow(Table):
    """Gives the same array each time."""

    def encode(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        if not hasattr(self, "row"):
            self.row = np.empty((1, self.rows.shape[1]), np.float32)
        self.row[:] = super().encode(frames)
        return self.row


def test_an_encoder_that_uses_its_array_again(
    both: tuple[Retriever, Retriever, NDArray[np.float32]],
) -> None:
    _, near, rows = both
    usual, reused = near.another(), near.another()
    reused.encoder = OneRow(rows)
    for start in (3 * LENGTH, 7 * LENGTH):  # from one demonstration to another
        for frame in numbered(start + 20, 6).frames:
            assert reused.step(frame) == usual.step(frame)


def test_distances_to_all_frames_are_not_known(
    both: tuple[Retriever, Retriever, NDArray[np.float32]],
) -> None:
    _, near, rows = both
    near.step_embedding(rows[0])
    with pytest.raises(ValueError, match=r"looks at a part of memory only: set search='exact'"):
        _ = near.distances


def test_auto_is_faiss_for_many_frames_of_several(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "EXACT_FRAMES", 99)
    rows = walks(2, 50)
    first, second = numbered(0, 50), numbered(50, 50)
    assert not Retriever([first, second], Table(rows)).memory.exact
    assert Retriever([first, numbered(50, 49)], Table(rows)).memory.exact
    assert Retriever(numbered(0, 100), Table(rows)).memory.exact  # one: as ever


def test_without_faiss(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "EXACT_FRAMES", 99)
    monkeypatch.setattr(memory, "find_spec", lambda _: None)
    monkeypatch.setitem(sys.modules, "faiss", None)
    demos = [numbered(0, 50), numbered(50, 50)]
    with pytest.warns(UserWarning, match=r"pip install 'regil-wrappers\[faiss\]'"):
        assert Retriever(demos, Table(walks(2, 50))).memory.exact
    with pytest.raises(ImportError, match=r"^search='faiss' needs faiss .*wrappers\[faiss\]'$"):
        Retriever(demos, Table(walks(2, 50)), search="faiss")
