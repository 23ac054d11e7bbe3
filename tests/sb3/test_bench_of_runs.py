"""Tables that are made of finished runs: `regil bench buffer-vs-learning` and `trajectories`."""

from __future__ import annotations

import shutil
import sys

import made_run
import numpy as np
import pyarrow.parquet as parquet
import pytest
import toy_env
from toy_env import ToyReach

from regil_sb3 import training
from regil_sb3.bench import trajectories
from regil_sb3.bench.buffer_vs_learning import Learned, buffer_after_warmup, learned, rank
from regil_sb3.bench.replay import env_id, task_of
from regil_sb3.bench.trajectories import Played, Trajectory, played
from regil_sb3.cli import main
from regil_sb3.report.run_contents import read_run
from regil_sb3.settings import Settings, make_settings

HAMMER = "regil/metaworld-hammer-v0"


def finished(folder, kept, solved, env=HAMMER, seed=0, **hyperparams):
    """A run folder whose guide left so many steps, the 29 of the demonstration among them."""
    made_run.run(folder, solved=solved)
    settings = Settings(env, seed=seed, hyperparams={"warmup_steps": 2_000, **hyperparams})
    settings.save(folder / "config.yaml")
    head = "time/total_timesteps,time/guided,success_buffer/steps,eval/success_rate\n"
    log = f"1990,1,7,\n2010,1,8,\n2040,1,{kept},.5\n2100,1,999,\n2500,0,2000,.9\n"
    (folder / "progress.csv").write_text(head + log)
    return folder


def test_what_the_guide_left_is_read_where_the_warmup_ends(tmp_path):
    run = read_run(finished(tmp_path / "a", 429, 19))
    assert buffer_after_warmup(run, 2_000) == 400
    run.rows[2].pop("eval/success_rate")  # then the first row in which no guide acts
    assert buffer_after_warmup(run, 2_000) == 1971
    run.rows[2]["time/guided"] = 0.0
    assert buffer_after_warmup(run, 2_000) == 400
    assert buffer_after_warmup(run, 3_000) is None
    run.demo = None
    assert buffer_after_warmup(run, 2_000) is None
    run.config["demo_actions"] = 9  # as a run says itself, whose demonstration need not be kept
    assert buffer_after_warmup(run, 2_000) == 420


def test_runs_that_say_too_little_are_left_out(tmp_path):
    finished(tmp_path / "good", 129, 19, seed=4)
    finished(tmp_path / "unguided", 129, 19, warmup_steps=0)
    finished(tmp_path / "short", 129, 19, warmup_steps=9_000)
    (finished(tmp_path / "running", 129, 19) / "evaluation.json").unlink()
    finished(tmp_path / "unregularised", 129, 19, bc_coef=0)
    names = ("good", "unguided", "short", "running", "unregularised")
    found, left_out = learned([tmp_path / name for name in names])
    good = str(tmp_path / "good")
    assert found == [Learned(good, "hammer", "default", 4, 15_000, 2_000, "null", 100, 19, 20)]
    assert [line.rpartition(": ")[2].split(" (")[0] for line in left_out] == [
        "no guide acted in it",
        "its log does not reach the end of the warm-up",
        "its policy is not evaluated",
        "it does not learn from the buffer",
    ]


def test_ranks():
    def runs(pairs, guide=""):
        same = ("", "hammer", "default", 0, 15_000, 2_000, guide)
        return [Learned(*same, buffer, solved, 20) for buffer, solved in pairs]

    grows = rank(runs([(100, 3), (200, 5), (300, 9), (5_000, 10)]))
    assert (grows.rho, grows.n) == (pytest.approx(1), 4)
    assert grows.p == pytest.approx(2 / 24)  # of 24 orders, two are as extreme
    assert rank(runs([(1, 9), (2, 5), (3, 1)])).rho == pytest.approx(-1)
    both = [*runs([(1, 9), (2, 5), (3, 1)]), *runs([(3, 1)], "another")]
    assert rank(both).n == 4  # as much was left by another guide
    # what had the same warm-up counts once: its mean
    assert rank(runs([(1, 9), (2, 2), (2, 8), (3, 1), (3, 1)])) == rank(
        runs([(1, 9), (2, 5), (3, 1)])
    )
    for few in ([(1, 2), (2, 3)], [(1, 2), (2, 2), (3, 2)], [(1, 2), (1, 3), (1, 4)]):
        assert np.isnan(rank(runs(few)).rho)


