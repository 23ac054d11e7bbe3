"""TD3BC with its updates beside the control loop."""

from __future__ import annotations

import csv
import json
import signal
import threading
import time

import gymnasium as gym
import numpy as np
import pytest
import toy_env
from at_step import At
from regil_wrappers import Demonstration, RetrievalGuideWrapper, RetrievalRewardWrapper
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from regil_sb3 import TD3BC, training
from regil_sb3.background import BackgroundTD3BC
from regil_sb3.checkpoint import CheckpointCallback, ReplayableEpisode, callback
from regil_sb3.checkpoint.learner_state import learner_state
from regil_sb3.cli import main
from regil_sb3.evaluation import METHODS
from regil_sb3.settings import Settings, make_settings


def made(demo, pauses=None, replayable=False, **arguments):
    def make():
        env = toy_env.ToyReach()
        if pauses is not None:
            env.pause = lambda: pauses.append("pause")
            env.resume = lambda: pauses.append("resume")
        env = RetrievalRewardWrapper(RetrievalGuideWrapper(env, demo=demo), demo=demo)
        return ReplayableEpisode(env) if replayable else env

    settings = {
        "warmup_steps": 60,
        "learning_starts": 20,
        "bc_pretrain_steps": 10,
        "buffer_size": 1000,
        "batch_size": 8,
        "seed": 0,
    }
    envs = VecFrameStack(DummyVecEnv([make]), 2)
    return BackgroundTD3BC("CnnPolicy", envs, demo=demo, **(settings | arguments))


def test_it_does_all_updates_and_keeps_all_transitions(demo):
    pauses = []
    model = made(demo, pauses).learn(200)
    assert model.num_timesteps == model.replay_buffer.total == 200
    assert model._n_updates == (200 - 20) // 2
    assert model.pretrained
    assert model.success_buffer.episodes > 1
    assert pauses == ["pause", "resume"] * 2  # the updates at the end of the warm-up; the last ones


def test_what_acts_is_what_has_learned(demo):
    model = made(demo)
    seen = model.env.reset()
    before = model.predict(seen, deterministic=True)[0]
    model.learn(150)
    after = model.predict(seen, deterministic=True)[0]
    assert not np.allclose(before, after)
    assert model._acting is None


def test_it_is_saved_and_loaded_as_td3bc(demo, tmp_path):
    model = made(demo).learn(100)
    model.save(tmp_path / "model.zip")
    loaded = TD3BC.load(tmp_path / "model.zip", buffer_size=1)
    seen = model.env.reset()
    assert np.array_equal(loaded.predict(seen)[0], model.predict(seen)[0])


def test_collecting_does_not_wait_for_updates(demo, monkeypatch):
    collected = threading.Event()
    pays = TD3BC.train

    def train(self, *arguments):
        assert collected.wait(60)  # if collecting waited for this, it would wait for ever
        pays(self, *arguments)

    monkeypatch.setattr(TD3BC, "train", train)
    model = made(demo, warmup_steps=1000, learning_starts=0)

    def step(*_):
        if model.num_timesteps == 60:
            assert model._n_updates == 0
            collected.set()
        return True

    model.learn(60, callback=step)
    assert model._n_updates == 30


def slow(monkeypatch):
    """Updates that take longer than steps; whether one is under way."""
    pays, under_way = TD3BC.train, threading.Event()

    def train(self, *arguments):
        under_way.set()
        time.sleep(0.05)
        pays(self, *arguments)
        under_way.clear()

    monkeypatch.setattr(TD3BC, "train", train)
    return under_way


def test_a_checkpoint_is_whole_while_it_learns(demo, tmp_path, monkeypatch):
    owed, pauses, under_way = [], [], slow(monkeypatch)

    def state(model):
        assert pauses[-1] == "pause"
        assert model.replay_buffer.total == model.num_timesteps
        assert model._n_updates + model._owed == max(0, model.num_timesteps - 20) // 2
        owed.append(model._owed)
        time.sleep(0.05)
        assert not under_way.is_set()
        return learner_state(model)

    monkeypatch.setattr(callback, "learner_state", state)
    model = made(demo, pauses, warmup_steps=1000, replayable=True)
    model.learn(100, CheckpointCallback(tmp_path, steps=10))
    assert len(owed) == 10
    assert max(owed) > 0  # it was saved in the middle of its work
    assert model._n_updates == 40


