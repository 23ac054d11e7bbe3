"""Runs that are killed and go on end as runs that never were, to the bit."""

from __future__ import annotations

import copy
import errno
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch as th
from at_step import At
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import HParam, Video, configure
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack
from toy import Reach

from regil_sb3 import VecRetrievalGuide, VecRetrievalReward
from regil_sb3.bench import toy as toy_module
from regil_sb3.bench.toy import STEPS, demonstration, flat, new_model, toy
from regil_sb3.checkpoint import (
    CheckpointCallback,
    Preempted,
    ReplayableEpisode,
    callback,
)


class Killed(BaseException):
    """What a process does not survive."""


class KillAt(BaseCallback):
    def __init__(self, step):
        super().__init__()
        self.step = step

    def _on_step(self):
        if self.num_timesteps >= self.step:
            raise Killed
        return True


def assert_same(ended, never_killed):
    a, b = dict(flat(ended)), dict(flat(never_killed))
    assert a.keys() == b.keys()
    different = [at for at in a if not np.array_equal(a[at], b[at])]
    assert not different


def live(folder, env, kill_at=None, every=23, **changes):
    """One life of a process: its model's state at the end, or None where it was killed."""

    def killer(done):
        return () if kill_at is None else [KillAt(done + kill_at)]

    try:
        return toy_module.live(folder, env, every, killer, **changes)
    except Killed:
        return None


@pytest.mark.parametrize(
    ("of_env", "changes"),
    [
        ({}, {}),
        ({"n_envs": 2}, {"train_freq": 3, "gradient_steps": 2}),
        (
            {"dict_obs": True},
            {"policy": "MultiInputPolicy", "n_steps": 1, "demo": None, "bc_coef": 0.0},
        ),
    ],
    ids=["images", "two environments", "dict"],
)
def test_killed_again_and_again_ends_the_same(of_env, changes, tmp_path):
    never_killed = live(tmp_path / "whole", toy(**of_env), **changes)
    rng = np.random.default_rng(0)
    ended, lives = None, 0
    while ended is None:
        lives += 1
        ended = live(tmp_path / "chain", toy(**of_env), int(rng.integers(2, 70)), **changes)
    assert lives > 4
    assert_same(ended, never_killed)


@pytest.mark.parametrize("n_envs", [1, 2])
def test_killed_before_its_second_checkpoint_ends_the_same(n_envs, tmp_path):
    """The first is of step 0, where environments have been reset already."""
    never_killed = live(tmp_path / "whole", toy(n_envs), every=90)
    assert live(tmp_path / "chain", toy(n_envs), 40, every=90) is None
    again = CheckpointCallback(tmp_path / "chain")
    assert not again.restored
    assert again.restore(new_model(toy(n_envs))) == 0
    assert again.restored
    assert_same(live(tmp_path / "chain", toy(n_envs), every=90), never_killed)


def test_open_episodes_that_cannot_be_replayed_are_truncated(tmp_path):
    assert live(tmp_path, toy(replayable=False), 100, every=25) is None
    model = new_model(toy(replayable=False))
    checkpoints = CheckpointCallback(tmp_path, steps=25)
    with pytest.warns(UserWarning, match="ended as truncated: its environment is no Replayable"):
        done = checkpoints.restore(model)
    (generator,) = model.env.get_attr("np_random")
    goes_on = copy.deepcopy(generator).uniform(0, 12)
    buffer = model.replay_buffer
    assert done == buffer.total == 75
    was_open = buffer.dones[done - 1] == 0
    assert was_open.all()
    model.learn(1, reset_num_timesteps=False)
    x = model.env.get_attr("x")[0] - 4 * buffer.actions[done, 0, 0]
    assert x == pytest.approx(goes_on)  # and does not begin again with the run's seed
    model.learn(STEPS - done - 1, checkpoints, reset_num_timesteps=False)
    assert (buffer.timeouts[done - 1] == 1).all()
    assert model.num_timesteps == STEPS


