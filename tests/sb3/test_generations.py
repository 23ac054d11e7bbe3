"""Whatever happens to a save, a generation loads."""

from __future__ import annotations

import copy
import errno
import shutil
import warnings

import numpy as np
import pytest

from regil_sb3.bench import disk_faults
from regil_sb3.bench.disk_faults import ROWS, Faults, Learner, same
from regil_sb3.checkpoint import generations
from regil_sb3.checkpoint.generations import Generations
from regil_sb3.checkpoint.snapshot import Ring


@pytest.fixture(autouse=True)
def small_blocks():
    with disk_faults.small_blocks():
        yield


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


@pytest.mark.parametrize("how", disk_faults.HOW)
def test_a_fault_at_every_call_of_a_save_leaves_one_that_loads(how, tmp_path):
    calls, failed, wrong = disk_faults.at_every_call(how, tmp_path)
    assert not wrong
    assert calls > 10
    assert (failed == 0) == (how == "short")


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


def test_a_failed_save_gives_its_room_back(tmp_path):
    learner, saver = Learner(), Generations(tmp_path)
    learner.learn(30)
    saver.save(learner.tree())
    before = set((tmp_path / "blocks").iterdir())
    learner.learn(9)
    with Faults("torn") as faults:
        faults.at = 10
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
