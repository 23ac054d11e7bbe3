"""Several runs on one page: which are of one method, and how sure the difference is."""

import itertools
import json
import math
import re

import made_run
import numpy as np
import pytest
import yaml
from scipy import stats

from regil_sb3.cli import main
from regil_sb3.intervals import improvement, iqm, wilson
from regil_sb3.report.comparison import methods, plots, write_comparison
from regil_sb3.report.run_contents import read_run

OTHER = "regil/metaworld-hammer-v0"

# What rliable 1.2.0 says of these: value, low, high (50,000 resamples)
RLIABLE = {"a": (0.6, 0.35, 0.85), "b": (0.35, 0.2, 0.5)}
SCORES = {"a": [[0.2, 0.5, 0.9], [0.4, 0.6, 1.0]], "b": [[0.1, 0.4, 0.3], [0.5, 0.2, 0.7]]}
# And of these its probability of improvement, a over b: the second pair has ties (20,000 resamples)
TIES = {
    "a": [[0.2, 0.5, 0.9, 0.5], [0.4, 0.6, 1.0, 0.6]],
    "b": [[0.5, 0.4, 0.3, 0.9], [0.5, 0.6, 0.7, 0.4]],
}
RLIABLE_IMPROVEMENT = [(SCORES, (0.7222, 0.3889, 1.0)), (TIES, (0.5625, 0.2656, 0.8438))]


@pytest.fixture
def runs(tmp_path):
    return [
        made_run.run(tmp_path / "a-0", films=False, solved=19),
        made_run.run(tmp_path / "a-1", films=False, solved=17, seed=1),
        made_run.run(tmp_path / "a-2", films=False, solved=15, env=OTHER),
        made_run.run(tmp_path / "a-3", films=False, solved=18, env=OTHER, seed=1),
        made_run.run(tmp_path / "b-0", films=False, solved=9, bc_coef=0.0),
        made_run.run(tmp_path / "b-1", films=False, solved=8, seed=1, bc_coef=0.0),
        made_run.run(tmp_path / "b-2", films=False, solved=20, env=OTHER, bc_coef=0.0),
        made_run.run(tmp_path / "b-3", films=False, solved=2, env=OTHER, seed=1, bc_coef=0.0),
    ]


def test_what_makes_no_steps_has_no_curve(runs, tmp_path):
    for run in runs[4:]:
        evaluation = json.loads((run / "evaluation.json").read_text())
        (run / "evaluation.json").write_text(json.dumps({**evaluation, "frames": 0}))
    page = write_comparison(runs, tmp_path / "c.html").read_text("utf-8")
    assert page.count('class="spread"') == 1
    assert re.findall(r"<b>(\d+) %</b>", page) == ["88", "43"]


def test_methods_and_scores(runs, tmp_path, capsys):
    assert main(["report", *map(str, runs)]) == 0
    page = (tmp_path / "comparison.html").read_text("utf-8")
    assert str(tmp_path / "comparison.html") in capsys.readouterr().out
    assert "ReGIL: 8 runs, 2 tasks" in page
    # the middle half of .95 .85 .75 .9 and of .45 .4 1 .1 (42.5)
    assert re.findall(r"<b>(\d+) %</b>", page) == ["88", "43"]
    assert page.count("4 runs, 2 tasks") == 2
    assert "bc_coef=2.0" in page
    assert "2.0 | 0.0" in page
    assert "90 % (85 to 95, 2 runs)" in page  # of button-press
    assert "17 of 20 (64 to 95 %)" in page
    assert page.count('class="spread"') == 2
    # on button-press none of b beats one of a, on hammer half do
    assert re.search(r"<td>bc_coef=0.0</td><td>25 % \(\d+ to \d+ %\)", page)
    assert "Missing from this page" not in page
    assert "data:" not in re.sub(r"img-src data:", "", page)


