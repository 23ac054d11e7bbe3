"""`regil bench real-time`: control at 30 Hz while a policy is learned."""

from __future__ import annotations

import pytest

from regil_sb3.bench import real_time
from regil_sb3.cli import main

FOUND = {
    "steps": 3_600,
    "missed": 2,
    "answer_ms": {"median": 2.54, "p99": 8.91, "max": 122.0},
    "period_ms": {"median": 33.33, "p99": 37.4, "max": 122.0},
    "updates": 1_300,
    "megabytes": [641, 700],
    "faults": ["the arm was stopped: camera: no new picture for more than 100 ms"],
    "recent_success": 95,
    "episodes": 100,
}


def test_a_line_for_each_run(tmp_path, monkeypatch, capsys):
    asked = []

    def controlled(*words):
        asked.append(words)
        return FOUND if words[3] == "beside control" else {**FOUND, "megabytes": []}

    monkeypatch.setattr(real_time, "_alone", controlled)
    words = ["bench", "real-time", "--tasks", "open", "--steps", "3600", "--out", str(tmp_path)]
    assert main([*words, "--dry-run"]) == 0
    assert "2 of 2 cells to measure" in capsys.readouterr().out
    assert not asked
    for _ in range(2):  # the second finds both
        assert main(words) == 0
    assert asked == [("open", 0, 3_600, "beside control"), ("open", 0, 3_600, "in turn")]
    command, _, head, _, beside, turn, _, below = (
        (tmp_path / "real-time.md").read_text().splitlines()
    )
    assert command.strip() == "regil bench real-time --tasks open --seeds 0 --steps 3600"
    columns = [[cell.strip() for cell in line.strip("|").split("|")] for line in (head, beside)]
    told = dict(zip(*columns, strict=True))
    assert told["updates"] == "beside control"
    assert told["updates made"] == "1,300"
    assert told["control step, ms: median / 99 % / most"] == "2.54 / 8.91 / 122"
    assert (told["missed"], told["arm stopped"], told["MB"]) == ("2", "1", "641 to 700")
    assert "| in turn |" in turn
    assert "| - | 95 of 100 |" in turn
    assert "commit " in below


def test_what_cannot_be_measured_is_said_in_a_line(tmp_path, capsys):
    for words in (["--tasks", "hammer"], ["--steps", "999"], ["--methods", "x"]):
        assert main(["bench", "real-time", "--out", str(tmp_path), *words]) == 2
        assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize("side", real_time.SIDES)
def test_a_robot_is_controlled_while_it_learns(side):
    found = real_time.controlled("reach", 0, 1_000, side)
    assert found["steps"] == 1_000
    assert found["updates"] > 200  # half of the steps that are not guided, but for an episode
    assert found["answer_ms"]["median"] < 33
    assert 30 < found["period_ms"]["median"] < 40
