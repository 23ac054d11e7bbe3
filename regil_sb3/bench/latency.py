"""`regil bench latency`: what a step costs, part by part, and what others take for its alignment.

Synthetic pictures, so that nothing is downloaded or simulated: a camera pans over a smooth scene
and never comes back. The episode is the demonstration with noise. All sides of one encoder and one
length see the same pictures or their embeddings, and take turns in small blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from regil_wrappers import Demonstration, Retriever
from regil_wrappers.alignment import accumulated_costs, best_end, squared_distances, warping_path
from regil_wrappers.encoders import Encoder, make_encoder
from regil_wrappers.encoders.weights import MissingWeightsError
from regil_wrappers.latency import Latency
from regil_wrappers.retrieval import step_together

from regil_sb3 import process
from regil_sb3.bench import machine
from regil_sb3.bench.page import need_parquet, said, write
from regil_sb3.bench.peers import LIBROSA_ON_COSTS, PEERS, Peer

__all__ = ["ENCODERS", "FRAMES", "Row", "latency", "main", "table"]

ENCODERS = ("pixels", "efficientnet-lite0")
"""Those that need no download."""
FRAMES = (150, 500, 5_000)

_SIDE = 84  # px of the pictures
_K, _HORIZON = 5, 4
_ENVIRONMENTS = 8
_SHIFT = 7  # frames between two environments' episodes
_NOISE = 5.0  # std of the episode's, of 255
_PAIR_S = 77.0  # seconds of an encoder with a demonstration, measured on two idle cores
_PACKAGES = ("numpy", "torch", "timm", "opencv-python-headless", "tslearn", "dtaidistance")

_ONE = "1 environment"
_TOGETHER = f"{_ENVIRONMENTS} environments, together"
_APART = f"{_ENVIRONMENTS} environments, one by one"
_ALONE = "S-DTW alone, given the distances"

Frames = NDArray[np.uint8]
Times = tuple[float, float, float, float]
Side = Callable[[int, int], Times]
"""(block, step of the block) -> seconds of encoding, search, alignment, and all."""
_NAN = float("nan")


@dataclass(frozen=True)
class Row:
    """One side, with one encoder and one length of the demonstration.

    Attributes:
        encoder: its name.
        frames: of the demonstration.
        what: the side.
        calls: how many were timed.
        encode: median ms of encoding; NaN where a side has no such part.
        search: the same of distances and candidates.
        alignment: the same of S-DTW.
        total: the same of the whole call.
        p99: 99th percentile of it.
        ratio: how many times the median of the side it is compared with.
        missing: why it was not measured.
    """

    encoder: str
    frames: int
    what: str
    calls: int = 0
    encode: float = _NAN
    search: float = _NAN
    alignment: float = _NAN
    total: float = _NAN
    p99: float = _NAN
    ratio: float = _NAN
    missing: str = ""


def latency(
    encoders: Sequence[str] = ENCODERS,
    frames: Sequence[int] = FRAMES,
    blocks: int = 40,
    steps: int = 10,
    seconds: float = 0.5,
) -> Iterator[Row]:
    """Measure; rows come as soon as they are known.

    Args:
        encoders: names that `make_encoder` takes.
        frames: lengths of the demonstration.
        blocks: how often all sides take turns.
        steps: calls in a turn.
        seconds: a turn that has taken so long ends earlier.

    Raises:
        ValueError: if there is no such encoder, or a demonstration is shorter than an alignment.
    """
    for length in frames:
        if length < max(_K, _HORIZON + 1):
            raise ValueError(f"--frames {length}: at least {max(_K, _HORIZON + 1)} are needed")
    for name in encoders:
        try:
            encoder = make_encoder(name)
        except (ImportError, MissingWeightsError) as error:
            yield Row(name, 0, "", missing=str(error))
            continue
        for length in frames:
            yield from _measured(name, encoder, length, blocks, steps, seconds)


def _measured(
    name: str, encoder: Encoder, length: int, blocks: int, steps: int, seconds: float
) -> Iterator[Row]:
    given = _Given(encoder, length, blocks, steps)
    sides: dict[str, Side | str] = {**_ours(given)}
    for peer in PEERS:
        sides[peer.name] = _theirs(peer, given.windows, given.memory)
    sides[_ALONE] = _alignment(given)
    sides[LIBROSA_ON_COSTS.name] = _theirs(LIBROSA_ON_COSTS, given.costs, given.memory)
    times = _taking_turns(sides, blocks, steps, seconds)

    ours = times[_ONE]
    compared = {
        _APART: times[_TOGETHER][:, 3],
        **{peer.name: ours[:, 3] - ours[:, 0] for peer in PEERS},
        LIBROSA_ON_COSTS.name: times[_ALONE][:, 3],
    }
    for what, side in sides.items():
        if isinstance(side, str):
            yield Row(name, length, what, missing=side)
            continue
        ms = 1e3 * times[what]
        encode, search, alignment, total = (float(part) for part in np.median(ms, axis=0))
        base = 1e3 * float(np.median(compared[what])) if what in compared else _NAN
        p99 = float(np.percentile(ms[:, 3], 99))
        yield Row(name, length, what, len(ms), encode, search, alignment, total, p99, total / base)


class _Given:
    """What all sides get: a demonstration, an episode, and the embeddings of both."""

    def __init__(self, encoder: Encoder, length: int, blocks: int, steps: int) -> None:
        seen = _scene(length)
        rng = np.random.default_rng(0)
        self._episode = np.empty_like(seen)
        for noisy, picture in zip(self._episode, seen, strict=True):
            noisy[:] = (picture + rng.normal(scale=_NOISE, size=picture.shape)).clip(0, 255)
        self._blocks = blocks
        self.retriever = Retriever(Demonstration(seen), encoder, k=_K, horizon=_HORIZON)
        self.memory = self.retriever.embeddings
        self.windows, self.costs = [], []
        for block in range(blocks):
            pictures = [self.picture(block, i)[None] for i in range(-_HORIZON, steps)]
            rows = np.concatenate([encoder.encode(picture) for picture in pictures])
            apart = squared_distances(rows, self.memory)
            self.windows.append([rows[i : i + _HORIZON + 1] for i in range(steps)])
            self.costs.append([apart[i : i + _HORIZON + 1] for i in range(steps)])

    def picture(self, block: int, step: int, environment: int = 0) -> Frames:
        """Blocks begin all over the demonstration: how far S-DTW looks depends on where."""
        length = len(self._episode)
        number = block * length // self._blocks + step + environment * _SHIFT
        picture: Frames = self._episode[number % length]
        return picture


def _ours(given: _Given) -> dict[str, Side]:
    one = given.retriever.another()
    apart, together = ([given.retriever.another() for _ in range(_ENVIRONMENTS)] for _ in range(2))
    whole = Latency()

    def step_one(block: int, step: int) -> Times:
        picture = given.picture(block, step)
        begun = perf_counter()
        one.step(picture)
        return (*one.latency.last, perf_counter() - begun)

    def step_all(block: int, step: int) -> Times:
        pictures = [given.picture(block, step, e) for e in range(_ENVIRONMENTS)]
        begun = perf_counter()
        step_together(together, pictures, whole)
        return (*whole.last, perf_counter() - begun)

    def step_each(block: int, step: int) -> Times:
        pictures = [given.picture(block, step, e) for e in range(_ENVIRONMENTS)]
        begun = perf_counter()
        for retriever, picture in zip(apart, pictures, strict=True):
            retriever.step(picture)
        total = perf_counter() - begun
        parts = [retriever.latency.last for retriever in apart]
        encode, search, alignment = (sum(part) for part in zip(*parts, strict=True))
        return encode, search, alignment, total

    return {_ONE: step_one, _TOGETHER: step_all, _APART: step_each}


def _alignment(given: _Given) -> Side:
    def align(block: int, step: int) -> Times:
        costs = given.costs[block][step]
        begun = perf_counter()
        accumulated = accumulated_costs(costs)
        end, _ = best_end(accumulated)
        warping_path(accumulated, end)
        total = perf_counter() - begun
        return _NAN, _NAN, total, total

    return align


def _theirs(peer: Peer, inputs: list[list[NDArray[Any]]], memory: NDArray[Any]) -> Side | str:
    """The peer's side, or why there is none. What it is given is converted beforehand."""
    try:
        call = peer.load()
    except ImportError as error:
        return str(error)
    known = peer.prepare(memory)
    prepared = [[peer.prepare(one) for one in block] for block in inputs]
    call(prepared[0][0], known)  # compiles

    def align(block: int, step: int) -> Times:
        begun = perf_counter()
        call(prepared[block][step], known)
        return _NAN, _NAN, _NAN, perf_counter() - begun

    return align


