"""Kept cells, and the tables made of them: `regil bench sensitivity` and `success-buffer`."""

from __future__ import annotations

import json

import missing_weights
import pyarrow.parquet as parquet
import pytest

from regil_sb3.bench import cells, page, replay, sensitivity, success_buffer
from regil_sb3.bench.cells import Cell, below, finish, predicted_hours
from regil_sb3.bench.machine import together
from regil_sb3.cli import main
from regil_sb3.intervals import wilson

DEFAULT = {"encoder": "pixels", "k": 5, "horizon": 4}


def cell(folder, seed, calls, expected=10.0):
    def measure():
        if len(calls) == 2:
            raise KeyboardInterrupt
        calls.append(seed)
        return {"doubled": 2 * seed}

    return Cell(folder, {"seed": seed}, measure, expected)


def test_a_killed_bench_goes_on_and_nothing_is_measured_twice(tmp_path, capsys):
    calls = []
    planned = [cell(tmp_path / "cells", seed, calls) for seed in (3, 1, 3, 2)]
    assert not finish(planned, dry_run=True)
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 4
    assert said[-1] == "3 of 3 cells to measure: about 0.01 hours"
    assert not calls
    with pytest.raises(KeyboardInterrupt):
        finish(planned)
    assert calls == [3, 1]
    assert [one.kept is not None for one in planned] == [True, True, True, False]
    calls.clear()
    assert finish(planned)
    assert calls == [2]
    assert [one.found["doubled"] for one in planned] == [6, 2, 6, 4]
    assert finish(planned, dry_run=True)
    assert "Demonstrations of seeds 1, 2, 3; 3 cells, " in below(planned)
    assert "commit " in below(planned)


def test_what_another_bench_measured_meanwhile_is_taken(tmp_path):
    calls = []
    twice = cell(tmp_path, 2, calls)

    def measure():
        finish([twice])
        return {"doubled": 2}

    assert finish([Cell(tmp_path, {"seed": 1}, measure, 1.0), cell(tmp_path, 2, calls)])
    assert calls == [2]


def test_machines_are_named_once_with_their_commits():
    told = ["A, 2 cores, commit 1", "B", "A, 2 cores, commit 2+", "A, 2 cores, commit 1"]
    assert together(told) == "A, 2 cores, commit 1, 2+; B"


def test_a_cell_is_what_decides_its_result(tmp_path, monkeypatch):
    one = cell(tmp_path, 1, [])
    assert one.path == cell(tmp_path, 1, [], expected=2.0).path
    assert one.path != cell(tmp_path, 2, []).path
    monkeypatch.setattr(cells, "version", lambda name: "9")
    assert one.path == one.path
    assert one.path != cell(tmp_path, 1, []).path


def test_hours_are_told_by_what_is_kept(tmp_path):
    planned = [cell(tmp_path, 1, []), cell(tmp_path, 2, [], expected=30.0)]
    assert predicted_hours(planned) == pytest.approx(40 / 3600)
    finish(planned[:1])
    kept = {**planned[0].kept, "seconds": 25.0}
    planned[0].path.write_text(json.dumps(kept))
    assert predicted_hours(planned) == pytest.approx(75 / 3600)


@pytest.mark.parametrize("text", ["", "[]", "{}", "{"])
def test_a_spoilt_file_gets_one_line(tmp_path, text):
    one = cell(tmp_path, 1, [])
    one.path.write_text(text)
    with pytest.raises(ValueError, match=r"^.*json holds no cell of a table: remove it, and it is"):
        finish([one])


@pytest.fixture
def without_dinov3(monkeypatch):
    missing_weights.without_dinov3(monkeypatch, sensitivity)


def test_sensitivity_varies_one_at_a_time(tmp_path, without_dinov3):
    plan = sensitivity.planned(
        str(tmp_path), ["hammer", "door-open"], (0, 1), 7, ["pixels", "pixels?size=14", "dinov3"]
    )
    assert [key for key in plan if key[0] == "horizon"] == [("horizon", h) for h in (9, 4, 2)]
    assert plan["encoder", "dinov3"] == "encoder 'dinov3': its weights are not here (a folder)"
    paths = {key: [c.path for c in found] for key, found in plan.items() if key[1] != "dinov3"}
    # the default stands in three lines, and is measured once
    assert paths["horizon", 4] == paths["k", 5] == paths["encoder", "pixels"]
    assert len({path for found in paths.values() for path in found}) == (2 + 3 + 1 + 1) * 4
    asked = [one.asked for one in plan["k", 1]]
    assert all(one["guide"] == {**DEFAULT, "k": 1} for one in asked)
    goals = [(one["env"], one["seed"], [g - 1_000_000 for g in one["goals"]]) for one in asked]
    assert goals == [
        ("regil/metaworld-hammer-v0", 0, [0, 2]),
        ("regil/metaworld-hammer-v0", 1, [1, 3]),
        ("regil/metaworld-door-open-v0", 0, [0, 2]),
        ("regil/metaworld-door-open-v0", 1, [1]),
    ]