class Moody(Reach):
    """Where it goes does not follow from its generator."""

    lives = 0

    def reset(self, **kwargs):
        out = super().reset(**kwargs)
        Moody.lives += 1
        self.x += 0.1 * Moody.lives
        return out

    def step(self, action):
        observation, reward, *rest = super().step(action)
        return observation, reward - self.x, *rest


def test_an_environment_that_is_not_deterministic_is_found_out(tmp_path):
    def moody():
        return VecFrameStack(DummyVecEnv([lambda: ReplayableEpisode(Moody())]), 2)

    assert live(tmp_path, moody(), 100, every=27) is None
    model = new_model(moody())
    with pytest.warns(UserWarning, match="environment 0: its step 1 returned -"):
        done = CheckpointCallback(tmp_path).restore(model)
    model.learn(STEPS - done, reset_num_timesteps=False)


def test_episodes_inside_vectorised_retrieval_are_truncated(tmp_path):
    def made():
        env = VecRetrievalReward(toy().venv, demo)
        return VecFrameStack(VecRetrievalGuide(env, demo), 2)

    demo = demonstration()

    assert live(tmp_path, made(), 100, every=27) is None
    model = new_model(made())
    checkpoints = CheckpointCallback(tmp_path)
    with pytest.warns(
        UserWarning, match="as truncated: no episode inside VecRetrievalGuide or Vec"
    ):
        done = checkpoints.restore(model)
    assert done == 81
    model.learn(STEPS - done, checkpoints, reset_num_timesteps=False)
    assert model.num_timesteps == STEPS
    assert (model.replay_buffer.timeouts[done - 1] == 1).all()