def test_buffer_vs_learning_is_made_of_runs_alone(tmp_path, capsys):
    assert main(["bench", "buffer-vs-learning", "--out", str(tmp_path)]) == 2
    assert "no evaluated run is there; name some with --runs" in capsys.readouterr().err
    for i, (kept, solved) in enumerate([(129, 6), (329, 18), (229, 12), (1029, 19)]):
        finished(tmp_path / f"hammer-{i}", kept, solved, seed=i)
    other = finished(tmp_path / "door", 29, 20, env="regil/metaworld-door-open-v0")
    assert main(["bench", "buffer-vs-learning", "--out", str(tmp_path), "--dry-run"]) == 0
    assert "5 of 5 runs to read: about 0 hours" in capsys.readouterr().out
    assert not list(tmp_path.glob("buffer*"))
    assert main(["bench", "buffer-vs-learning", "--out", str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].startswith(
        "| hammer | default | 3 | 15000 | 2000 | 1000 | 0.95 (0.76 to 0.99) |"
    )
    assert lines[-3].startswith("| door-open | default | 0 | 15000 | 2000 | 0 | 1.00 ")
    assert "of all runs: +0.00 (p 1.000) of 5 warm-ups; door-open: none, of 1 warm-ups" in lines[-1]
    assert "; hammer: +1.00" in lines[-1]
    rows = parquet.read_table(tmp_path / "buffer-vs-learning.parquet").to_pylist()
    assert [row["buffer"] for row in rows] == [0, 100, 300, 200, 1000]
    assert (tmp_path / "buffer-vs-learning.png").stat().st_size > 5_000
    assert (tmp_path / "buffer-vs-learning.md").read_text().splitlines()[0] == (
        "    regil bench buffer-vs-learning"
    )
    (other / "took.json").write_text('{"seconds": 5400}')
    for i in (8, 9):
        finished(tmp_path / f"unguided-{i}", 129, 19, warmup_steps=0)
    assert main(["bench", "buffer-vs-learning", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "Left out (no guide acted in it): unguided-8, unguided-9. To make 1 of them took" in out
    assert "took 1.5 hours, one after the other. Read by" in out
    named = ["bench", "buffer-vs-learning", "--runs", str(other), "--out", str(tmp_path / "b")]
    assert main(named) == 0
    assert f"--runs {other}" in (tmp_path / "b/buffer-vs-learning.md").read_text()


def told(monkeypatch, **facts):
    """Let the toy say more of itself; its hand moves 5 cm where 1 is asked for."""
    make = ToyReach.__init__

    def say(self, *args, **kwargs):
        make(self, *args, **kwargs)
        self.metadata["regil"] = {**self.metadata["regil"], **facts}

    monkeypatch.setattr(ToyReach, "__init__", say)


def test_the_warmup_is_the_runs_own(toy_run, monkeypatch):
    """What is played again keeps as many transitions; both measures find the same paths."""
    run = read_run(toy_run)
    with monkeypatch.context() as patch:
        told(patch, translation_dims=[0, 1], step_cm=5.0)
        summed = played(run, 2)
    with monkeypatch.context() as patch:
        patch.setattr(ToyReach, "hand_position", lambda self: self.point.copy(), raising=False)
        simulated = played(run, 2)
    assert (summed.simulated, simulated.simulated) == (False, True)
    for found in (summed, simulated):
        assert (found.task, found.unit) == ("ToyReach-v0", "cm")
        assert found.kept == sum(len(path.points) for path in found.of("success buffer")) > 0
        assert [len(found.of(source)) for source in ("demonstration", "policy")] == [1, 2]
        assert all(path.success for path in found.of("success buffer"))
    (demo,) = simulated.of("demonstration")
    assert demo.success
    assert len(demo.points) == len(run.demo.actions)
    np.testing.assert_allclose(demo.points[:2], [[0, 0], [5, 5]], atol=1e-5)
    kept = [one.of("demonstration") + one.of("success buffer") for one in (summed, simulated)]
    for a, b in zip(*kept, strict=True):
        np.testing.assert_allclose(a.points, b.points, atol=1e-4)


def test_the_warmup_begins_as_training_did(tmp_path, monkeypatch):
    """The same goals in the same order, where every reset draws another."""
    demo = toy_env.record()
    begun: dict[ToyReach, list[tuple[float, ...]]] = {}  # by environment, the first made first
    step = ToyReach.step

    def noted(self, action):
        if not self.steps:
            begun.setdefault(self, []).append(tuple(self.goal))
        return step(self, action)

    tiny = ("warmup_steps=90", "learning_starts=10", "bc_pretrain_steps=2", "batch_size=4")
    tiny += ("buffer_size=200", "eval_episodes=1", "env_kwargs.frozen=false")
    settings = make_settings("ToyReach-v0", "plain", 3, 140, list(tiny))
    with monkeypatch.context() as patch:
        patch.setattr(ToyReach, "step", noted)
        training.train(settings, demo, tmp_path / "run")
    trained = next(iter(begun.values()))
    begun.clear()
    env = training.make_env(settings, tmp_path / "run/demo.hdf5")
    env.get_attr("unwrapped")[0].metadata["regil"]["translation_dims"] = [0, 1]
    monkeypatch.setattr(ToyReach, "step", noted)
    list(trajectories._warmup(trajectories._Hands(env), settings.seed, settings.warmup_steps))
    (again,) = begun.values()
    env.close()
    assert len(set(again)) == len(again) > 2
    assert again == trained[: len(again)]


def test_trajectories_are_compared_with_the_demonstration():
    straight = np.array([[0.0, 0, 0], [3, 0, 0], [6, 0, 0]])
    run = Played(
        "runs/a",
        "hammer",
        "cm",
        True,
        [
            Trajectory("demonstration", True, straight),
            Trajectory("policy", True, straight + np.array([0, 4, 0])),
            Trajectory("policy", False, straight - np.array([0, 4, 0])),
        ],
        None,
    )
    assert trajectories.table([run])[2:] == [
        "| runs/a | demonstration | 1 | 1 | 3 | 6.0 | 0.0 | 0.0 |",
        "| runs/a | success buffer | 0 | - | - | - | - | - |",
        "| runs/a | policy | 2 | 1 | 3 | 6.0 | 4.0 | 4.0 |",
    ]


def test_trajectories_from_the_command_line(toy_run, tmp_path, monkeypatch, capsys):
    words = ["bench", "trajectories", "--out", str(tmp_path), "--episodes", "1"]
    words += ["--runs", str(toy_run)]
    assert main(words) == 2
    assert "says neither where the hand is (hand_position()) nor which" in capsys.readouterr().err
    told(monkeypatch, translation_dims=[0, 1])
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "hand sum of executed translations, action units" in said
    rows = parquet.read_table(tmp_path / "trajectories.parquet").to_pylist()
    assert {row["source"] for row in rows} == {"demonstration", "success buffer", "policy"}
    assert all(row["x"] == row["y"] == 0 for row in rows if row["step"] == 0)
    assert (tmp_path / "trajectories.png").stat().st_size > 5_000
    assert said.rstrip().endswith((tmp_path / "trajectories.md").read_text().rstrip()[-80:])


def test_trajectories_of_an_encoder_of_ones_own(toy_run, tmp_path, monkeypatch, capsys):
    """Code that a run names runs with --trust alone, as in `regil evaluate`."""
    told(monkeypatch, translation_dims=[0, 1])
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "own_encoder.py").write_text(
        "from regil_wrappers import make_encoder\n\n\n"
        "def pixels():\n    return make_encoder('pixels')\n"
    )
    run = shutil.copytree(toy_run, tmp_path / "own")
    config = run / "config.yaml"
    named = config.read_text().replace("encoder: pixels", "encoder: own_encoder:pixels")
    config.write_text(named)
    assert "own_encoder" in named
    words = ["bench", "trajectories", "--out", str(tmp_path), "--episodes", "1", "--runs", str(run)]
    assert main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "names code to run, encoder 'own_encoder:pixels'" in line
    assert "own_encoder" not in sys.modules
    assert main([*words, "--trust"]) == 0
    assert "| policy | 1 |" in capsys.readouterr().out


def test_bad_options_get_one_line_before_anything_is_played(toy_run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(trajectories, "played", None)
    broken = tmp_path / "broken"
    shutil.copytree(toy_run, broken)
    (broken / "model.zip").unlink()
    for words, said in (
        ([], "--runs is missing: name a run that has ended"),
        (["--runs", str(tmp_path)], "is not a run folder"),
        (["--runs", str(broken)], "it has no model.zip yet"),
        (["--runs", str(toy_run), "--episodes", "0"], "--episodes 0: at least 1"),
        (["--seeds", "1"], "the table 'trajectories' has no option --seeds"),
    ):
        assert main(["bench", "trajectories", *words, "--out", str(tmp_path)]) == 2
        error = capsys.readouterr().err
        assert said in error
        assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("env", "task"),
    [
        (HAMMER, "hammer"),
        ("ToyReach-v0", "ToyReach-v0"),
        ("regil/libero-a-v0", "regil/libero-a-v0"),
    ],
)
def test_tasks_have_the_names_that_tables_take(env, task):
    assert task_of(env) == task
    assert "/" not in env or env_id(task) == env


def test_metaworlds_hand():
    import gymnasium as gym

    env = gym.make("regil/metaworld-button-press-v0", obs="state")
    with pytest.raises(ValueError, match="before reset"):
        env.unwrapped.hand_position()
    state, _ = env.reset(seed=0)
    before = env.unwrapped.hand_position()
    np.testing.assert_allclose(before, state[:3], atol=1e-6)
    for _ in range(5):
        env.step(np.array([0, 1, 0, 0], np.float32))
    moved = 100 * (env.unwrapped.hand_position() - before)
    assert 4 < moved[1] < 10  # 2 cm a step, and the hand lags behind
    assert np.abs(moved[[0, 2]]).max() < 1
    env.close()
