"""Whatever happens to a save, a generation loads."""

from __future__ import annotations

import copy
import errno
import os
import shutil
import warnings

import numpy as np
import pytest
import torch as th

from regil_sb3.checkpoint import generations
from regil_sb3.checkpoint.generations import Generations
from regil_sb3.checkpoint.snapshot import Ring

ROWS = 40


class Learner:
    """Something that changes, most of it little by little."""

    def __init__(self):
        self.rng = np.random.default_rng(0)
        self.ring = np.zeros((ROWS, 3, 1000), np.uint8)
        self.written = 0
        self.step = 0

    def learn(self, rows=7):
        self.step += 1
        for _ in range(rows):
            self.ring[self.written % ROWS] = self.rng.integers(0, 256, (3, 1000))
            # the row after the newest holds something, too
            self.ring[(self.written + 1) % ROWS] = 7
            self.written += 1

    def tree(self):
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


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    monkeypatch.setattr(generations, "BLOCK", 8_000)
    monkeypatch.setattr(generations, "SMALL", 1_000)


def same(loaded, tree):
    if isinstance(tree, dict):
        return loaded.keys() == tree.keys() and all(same(loaded[k], tree[k]) for k in tree)
    if isinstance(tree, Ring):
        return np.array_equal(loaded, tree.rows)
    if isinstance(tree, np.ndarray | th.Tensor):
        return (
            type(loaded) is type(tree)
            and loaded.dtype == tree.dtype
            and bool((loaded == tree).all())
        )
    return type(loaded) is type(tree) and loaded == tree


def test_what_is_saved_is_loaded_and_only_what_changed_is_written(tmp_path):
    learner = Learner()
    saver = Generations(tmp_path)
    learner.learn(30)
    saver.save(learner.tree())
    for _ in range(8):  # around the ring and on
        before = set((tmp_path / "blocks").iterdir())
        learner.learn(3)
        saver.save(learner.tree())
        new = set((tmp_path / "blocks").iterdir()) - before
        # 5 of "big", and of the ring, in blocks of 2 rows, those of 5 rows
        assert len(new) <= 5 + 4
        loaded = Generations(tmp_path).load()
        assert same(loaded, learner.tree())
        assert loaded["seen"].strides == learner.tree()["seen"].strides
    assert saver.numbers == [8, 9]


@pytest.mark.parametrize("since", [1, 37, 38, 39, 40, 41, 80, 100])
def test_a_ring_may_have_been_overwritten_by_any_number_of_rows(since, tmp_path):
    learner = Learner()
    saver = Generations(tmp_path)
    learner.learn(55)
    saver.save(learner.tree())
    learner.learn(since)
    saver.save(learner.tree())
    assert same(Generations(tmp_path).load(), learner.tree())


class Faults:
    """Counts the calls that a save makes of the system, and lets one of them go wrong."""

    CALLS = ("write", "fsync", "rename")

    def __init__(self, monkeypatch):
        self.calls, self.at, self.how = 0, -1, ""
        for name in self.CALLS:
            monkeypatch.setattr(os, name, self.around(getattr(os, name), name))

    def around(self, call, name):
        def faulty(*args, **kwargs):
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


@pytest.mark.parametrize("how", ["ENOSPC", "EIO", "killed", "short", "torn", "flipped"])
def test_a_fault_at_every_call_of_a_save_leaves_one_that_loads(how, tmp_path, monkeypatch):
    learner = Learner()
    faults = Faults(monkeypatch)
    faults.how = how
    saver = Generations(tmp_path)
    learner.learn()
    saver.save(learner.tree())
    good, failed = copy.deepcopy(learner.tree()), 0
    faults.calls = faults.at = 0
    while faults.at <= faults.calls:  # until no call was left to go wrong
        faults.calls, faults.at = 0, faults.at + 1
        learner.learn(2)
        try:
            saver.save(learner.tree())
            good = copy.deepcopy(learner.tree())
        except (OSError, KeyboardInterrupt):
            failed += 1
        loaded = Generations(tmp_path).load()
        if loaded["step"] == learner.step:  # renamed, and then a fault: it is there all the same
            good = copy.deepcopy(learner.tree())
        assert same(loaded, good)
        if how == "killed":
            saver = Generations(tmp_path)
    assert (failed == 0) == (how == "short")
    assert faults.at > 10


@pytest.mark.parametrize("name", ["state.json", "small.bin", "block"])
@pytest.mark.parametrize("damage", ["flip", "cut", "remove"])
def test_a_damaged_generation_is_named_kept_and_passed_over(name, damage, tmp_path):
    learner = Learner()
    saver = Generations(tmp_path, keep=3)
    learner.learn()
    saver.save(learner.tree())
    good = {**learner.tree(), "ring": Ring(learner.ring[:8].copy(), 0, ROWS)}
    before = set((tmp_path / "blocks").iterdir())
    learner.learn()
    folder = saver.save(learner.tree())
    path = folder / name
    if name == "block":
        path = min(set((tmp_path / "blocks").iterdir()) - before)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    if damage == "remove":
        path.unlink()
    else:
        path.write_bytes(data if damage == "flip" else data[:-1])
    again = Generations(tmp_path, keep=3)
    with pytest.warns(UserWarning, match="000002 is damaged"):
        assert same(again.load(), good)
    assert folder.with_suffix(".damaged").is_dir()
    again.save(learner.tree())  # writes the damaged block anew
    assert again.numbers == [1, 3]
    assert same(Generations(tmp_path).load(), learner.tree())


