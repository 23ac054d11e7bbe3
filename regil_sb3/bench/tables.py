"""Tables that compare this project with others on the machine at hand: `regil bench TABLE`.

The two sides of a table take turns in small blocks, so that a busy machine hits both alike, and
what counts is the ratio of their medians.
"""

from __future__ import annotations

import inspect
import os
import time
from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

__all__ = ["TABLES", "Row", "main", "rendering", "retrieval"]


@dataclass(frozen=True)
class Row:
    """One line of a table.

    Attributes:
        what: the side that was timed.
        median_ms: median time of one call in milliseconds.
        ratio: how many times the first row's median this one is.
    """

    what: str
    median_ms: float
    ratio: float


def rendering(blocks: int = 6, steps: int = 15) -> list[Row]:
    """Time a step of `regil/metaworld-button-press-v0` against Meta-World's own rendering.

    The peer is the same task class, drawn by its own renderer as shipped: same camera, 84x84, same
    action repeat. It runs in a process of its own, since a process has one set of graphics options.

    Args:
        blocks: how often the two take turns.
        steps: agent steps in a turn.
    """
    import gymnasium as gym

    env = gym.make("regil/metaworld-button-press-v0", max_steps=blocks * steps + 1)
    context = get_context("spawn")  # started after `env` has chosen a graphics library for both
    here, there = context.Pipe()
    peer = context.Process(target=_metaworld_as_shipped, args=(there,), daemon=True)
    peer.start()
    there.close()  # so that the end of the peer is noticed
    try:
        env.reset(seed=0)
        idle = np.zeros(4, np.float32)

        def ask_peer(count: int) -> list[float]:
            here.send(count)
            times: list[float] = here.recv()
            return times

        return _compare(
            blocks,
            steps,
            "regil/metaworld-button-press-v0",
            lambda count: _time(lambda: env.step(idle), count),
            "Meta-World as shipped",
            ask_peer,
        )
    finally:
        env.close()
        here.close()
        peer.join()


def _metaworld_as_shipped(pipe: Connection) -> None:
    """Answer each number received with as many times (s) of a step and a frame."""
    os.environ.pop("LP_NUM_THREADS", None)  # ours; Mesa's own choice is faster for the peer
    from metaworld.env_dict import ENV_CLS_MAP

    sim: Any = ENV_CLS_MAP["button-press-v3"](
        render_mode="rgb_array", camera_name="corner4", width=84, height=84
    )
    sim._set_task_called, sim._freeze_rand_vec, sim.seeded_rand_vec = True, False, True
    sim.seed(0)
    sim.reset()
    idle = np.zeros(4, np.float32)

    def step() -> None:
        for _ in range(2):
            sim.step(idle)
        sim.render()

    try:
        while True:
            pipe.send(_time(step, pipe.recv()))
    except EOFError:
        sim.close()


def retrieval(blocks: int = 30, steps: int = 50) -> list[Row]:
    """Time one retrieval without its encoder against tslearn's subsequence DTW.

    150 demonstration frames, 384 dimensions, H = 4, k = 5; the episode is the demonstration with
    noise. Both sides get the same float32 vectors. Ours finds the neighbours, the segment and its
    cost; the peer aligns the window with the whole demonstration.

    Args:
        blocks: how often the two take turns.
        steps: steps in a turn.

    Raises:
        ValueError: where tslearn is not installed.
    """
    try:
        from tslearn.metrics import dtw_subsequence_path  # type: ignore[import-untyped]
    except ModuleNotFoundError as error:
        raise ValueError(
            f"table 'retrieval' compares with tslearn ({error}): pip install 'regil-sb3[bench]'"
        ) from None
    from regil_wrappers.demonstration import Demonstration
    from regil_wrappers.retrieval import Retriever

    horizon, dims = 4, 384
    rng = np.random.default_rng(0)
    memory = rng.normal(size=(150, dims)).cumsum(axis=0).astype(np.float32)

    class Given:
        """Stands in for an encoder: frame i of the demonstration is vector i."""

        def encode(self, frames: np.ndarray[Any, np.dtype[np.uint8]]) -> Any:
            return memory[frames[:, 0, 0, 0]]

    frames = np.zeros((150, 1, 1, 3), np.uint8)
    frames[:, 0, 0, 0] = np.arange(150)
    retriever = Retriever(Demonstration(frames), encoder=Given(), k=5, horizon=horizon)
    order = np.resize(np.arange(150), horizon + blocks * steps)
    episode = memory[order] + rng.normal(size=(len(order), dims)).astype(np.float32)
    windows = iter(range(horizon, len(order)))
    ends = iter(range(horizon, len(order)))
    for vector in episode[:horizon]:
        retriever.step_embedding(vector)

    def peer() -> None:
        end = next(windows)
        dtw_subsequence_path(episode[end - horizon : end + 1], memory)

    dtw_subsequence_path(episode[: horizon + 1], memory)  # compiles
    return _compare(
        blocks,
        steps,
        "Retriever.step without encoder",
        lambda count: _time(lambda: retriever.step_embedding(episode[next(ends)]), count),
        "tslearn dtw_subsequence_path",
        lambda count: _time(peer, count),
    )