def test_wrappers_and_the_environment_make_a_method(tmp_path):
    def of(name, change, seed=0):
        run = made_run.run(tmp_path / name, films=False, solved=9, seed=seed)
        config = yaml.safe_load((run / "config.yaml").read_text())
        change(config)
        (run / "config.yaml").write_text(yaml.safe_dump(config))
        return read_run(run)

    def wrapped(config, **arguments):
        next(iter(config["env_wrapper"][0].values())).update(arguments)

    runs = [
        of("a", lambda config: config.update(demo_actions=40)),
        of("a-1", lambda config: config.update(demo_actions=43), seed=1),  # as its demonstration
        of("b", lambda config: wrapped(config, reward="sdtw")),
        of("c", lambda config: config.update(env_kwargs={"camera": "corner3"})),
        of("d", lambda config: wrapped(config, demo="another.hdf5")),
    ]
    assert [len(group) for group in methods(runs).values()] == [3, 1, 1]


def test_what_differs_between_tasks_alone_is_no_method(runs):
    for run in runs:
        config = yaml.safe_load((run / "config.yaml").read_text())
        config["preset"] = config["env"]  # a task's own section
        config["hyperparams"]["warmup_steps"] = len(config["env"])
        (run / "config.yaml").write_text(yaml.safe_dump(config))
    named = methods([read_run(run) for run in runs])
    assert {name: len(group) for name, group in named.items()} == {
        "bc_coef=2.0": 4,
        "bc_coef=0.0": 4,
    }
    config = yaml.safe_load((runs[4] / "config.yaml").read_text())
    (runs[4] / "config.yaml").write_text(yaml.safe_dump({**config, "preset": "plain"}))
    assert len(methods([read_run(run) for run in runs])) == 3
    assert list(methods([read_run(run) for run in runs[:2]])) == ["runs"]


def test_one_run_of_a_task_has_no_interval(runs, tmp_path):
    page = write_comparison([runs[0], runs[4]], tmp_path / "page.html").read_text("utf-8")
    assert page.count("no interval: a task with one run") == 3
    assert "nan" not in page


def test_what_was_not_evaluated_is_said(runs, tmp_path, capsys):
    (runs[0] / "evaluation.json").write_text("{}")
    page = write_comparison(runs[:3], tmp_path / "page.html").read_text("utf-8")
    assert f"{runs[0]}: its policy is not evaluated" in page
    assert "ReGIL: 2 runs" in page
    assert main(["report", str(runs[0]), str(runs[0])]) == 2
    assert "none of these runs has been evaluated" in capsys.readouterr().err
    assert main(["report", str(runs[1]), str(tmp_path)]) == 2
    assert "is not a run folder" in capsys.readouterr().err
    assert main(["report", *map(str, runs[:2]), "-o", str(tmp_path)]) == 2
    assert "is a folder" in capsys.readouterr().err


def test_more_methods_than_colours_differ_in_their_lines(tmp_path):
    many = [made_run.run(tmp_path / f"{i}", films=False, bc_coef=float(i)) for i in range(7)]
    page = write_comparison(many, tmp_path / "page.html").read_text("utf-8")
    lines = re.findall(r'<polyline class="series (\w+)" style="--c:var\(--(m\d)\)"', page)
    assert len(set(lines)) == 7
    assert lines[0] == ("solid", "m0")
    assert lines[6] == ("dashed", "m0")


def test_more_methods_than_lines(runs):
    named = {f"method {i}": [read_run(runs[0])] for i in range(19)}
    with pytest.raises(ValueError, match=r"19 methods .method 0; method 1;.*at most 18"):
        plots(named)


def test_everything_read_is_escaped(runs, tmp_path):
    evil = "</td><script>alert(1)</script>"
    config = yaml.safe_load((runs[0] / "config.yaml").read_text())
    config["hyperparams"][evil] = evil
    (runs[0] / "config.yaml").write_text(yaml.safe_dump(config | {"env": evil}))
    page = write_comparison(runs[:2], tmp_path / "page.html").read_text("utf-8")
    assert "<script>alert" not in page


def test_iqm_is_rliables():
    for name, (value, low, high) in RLIABLE.items():
        found = iqm(SCORES[name])
        assert found.value == pytest.approx(value, abs=1e-9)
        assert (found.low, found.high) == pytest.approx((low, high), abs=0.02)