def test_the_budget_of_the_disk_is_kept_but_for_the_newest(tmp_path):
    learner = Learner()
    saver = Generations(tmp_path, keep=5, max_bytes=1)
    for _ in range(3):
        learner.learn()
        saver.save(learner.tree())
    assert saver.numbers == [3]
    roomy = Generations(tmp_path, keep=5, max_bytes=10**6)
    for _ in range(3):
        learner.learn()
        roomy.save(learner.tree())
    assert roomy.numbers == [3, 4, 5, 6]


def test_a_folder_that_is_removed_while_it_is_in_use(tmp_path):
    learner, saver = Learner(), Generations(tmp_path / "checkpoints")
    learner.learn(30)
    saver.save(learner.tree())
    shutil.rmtree(saver.folder)
    learner.learn(1)  # most blocks have not changed
    saver.save(learner.tree())
    assert same(Generations(saver.folder).load(), learner.tree())


@pytest.mark.parametrize("damage", ["flip", "cut", "remove"])
def test_a_shared_block_that_is_damaged_is_written_anew(damage, tmp_path):
    """One byte of it would else cost every generation."""
    learner, saver = Learner(), Generations(tmp_path)
    learner.learn(30)
    saver.save(learner.tree())
    before = set((tmp_path / "blocks").iterdir())
    learner.learn(1)
    saver.save(learner.tree())
    path = min(set((tmp_path / "blocks").iterdir()) & before)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    if damage == "remove":
        path.unlink()
    else:
        path.write_bytes(data if damage == "flip" else data[:-1])
    with pytest.raises(ValueError, match=r"no checkpoint in .* is whole"), pytest.warns():
        Generations(shutil.copytree(tmp_path, tmp_path / "copy")).load()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for _ in range(generations.TRUSTED):
            saver.save(learner.tree())
    assert len(said) == (damage == "flip")
    assert same(Generations(tmp_path).load(), learner.tree())


def test_what_another_version_wrote_is_refused_and_kept(tmp_path, monkeypatch):
    learner, saver = Learner(), Generations(tmp_path)
    learner.learn(30)
    monkeypatch.setattr(generations, "VERSION", 7)
    monkeypatch.setattr(generations, "__version__", "9.8.7")
    saver.save(learner.tree())
    monkeypatch.undo()
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(ValueError, match=r"written by regil-sb3 9\.8\.7 in format 7") as refused:
        Generations(tmp_path).load()
    assert "\n" not in str(refused.value)
    Generations(tmp_path).save({"a": np.zeros(5_000)})
    assert set(before) < set(tmp_path.rglob("*"))


def test_a_generation_that_cannot_be_read_now_keeps_its_blocks(tmp_path, monkeypatch):
    learner, saver = Learner(), Generations(tmp_path)
    learner.learn(30)
    saver.save(learner.tree())
    good = copy.deepcopy(learner.tree())
    state_of = generations._state

    def unreadable(folder):
        if folder.name == "000001":
            raise OSError(errno.EIO, "for now")
        return state_of(folder)

    monkeypatch.setattr(generations, "_state", unreadable)
    learner.learn(45)
    saver.save(learner.tree())
    monkeypatch.undo()
    shutil.rmtree(tmp_path / "000002")
    assert same(Generations(tmp_path).load()["big"], good["big"])


def test_a_failed_save_gives_its_room_back(tmp_path, monkeypatch):
    learner, saver = Learner(), Generations(tmp_path)
    learner.learn(30)
    saver.save(learner.tree())
    before = set((tmp_path / "blocks").iterdir())
    faults = Faults(monkeypatch)
    faults.how, faults.at = "torn", 10
    learner.learn(9)
    with pytest.raises(OSError, match="No space"):
        saver.save(learner.tree())
    assert set((tmp_path / "blocks").iterdir()) == before
    saver.save(learner.tree())
    assert same(Generations(tmp_path).load(), learner.tree())


def test_the_millionth(tmp_path):
    saver = Generations(tmp_path)
    for name in ("999999", "1000000"):
        saver.save({"a": name}).rename(tmp_path / name)
    assert saver.save({"a": 1}).name == "1000001"
    assert Generations(tmp_path).load() == {"a": 1}


@pytest.mark.parametrize(
    "what", [object(), {"a": [np.array([None])]}, b"bytes", {1, 2}, np.array(["x"])]
)
def test_what_cannot_be_held_is_refused_and_nothing_is_lost(what, tmp_path):
    saver = Generations(tmp_path)
    saver.save({"a": 1})
    with pytest.raises(ValueError, match="a checkpoint cannot hold"):
        saver.save({"a": what})
    assert Generations(tmp_path).load() == {"a": 1}