def _time(call: Callable[[], Any], count: int) -> list[float]:
    times = []
    for _ in range(count):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return times


def _compare(
    blocks: int,
    count: int,
    our_name: str,
    ours: Callable[[int], list[float]],
    peer_name: str,
    peer: Callable[[int], list[float]],
) -> list[Row]:
    """Let two sides take turns; each gives the times (s) of as many calls as asked."""
    our_times: list[float] = []
    peer_times: list[float] = []
    for _ in range(blocks):
        our_times += ours(count)
        peer_times += peer(count)
    our_ms, peer_ms = (1e3 * float(np.median(times)) for times in (our_times, peer_times))
    return [Row(our_name, our_ms, 1.0), Row(peer_name, peer_ms, peer_ms / our_ms)]


TABLES: dict[str, Callable[[], list[Row]]] = {"rendering": rendering, "retrieval": retrieval}
"""Tables by name."""
FAULTS = ("kills", "disk", "files", "checkpoints", "pickles", "yaml", "archives", "numbers")
"""Parts of the table "faults", and the options that count them."""
_ROOMS: dict[str, tuple[str, ...] | None] = {
    "ranking": (),
    "guide": None,
    "success-buffer": None,
    "sensitivity": None,
    "buffer-vs-learning": None,
    "trajectories": None,
    "real-time": None,
    "results": None,
    "latency": ("encoders", "frames", "out", "dry_run"),
    "memory": ("frames", "dims", "plot"),
    "index": ("frames", "dims"),
    "throughput": (),
    "faults": ("out", *FAULTS),
}
"""Modules by the names of their tables, and the options of each; None: all of its ``main``."""


def _check_options(table: str, options: Iterable[str], known: Container[str]) -> None:
    for name in options:
        if name not in known:
            raise ValueError(f"the table {table!r} has no option --{name.replace('_', '-')}")


def main(table: str, **options: Any) -> list[Row]:
    """Measure a table and print it.

    Args:
        table: one of `TABLES`; the name of a module here, as "success-buffer"; "index", of
            `regil_sb3.bench.memory`; or one of `regil_sb3.bench.run_tables.LEARNING`.
        **options: the table's own.

    Returns:
        rows of `TABLES`; the others give none.

    Raises:
        ValueError: where there is no such table, or it has no such option.
    """
    if table in _ROOMS:
        room = "memory" if table == "index" else table
        module = import_module(f"regil_sb3.bench.{room.replace('-', '_')}")
        known = _ROOMS[table]
        if known is None:
            known = tuple(inspect.signature(module.main).parameters)
        _check_options(table, options, known)
        module.main(*[table] if room == "memory" else [], **options)
        return []
    from regil_sb3.bench import run_tables

    if table in run_tables.LEARNING:
        learning = {*inspect.signature(run_tables.planned).parameters}
        learning |= {*inspect.signature(run_tables.main).parameters}
        _check_options(table, options, learning - {"name", "root", "options"})
        run_tables.main(table, **options)
        return []
    if table not in TABLES:
        known_tables = ", ".join([*TABLES, *_ROOMS, *run_tables.LEARNING])
        raise ValueError(f"table {table!r} is not one of {known_tables}")
    _check_options(table, options, ())
    rows = TABLES[table]()
    width = max(len(row.what) for row in rows)
    print(f"{table:{width}}  median ms  times the first")
    for row in rows:
        print(f"{row.what:{width}}  {row.median_ms:9.3f}  {row.ratio:15.2f}")
    return rows