def _taking_turns(
    sides: dict[str, Side | str], blocks: int, steps: int, seconds: float
) -> dict[str, NDArray[np.float64]]:
    """(calls, 4) seconds of each side that can be called."""
    there = {name: side for name, side in sides.items() if not isinstance(side, str)}
    times: dict[str, list[Times]] = {name: [] for name in there}
    for block in range(blocks):
        for name, side in there.items():
            spent = 0.0
            for step in range(steps):
                times[name].append(side(block, step))
                spent += times[name][-1][3]
                if spent > seconds:
                    break
    return {name: np.array(rows) for name, rows in times.items()}


def _scene(length: int) -> Frames:
    """(length, 84, 84, 3): a camera that goes over a smooth picture in an opening spiral."""
    rng = np.random.default_rng(0)
    coarse = rng.uniform(0, 255, (24, 24, 3)).astype(np.float32)
    wide = 6 * _SIDE
    scene = np.asarray(cv2.resize(coarse, (wide, wide), interpolation=cv2.INTER_CUBIC))
    scene = scene.clip(0, 255).astype(np.uint8)
    frames = np.empty((length, _SIDE, _SIDE, 3), np.uint8)
    for i, share in enumerate(np.linspace(0.05, 1, length)):
        angle, radius = 12 * np.pi * share, 2.4 * _SIDE * share
        x, y = wide / 2 + radius * np.cos(angle), wide / 2 + radius * np.sin(angle)
        frames[i] = cv2.getRectSubPix(scene, (_SIDE, _SIDE), (float(x), float(y)))
    return frames


