"""The guided warm-up of algorithms that know nothing of guides."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from sb3_contrib import TQC
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv
from toy import Reach, demonstration

from regil_sb3 import TD3BC, GuidedWarmup, VecRetrievalGuide, VecRetrievalReward

HIGH = 2.0


def reach(n_envs=1, env=Reach):
    return DummyVecEnv([lambda: env(action_high=HIGH, dict_obs=True)] * n_envs)


def model(algorithm, env, **kwargs):
    kwargs = {"learning_starts": 40, "batch_size": 8, "buffer_size": 500, "seed": 0, **kwargs}
    return algorithm("MultiInputPolicy", env, **kwargs)


def stored(learner, env):
    """Actions that the replay buffer holds of an environment, in its own units."""
    buffer = learner.replay_buffer
    return HIGH * buffer.actions[: buffer.pos, env]


def by_guide(actions):
    """Where the toy's guide acted: nothing else always says 0.1 of the second dimension."""
    return np.isclose(actions[:, 1], 0.1 * HIGH)


@pytest.mark.parametrize("algorithm", [SAC, TQC, TD3])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_the_guide_acts_and_what_was_executed_is_stored(algorithm, n_envs):
    env = reach(n_envs)
    noise = {"action_noise": NormalActionNoise(np.zeros(2), np.ones(2))} if n_envs == 1 else {}
    learner = model(algorithm, env, **noise).learn(120, callback=GuidedWarmup(60))
    for i in range(n_envs):
        executed = np.array(env.envs[i].executed)
        assert np.allclose(stored(learner, i), executed, atol=1e-6)
        acted = by_guide(executed)
        warmup = int(acted.argmin())
        assert acted[:warmup].all()
        assert not acted[warmup:].any()
        # to the end of the episode begun in warm-up, and no further
        assert 60 <= warmup * n_envs < 60 + n_envs * (Reach.LENGTH + 1)
        assert learner.replay_buffer.dones[warmup - 1, i]
    assert learner._n_updates > 0
    assert type(learner) is algorithm


class Disturbed(Reach):
    def disturbed_action(self):
        return np.array([0.4, -0.3], np.float32) * self.action_space.high


def test_a_disturbing_guide_is_executed_and_stored_as_disturbed():
    env = reach(2, Disturbed)
    learner = model(SAC, env).learn(40, callback=GuidedWarmup(100))
    for i in range(2):
        assert np.allclose(env.envs[i].executed, np.array([0.4, -0.3]) * HIGH)
        assert np.allclose(stored(learner, i), env.envs[i].executed)


def test_a_vector_guide_with_states(demo):
    env = make_vec_env("ToyReach-v0", 2, env_kwargs={"obs": "dict"})
    env = VecRetrievalGuide(env, demo, image="obs:front")
    env = VecRetrievalReward(env, demo, image="obs:front")
    learner = model(SAC, env).learn(80, callback=GuidedWarmup(80))
    expert = demo.actions
    played = learner.replay_buffer.actions[: learner.replay_buffer.pos]
    for i in range(2):  # nothing moves in this toy: its guide replays the expert
        assert np.allclose(played[: len(expert), i], expert)
    rewards = learner.replay_buffer.rewards[: len(expert)]
    assert np.allclose(rewards, 0, atol=1e-6)


def test_a_model_saved_in_the_warm_up_is_one_of_its_class(tmp_path):
    keep = CheckpointCallback(20, str(tmp_path))
    learner = model(SAC, reach()).learn(50, callback=[GuidedWarmup(30), keep])
    again = SAC.load(tmp_path / "rl_model_20_steps.zip", env=reach())
    assert type(again) is SAC
    assert again.num_timesteps == 20
    env = again.get_env()
    again.learn(60, callback=GuidedWarmup(30), reset_num_timesteps=False)
    assert by_guide(np.array(env.envs[0].executed))[:10].all()
    assert not by_guide(np.array(env.envs[0].executed))[-30:].any()
    env = learner.get_env()
    before = len(env.envs[0].executed)
    learner.learn(20, callback=GuidedWarmup(30), reset_num_timesteps=False)  # past its warm-up
    assert not by_guide(np.array(env.envs[0].executed[before:])).any()


def test_learning_that_was_interrupted_leaves_nothing_behind():
    learner = model(SAC, reach())

    class Interrupt(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 10:
                raise KeyboardInterrupt
            return True

    warmup = GuidedWarmup(30)
    with pytest.raises(KeyboardInterrupt):
        learner.learn(50, callback=[warmup, Interrupt()])
    learner.learn(50, callback=warmup, reset_num_timesteps=False)
    assert type(learner) is SAC


@pytest.mark.parametrize(
    ("make", "steps", "message"),
    [
        (lambda: PPO("MultiInputPolicy", reach(), n_steps=8, batch_size=8), 10, "off-policy"),
        (lambda: TD3BC("CnnPolicy", Reach(), demonstration(), buffer_size=50), 10, "of its own"),
        (lambda: SAC("MlpPolicy", gym.make("Pendulum-v1"), buffer_size=50), 10, "needs a guide"),
        (lambda: SAC("MlpPolicy", gym.make("Pendulum-v1"), buffer_size=50), 0, "steps is 0"),
        (lambda: SAC("MlpPolicy", gym.make("Pendulum-v1"), buffer_size=50), 1e3, "steps is 1000"),
    ],
)
def test_bad_input_is_refused(make, steps, message):
    learner = make()
    with pytest.raises(ValueError, match=message):
        learner.learn(20, callback=GuidedWarmup(steps))
