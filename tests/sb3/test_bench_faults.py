"""`regil bench faults`, at tiny counts: it counts right, and goes on where it stopped."""

from __future__ import annotations

import json
import os
import pickle
import re
import sys

import pytest
from regil_wrappers.formats import fuzz

from regil_sb3.bench import disk_faults, faults, hostile, lives, tables
from regil_sb3.checkpoint.generations import Generations
from regil_sb3.cli import main

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits memory as Linux does it")


def test_a_few_of_each(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    counts = {"disk": 1, "checkpoints": 12, "pickles": 9, "yaml": 10, "archives": 5, "numbers": 4}
    words = ["bench", "faults"]
    for part, count in counts.items():
        words += [f"--{part}", str(count)]
    assert main(words) == 0
    table = capsys.readouterr().out
    for part, count in counts.items():
        done, read, refused, wrong = map(
            int, re.search(rf"\| {part} \| (\d+) \| (\d+) \| (\d+) \| (\d+) \|", table).groups()
        )
        assert (done, wrong) == (count, 0)
        if part != "disk":
            assert read + refused == count
    again = [*words[:4], "--yaml", "10"]
    monkeypatch.setattr(fuzz, "run", None)  # nothing is done twice
    assert main(again) == 0
    assert "| yaml | 10 |" in capsys.readouterr().out


def test_killed_for_real(tmp_path):
    tally = faults.main(str(tmp_path), kills=1)["kills"]
    assert tally.done >= 1
    assert tally.wrong == []


def test_it_goes_on_after_ctrl_c(tmp_path, monkeypatch):
    spoilt = lives.spoilt

    def interrupted(number):
        if number == 2:
            raise KeyboardInterrupt
        return spoilt(number)

    monkeypatch.setattr(lives, "spoilt", interrupted)
    assert main(["bench", "faults", "--numbers", "4", "--out", str(tmp_path)]) == 130
    assert json.loads((tmp_path / "numbers.json").read_text())["done"] == 2
    begun = []
    monkeypatch.setattr(lives, "spoilt", lambda number: begun.append(number) or "")
    assert main(["bench", "faults", "--numbers", "4", "--out", str(tmp_path)]) == 0
    assert begun == [2, 3]


def test_what_goes_wrong_is_counted_and_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(Generations, "load", lambda self: {"step": -1})
    assert main(["bench", "faults", "--disk", "1", "--out", str(tmp_path)]) == 2
    said = capsys.readouterr()
    assert "not what was saved last" in said.err
    assert json.loads((tmp_path / "disk.json").read_text())["wrong"]


def test_what_is_executed_is_found_out(tmp_path):
    marker = tmp_path / "executed"
    content = dict(hostile.pickles(marker))["os.system"]
    assert hostile._read(lambda: pickle.loads(content), marker) == "it was executed"
    os.unlink(marker)
    assert hostile._read(lambda: 1, marker) == "it was read"
    assert hostile._read(lambda: 1 / 0, marker).startswith("ZeroDivisionError")


def test_bad_counts(tmp_path, capsys):
    assert main(["bench", "faults", "--disk", "9", "--out", str(tmp_path)]) == 2
    assert "--disk 9: 1 to 6" in capsys.readouterr().err
    assert main(["bench", "memory", "--kills", "9"]) == 2
    assert "no option --kills" in capsys.readouterr().err


def test_each_part_has_its_option():
    assert tuple(faults.COUNTS) == tables.FAULTS
    assert faults.COUNTS["disk"] == len(disk_faults.HOW)