def test_going_on_it_does_the_updates_that_were_owed(demo, tmp_path, monkeypatch):
    def stop():
        raise KeyboardInterrupt

    slow(monkeypatch)
    checkpoints = CheckpointCallback(tmp_path, steps=10)
    model = made(demo, replayable=True)
    with pytest.raises(KeyboardInterrupt):
        model.learn(100, [checkpoints, At(93, stop)])
    assert model._owed == 0
    again = made(demo, replayable=True)
    assert CheckpointCallback(tmp_path).restore(again) == 90
    assert again._owed > 0
    assert again._n_updates + again._owed == 35
    again.learn(30, reset_num_timesteps=False)
    assert again._n_updates == 50
    assert again.replay_buffer.total == 120
    assert again._owed == 0


def test_a_failure_of_the_learner_ends_a_save(demo, tmp_path, monkeypatch):
    def broken(self, *_):
        raise FloatingPointError("critic loss is nan")

    monkeypatch.setattr(TD3BC, "_require_finite", broken)
    with pytest.raises(FloatingPointError, match="critic loss is nan"):
        made(demo).learn(5_000, CheckpointCallback(tmp_path, steps=1))
    assert CheckpointCallback(tmp_path).generations.numbers


def test_a_failure_of_the_learner_ends_learning(demo, monkeypatch):
    def broken(self, *_):
        raise FloatingPointError("critic loss is nan")

    monkeypatch.setattr(BackgroundTD3BC, "_empty_inbox", lambda self: None)
    monkeypatch.setattr(TD3BC, "_require_finite", broken)
    with pytest.raises(FloatingPointError, match="critic loss is nan"):
        made(demo).learn(5_000)