@pytest.mark.parametrize(("scores", "expected"), RLIABLE_IMPROVEMENT)
def test_improvement_is_rliables(scores, expected):
    found = improvement(scores["a"], scores["b"])
    assert found.value == pytest.approx(expected[0], abs=1e-4)
    assert (found.low, found.high) == pytest.approx(expected[1:], abs=0.02)


def test_improvement_is_the_mean_of_mann_whitneys_u():
    """rliable's definition: U over the number of pairs, where a tie is half a win; tasks' mean."""
    rng = np.random.default_rng(0)
    tied = 0
    for _ in range(30):
        runs = rng.integers(1, 7, (2, 3))  # of each method on each task: tasks weigh the same
        ours, theirs = ([rng.integers(0, 5, n) / 4 for n in of] for of in runs)
        wins = []
        for x, y in zip(ours, theirs, strict=True):
            wins.append(stats.mannwhitneyu(x, y).statistic / (len(x) * len(y)))
            tied += len(np.intersect1d(x, y))
        assert improvement(ours, theirs).value == pytest.approx(np.mean(wins), abs=1e-12)
    assert tied > 30


def _resampled(task):
    """All that drawing a task's runs again can give, each as probable as any other."""
    return list(itertools.product(task, repeat=len(task)))


def test_runs_are_drawn_again_within_their_task():
    """The intervals are those of all resamples there are, counted instead of drawn."""
    apart = [[0.1, 0.2, 0.4], [0.7, 0.8, 1.0]]
    drawn = itertools.product(*map(_resampled, apart))
    exact = np.percentile([np.sort([*x, *y])[1:5].mean() for x, y in drawn], [2.5, 97.5])
    found = iqm(apart)
    assert (found.low, found.high) == pytest.approx(exact, abs=0.02)
    # Drawn from both tasks at once, it would be wider
    pooled = np.random.default_rng(0).choice(np.ravel(apart), (5_000, 6))
    low, high = np.percentile(np.sort(pooled)[:, 1:5].mean(axis=1), [2.5, 97.5])
    assert low < found.low - 0.1
    assert found.high + 0.1 < high

    a, b = SCORES["a"], SCORES["b"]
    of_tasks = [
        [
            np.mean([(x > y) + (x == y) / 2 for x in xs for y in ys])
            for xs in _resampled(a[task])
            for ys in _resampled(b[task])
        ]
        for task in (0, 1)
    ]
    exact = np.percentile(np.add.outer(*of_tasks) / 2, [2.5, 97.5])
    found = improvement(a, b)
    assert (found.low, found.high) == pytest.approx(exact, abs=0.02)


def test_what_no_resample_can_change():
    # Tasks as far apart as can be, whose own runs agree: between tasks nothing is drawn
    assert iqm([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]) == (0.5, 0.5, 0.5)
    assert improvement([[0.2, 0.2], [0.9, 0.9]], [[0.1, 0.1], [0.9, 0.9]]) == (0.75, 0.75, 0.75)
    # Both methods' runs are drawn by themselves: in pairs, equal methods would have no interval
    same = improvement([[0.0, 1.0]], [[0.0, 1.0]])
    assert (same.low, same.value, same.high) == (0.0, 0.5, 1.0)


def test_intervals():
    assert iqm([[0.5, 0.5], [0.5, 0.5]]) == (0.5, 0.5, 0.5)
    alone = iqm([[0.5], [0.7, 0.9]])
    assert alone.value == pytest.approx(0.7)
    assert math.isnan(alone.low)
    better = improvement([[0.9, 0.8]], [[0.8, 0.1]])
    assert better.value == pytest.approx((1 + 1 + 0.5 + 1) / 4)
    assert better.low <= better.value <= better.high
    rng = np.random.default_rng(0)
    same = improvement([rng.random(40).tolist()], [rng.random(40).tolist()])
    assert same.low < 0.5 < same.high


def test_wilson_interval_is_the_published_one():
    # Newcombe (1998), Table I, score method without continuity correction: 15/148 and 0/20.
    assert wilson(15, 148) == pytest.approx((6.24, 16.05), abs=0.1)
    assert wilson(0, 20) == pytest.approx((0.0, 16.11), abs=0.01)
