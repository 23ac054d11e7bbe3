"""`regil bench memory`, `regil bench index`: what a step costs as memory grows.

Embeddings are synthetic, of demonstrations of one task that differ: each hand goes by way points of
its own to a goal of its own, and a picture is a smooth function of where both are. Demonstrations
have 1,000 frames. Episodes are demonstrations that memory does not hold.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import psutil
from numpy.typing import NDArray
from regil_wrappers import Demonstration, Retriever
from regil_wrappers.alignment import nearest
from regil_wrappers.limits import need
from regil_wrappers.memory import Search

from regil_sb3 import process
from regil_sb3.bench import machine

__all__ = ["DIMS", "FRAMES", "Row", "draw", "growth", "indexes", "main", "measure"]

FRAMES = (1_000, 10_000, 100_000, 1_000_000)
DIMS = 384
"""Of a DINOv3 or DINOv2 ViT-S."""
LENGTH = 1_000
"""Frames of a demonstration."""
SEARCHES: tuple[Search, ...] = ("exact", "faiss")

_K, _HORIZON = 5, 4
_EPISODES, _STEPS = 10, 20
_UNSEEN = 16_000  # number of the first demonstration that is not in memory
_LATENT = 12  # six numbers that say where the hand is, six where the goal is
_PACKAGES = ("numpy", "faiss-cpu")

Vectors = NDArray[np.float32]


class Pictures:
    """Stands in for an encoder: picture n is frame n % 1000 of demonstration n // 1000.

    Args:
        dims: D of the embeddings.
    """

    def __init__(self, dims: int) -> None:
        rng = np.random.default_rng(0)
        self._dims = dims
        self._directions = rng.normal(size=(_LATENT, dims))
        self._phases = rng.uniform(0, 2 * np.pi, dims)
        self._way = rng.uniform(size=(6, 6)).cumsum(axis=0) / 2  # all hands', but for details
        self.demonstration = lru_cache(maxsize=2)(self._demonstration)

    def _demonstration(self, number: int) -> Vectors:
        """(1000, D) of length 1."""
        rng = np.random.default_rng([1, number])
        way = self._way + 0.3 * rng.normal(size=self._way.shape)
        when = np.linspace(0, len(way) - 1, LENGTH)
        hand = [np.interp(when, np.arange(len(way)), column) for column in way.T]
        goal = np.repeat(rng.uniform(-0.5, 0.5, (_LATENT - len(hand), 1)), LENGTH, axis=1)
        latent = np.concatenate([hand, goal]).T + 0.01 * rng.normal(size=(LENGTH, _LATENT))
        pictures = np.cos(latent @ self._directions + self._phases)
        pictures += 0.02 * rng.normal(size=pictures.shape)
        pictures /= np.linalg.norm(pictures, axis=1, keepdims=True)
        rows: Vectors = pictures.astype(np.float32)
        return rows

    def encode(self, frames: NDArray[np.uint8]) -> Vectors:
        """(B, 1, 1, 3) uint8, a number in three bytes each, to (B, D)."""
        numbers = frames.reshape(len(frames), 3).astype(np.int64) @ (1, 256, 65536)
        return np.stack([self.demonstration(n // LENGTH)[n % LENGTH] for n in numbers.tolist()])


def _numbered(demonstration: int, frames: int) -> Demonstration:
    numbers = demonstration * LENGTH + np.arange(frames)
    digits = np.stack([numbers & 255, numbers >> 8 & 255, numbers >> 16], axis=1)
    return Demonstration(digits.astype(np.uint8).reshape(frames, 1, 1, 3))


@dataclass(frozen=True)
class Row:
    """One size of memory, one way to search it.

    Attributes:
        frames: in memory.
        demonstrations: that they are of.
        search: "exact" or "faiss".
        step: median ms of a step without its encoder.
        p99: the 99th percentile of it.
        found: median ms of its search.
        aligned: median ms of its S-DTW.
        recall: share of the k exact candidates that are found, in the mean.
        same: share of steps with the same demonstration and end as the exact search's.
        megabytes: of 10^6 bytes, that the process grew by when the memory was made.
        seconds: that making it took, synthetic embeddings included.
    """

    frames: int
    demonstrations: int
    search: str
    step: float
    p99: float
    found: float
    aligned: float
    recall: float
    same: float
    megabytes: float
    seconds: float


def measure(frames: int, dims: int = DIMS) -> list[Row]:
    """One size: both searches see the same episodes, in turns.

    Args:
        frames: in memory.
        dims: of the embeddings.
    """
    pictures = Pictures(dims)
    whole, rest = divmod(frames, LENGTH)
    demos = [_numbered(i, LENGTH) for i in range(whole)]
    demos += [_numbered(whole, rest)] if rest else []
    retrievers, megabytes, seconds = {}, {}, {}
    for search in SEARCHES:
        gc.collect()
        before, begun = psutil.Process().memory_info().rss, perf_counter()
        retrievers[search] = Retriever(demos, pictures, _K, _HORIZON, search=search)
        seconds[search] = perf_counter() - begun
        gc.collect()
        megabytes[search] = max(0, psutil.Process().memory_info().rss - before) / 1e6

    times: dict[Search, list[float]] = {search: [] for search in SEARCHES}
    ends: dict[Search, list[tuple[int, int]]] = {search: [] for search in SEARCHES}
    shared = []
    for episode in _episodes(pictures):
        wanted = []
        for search, retriever in retrievers.items():
            retriever.reset()
            for vector in episode:
                begun = perf_counter()
                alignment = retriever.step_embedding(vector)
                times[search].append(perf_counter() - begun)
                ends[search].append((alignment.demonstration, alignment.end))
                if search == "exact":
                    wanted.append(nearest(retriever.distances, _K))
        for vector, right in zip(episode, wanted, strict=True):
            found, _ = retrievers["faiss"].memory.nearest(vector, _K)
            shared.append(len(set(right.tolist()) & set(found.tolist())) / _K)
    same = np.mean([a == b for a, b in zip(*ends.values(), strict=True)])
    rows = []
    for search, retriever in retrievers.items():
        parts = retriever.latency.percentiles()
        is_exact = search == "exact"
        rows.append(
            Row(
                frames,
                len(demos),
                search,
                1e3 * float(np.median(times[search])),
                1e3 * float(np.percentile(times[search], 99)),
                parts["search"]["p50"],
                parts["alignment"]["p50"],
                1.0 if is_exact else float(np.mean(shared)),
                1.0 if is_exact else float(same),
                megabytes[search],
                seconds[search],
            )
        )
    return rows


def _episodes(pictures: Pictures) -> Iterator[Vectors]:
    """Short ones, from all over a demonstration."""
    for i in range(_EPISODES):
        first = i * (LENGTH - _STEPS) // max(1, _EPISODES - 1)
        yield pictures.demonstration(_UNSEEN + i)[first : first + _STEPS]


def growth(rows: Sequence[Row], search: str) -> tuple[float, float]:
    """How fast a step's cost grows: b of cost ~ frames^b, over all sizes and over the last two.

    b is 1 where the cost grows as memory does.

    Args:
        rows: of at least two sizes.
        search: whose.
    """
    own = [row for row in rows if row.search == search]
    x, y = np.log([row.frames for row in own]), np.log([row.step for row in own])
    fitted = float(np.polyfit(x, y, 1)[0])
    return fitted, float((y[-1] - y[-2]) / (x[-1] - x[-2]))


def _check(frames: Sequence[int], dims: int) -> None:
    if dims < 1:
        raise ValueError(f"--dims {dims}: at least 1 is needed")
    for size in frames:
        if not 10 * _K <= size <= _UNSEEN * LENGTH:
            raise ValueError(f"--frames {size}: choose {10 * _K} to {_UNSEEN * LENGTH}")
        if 0 < size % LENGTH <= _HORIZON:
            raise ValueError(f"--frames {size}: choose thousands, or {_HORIZON + 1} more at least")
    # Embeddings twice (exact, faiss), the index's copy, and what joining takes; half a KB a frame
    # for numbers and digests.
    needed, free = max(frames) * (16 * dims + 512), psutil.virtual_memory().available
    if needed > free:
        raise ValueError(
            f"--frames {max(frames)} of {dims} dimensions need {needed / 1e9:.1f} GB and "
            f"{free / 1e9:.1f} are free: choose fewer frames, or --dims"
        )


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw a step's cost against the number of frames, as a picture file."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axis = plt.subplots(figsize=(6.4, 4), layout="constrained")
    for search, colour in zip(SEARCHES, ("#1f5fa8", "#d1495b"), strict=True):
        own = [row for row in rows if row.search == search]
        label = f"{search}, frames^{growth(rows, search)[0]:.2f}"
        axis.loglog([r.frames for r in own], [r.step for r in own], "o-", color=colour, label=label)
    sizes = sorted({row.frames for row in rows})
    exact = [row.step for row in rows if row.search == "exact"]
    axis.loglog(
        sizes,
        [exact[-1] * size / sizes[-1] for size in sizes],
        ":",
        color="0.6",
        label="as memory does, frames^1",
    )
    axis.axhline(1000 / 30, color="0.8", linewidth=0.8)
    axis.annotate("30 Hz", (sizes[0], 1000 / 30), color="0.5", fontsize=8, va="bottom")
    axis.set_xlabel(f"frames in memory (demonstrations of {LENGTH:,} frames)")
    axis.set_ylabel("ms a step, without its encoder")
    axis.legend(fontsize=8)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def indexes(frames: int, dims: int = DIMS) -> Iterator[tuple[str, float, float, float]]:
    """Faiss's kinds of index on the same embeddings: (kind, seconds to make, ms, recall).

    Args:
        frames: in memory.
        dims: of the embeddings.

    Raises:
        ImportError: if Faiss is not installed.
    """
    faiss = need("faiss", "faiss", "regil bench index")
    pictures = Pictures(dims)
    bounds = [*range(0, frames, LENGTH), frames]
    memory = np.concatenate(
        [pictures.demonstration(a // LENGTH)[: b - a] for a, b in pairwise(bounds)]
    )
    asked = np.concatenate(list(_episodes(pictures)))
    flat = faiss.IndexFlatL2(dims)
    flat.add(memory)
    wanted = flat.search(asked, _K)[1]
    root = int(frames**0.5)

    def tried(index: Any) -> tuple[float, float]:
        times, shares = [], []
        for vector, right in zip(asked, wanted, strict=True):
            begun = perf_counter()
            found = index.search(vector[None], _K)[1][0]
            times.append(perf_counter() - begun)
            shares.append(len(set(right.tolist()) & set(found.tolist())) / _K)
        return 1e3 * float(np.median(times)), float(np.mean(shares))

    yield "flat (exact)", 0.0, *tried(flat)
    for cells in sorted({max(1, min(n, frames // 39)) for n in (root, 4 * root)}):
        begun = perf_counter()
        index = faiss.IndexIVFFlat(faiss.IndexFlatL2(dims), dims, cells)
        index.cp.max_points_per_centroid, index.cp.niter = 64, 10
        index.train(memory)
        index.add(memory)
        seconds = perf_counter() - begun
        for probed in (4, 8, 16, 32, 64):
            index.nprobe = probed
            yield f"inverted file, {probed} of {cells} cells", seconds, *tried(index)
    begun = perf_counter()
    index = faiss.IndexHNSWFlat(dims, 16)
    index.hnsw.efConstruction = 64
    index.add(memory)
    seconds = perf_counter() - begun
    for kept in (16, 32, 64, 128):
        index.hnsw.efSearch = kept
        yield f"HNSW, 16 links, efSearch {kept}", seconds, *tried(index)


def main(
    table: str, frames: Sequence[int] | None = None, dims: int = DIMS, plot: str | None = None
) -> None:
    """Measure and print, line by line.

    Args:
        table: "memory" or "index".
        frames: sizes of memory; None: 1,000 to 1,000,000, for "index" 100,000.
        dims: of the embeddings.
        plot: file for the picture of "memory"; None: none.

    Raises:
        ValueError: if this machine's memory does not suffice, or there is nothing to plot.
        ImportError: if Faiss is not installed.
    """
    process.set_threads()
    need("faiss", "faiss", f"regil bench {table}")
    sizes = sorted(set(frames or (FRAMES if table == "memory" else (100_000,))))
    _check(sizes, dims)
    if table == "index":
        _print_indexes(sizes, dims)
    else:
        if plot is not None and len(sizes) < 2:
            raise ValueError(f"--plot {plot}: name at least two sizes with --frames")
        rows = _print_growth(sizes, dims)
        if plot is not None:
            draw(rows, Path(plot))
            print(f"picture: {plot}")
    print(machine.describe(_PACKAGES))


def _print_indexes(sizes: Sequence[int], dims: int) -> None:
    print("| frames | index | made in s | search, ms | recall |\n|---|---|---|---|---|", flush=True)
    for size in sizes:
        for kind, seconds, ms, recall in indexes(size, dims):
            print(f"| {size} | {kind} | {seconds:.1f} | {ms:.3f} | {recall:.3f} |", flush=True)
    print(f"\nk {_K}, {dims} dimensions, median of {_EPISODES * _STEPS} searches, one at a time.")


def _print_growth(sizes: Sequence[int], dims: int) -> list[Row]:
    print(
        "| frames | demonstrations | search | step | p99 | of it search | S-DTW | recall | "
        "same alignment | MB | made in s |\n" + "|---" * 11 + "|",
        flush=True,
    )
    rows: list[Row] = []
    for size in sizes:
        for row in measure(size, dims):
            rows.append(row)
            print(
                f"| {row.frames} | {row.demonstrations} | {row.search} | {row.step:.3f} | "
                f"{row.p99:.3f} | {row.found:.3f} | {row.aligned:.3f} | {row.recall:.3f} | "
                f"{row.same:.3f} | {row.megabytes:.0f} | {row.seconds:.1f} |",
                flush=True,
            )
    print(f"\nMedian ms without the encoder, {dims} dimensions, k {_K}, H {_HORIZON}.")
    if len(sizes) > 1:
        for search in SEARCHES:
            fitted, last = growth(rows, search)
            print(f"{search}: cost grows as frames^{fitted:.2f}, over the last two ^{last:.2f}")
    return rows