def test_who_leaves_does_not_wait_for_the_updates_by_cloning(demo, monkeypatch):
    made_so_far = []
    pays = TD3BC._bc_term

    def bc_term(self):
        made_so_far.append(1)
        time.sleep(0.01)
        return pays(self)

    monkeypatch.setattr(TD3BC, "_bc_term", bc_term)
    model = made(demo, warmup_steps=10, bc_pretrain_steps=10**6)
    main_thread = threading.main_thread().ident

    def interrupt():
        while len(made_so_far) < 5:
            time.sleep(0.01)
        signal.pthread_kill(main_thread, signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        model.learn(100)
    assert 5 <= len(made_so_far) < 10**4
    assert not model.pretrained


def test_who_stops_waits_for_the_updates_by_cloning(demo, monkeypatch):
    slow(monkeypatch)
    model = made(demo, warmup_steps=20, learning_starts=0, train_freq=7, gradient_steps=7)
    model.learn(1_000, callback=lambda *_: model.in_warmup or model.num_timesteps < 20)
    assert model.num_timesteps < 60
    assert model.pretrained


class StoppedError(Exception):
    """Before the evaluation."""


class Robot(toy_env.ToyReach):
    """There is one camera and one arm."""

    open_ones = 0
    steps_of_all = 0
    put_back = 0
    in_vain = 0
    played = True

    def __init__(self, **settings):
        if Robot.open_ones:
            raise RuntimeError("the camera is in use")
        super().__init__(**settings)
        Robot.open_ones += 1
        self.metadata["regil"]["exists_once"] = True

    def reset(self, *, seed=None, options=None):
        Robot.put_back += 1
        Robot.in_vain += not self.played
        self.played = False
        return super().reset(seed=seed, options=options)

    def step(self, action):
        Robot.steps_of_all += 1
        self.played = True
        return super().step(action)

    def close(self):
        Robot.open_ones -= 1


@pytest.fixture
def robot(words, monkeypatch):
    """Words of a `regil train` on it."""
    monkeypatch.setattr(Robot, "open_ones", 0)
    monkeypatch.setattr(Robot, "in_vain", 0)
    monkeypatch.setattr(training, "BC_UPDATES", 3)
    gym.register("OneRobot-v0", Robot)
    yield [*(word.replace("ToyReach", "OneRobot") for word in words), "--algo", "td3bc-background"]
    assert Robot.open_ones == 0
    del gym.registry["OneRobot-v0"]


def test_a_robot_is_opened_once_at_a_time(robot, tmp_path, capsys):
    run = tmp_path / "run"
    assert main(robot) == 0
    said = capsys.readouterr()
    assert "OneRobot-v0 exists once: the policy is evaluated when all is learned" in said.err
    settings = Settings.load(run / "config.yaml")
    assert (settings.algo, settings.eval_episodes) == ("td3bc-background", 0)
    assert not (run / "best_model.zip").exists()
    found = json.loads((run / "evaluation.json").read_text())
    assert {"policy", "guide", "bc"} == found.keys() & METHODS.keys()
    assert found["steps"] == 200
    with (run / "progress.csv").open(newline="") as file:
        logged = list(csv.DictReader(file))
    assert {"train/updates_owed", "time/guided"} <= logged[-1].keys()
    assert "eval/success_rate" not in logged[-1]
    assert "from regil_sb3.background import BackgroundTD3BC\n" in (run / "README.md").read_text()
    assert main(["report", str(run)]) == 0
    Robot.put_back = 0
    assert main(["evaluate", str(run), "--episodes", "3"]) == 0
    found = json.loads((run / "evaluation.json").read_text())
    played = sum(found[name]["episodes"] for name in METHODS if name in found)
    assert Robot.put_back == played  # the scene, once for each
    assert Robot.in_vain == 0


def test_several_of_a_robot_are_refused(robot, capsys):
    assert main([*robot, "--set", "n_envs=2"]) == 2
    assert "OneRobot-v0 exists once: n_envs is 2, take 1" in capsys.readouterr().err


def test_a_robot_does_nothing_again_when_a_run_goes_on(robot, tmp_path, monkeypatch, capsys):
    """Its open episode is ended, not repeated."""
    step = training.TrainingCallback._on_step

    def on_step(self):
        if self.num_timesteps == 130:
            signal.raise_signal(signal.SIGTERM)
        return step(self)

    monkeypatch.setattr(training.TrainingCallback, "_on_step", on_step)
    with pytest.raises(SystemExit):
        main(robot)
    monkeypatch.setattr(training.TrainingCallback, "_on_step", step)
    monkeypatch.setattr(Robot, "steps_of_all", 0)
    monkeypatch.setattr(Robot, "put_back", 0)
    restore, before = training.CheckpointCallback.restore, []

    def restored(self, model):
        before.append(Robot.put_back)
        return restore(self, model)

    monkeypatch.setattr(training.CheckpointCallback, "restore", restored)
    monkeypatch.setattr(training, "evaluate_run", lambda *_: (_ for _ in ()).throw(StoppedError))
    capsys.readouterr()
    with pytest.raises(StoppedError), pytest.warns(UserWarning, match="ended as truncated"):
        main(["train", "--resume", str(tmp_path / "run")])
    assert Robot.steps_of_all == 200 - 130
    assert before == [0]  # the guide goes on from what was saved: the scene is put back after that
    assert Robot.put_back > 0
    assert Robot.in_vain == 0


def test_a_robot_is_paused_while_the_policy_is_evaluated_in_another(words, tmp_path, monkeypatch):
    told, meanwhile = [], []
    evaluate = training.evaluate

    def evaluated(*arguments):
        meanwhile.append(told[-1])
        return evaluate(*arguments)

    for name in ("pause", "resume"):
        monkeypatch.setattr(
            toy_env.ToyReach, name, lambda self, name=name: told.append(name), raising=False
        )
    monkeypatch.setattr(training, "evaluate", evaluated)
    settings = [word for word in words[words.index("--set") :] if word != "--set"]
    made = make_settings("ToyReach-v0", None, 0, 120, settings, "td3bc-background")
    training.train(made, Demonstration.load(tmp_path / "reach.hdf5"), tmp_path / "run")
    assert meanwhile == ["pause"] * len(meanwhile)
    assert len(meanwhile) > 2
    assert told[-1] == "resume"