def test_sensitivity_is_printed_beside_the_papers(tmp_path, monkeypatch, capsys, without_dinov3):
    calls = []

    def successes(task, seed, goals, guide):
        calls.append(guide)
        return {"successes": [goal % 10 < guide["horizon"] for goal in goals]}

    monkeypatch.setattr(sensitivity, "successes", successes)
    command = ["bench", "sensitivity", "--tasks", "hammer", "--seeds", "0", "1", "--episodes", "10"]
    command += ["--encoders", "pixels", "dinov3", "--out", str(tmp_path)]
    assert main([*command, "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "12 of 12 cells to measure" in said
    assert "encoder dinov3: encoder 'dinov3': its weights are not here" in said
    assert not list(tmp_path.iterdir())
    for _ in range(2):
        assert main(command) == 0
    assert len(calls) == 12
    lines = capsys.readouterr().out.splitlines()
    low, high = (bound / 100 for bound in wilson(9, 10))
    assert f"| horizon | 9 | 0.90 ({low:.2f} to {high:.2f}) | 10 | 0.48 |" in lines
    assert "| k | 5 (default) | 0.40 (0.17 to 0.69) | 10 | 0.53 |" in lines
    assert "| encoder | pixels (default) | 0.40 (0.17 to 0.69) | 10 | - |" in lines
    assert "| encoder | dinov3 | encoder 'dinov3': its weights are not here | - | 0.53 |" in lines
    assert "varied about horizon 4, k 5, encoder pixels; 10 unseen goals a line" in lines[-1]
    written = (tmp_path / "sensitivity.md").read_text()
    rows = parquet.read_table(tmp_path / "sensitivity.parquet").to_pylist()
    assert {row["seed"] for row in rows} == {0, 1}
    assert all(len(row["successes"]) > 0 < row["seconds"] for row in rows)
    assert written.startswith(f"    regil {' '.join(command[:-2])}\n")
    assert lines[-1] in written


def test_sensitivity_of_each_task(tmp_path, monkeypatch, capsys, without_dinov3):
    def successes(task, seed, goals, guide):
        return {"successes": [task == "hammer"] * len(goals)}

    monkeypatch.setattr(sensitivity, "successes", successes)
    command = ["bench", "sensitivity", "--tasks", "hammer", "door-open", "--episodes", "3"]
    command += ["--encoders", "pixels", "dinov3"]
    assert main([*command, "--each-task", "--out", str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith("| episodes | paper | hammer | door-open |")
    assert (
        "| k | 1 | 0.50 (0.19 to 0.81) | 6 | 0.48 | 1.00 (0.44 to 1.00) | 0.00 (0.00 to 0.56) |"
    ) in lines
    assert (
        "| encoder | dinov3 | encoder 'dinov3': its weights are not here | - | 0.53 | - | - |"
        in (lines)
    )
    assert "3 unseen goals a task and line over hammer, door-open" in lines[-1]
    assert " --each-task\n" in (tmp_path / "sensitivity.md").read_text()
    assert main([*command, "--episodes", "1", "--each-task", "--dry-run"]) == 0
    assert main([*command, "--episodes", "1"]) == 2


def test_success_buffers_have_a_deviation_over_seeds(tmp_path, monkeypatch, capsys):
    def collected(task, seed, steps, guide):
        kept = steps * (seed + 1) * (1 + guide.get("register", False) + ("correction" in guide))
        return {"transitions": kept}

    monkeypatch.setattr(success_buffer, "collected", collected)
    command = ["bench", "success-buffer", "--tasks", "hammer", "assembly", "--steps", "10"]
    command += ["--out", str(tmp_path)]
    assert main([*command, "--seeds", "0"]) == 0
    assert "| hammer | 10 | 20 | 30 | - |" in capsys.readouterr().out  # the paper's is of 5,000
    assert main([*command, "--seeds", "0", "1", "2", "--dry-run"]) == 0
    assert "12 of 18 cells to measure" in capsys.readouterr().out
    assert main([*command, "--seeds", "0", "1", "2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "| task | plain | moved back | corrected | paper |"
    assert "| hammer | 20 ± 10 | 40 ± 20 | 60 ± 30 | - |" in lines
    assert "| assembly | 20 ± 10 | 40 ± 20 | 60 ± 30 | - |" in lines
    assert "| **mean** | 20 | 40 | 60 | - |" in lines
    plate = "regil/libero-kitchen1-bowl-on-plate-v0"
    for task, steps, paper in (("hammer", 5_000, "456 ± 147"), (plate, 20_000, "3024")):
        command[3:] = [task, "--steps", str(steps), "--out", str(tmp_path)]
        assert main(command) == 0
        (line,) = (x for x in capsys.readouterr().out.splitlines() if x.startswith(f"| {task} |"))
        assert line.endswith(f" | {paper} |")


def test_the_papers_sensitivity_is_of_one_benchmark():
    meta, libero = ["hammer", "door-open"], ["regil/libero-study4-book-v0"]
    told = [replay.benchmark(tasks) for tasks in (meta, libero, meta + libero, ["my/reach-v0"])]
    assert told == ["metaworld", "libero", "", ""]
    paper = page.said()["paper"]["sensitivity"]
    assert [paper[name]["horizon"][4] for name in told[:2]] == [0.53, 0.47]


def test_a_guide_that_is_followed():
    guides = replay.guides()
    assert guides["plain"] == DEFAULT
    found = sensitivity.successes("button-press", 0, [1_000_000, 1_000_001], guides["plain"])
    assert found == {"successes": [False, True]}
    plain, corrected = (
        success_buffer.collected("button-press", 0, 165, guides[name])
        for name in ("plain", "corrected")
    )
    # the first goal is not the demonstration's, where its 31 actions would do
    early = success_buffer.collected("button-press", 0, 31, guides["plain"])
    assert early == {"transitions": 0, "episodes": 0, "successes": 0}
    # the first 125 steps calibrate, and the last episode may be open
    assert plain["transitions"] < corrected["transitions"] <= 40
    assert corrected["successes"] < corrected["episodes"]
