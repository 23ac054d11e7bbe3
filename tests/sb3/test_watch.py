"""What goes wrong in silence is said once, with its number; what is well says nothing."""

from __future__ import annotations

import json
import time

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from made_run import run as made_run
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack
from test_checkpoint import At
from toy import Reach

from regil_sb3.bench.toy import new_model, toy
from regil_sb3.checkpoint import CheckpointCallback
from regil_sb3.report import write_report
from regil_sb3.watch import Watch


def distance(env):
    return -abs(30.0 - env.x) / 30.0


def learn(env_class=Reach, steps=110, also=(), file=None, **settings):
    """What is said of a run of the toy, by kind."""
    env = VecFrameStack(DummyVecEnv([lambda: env_class(reward=distance)]), 2)
    watch = Watch(file, episodes=4, guided=3, frozen=15, hung=0.3)
    new_model(env, **settings).learn(steps, [watch, *also])
    return watch.said


def test_nothing_is_said_of_what_is_well(tmp_path):
    assert learn(file=tmp_path / "warnings.jsonl", steps=200) == {}
    assert not (tmp_path / "warnings.jsonl").exists()


def test_nothing_is_said_of_a_run_of_the_command(toy_run):
    assert not (toy_run / "warnings.jsonl").exists()
    assert "Warnings" not in (toy_run / "report.html").read_text()


class Flat(Reach):
    def __init__(self, reward):
        super().__init__(reward=lambda env: -0.25)


class Lost(Reach):
    def guide_action(self):
        return np.array([-0.5, 0.1], np.float32)


class Still(Reach):
    def _obs(self):
        return np.full((40, 40, 3), 9, np.uint8)


class Slow(Reach):
    def step(self, action):
        if len(self.executed) == 20:
            time.sleep(1.2)
        return super().step(action)


@pytest.mark.parametrize(
    ("env", "kind", "line"),
    [
        (Flat, "reward", "the retrieval reward was -0.25 at every step of 4 episodes"),
        (Lost, "guide", "the guide has not succeeded in its first 3 episodes"),
        (Lost, "success_buffer", "no episode of the warm-up's 60 steps was a success"),
        (Still, "frozen", "environment 0 has not changed for 15 steps"),
        (Slow, "hung", "an environment has not answered for 0"),
    ],
)
def test_what_is_wrong_is_said_once(env, kind, line, tmp_path, capsys):
    file = tmp_path / "warnings.jsonl"
    file.write_text("half a line\n")
    said = learn(env, file=file)
    assert set(said) == {"guide", "success_buffer"} if env is Lost else {kind}
    assert line in said[kind]
    kept = [json.loads(text) for text in file.read_text().splitlines()[1:]]
    assert [w["text"] for w in kept] == list(said.values())
    assert all(w["value"] is not None and w["step"] > 0 for w in kept)
    assert capsys.readouterr().err.count(line) == 1
    assert Watch(file).said == said  # so that a run that goes on does not say it again
    if kind == "hung":
        assert "test_watch.py" in said[kind]


@pytest.mark.parametrize("n_envs", [3, 4])
def test_a_flat_reward_of_several_environments(n_envs):
    env = VecFrameStack(DummyVecEnv([lambda: Flat(reward=distance)] * n_envs), 2)
    watch = Watch(None, episodes=10, guided=3, frozen=15, hung=5)
    new_model(env).learn(400, watch)
    assert "at every step of 1" in watch.said["reward"]


def test_a_critic_that_diverges_is_named():
    class Bias(BaseCallback):
        def _on_step(self):
            if self.num_timesteps > 60:
                with th.no_grad():
                    self.model.critic.qf0[-1].bias += 100.0
                    self.model.critic_target.qf0[-1].bias += 100.0
            return True

    said = learn(also=[Bias()], steps=250, gamma=0.9)
    assert list(said) == ["q"]
    assert "rewards of at most" in said["q"]


def test_warnings_are_on_the_page_of_a_run(tmp_path):
    folder = made_run(tmp_path / "run", films=False)
    line = {"step": 7, "kind": "reward", "value": 1, "text": "a <b>bad</b> reward"}
    (folder / "warnings.jsonl").write_text(json.dumps(line) + "\n[1]\n{")
    page = write_report(folder).read_text()
    assert "<h2>Warnings</h2><ul><li>step 7: a &lt;b&gt;bad&lt;/b&gt; reward</li></ul>" in page


class Broken(gym.Wrapper):
    """Says a number that is none at one of its steps."""

    def __init__(self, what, at=40):
        super().__init__(gym.make("Pendulum-v1"))
        self.what, self.left = what, at

    def step(self, action):
        seen, reward, *rest = self.env.step(action)
        self.left -= 1
        if self.left == 0 and self.what == "reward":
            reward = np.inf
        if self.left == 0 and self.what == "observation":
            seen = seen * np.nan
        return seen, reward, *rest


@pytest.mark.parametrize("what", ["reward", "observation"])
@pytest.mark.parametrize("algorithm", [SAC, PPO])
def test_what_is_not_finite_ends_any_algorithm(what, algorithm):
    model = algorithm("MlpPolicy", Broken(what), device="cpu")
    with pytest.raises(FloatingPointError, match=f"{what} of environment 0 is not .* at step 40:"):
        model.learn(100, Watch())


def test_a_parameter_that_is_not_finite_is_not_saved(tmp_path):
    model = new_model(toy(), learning_starts=1_000)

    def spoil():
        with th.no_grad():
            next(model.actor.parameters())[0] = np.nan

    callbacks = [CheckpointCallback(tmp_path, steps=25), At(40, spoil)]
    with pytest.raises(FloatingPointError, match=r"parameter actor.* is not finite at step 50"):
        model.learn(110, callbacks)
    assert CheckpointCallback(tmp_path).restore(new_model(toy())) == 25


def test_a_gradient_that_is_not_finite_changes_no_parameter():
    model = new_model(toy())
    parameter = model.critic.qf0[-1].bias

    def spoil():
        parameter.register_hook(lambda gradient: gradient * np.inf)

    with pytest.raises(FloatingPointError, match=r"critic's gradient is .* at step 70, update"):
        model.learn(110, At(70, spoil))
    assert all(bool(th.isfinite(p).all()) for p in model.policy.parameters())


@pytest.mark.parametrize("argument", ["episodes", "guided", "frozen", "hung"])
def test_bad_arguments(argument):
    with pytest.raises(ValueError, match=f"{argument}=0"):
        Watch(**{argument: 0})
