"""The command line on a real environment, with step counts that a test can pay for."""

from __future__ import annotations

import csv
import dataclasses
import functools
import json
import os
import re
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from regil_wrappers import Demonstration

from regil_sb3 import TD3BC, training
from regil_sb3.checkpoint import CheckpointCallback
from regil_sb3.cli import main
from regil_sb3.evaluation import METHODS
from regil_sb3.run_folder import locked, save_model
from regil_sb3.settings import Settings, make_settings, presets
from regil_sb3.training import TrainingCallback, make_env

ENV = "regil/metaworld-button-press-v0"
TINY = ["--set", "warmup_steps=150", "--set", "learning_starts=100", "--set", "bc_pretrain_steps=3",
        "--set", "batch_size=8", "--set", "buffer_size=500", "--set", "eval_episodes=1",
        "--episodes", "2"]  # fmt: skip


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setattr(training, "BC_UPDATES", 5)


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    path = tmp_path_factory.mktemp("demos") / "demo.hdf5"
    assert main(["record", ENV, "-o", str(path), "--seed", "3"]) == 0
    return path


@pytest.fixture(scope="module")
def run(demo, tmp_path_factory):
    """One finished run; tests read it."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "BC_UPDATES", 5)
        words = ["train", "--env", ENV, "--demo", str(demo), "--out", str(folder), "--steps", "260"]
        assert main([*words, *TINY]) == 0
    return folder


def rows(folder):
    with (folder / "progress.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_run_folder_holds_what_the_contract_names(run):
    for name in ("config.yaml", "demo.hdf5", "model.zip", "best_model.zip", "progress.csv",
                 "report.html", "evaluation.json", "episode.hdf5", "success_buffer.npz",
                 ):  # fmt: skip
        assert (run / name).stat().st_size > 0, name
    assert list(run.glob("events.out.tfevents.*"))
    results = json.loads((run / "evaluation.json").read_text())
    assert results["steps"] == 260
    assert results["frames"] == 520
    assert results["seeds"] == [1_000_000, 1_000_001]
    for method in ("policy", "guide", "bc"):
        assert results[method]["episodes"] == 2
        assert results[method]["success"] == np.mean(results[method]["successes"])
    assert any(row.get("eval/success_rate") for row in rows(run))
    assert max(float(row["time/frames"]) for row in rows(run) if row["time/frames"]) <= 520
    assert len(Demonstration.load(run / "episode.hdf5")) == results["policy"]["lengths"][0] + 1


def test_config_makes_the_run_again(run):
    settings = Settings.load(run / "config.yaml")
    again = make_settings(ENV, None, 0, 260, TINY[1:12:2])
    assert settings == again
    said = yaml.safe_load((run / "config.yaml").read_text())["defaults"]
    assert said == again.defaults()  # another version may have others
    assert said["TD3BC"]["tau"] == 0.005
    assert "warmup_steps" not in said["TD3BC"]  # it was set
    assert said["ImagePolicy"]["random_shift"] == 4
    assert said["RetrievalGuideWrapper"]["step_pattern"] == "symmetric"


def test_evaluate_and_report_again(run, capsys):
    before = json.loads((run / "evaluation.json").read_text())
    assert main(["evaluate", str(run), "--episodes", "1"]) == 0
    after = json.loads((run / "evaluation.json").read_text())
    for method in ("policy", "guide", "bc"):  # the same seeds give the same episodes
        assert after[method]["returns"] == pytest.approx(before[method]["returns"][:1])
    assert "guided replay" in capsys.readouterr().out
    assert main(["report", str(run)]) == 0


def test_a_run_is_never_written_over(run, demo, capsys):
    assert main(["train", "--env", ENV, "--demo", str(demo), "--out", str(run)]) == 2
    assert "holds a run already" in capsys.readouterr().err


def test_pictures_that_are_small_for_the_encoder(demo, tmp_path, monkeypatch, capsys):
    def refuse(*_):
        raise ValueError("no further")

    monkeypatch.setattr(training, "train", refuse)
    words = ["train", "--env", ENV, "--demo", str(demo), "--out", str(tmp_path / "run")]
    assert main([*words, "--set", "encoder=efficientnet-lite0"]) == 2
    said = capsys.readouterr().err
    assert "pictures of 84 px alone, which are enlarged to 224" in said
    assert f"regil record {ENV} --encoder-size 224" in said
    assert main(words) == 2
    assert "enlarged" not in capsys.readouterr().err


class Killed(BaseException):
    """What a process does not survive."""


def test_run_killed_twice_ends_as_one_never_killed(run, demo, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "run"
    step = TrainingCallback._on_step
    monkeypatch.setattr(
        training, "CheckpointCallback", functools.partial(CheckpointCallback, steps=40)
    )

    def interrupt(at, how):
        def on_step(self):
            if self.num_timesteps == at:
                how()
            return step(self)

        monkeypatch.setattr(TrainingCallback, "_on_step", on_step)

    def kill():
        raise Killed

    words = ["train", "--env", ENV, "--demo", str(demo), "--out", str(folder), "--steps", "260"]
    interrupt(70, kill)
    with pytest.raises(Killed):
        main([*words, *TINY])
    interrupt(190, functools.partial(signal.raise_signal, signal.SIGTERM))
    with pytest.raises(SystemExit) as ended:
        main(["train", "--resume", str(folder), "--episodes", "2"])
    assert ended.value.code == 75
    assert f"regil train --resume {folder}" in capsys.readouterr().err
    monkeypatch.setattr(TrainingCallback, "_on_step", step)
    assert main(["train", "--resume", str(folder), "--episodes", "2"]) == 0

    one, other = (TD3BC.load(f / "model.zip").get_parameters() for f in (folder, run))
    for name, values in one["policy"].items():
        assert torch.equal(values, other["policy"][name]), name
    # another test may have evaluated that run at other numbers of episodes
    ours, its = (
        json.loads((f / "evaluation.json").read_text())["policy"]["returns"] for f in (folder, run)
    )
    n = min(len(ours), len(its))
    assert ours[:n] == its[:n]
    logs = [
        [
            {k: v for k, v in row.items() if k not in ("time/fps", "time/time_elapsed")}
            for row in rows(f)
        ]
        for f in (folder, run)
    ]
    assert logs[0] == logs[1]
    assert not (folder / "checkpoints").exists()
    assert main(["train", "--resume", str(folder)]) == 2
    assert "has learned all its steps" in capsys.readouterr().err
    (folder / "evaluation.json").rename(folder / "old.json")  # stopped before it was written
    assert main(["train", "--resume", str(folder), "--episodes", "1"]) == 0
    again = json.loads((folder / "evaluation.json").read_text())["policy"]["returns"]
    assert again == ours[:1]


def test_run_killed_before_its_second_checkpoint_ends_as_one_never_killed(
    words, tmp_path, monkeypatch
):
    """The first is of step 0: it is gone on from, and its log begins anew."""
    words += ["--set", "env_kwargs.frozen=false", "--set", "eval_freq=20"]
    whole, killed = tmp_path / "run", tmp_path / "killed"
    assert main([*words, "--steps", "80"]) == 0
    step = TrainingCallback._on_step

    def on_step(self):
        if self.num_timesteps == 70:
            raise Killed
        return step(self)

    with monkeypatch.context() as patch:
        patch.setattr(TrainingCallback, "_on_step", on_step)
        with pytest.raises(Killed):
            main([*words, "--steps", "80", "--out", str(killed)])
    assert rows(killed)
    assert main(["train", "--resume", str(killed), "--episodes", "2"]) == 0
    one, other = (TD3BC.load(f / "model.zip").get_parameters() for f in (whole, killed))
    for name, values in one["policy"].items():
        assert torch.equal(values, other["policy"][name]), name
    assert len(rows(whole)) == len(rows(killed))


def test_two_runs_in_one_folder_are_refused(demo, tmp_path, capsys):
    folder = tmp_path / "run"
    folder.mkdir()
    words = ["train", "--env", ENV, "--demo", str(demo), "--out", str(folder)]
    with locked(folder):
        assert main(words) == 2
    assert f"process {os.getpid()} is learning in {folder}" in capsys.readouterr().err


def test_failed_save_loses_nothing(run, tmp_path, monkeypatch):
    path = tmp_path / "model.zip"
    model = TD3BC.load(run / "model.zip")
    save_model(model, path)
    good = path.read_bytes()

    def break_off(self, file):
        file.write(b"half")
        raise OSError("No space left on device")

    monkeypatch.setattr(TD3BC, "save", break_off)
    with pytest.raises(OSError, match="No space"):
        save_model(model, path)
    assert path.read_bytes() == good


def test_nan_stops_training_and_keeps_the_model(demo, tmp_path, monkeypatch, capsys):
    sample = TD3BC._store_transition

    def poison(self, buffer, action, obs, reward, dones, infos):
        if self.num_timesteps == 230:
            reward = reward * np.nan
        return sample(self, buffer, action, obs, reward, dones, infos)

    monkeypatch.setattr(TD3BC, "_store_transition", poison)
    words = ["train", "--env", ENV, "--demo", str(demo), "--out", str(tmp_path / "run")]
    assert main([*words, "--steps", "260", *TINY]) == 2
    assert "not finite at step 230" in capsys.readouterr().err
    assert TD3BC.load(tmp_path / "run" / "model.zip").num_timesteps < 230


def test_evaluation_seeds_give_the_same_frames_to_every_method(demo):
    env = make_env(make_settings(ENV), demo, n_envs=1)
    first = []
    for _ in range(2):
        env.seed(1_000_003)
        first.append(env.reset())
        env.step(np.ones((1, 4), np.float32))
    env.close()
    assert np.array_equal(*first)
    assert first[0].shape == (1, 84, 84, 6)


def test_presets_are_plain_yaml_and_fit():
    sections = presets()
    assert {"default", "quick", "paper"} <= sections.keys()
    assert sum(name.startswith("regil/metaworld-") for name in sections) == 8
    for name, section in sections.items():
        settings = make_settings(ENV, name)
        assert settings.steps == section["n_timesteps"]
        assert len(settings.wrappers("demo.hdf5")) == 2
        if name.startswith("regil/"):
            demos = {next(iter(w.values()))["demo"] for w in section["env_wrapper"]}
            assert demos == {section["demo"]} == {f"demos/{name.removeprefix('regil/')}.hdf5"}


@pytest.mark.parametrize(
    ("override", "where", "value"),
    [
        ("bc_coef=0.5", lambda s: s.hyperparams["bc_coef"], 0.5),
        ("learning_rate=3e-4", lambda s: s.hyperparams["learning_rate"], 3e-4),
        ("buffer_size=1e5", lambda s: s.hyperparams["buffer_size"], 100_000),
        ("k=9", lambda s: s.retrieval("k"), 9),
        ("frame_stack=3", lambda s: s.frame_stack, 3),
        ("env_kwargs.camera=corner2", lambda s: s.env_kwargs, {"camera": "corner2"}),
        ("guide_patience=8", lambda s: s.wrappers("d")[0][1]["guide_patience"], 8),
        ("policy_kwargs.shared_encoder=true", lambda s: s.hyperparams["policy_kwargs"],
         {"shared_encoder": True, "q_trains_encoder": False}),
        ("encoder=r3m-resnet18@w/r3m.pt", lambda s: {a["encoder"] for _, a in s.wrappers("d")},
         {f"r3m-resnet18@{Path.cwd()}/w/r3m.pt"}),  # wherever it is gone on with
    ],
)  # fmt: skip
def test_overrides(override, where, value):
    settings = make_settings(ENV, overrides=[override])
    assert where(settings) == value
    yaml.safe_dump(settings.hyperparams)


@pytest.mark.parametrize(
    ("steps", "changes", "every"),
    [(60_000, [], 2_500), (6_000, [], 1_000), (5, [], 1), (60_000, ["eval_freq=700"], 700)],
)
def test_evaluations_come_as_often_in_runs_of_any_length(steps, changes, every, tmp_path):
    settings = make_settings(ENV, steps=steps, overrides=changes)
    assert settings.eval_every == every
    settings.save(tmp_path / "config.yaml")
    assert Settings.load(tmp_path / "config.yaml") == settings
    text = (tmp_path / "config.yaml").read_text()
    (tmp_path / "older.yaml").write_text(re.sub("eval_freq: .*\n", "", text))
    assert Settings.load(tmp_path / "older.yaml").eval_freq is None


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["train"], "--env is missing"),
        (
            ["train", "--env", ENV, "--preset", "fast"],
            "preset 'fast' is unknown: use one of default",
        ),
        (["train", "--env", ENV, "--set", "bc_coeff=1"], "did you mean bc_coef"),
        (["train", "--env", ENV, "--set", "bc_coef"], "write KEY=VALUE"),
        (["train", "--env", ENV, "--set", "encoder=vgg"], "pixels"),
        (["train", "--env", "regil/metaworld-fly-v0"], "metaworld-fly"),
        (["train", "--env", ENV, "--episodes", "0"], "--episodes is 0"),
        (["train", "--env", ENV, "--set", "frame_stack=two"], "frame_stack is 'two'"),
        (["train", "--env", ENV, "--set", "n_envs=0"], "n_envs is 0"),
        (["train", "--env", ENV, "--set", "action_noise=normal"], "no setting has that name"),
        (["train", "--resume", "nowhere", "--steps", "9"], "give it alone, without --steps"),
        (["train", "--resume", "nowhere", "--steps", "0"], "give it alone, without --steps"),
        (["train", "--resume", "nowhere", "--out", "here"], "give it alone, without --out"),
        (["train", "--resume", "x", "--seed", "0", "--algo", "bc"], "without --algo, --seed"),
        (["train", "--resume", "x", "--set", "k=5", "--demo", "d"], "without --demo, --set"),
        (["evaluate", "nowhere", "--episodes", "-1"], "--episodes is -1"),
        (["train", "--resume", "nowhere"], "nowhere is not a run folder"),
        (["evaluate", "nowhere"], "nowhere is not a run folder"),
        (["report", "nowhere"], "nowhere"),
        (["record", "Pendulum-v1"], "no scripted expert"),
        (["bench", "nothing"], "nothing"),
    ],
)
def test_bad_input_is_one_line_and_status_2(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.strip().splitlines()) == 1, error
    assert not list(tmp_path.rglob("*.hdf5"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--set", "env_kwargs.nonsense=1"], "nonsense"),
        (["--set", "policy_kwargs.foo=1"], "foo"),
        (["--set", "bc_steps=0"], "bc_steps is 0"),
        (["--steps", "1500"], "end before the warm-up of 2000"),
        (["--set", "env_kwargs.camera=corner"], "camera"),
        (["--set", "env_kwargs.size=96"], "--size 96"),
    ],
)
def test_a_run_that_cannot_start_leaves_its_folder_free(change, message, demo, tmp_path, capsys):
    folder = tmp_path / "run"
    words = ["train", "--env", ENV, "--demo", str(demo), "--out", str(folder)]
    assert main([*words, *change]) == 2
    assert message in capsys.readouterr().err
    assert not (folder / "config.yaml").exists()


def test_upside_down_demonstration_is_refused_before_the_run_begins(demo, tmp_path, capsys):
    upright = Demonstration.load(demo)
    Demonstration(
        frames=upright.frames[:, ::-1], actions=upright.actions, metadata=upright.metadata
    ).save(tmp_path / "down.hdf5")
    folder = tmp_path / "run"
    words = ["train", "--env", ENV, "--demo", str(tmp_path / "down.hdf5"), "--out", str(folder)]
    assert main(words) == 2
    assert "upside down" in capsys.readouterr().err
    assert not (folder / "config.yaml").exists()


@pytest.mark.parametrize(
    ("obs", "image", "policy"),
    [("dict", "obs:front", "MultiInputPolicy"), ("state", "render", "MlpPolicy")],
)
def test_other_observations_from_recording_to_report(obs, image, policy, tmp_path):
    demo, run = tmp_path / "demo.hdf5", tmp_path / "run"
    assert main(["record", "ToyReach-v0", "-o", str(demo), "--env-kwargs", f"obs={obs}"]) == 0
    words = ["train", "--env", "ToyReach-v0", "--demo", str(demo), "--out", str(run)]
    changes = {
        **{"env_kwargs.obs": obs, "image": image, "policy": policy, "correction": "none"},
        **{"register": "false", "disturbance": 0, "warmup_steps": 25, "learning_starts": 10},
        **{"bc_pretrain_steps": 2, "buffer_size": 200, "batch_size": 4, "eval_episodes": 1},
    }
    for key, value in changes.items():
        words += ["--set", f"{key}={value}"]
    assert main([*words, "--steps", "60", "--episodes", "1"]) == 0
    assert any(row["eval/success_rate"] for row in rows(run))
    assert {"policy", "guide", "bc"} <= set(json.loads((run / "evaluation.json").read_text()))
    assert not (run / "episode.hdf5").exists()  # pictures are not all that the policy saw


def test_where_no_folder_can_be_locked_one_line_says_so(words, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "fcntl", None)  # as on Windows
    assert main(words) == 2
    assert "regil: a run folder needs Linux or macOS" in capsys.readouterr().err


def test_a_demonstration_without_actions(words, tmp_path, capsys):
    """It learns from the reward alone, with what was asked of the guide left out."""
    demo, run = tmp_path / "reach.hdf5", tmp_path / "run"
    dataclasses.replace(Demonstration.load(demo), actions=None).save(demo)
    assert main([*words, "--steps", "90"]) == 0
    assert "the demonstration has no actions: no guide" in capsys.readouterr().err
    settings = Settings.load(run / "config.yaml")
    assert [w.__name__ for w, _ in settings.wrappers("d")] == ["RetrievalRewardWrapper"]
    assert settings.guide is None
    assert (settings.hyperparams["bc_coef"], settings.warmup_steps) == (0, 0)
    assert settings.hyperparams["policy_kwargs"]["shared_encoder"]  # or nothing would train it
    assert any(row["eval/success_rate"] for row in rows(run))
    assert main(["evaluate", str(run), "--episodes", "1"]) == 0
    found = json.loads((run / "evaluation.json").read_text())
    assert {"policy", "best_policy"} == set(found) & set(METHODS)
    page = (run / "report.html").read_text()
    assert "not evaluated: " not in page
    assert "TD3 on a reward that compares pictures with it" in (run / "README.md").read_text()
    model = TD3BC.load(run / "model.zip")
    assert model.num_timesteps == 90
    assert not model.success_buffer.episodes


def test_what_is_set_beside_a_policy_without_pictures_holds():
    given = ["policy=MultiInputPolicy", "frame_stack=3", "n_steps=2", "policy_kwargs.net_arch=[8]"]
    settings = make_settings("ToyReach-v0", overrides=given)
    assert settings.frame_stack == 3
    assert settings.hyperparams["n_steps"] == 2
    assert settings.hyperparams["policy_kwargs"] == {"net_arch": [8]}
    settings = make_settings("ToyReach-v0", "rfcl", overrides=["policy=MlpPolicy"])
    assert settings.frame_stack == 1
    assert {"n_steps", "policy_kwargs"}.isdisjoint(settings.hyperparams)


def test_missing_demonstration_names_what_to_do(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["train", "--env", "Pendulum-v1"]) == 2
    error = capsys.readouterr().err
    assert "no scripted expert" in error
    assert "`regil record`" in error
    assert "--demo" in error


@pytest.mark.parametrize("entry", [{}, {"a.B": {}, "a.C": {}}, {"a.B": "register"}])
def test_a_wrapper_that_cannot_be_read_gets_one_line(entry):
    settings = Settings("toy_registered:regil/ToyReach-v0", env_wrapper=[entry])
    with pytest.raises(ValueError, match=r"write NAME, or NAME: \{"):
        settings.wrappers("demo.hdf5")