def test_on_fewer_devices_the_generators_that_there_are_come_back(tmp_path, monkeypatch):
    checkpoints, again = CheckpointCallback(tmp_path), new_model(toy())
    new_model(toy()).learn(5, checkpoints)
    took = {}
    monkeypatch.setattr(th.cuda, "is_available", lambda: True)
    monkeypatch.setattr(th.cuda, "get_rng_state_all", lambda: [th.tensor([i]) for i in range(3)])
    monkeypatch.setattr(th.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(th.cuda, "set_rng_state_all", lambda all: took.update(enumerate(all)))
    checkpoints.save()
    assert CheckpointCallback(tmp_path).restore(again) == 5
    assert {i: state.item() for i, state in took.items()} == {0: 0, 1: 1}


def test_another_model_is_refused(tmp_path):
    assert live(tmp_path, toy(), 50) is None
    other = new_model(toy(), buffer_size=151)
    with pytest.raises(ValueError, match="with the same arguments"):
        CheckpointCallback(tmp_path).restore(other)
    with pytest.raises(ValueError, match="the checkpoint is of other networks"):
        CheckpointCallback(tmp_path).restore(new_model(toy(), policy_kwargs={"net_arch": [8]}))


@pytest.mark.parametrize(
    ("number", "ends"), [(signal.SIGTERM, Preempted), (signal.SIGINT, KeyboardInterrupt)]
)
def test_told_to_end_it_saves_the_step_under_way(number, ends, tmp_path):
    class Tell(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 90:
                signal.raise_signal(number)
            return True

    before = signal.getsignal(number)
    checkpoints = CheckpointCallback(tmp_path)
    model = new_model(toy())
    with pytest.raises(ends) as told:
        model.learn(STEPS, CallbackList([checkpoints, Tell()]))
    assert signal.getsignal(number) is before
    if ends is Preempted:
        assert told.value.code == 75
    again = new_model(toy())
    assert CheckpointCallback(tmp_path).restore(again) == 90


def test_forked_processes_end_when_told(tmp_path):
    """Those of environments, as a vector environment starts them, inherit the handlers."""

    class Fork(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 20:
                here, there = multiprocessing.Pipe()
                context = multiprocessing.get_context("fork")
                child = context.Process(target=lambda: (there.send(1), time.sleep(60)))
                child.start()
                here.recv()  # Python forgets a signal that comes while it forks
                child.terminate()
                child.join(30)
                self.exitcode = child.exitcode
            return True

    fork = Fork()
    new_model(toy()).learn(40, [CheckpointCallback(tmp_path), fork])
    assert fork.exitcode == -signal.SIGTERM


def test_a_full_disk_is_named_and_training_goes_on(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    class Fill(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 55:
                monkeypatch.setattr(os, "write", full)
            return True

    model = new_model(toy())
    with pytest.warns(UserWarning, match="at step 75 could not be saved .*No space.* of step 50"):
        model.learn(110, [CheckpointCallback(tmp_path, steps=25), Fill()])
    assert model.num_timesteps == 110
    assert CheckpointCallback(tmp_path).restore(new_model(toy())) == 50


def test_learning_again_from_step_0_is_saved_as_the_first_time(tmp_path):
    model = new_model(toy())
    checkpoints = CheckpointCallback(tmp_path, steps=25)
    model.learn(110, checkpoints)
    model.learn(60, checkpoints)
    assert CheckpointCallback(tmp_path).restore(new_model(toy())) == 50


@pytest.mark.parametrize("steps", [None, 1000])
def test_learning_again_is_saved_at_once(steps, tmp_path):
    model = new_model(toy())
    checkpoints = CheckpointCallback(tmp_path, steps=steps)
    model.learn(40, checkpoints)
    updates = model._n_updates
    model.learn(30, checkpoints)
    again = new_model(toy())
    assert CheckpointCallback(tmp_path).restore(again) == 0
    assert again._n_updates == updates > 0


def test_what_takes_too_long_is_broken_off(tmp_path):
    class Hang(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 90:
                signal.raise_signal(signal.SIGTERM)
                threading.Event().wait(60)
            return True

    checkpoints = CheckpointCallback(tmp_path, steps=40, grace=0.2)
    with pytest.raises(Preempted):
        new_model(toy()).learn(STEPS, [checkpoints, Hang()])
    assert CheckpointCallback(tmp_path).restore(new_model(toy())) == 80


def test_what_only_tensorboard_takes_is_not_kept(tmp_path):
    """As SB3's documentation logs hyperparameters and figures."""

    class Log(BaseCallback):
        def _on_training_start(self):
            hparams = HParam({"gamma": self.model.gamma}, {"rollout/ep_len_mean": 0.0})
            self.logger.record("hparams", hparams, exclude=("stdout", "log", "json", "csv"))

        def _on_step(self):
            self.logger.record("film", Video(th.zeros(1, 1, 3, 2, 2), fps=1))
            self.logger.record("note", "text")
            self.logger.record_mean("mean", np.float32(self.num_timesteps))
            return True

    checkpoints = CheckpointCallback(tmp_path, steps=5)
    new_model(toy()).learn(7, [Log(), checkpoints])
    again = CheckpointCallback(tmp_path)
    assert again.restore(new_model(toy())) == 5
    values, counts, excluded = again._pending
    assert (values, counts) == ({"note": "text", "mean": 3.0}, {"mean": 5})
    assert excluded.keys() == values.keys()


def test_what_was_logged_before_is_written_after(tmp_path):
    """TensorBoard's log, of SB3, wants to know of each value which logs leave it out."""
    once = At(3, lambda: model.logger.record("once", 1.0, exclude="csv"))
    model = new_model(toy())
    model.learn(7, [once, CheckpointCallback(tmp_path, steps=5)])
    again, checkpoints = new_model(toy()), CheckpointCallback(tmp_path)
    again.set_logger(configure(str(tmp_path / "log"), ["tensorboard", "csv"]))
    checkpoints.restore(again)
    again.learn(20, [checkpoints, At(7, again.dump_logs)], reset_num_timesteps=False)
    again.logger.close()
    assert "once" not in (tmp_path / "log" / "progress.csv").read_text().splitlines()[0]


def test_a_removed_folder_is_noticed_and_training_goes_on(tmp_path):
    folder = tmp_path / "run" / "checkpoints"
    remove = At(90, lambda: shutil.rmtree(tmp_path / "run"))
    with pytest.warns(UserWarning, match="are gone: training goes on, and one is saved at step 90"):
        new_model(toy()).learn(130, [CheckpointCallback(folder, steps=25), remove])
    assert CheckpointCallback(folder).restore(new_model(toy())) == 115


def test_where_no_folder_can_be_made_none_is_claimed(tmp_path):
    folder = tmp_path / "run" / "checkpoints"

    def replace():
        shutil.rmtree(tmp_path / "run")
        (tmp_path / "run").touch()

    with pytest.warns(UserWarning, match="checkpoint") as said:
        new_model(toy()).learn(130, [CheckpointCallback(folder, steps=25), At(90, replace)])
    lines = [str(w.message) for w in said]
    assert ["are gone" in line for line in lines] == [True, False]
    assert lines[1].endswith("training goes on; there is none")


def test_a_state_that_this_version_does_not_know_is_refused(tmp_path, monkeypatch):
    assert live(tmp_path, toy(), 50) is None
    monkeypatch.setattr(
        callback, "load_learner_state", lambda model, state: state["something newer"]
    )
    with pytest.raises(ValueError, match=r"written by regil-sb3 .* go on with that version"):
        CheckpointCallback(tmp_path).restore(new_model(toy()))


def test_noise_with_a_state_is_refused(tmp_path):
    zeros = np.zeros(2)
    walk = OrnsteinUhlenbeckActionNoise(zeros, zeros + 0.1)
    for n_envs in (1, 2):
        model = new_model(toy(n_envs), action_noise=walk)
        with pytest.raises(ValueError, match="state of a OrnsteinUhlenbeckActionNoise: use Normal"):
            model.learn(40, CheckpointCallback(tmp_path))
    calm = NormalActionNoise(zeros, zeros + 0.1)
    new_model(toy(2), action_noise=calm).learn(40, CheckpointCallback(tmp_path))


def test_a_second_signal_ends_a_save_that_hangs(tmp_path, monkeypatch):
    hung = threading.Event()

    def hang(*_):
        hung.set()
        for _ in range(3_000):  # a signal just before a long sleep would not end it
            time.sleep(0.01)

    def begin():
        monkeypatch.setattr(os, "fsync", hang)
        threading.Thread(target=interrupt_twice).start()

    def interrupt_twice():
        hung.wait(300)
        os.kill(os.getpid(), signal.SIGINT)
        while checkpoints._told is None:  # two that are pending at once are one
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGINT)

    checkpoints = CheckpointCallback(tmp_path, steps=40)
    with pytest.raises(KeyboardInterrupt):
        new_model(toy()).learn(200, [checkpoints, At(79, begin)])
    monkeypatch.undo()
    assert CheckpointCallback(tmp_path).restore(new_model(toy())) == 40


CHILD = """
import sys
from pathlib import Path
from regil_sb3.bench.toy import digest, live, toy
print(digest(live(Path(sys.argv[1]), toy(), 9)))
"""


def test_a_process_killed_for_real(tmp_path):
    def child(folder):
        return subprocess.Popen(
            [sys.executable, "-c", CHILD, str(folder)],
            cwd=Path(__file__).parent,
            stdout=subprocess.PIPE,
            text=True,
        )

    def generations(folder):
        return [int(p.name) for p in folder.glob("0*") if p.name.isdecimal()]

    whole = child(tmp_path / "whole")
    for stop_at in (4, 12):
        killed = child(tmp_path / "chain")
        while max(generations(tmp_path / "chain"), default=0) < stop_at:
            assert killed.poll() is None, "it ended before it was killed"
            threading.Event().wait(0.01)
        killed.kill()
        assert killed.wait() == -signal.SIGKILL
        killed.stdout.close()
    last = child(tmp_path / "chain")
    ends = [process.communicate()[0] for process in (whole, last)]
    assert whole.returncode == last.returncode == 0
    assert ends[0] == ends[1] != ""
