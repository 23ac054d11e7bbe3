"""Saves of checkpoints in which one call of the system goes wrong, each of them once.

* ``at_every_call`` - a kind of fault at every write, fsync and rename of a save
* ``Faults`` - lets one call go wrong; ``Learner`` - something to save; ``same``
"""

from __future__ import annotations

import copy
import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from regil_sb3.checkpoint import generations
from regil_sb3.checkpoint.generations import Generations
from regil_sb3.checkpoint.snapshot import Ring

__all__ = ["HOW", "ROWS", "Faults", "Learner", "at_every_call", "same", "small_blocks"]

HOW = ("ENOSPC", "EIO", "killed", "short", "torn", "flipped")
"""What goes wrong: an error, a kill, half a write that is said, half a write and then an error, a
byte that is written otherwise."""
ROWS = 40


class Learner:
    """Something that changes, most of it little by little."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(0)
        self.ring = np.zeros((ROWS, 3, 1000), np.uint8)
        self.written = 0
        self.step = 0

    def learn(self, rows: int = 7) -> None:
        """Write so many rows."""
        self.step += 1
        for _ in range(rows):
            self.ring[self.written % ROWS] = self.rng.integers(0, 256, (3, 1000))
            # the row after the newest holds something, too
            self.ring[(self.written + 1) % ROWS] = 7
            self.written += 1

    def tree(self) -> dict[str, Any]:
        """Of every kind that a checkpoint holds."""
        used = min(self.written + 1, ROWS)
        return {
            "step": self.step,
            "ring": Ring(self.ring[:used], self.written, ROWS),
            "weights": {0: th.full((3, 4), self.step + 0.5), "m": (1, [2.5, None, "text", True])},
            "seen": np.arange(24.0).reshape(2, 3, 4).transpose(0, 2, 1),
            "big": np.full(5_000, self.step, np.int64),
            "one": np.float32(0.1),
            "whole": 2**100,
        }


@contextmanager
def small_blocks() -> Iterator[None]:
    """Arrays of a few kilobytes are in several blocks meanwhile."""
    before = generations.BLOCK, generations.SMALL
    generations.BLOCK, generations.SMALL = 8_000, 1_000
    try:
        yield
    finally:
        generations.BLOCK, generations.SMALL = before


def same(loaded: Any, tree: Any) -> bool:
    """Whether what was loaded is what was saved."""
    if isinstance(tree, dict):
        return bool(loaded.keys() == tree.keys() and all(same(loaded[k], tree[k]) for k in tree))
    if isinstance(tree, Ring):
        return np.array_equal(loaded, tree.rows)
    if isinstance(tree, np.ndarray | th.Tensor):
        one, other = np.asarray(loaded), np.asarray(tree)
        return type(loaded) is type(tree) and one.dtype == other.dtype and (one == other).all()
    return type(loaded) is type(tree) and bool(loaded == tree)


class Faults:
    """While it is entered, counts the calls that a save makes, and lets one of them go wrong.

    Args:
        how: one of `HOW`.

    Attributes:
        calls: so far.
        at: number of the call that goes wrong, from 1.
    """

    CALLS = ("write", "fsync", "rename")

    def __init__(self, how: str) -> None:
        self.how, self.calls, self.at = how, 0, -1

    def __enter__(self) -> Faults:
        self._own = {name: getattr(os, name) for name in self.CALLS}
        for name, call in self._own.items():
            setattr(os, name, self._around(call, name))
        return self

    def __exit__(self, *_: object) -> None:
        for name, call in self._own.items():
            setattr(os, name, call)

    def _around(self, call: Callable[..., Any], name: str) -> Callable[..., Any]:
        def faulty(*args: Any, **kwargs: Any) -> Any:
            self.calls += 1
            if self.calls != self.at:
                return call(*args, **kwargs)
            if self.how == "killed":
                raise KeyboardInterrupt
            if self.how == "short" and name == "write":
                return call(args[0], args[1][: len(args[1]) // 2])
            if self.how == "torn" and name == "write":
                call(args[0], args[1][: len(args[1]) // 2])
                raise OSError(errno.ENOSPC, "No space left on device")
            if self.how == "flipped" and name == "write":
                data = bytearray(args[1])
                data[len(data) // 3] ^= 16
                return call(args[0], bytes(data))
            if self.how in ("ENOSPC", "EIO"):
                raise OSError(getattr(errno, self.how), "fault")
            return call(*args, **kwargs)

        return faulty


@small_blocks()
def at_every_call(how: str, folder: Path) -> tuple[int, int, list[str]]:
    """Save again and again, with a fault at the next call each time, and load each time.

    Args:
        how: one of `HOW`.
        folder: an empty one.

    Returns:
        calls that went wrong, saves that said so, and a line for each time that no generation was
        loaded, or another than the last one saved.
    """
    learner, saver = Learner(), Generations(folder)
    learner.learn()
    saver.save(learner.tree())
    good, failed, wrong = copy.deepcopy(learner.tree()), 0, []
    faults = Faults(how)
    faults.at = 0
    while faults.at <= faults.calls:  # until no call was left to go wrong
        faults.calls, faults.at = 0, faults.at + 1
        learner.learn(2)
        try:
            with faults:
                saver.save(learner.tree())
            good = copy.deepcopy(learner.tree())
        except (OSError, KeyboardInterrupt):
            failed += 1
        try:
            loaded = Generations(folder).load()
        except ValueError as error:
            wrong.append(f"{how} at call {faults.at}: {error}")
            continue
        if loaded["step"] == learner.step:  # renamed, and then a fault: it is there all the same
            good = copy.deepcopy(learner.tree())
        if not same(loaded, good):
            wrong.append(f"{how} at call {faults.at}: not what was saved last")
        if how == "killed":
            saver = Generations(folder)
    return faults.at, failed, wrong