def table(rows: Sequence[Row]) -> list[str]:
    """A table in Markdown: one line a side."""
    return [
        "| encoder | frames | what | encode | search | S-DTW | total | p99 | ratio | calls |",
        "|---" * 10 + "|",
        *map(_line, rows),
    ]


def _line(row: Row) -> str:
    if row.missing:
        frames = row.frames or "-"
        return f"| {row.encoder} | {frames} | {row.missing} | - | - | - | - | - | - | - |"
    cells = [
        "-" if np.isnan(value) else f"{value:.3f}"
        for value in (row.encode, row.search, row.alignment, row.total, row.p99)
    ]
    ratio = "-" if np.isnan(row.ratio) else f"{row.ratio:.2f}"
    return (
        f"| {row.encoder} | {row.frames} | {row.what} | {' | '.join(cells)} | {ratio} | "
        f"{row.calls} |"
    )


def main(out: str = "bench", dry_run: bool = False, **options: Any) -> list[Row]:
    """Measure and print, line by line.

    Args:
        out: folder of ``latency.md``, ``.tex`` and ``.parquet``.
        dry_run: print what would be measured, and about how long; measure nothing.
        **options: of `latency`.

    Raises:
        ImportError: pyarrow is not installed.
    """
    if dry_run:
        encoders, frames = options.get("encoders", ENCODERS), options.get("frames", FRAMES)
        pairs = [f"{encoder}, {length} frames" for encoder in encoders for length in frames]
        print("\n".join(pairs))
        hours = len(pairs) * _PAIR_S / 3600
        print(f"{len(pairs)} pairs to measure, anew each time: about {hours:.2f} hours")
        return []
    need_parquet("latency")
    process.set_threads()
    process.keep_freed_memory()  # as regil train does
    begun = perf_counter()
    rows: list[Row] = []
    print("\n".join(table([])), flush=True)
    for row in latency(**options):
        rows.append(row)
        print(_line(row), flush=True)
    paper = "; ".join(
        f"{where} {total:.2f} in all, {encode:.2f} encoding and {rest:.2f} search and S-DTW"
        for where, (total, encode, rest) in said()["paper"]["latency"].items()
    )
    below = (
        f"Median ms of a call, k {_K}, H {_HORIZON}, pictures of {_SIDE}x{_SIDE}. Ratio: one by "
        "one against together; others with the whole of their distances against search and S-DTW "
        "of 1 environment; librosa given the distances against S-DTW given the same. The paper's "
        f"means, DINOv3, 1 environment, 150 steps: {paper}. "
        f"Seed 0; {(perf_counter() - begun) / 60:.1f} minutes; "
        f"{machine.describe((*_PACKAGES, 'librosa'))}"
    )
    print(f"\n{below}")
    write(Path(out), "latency", options, table(rows), below, [vars(row) for row in rows])
    return rows
