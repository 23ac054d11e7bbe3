"""`regil bench guide`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from regil_sb3.bench import guide, tables
from regil_sb3.bench.guide import DISTURBANCES, Guided
from regil_sb3.cli import main

LIFT = "regil/robosuite-lift-panda-v0"


def test_table_means_over_each_disturbance():
    one = Guided(
        "hammer", 0, "none", [False, True], [True, False], [True, True], [1.0, 3.0], 0.25, 125
    )
    lines = guide.table(
        [
            one,
            replace(
                one,
                seed=1,
                plain=[False] * 2,
                moved_back=[True] * 2,
                corrected=[True, False],
                errors_cm=[],
            ),
            replace(one, disturbance="noise", corrected=[False] * 2, said="plane: off"),
        ]
    )
    assert "| hammer | 0 | none | 0.50 | 0.50 | 1.00 | 2.0 / 2.8 | 0.25 | 125 |" in lines
    assert "| hammer | 1 | none | 0.00 | 1.00 | 0.50 | - | 0.25 | 125 |" in lines
    assert "| **mean** | 2 | none | 0.25 | 0.75 | 0.75 | 2.0 / 2.8 | 0.25 | |" in lines
    assert "| **mean** | 1 | noise | 0.50 | 0.50 | 0.00 | 2.0 / 2.8 | 0.25 | |" in lines
    assert lines[-1] == "hammer, 0, noise: plane: off"


def test_corrected_replay_of_one_task():
    first, second = (next(guide.guide(["button-press"], episodes=3, seeds=[0])) for _ in range(2))
    assert replace(first, seconds=0.0) == replace(second, seconds=0.0)
    assert len(first.plain) == len(first.moved_back) == len(first.corrected) == 3
    assert sum(first.corrected) >= sum(first.moved_back) > sum(first.plain)
    assert np.median(first.errors_cm) < 1.5
    assert 0 < first.calibration_steps <= 250
    assert 0 < first.seconds < 5
    assert first.said == ""


def test_a_task_that_does_not_say_where_its_targets_are():
    (found,) = guide.guide(["regil/rehearsal-reach-v0"], episodes=1, seeds=[0])
    assert (len(found.corrected), found.errors_cm) == (1, [])


def test_disturbances_change_pictures_and_repeat_themselves():
    def frames(name):
        env = guide._make("button-press", name)
        first = env.reset(seed=5)[0]
        later = env.step(np.zeros(4, np.float32))[0]
        again = env.reset(seed=5)[0]
        np.testing.assert_array_equal(first, again)
        env.close()
        assert first.dtype == np.uint8
        return first.astype(int), later.astype(int)

    plain, _ = frames("none")
    assert frames("brighter")[0].mean() == pytest.approx(1.2 * plain.mean(), rel=0.05)
    assert frames("darker")[0].mean() == pytest.approx(0.8 * plain.mean(), rel=0.05)
    noise = frames("noise")[0] - plain
    assert noise.std() == pytest.approx(8, abs=1)
    square, later = frames("distractor")
    assert ((square != plain).any(axis=2)).sum() <= 100
    assert (later != square).any(axis=2).mean() < 0.5
    # turned by 3 px along both axes
    turned, _ = frames("camera")
    shifts = {
        (x, y): np.abs(np.roll(plain, (y, x), (0, 1)) - turned)[8:-8, 8:-8].mean()
        for x in (-3, 0, 3)
        for y in (-3, 0, 3)
    }
    assert 0 not in min(shifts, key=shifts.get)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (["guide", "--tasks", "hamer"], "--tasks hamer: choose from assembly, "),
        (["guide", "--disturbances", "fog"], f"fog: choose from {', '.join(DISTURBANCES)}"),
        (["guide", "--steps", "9"], "the table 'guide' has no option --steps"),
        (["guide", "--disturbances", "camera", "--tasks", LIFT], "only Meta-World's cameras"),
        (["success-buffer", "--episodes", "9"], "'success-buffer' has no option --episodes"),
        (["success-buffer", "--seeds", "1", "1"], "--seeds 1 1: name each once"),
        (
            ["success-buffer", "--tasks", "hammer", "regil/metaworld-hammer-v0"],
            "--tasks hammer regil/metaworld-hammer-v0: name each once",
        ),
        (["success-buffer", "--seeds", "1000000"], "must lie between 0 and 999999"),
        (["success-buffer", "--steps", "0"], "--steps 0: at least 1"),
        (["sensitivity", "--steps", "9"], "'sensitivity' has no option --steps"),
        (["sensitivity", "--episodes", "6"], "--episodes 6: at least 7, one a task, are needed"),
        (["sensitivity", "--encoders", "pixel"], "--encoders: encoder 'pixel': unknown"),
        (["sensitivity", "--encoders", "pixels?a=1"], "it has no option 'a'"),
        (["guide", "--episodes", "0"], "--episodes 0: at least 1"),
        (["ranking", "--seeds", "0"], "'ranking' has no option --seeds"),
    ],
)
def test_bad_options_get_one_line(command, message, capsys):
    assert main(["bench", *command]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_it_is_reached_by_name(monkeypatch):
    calls = []
    monkeypatch.setattr(guide, "main", lambda tasks: calls.append(tasks))
    assert tables.main("guide", tasks=["hammer"]) == []
    assert calls == [["hammer"]]
