"""Several demonstrations: against brute force, and against one alone."""

from __future__ import annotations

import gc
import weakref
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from regil_wrappers import (
    Demonstration,
    RetrievalGuideWrapper,
    RetrievalRewardWrapper,
    Retriever,
)
from regil_wrappers.latency import Latency
from regil_wrappers.retrieval import step_together
from toy_env import ToyReach, record


class Flat:
    """A frame's own first pixels."""

    def encode(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        return frames.reshape(len(frames), -1).astype(np.float32)


def brute_force(
    demos: list[NDArray[np.uint8]], seen: list[NDArray[np.uint8]], k: int
) -> list[tuple[int, int, float]]:
    """(demonstration, end, cost) that align the frames seen, the cheapest first."""
    vectors = [d.reshape(len(d), -1).astype(float) for d in demos]
    recent = [s.reshape(-1).astype(float) for s in seen]
    away = [(((v - recent[-1]) ** 2).sum(axis=1)) for v in vectors]
    flat = sorted(
        (float(d), -f, -i) for i, one in enumerate(away) for f, d in enumerate(one)
    )  # the nearest first
    found = []
    kth = flat[k - 1][0]
    for i, v in enumerate(vectors):
        candidates = [f for f, d in enumerate(away[i]) if d <= kth]
        if not candidates:
            continue
        q = max(candidates)
        cost = np.array([[((a - b) ** 2).sum() for b in v[: q + 1]] for a in recent])
        table = cost.copy()
        for r in range(1, len(table)):
            for j in range(len(table[0])):
                before = [table[r - 1, j]]
                if j:
                    before += [table[r - 1, j - 1], table[r, j - 1]]
                table[r, j] += min(before)
        end = int(np.flatnonzero(table[-1] == table[-1].min())[-1])
        found.append((i, end, float(table[-1, end])))
    return sorted(found, key=lambda one: one[2])


@pytest.mark.parametrize("seed", range(60))
def test_against_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frames = [rng.integers(0, 256, (n, 2, 2, 3), np.uint8) for n in rng.integers(6, 15, 4)]
    retriever = Retriever([Demonstration(f) for f in frames], Flat(), k=5, horizon=3)
    seen: list[NDArray[np.uint8]] = []
    for _ in range(8):
        seen = [*seen, rng.integers(0, 256, (2, 2, 3), np.uint8)][-4:]
        got = retriever.step(seen[-1])
        (demo, end, cost), *_ = brute_force(frames, seen, 5)
        assert (got.demonstration, got.end) == (demo, end)
        assert got.cost == pytest.approx(cost)


def test_each_is_recognised(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 256, (12, 8, 8, 3), np.uint8) for _ in range(3)]
    for i, f in enumerate(frames):
        Demonstration(f).save(tmp_path / f"{i}.hdf5")
    retriever = Retriever([Demonstration(f) for f in frames], Flat(), k=3, horizon=2)
    for i, f in enumerate(frames):
        retriever.reset()
        for j, frame in enumerate(f):
            got = retriever.step(frame)
            assert (got.demonstration, got.end, got.cost) == (i, j, 0.0)


def test_a_folder_guides_and_rewards(tmp_path: Path) -> None:
    for seed in (0, 1):
        record(seed).save(tmp_path / f"{seed}.hdf5")
    (tmp_path / "._0.hdf5").write_bytes(b"of a Macintosh")
    env = ToyReach()
    guided = RetrievalGuideWrapper(env, str(tmp_path))
    both = RetrievalRewardWrapper(guided, str(tmp_path))
    _, info = both.reset(seed=0)
    used, done = set(), False
    while not done:
        _, reward, terminated, truncated, info = both.step(guided.guide_action())
        assert float(reward) <= 0
        used.add(info["retrieval"]["demonstration"])
        done = terminated or truncated
    assert info["is_success"]
    assert used <= {0, 1}


@pytest.mark.parametrize(("encoder", "reads"), [("pixels", 1), ("pixels?whiten=2", 2)])
def test_files_are_read_one_after_the_other_and_not_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, encoder: str, reads: int
) -> None:
    for seed in range(4):
        record(seed).save(tmp_path / f"{seed}.hdf5")
    read, there = [], weakref.WeakSet[Demonstration]()
    load = Demonstration.load

    def spied(path: str) -> Demonstration:
        read.append(Path(path).stem)
        demo = load(path)
        there.add(demo)
        assert len(there) <= 3  # the first, the one before and this
        return demo

    monkeypatch.setattr(Demonstration, "load", spied)
    guided = RetrievalGuideWrapper(ToyReach(), str(tmp_path), encoder)
    both = RetrievalRewardWrapper(guided, str(tmp_path), encoder)
    both.reset(seed=0)
    assert read == ["0"] + reads * ["1", "2", "3"]
    gc.collect()
    assert len(there) == 1


def test_a_file_that_claims_too_much_is_refused_before_it_is_read(tmp_path: Path) -> None:
    for seed in range(2):
        record(seed).save(tmp_path / f"{seed}.hdf5")
    with h5py.File(tmp_path / "1.hdf5", "a") as file:
        obs = file["data/demo_0/obs"]
        shape = (10**12, *obs["agentview_image"].shape[1:])
        del obs["agentview_image"]
        obs.create_dataset("agentview_image", shape, np.uint8, chunks=(1, *shape[1:]))
    with pytest.raises(ValueError, match=r"1\.hdf5.*claims \d+ bytes"):
        RetrievalRewardWrapper(ToyReach(), str(tmp_path))


def test_an_empty_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"is a folder without \.hdf5 or \.h5 files"):
        RetrievalRewardWrapper(ToyReach(), str(tmp_path))


@pytest.mark.parametrize("deadline", [0, -1.0, True, float("nan")])
def test_a_deadline_is_a_time(deadline: float) -> None:
    demo = Demonstration(np.zeros((9, 8, 8, 3), np.uint8))
    with pytest.raises(ValueError, match=r"deadline_ms=.*positive number of milliseconds"):
        Retriever(demo, deadline_ms=deadline)


def test_steps_that_come_too_late_are_counted_and_warned_of_once() -> None:
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (9, 16, 16, 3), np.uint8)
    retriever = Retriever(Demonstration(frames), deadline_ms=1e-6)
    with pytest.warns(UserWarning, match="later steps that do are only counted"):
        retriever.step(frames[0])
    for frame in frames[1:]:
        retriever.step(frame)  # a second warning would be an error
    assert (retriever.latency.steps, retriever.latency.misses) == (9, 9)
    assert retriever.latency.percentiles()["total"]["p99"] > 0


@pytest.mark.parametrize("count", [1, 3])
def test_episodes_stepped_together_align_as_each_alone(count: int) -> None:
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 256, (12, 8, 8, 3), np.uint8) for _ in range(count)]
    alone = Retriever([Demonstration(f) for f in frames], k=4, horizon=2)
    together = [alone, alone.another(), alone.another()]
    single = [alone.another() for _ in together]
    latency = Latency()
    for _ in range(6):
        seen = list(rng.integers(0, 256, (3, 8, 8, 3), np.uint8))
        step_together(together, seen, latency)
        for a, b, frame in zip(together, single, seen, strict=True):
            assert a.alignment == b.step(frame)
            np.testing.assert_array_equal(a.distances, b.distances)
    assert latency.steps == 6
