"""TD3BC: against TD3 itself, and what the warm-up stores, keeps and trains."""

from __future__ import annotations

import io
import pickle
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from regil_wrappers import Demonstration
from stable_baselines3 import TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecNormalize
from toy import Reach, demonstration, stacked

from regil_sb3 import TD3BC

OFF = {
    "bc_coef": 0.0,
    "warmup_steps": 0,
    "actor_q": "q1",
    "normalize_q": False,
    "reward_scale": 1.0,
    "exploration_std": 0.0,
}
TD3_OWN = {
    "learning_rate": 1e-3,
    "buffer_size": 10_000,
    "learning_starts": 100,
    "batch_size": 32,
    "train_freq": 1,
    "gradient_steps": 1,
    "n_steps": 1,
    "target_noise_clip": 0.5,
    "seed": 3,
    "device": "cpu",
}


def small(env, policy="CnnPolicy", **kwargs):
    settings = {
        "demo": demonstration(),
        "buffer_size": 2_000,
        "learning_starts": 20,
        "batch_size": 8,
        "warmup_steps": 60,
        "bc_pretrain_steps": 3,
        "seed": 0,
        "device": "cpu",
    }
    return TD3BC(policy, env, **{**settings, **kwargs})


def test_is_td3_to_the_last_bit_when_switched_off():
    # each seeds the global generators when it is built, so one learns before the next is built
    td3 = TD3("MlpPolicy", "Pendulum-v1", **TD3_OWN).learn(1_000)
    ours = TD3BC("MlpPolicy", "Pendulum-v1", **TD3_OWN, **OFF).learn(1_000)
    expected, got = td3.policy.state_dict(), ours.policy.state_dict()
    assert expected.keys() == got.keys()
    for name, value in expected.items():
        assert th.equal(value, got[name]), name
    initial = TD3BC("MlpPolicy", "Pendulum-v1", **TD3_OWN, **OFF).policy.state_dict()
    assert not any(th.equal(v, got[k]) for k, v in initial.items() if k.endswith("mu.0.weight"))


@pytest.mark.parametrize("n_envs", [1, 2, 3])
@pytest.mark.parametrize("high", [1.0, 3.0])
def test_stored_action_is_the_executed_one(n_envs, high):
    envs = [Reach(high) for _ in range(n_envs)]
    env = VecFrameStack(DummyVecEnv([lambda e=e: e for e in envs]), 2)
    model = small(env, demo=demonstration(high))
    model.learn(120)
    stored = model.replay_buffer.actions[: model.replay_buffer.total]
    assert len(stored) == 120 // n_envs
    for i, one in enumerate(envs):
        np.testing.assert_allclose(stored[:, i] * high, np.stack(one.executed), atol=1e-6)


def test_guide_acts_until_the_episode_begun_in_warmup_has_ended():
    model = small(stacked(), warmup_steps=15, exploration_std=0.0, learning_starts=0)
    model.learn(60)
    second = model.replay_buffer.actions[: model.replay_buffer.total, 0, 1]
    guided = np.isclose(second, 0.1)
    ends = np.flatnonzero(model.replay_buffer.dones[:60, 0])
    last = ends[ends >= 14][0]
    assert guided[: last + 1].all()
    assert not guided[last + 1 :].any()


@pytest.mark.parametrize("n_envs", [1, 2, 8])
def test_no_policy_acts_before_its_bc_updates(n_envs):
    model = small(stacked(n_envs), warmup_steps=100)
    acted = []

    def note(*_):
        acted.append((model.pretrained, model._collection.guided.copy()))
        return True

    model.learn(400, callback=note)
    before = np.array([guided for pretrained, guided in acted if not pretrained])
    after = np.array([guided for pretrained, guided in acted if pretrained])
    assert before.all()
    assert len(before) * n_envs <= 100 + n_envs * Reach.LENGTH, "no warm-up without end"
    assert not after[Reach.LENGTH :].any()


def test_success_buffer_takes_whole_successful_guided_episodes():
    demo = demonstration()
    model = small(stacked(n_envs=3))
    model.learn(150)
    done = model.replay_buffer.dones.astype(bool) & ~model.replay_buffer.timeouts.astype(bool)
    assert model.success_buffer.episodes > 3
    assert model.success_buffer.steps > len(demo.actions)
    _, actions = model.success_buffer.sample(300)
    assert ((actions[:, 0] > 0.4) & (actions[:, 0] < 0.95)).all()  # no policy action among them
    assert done.any()


def test_no_success_leaves_the_demonstration_alone(monkeypatch):
    monkeypatch.setattr(Reach, "guide_action", lambda self: np.array([-0.5, 0.0], np.float32))
    model = small(stacked())
    model.learn(100)
    assert model.success_buffer.episodes == 1
    assert model.num_timesteps == 100


def test_demonstration_is_stacked_as_the_policy_sees_it():
    demo = demonstration()
    model = small(stacked(n_stack=3))
    np.random.seed(0)
    observations, _ = model.success_buffer.sample(200)
    assert observations.shape == (200, 9, 40, 40)
    first = [o for o in observations if not o[:6].any()]
    assert first, "the first step has zeros before it, as VecFrameStack pads"
    assert np.array_equal(first[0][6:], demo.frames[0].transpose(2, 0, 1))


@pytest.mark.parametrize(
    ("coef", "floor", "steps", "at", "expected"),
    [
        (2.0, 0.1, None, 0, 2.0),
        (2.0, 0.1, None, 50, 1.0),
        (2.0, 0.1, None, 100, 0.2),
        (3.0, 0.0, 40, 40, 0.0),
    ],
)
def test_lambda(coef, floor, steps, at, expected):
    model = small(stacked(), bc_coef=coef, bc_floor=floor, bc_steps=steps)
    model._total_timesteps, model.num_timesteps = 100, at
    assert model.bc_coef_now() == pytest.approx(expected)


@pytest.mark.parametrize("shared", [True, False])
def test_q_coef_zero_keeps_the_critic_out_of_the_actors_encoder(shared):
    # a BC term too small to move anything, so that whatever moves was moved by the critic
    model = small(
        stacked(), q_coef=0.0, bc_coef=1e-30, bc_pretrain_steps=0,
        policy_kwargs={"shared_encoder": shared},
    )  # fmt: skip
    before = {k: v.clone() for k, v in model.actor.features_extractor.state_dict().items()}
    q_before = model.critic.q_networks[0][0].weight.clone()
    model.learn(60)
    after = model.actor.features_extractor.state_dict()
    assert all(th.allclose(before[k], after[k], rtol=0, atol=1e-20) for k in before)
    assert not th.equal(q_before, model.critic.q_networks[0][0].weight)


@pytest.mark.parametrize("shared", [True, False])
def test_shared_encoder_is_one_module(shared):
    model = small(stacked(), policy_kwargs={"shared_encoder": shared})
    same = model.actor.features_extractor is model.critic.features_extractor
    assert same == shared
    model.learn(100)
    ids = {id(p) for p in model.critic.parameters()}
    assert any(id(p) in ids for p in model.actor.parameters()) == shared


@pytest.mark.parametrize(
    ("kwargs", "name"),
    [
        ({"warmup_steps": 0}, "BC_RL"),
        ({"bc_coef": 0.0}, "ReG_RL"),
        ({"bc_coef": 0.0, "warmup_steps": 0, "demo": None}, "RL"),
        ({"q_coef": 0.0}, "ReG_BC"),
        ({"bc_loss": "nll", "bootstrap_success": True, "target_policy_noise": 0.0}, "paper"),
    ],
)
def test_ablations_are_settings(kwargs, name):
    model = small(stacked(), **kwargs)
    before = [p.clone() for p in model.actor.parameters()]
    model.learn(100)
    assert any(not th.equal(a, b) for a, b in zip(before, model.actor.parameters(), strict=True)), (
        name
    )


@pytest.mark.parametrize("n_envs", [1, 2, 8])
def test_one_update_for_every_two_transitions(n_envs):
    model = small(stacked(n_envs=n_envs), learning_starts=16)
    model.learn(96)
    assert abs(model._n_updates - (96 - 16) / 2) <= n_envs


def test_as_many_updates_as_the_episode_has_steps():
    model = small(stacked(), train_freq=(1, "episode"), gradient_steps=-1, learning_starts=0)
    model.learn(60)
    assert model._n_updates == model.num_timesteps


def test_bc_learns_the_demonstration():
    model = small(stacked(), policy_kwargs={"random_shift": 0})
    model.set_logger(Logger(None, []))
    before = model._bc_term().item()
    model.pretrain_bc(150)
    assert model._bc_term().item() < 0.1 * before


def test_reward_scale_comes_from_the_environment(monkeypatch):
    monkeypatch.setattr(Reach, "reward_scale", 0.25, raising=False)
    model = small(stacked())
    model.learn(50)
    assert model.used_reward_scale == pytest.approx(0.25 * 10 * (1 - 0.99))
    assert set(np.unique(model.replay_buffer.rewards[:50])) == {-1.0}  # kept raw
    assert small(stacked(), reward_scale=3.0).learn(30).used_reward_scale == 3.0
    assert small(stacked(), reward_scale=0.5, gamma=1.0).learn(30).used_reward_scale == 0.5


def test_nan_reward_stops_with_step_and_cause():
    model = small(stacked(reward=lambda env: np.nan if env.t == 3 else -1.0))
    with pytest.raises(FloatingPointError, match="reward of environment 0 is not finite at step 3"):
        model.learn(50)


def test_nan_loss_stops_with_step_and_cause():
    model = small(stacked(reward=lambda env: 1e30), reward_scale=1e30)
    with pytest.raises(FloatingPointError, match="critic loss is"):
        model.learn(50)


def test_logs_under_fixed_names(tmp_path):
    model = small(stacked(n_envs=2))
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(200)
    model.logger.close()
    header = (tmp_path / "progress.csv").read_text().splitlines()[0].split(",")
    for name in (
        "rollout/success_rate", "rollout/env_reward", "rollout/retrieval_reward", "train/bc_loss",
        "train/bc_coef", "success_buffer/steps", "success_buffer/episodes", "time/guided",
    ):  # fmt: skip
        assert name in header


def test_saves_without_demonstration_and_buffers_and_loads(tmp_path):
    env = stacked()
    model = small(env)
    model.learn(80)
    model.save(tmp_path / "model")
    assert (tmp_path / "model.zip").stat().st_size < 12e6
    loaded = TD3BC.load(tmp_path / "model", env=env, demo=demonstration())
    obs = env.reset()
    assert np.array_equal(model.predict(obs)[0], loaded.predict(obs)[0])
    loaded.learn(40, reset_num_timesteps=False)
    assert loaded.num_timesteps == 120
    alone = TD3BC.load(tmp_path / "model")
    assert np.array_equal(model.predict(obs)[0], alone.predict(obs)[0])
    assert alone.n_stack == 2
    assert alone.replay_buffer.frames.nbytes == model.replay_buffer.frames.nbytes
    demonstration().save(tmp_path / "demo.hdf5")
    by_path = TD3BC.load(tmp_path / "model", env=env, demo=str(tmp_path / "demo.hdf5"))
    assert by_path.success_buffer.episodes == 1


@pytest.mark.parametrize("reset", [True, False])
def test_learning_again_in_the_middle_of_an_episode(reset):
    model = small(stacked(n_envs=2), warmup_steps=200)
    model.learn(70)
    open_before = model._collection.lengths
    assert open_before.any()
    model.learn(70, reset_num_timesteps=reset)
    assert model.num_timesteps == (70 if reset else 140)
    first = [e.observations[0] for e in model.success_buffer._episodes]
    dots = [np.flatnonzero(f.any(axis=(0, 1)))[0] for f in first]
    assert max(dots) <= 12, "every kept episode starts where episodes start"


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("name", ["buffer", "buffer.pkl", None])
def test_replay_buffer_of_frames_is_saved_and_loaded(n_envs, name, tmp_path):
    model = small(stacked(n_envs), buffer_size=200)
    model.learn(62)  # an episode is open
    file = io.BytesIO() if name is None else tmp_path / name
    model.save_replay_buffer(file)
    saved = {key: value.copy() for key, value in model.replay_buffer.state().items()}
    if name is None:
        file.seek(0)
    other = small(stacked(n_envs), buffer_size=200)
    other.load_replay_buffer(file)
    loaded = other.replay_buffer.state()
    assert loaded.keys() == saved.keys()
    assert all(np.array_equal(loaded[key], saved[key]) for key in saved)
    assert other.replay_buffer.total == 62 // n_envs
    other.learn(30)
    assert other.replay_buffer.dones[62 // n_envs - 1].all(), "the open episodes have ended"


def test_replay_buffer_goes_back_in_the_model_that_went_on(tmp_path):
    model = small(stacked())
    model.learn(62)
    model.save_replay_buffer(tmp_path / "buffer.npz")
    model.learn(7, reset_num_timesteps=False)
    model.load_replay_buffer(tmp_path / "buffer.npz")
    assert model.replay_buffer.total == 62
    model.learn(30, reset_num_timesteps=False)
    assert model.replay_buffer.total == 92
    assert model.replay_buffer.dones[61] == 1


def test_replay_buffer_of_sb3_is_saved_and_loaded(tmp_path):
    model = TD3BC("MlpPolicy", "Pendulum-v1", **TD3_OWN, **OFF).learn(30)
    model.save_replay_buffer(tmp_path / "buffer")
    other = TD3BC("MlpPolicy", "Pendulum-v1", **TD3_OWN, **OFF)
    other.load_replay_buffer(tmp_path / "buffer")
    assert np.array_equal(other.replay_buffer.rewards, model.replay_buffer.rewards)


def test_what_is_no_replay_buffer_gets_one_line(tmp_path):
    model, path = small(stacked(), buffer_size=50), tmp_path / "buffer.npz"
    small(stacked(), buffer_size=200).save_replay_buffer(path)
    whole = path.read_bytes()
    arrays = io.BytesIO()
    np.save(arrays, np.zeros(3))
    for content in (b"", b"text", whole[:200], arrays.getvalue(), pickle.dumps({"total": 3})):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"buffer\.npz is no replay buffer") as refused:
            model.load_replay_buffer(path)
        assert "\n" not in str(refused.value)
    small(stacked(2), buffer_size=50).save_replay_buffer(path)
    with pytest.raises(ValueError, match="does not fit one of"):
        model.load_replay_buffer(path)
    with pytest.raises(FileNotFoundError):
        model.load_replay_buffer(tmp_path / "nowhere")


@pytest.mark.parametrize("n_steps", [1, 3])
def test_returns_do_not_reach_over_a_reset(n_steps):
    settings = {**TD3_OWN, **OFF, "n_steps": n_steps}
    model = TD3BC("MlpPolicy", make_vec_env("Pendulum-v1", 2), **settings)
    model.learn(60)
    model.learn(60)  # resets both in the middle of an episode
    buffer = model.replay_buffer
    state = np.random.get_state()
    for last in (29, 28):
        np.random.set_state(state)
        drawn = np.random.randint(0, 2, size=8)
        np.random.set_state(state)
        batch = buffer._get_samples(np.full(8, last))
        steps = min(30 - last, n_steps)
        expected = sum(0.99**i * buffer.rewards[last + i, drawn] for i in range(steps))
        np.testing.assert_allclose(batch.rewards[:, 0], expected, rtol=1e-5)
        reached = buffer.next_observations[last + steps - 1, drawn]
        assert np.array_equal(batch.next_observations, reached)
        assert not batch.dones.any(), "truncated, and no end to learn from"


def test_going_on_after_a_callback_stopped_in_a_step():
    from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes

    model = small(stacked(), warmup_steps=200)
    model.learn(100, callback=StopTrainingOnMaxEpisodes(2))
    model.learn(50, reset_num_timesteps=False)
    last_stored = model.num_timesteps - 50 - 2  # the step that was stopped in is not stored
    assert model.replay_buffer.dones[last_stored, 0]  # closed, and not joined with the next episode
    lengths = [len(e) for e in model.success_buffer._episodes]
    assert all(length <= Reach.LENGTH for length in lengths)


def test_guide_acts_again_in_whole_episodes_where_the_policy_fails():
    env = stacked()
    never_trained = small(env, learning_starts=10_000, bc_pretrain_steps=0, guide_again=0.5)
    never_trained.learn(400)
    (played,) = env.get_attr("executed")
    own = np.stack(played)[:, 1] != np.float32(0.1)  # what the guide says there
    dones = never_trained.replay_buffer.dones[:400, 0].astype(bool)
    episodes = np.split(own, np.flatnonzero(dones) + 1)
    after = [e for e in episodes if len(e)][6:]  # the warm-up has fewer
    assert {bool(e[0]) for e in after} == {True, False}
    assert all((e == e[0]).all() for e in after)
    kept = [e for e in episodes[: dones.sum()] if not e[0]]
    assert never_trained.success_buffer.episodes == 1 + len(kept)


def test_pretraining_by_nothing_leaves_the_target_alone():
    model = small(stacked())
    model.learn(40)
    before = [p.clone() for p in model.actor_target.parameters()]
    model.pretrain_bc(0)
    assert all(th.equal(a, b) for a, b in zip(before, model.actor_target.parameters(), strict=True))


def test_demonstration_with_observations_trains_an_image_policy():
    demo = demonstration()
    with_x = Demonstration(
        frames=demo.frames,
        actions=demo.actions,
        observations={"x": np.zeros((len(demo), 1), np.float32)},
    )
    assert small(stacked(), demo=with_x).success_buffer.sample(1)[0].shape == (1, 6, 40, 40)


def test_executed_actions_stay_inside_asymmetric_bounds():
    from gymnasium import spaces

    env = Reach()
    env.action_space = spaces.Box(
        np.array([-0.44, -1.0], np.float32), np.array([0.11, 1.0], np.float32)
    )
    demo = Demonstration(
        frames=demonstration().frames,
        actions=np.zeros((len(demonstration().actions), 2), np.float32),
    )
    model = small(VecFrameStack(DummyVecEnv([lambda: env]), 2), demo=demo, warmup_steps=0,
                  exploration_std=5.0, exploration_clip=5.0)  # fmt: skip
    model.learn(120)
    assert all(env.action_space.contains(action) for action in env.executed[20:])


def test_subprocesses_and_dict_observations():
    model = small(stacked(n_envs=2, vec=SubprocVecEnv))
    model.learn(70)
    assert model.success_buffer.episodes > 1
    model.env.close()
    demo = demonstration()
    with_x = Demonstration(
        frames=demo.frames,
        actions=demo.actions,
        observations={"x": np.linspace(0, 1, len(demo))[:, None].astype(np.float32)},
    )
    env = DummyVecEnv([lambda: Reach(dict_obs=True)])
    model = small(env, policy="MultiInputPolicy", demo=with_x, n_steps=1)
    model.learn(80)
    assert model.success_buffer.episodes > 1


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"demo": None}, "needs demo="),
        ({"q_coef": 0.0, "bc_coef": 0.0}, "nothing to learn from"),
        ({"bc_loss": "huber"}, "use one of mse, nll"),
        ({"actor_q": "q2"}, "use one of min, q1"),
        ({"demo": "no-such-file.hdf5"}, "no-such-file.hdf5"),
        ({"success_buffer_size": 0}, "success_buffer_size is 0"),
        ({"success_buffer_size": 3}, "the demonstration alone has"),
        ({"buffer_size": 1e5}, "buffer_size is 100000.0: it must be a whole number"),
        ({"policy_delay": 0}, "policy_delay is 0"),
        ({"bc_steps": 0}, "bc_steps is 0"),
        ({"bc_coef": -1}, "bc_coef is -1"),
        ({"bc_std": 0}, "bc_std is 0"),
        ({"gamma": 1.5}, "at most 1"),
        ({"gamma": 1}, "makes every reward 0: set reward_scale"),
        ({"train_freq": (1, "episode")}, r"gradient_steps=0\.5 counts .* train_freq=\(1, 'ep"),
        ({"train_freq": (1, "epoch")}, "use 'step' or 'episode'"),
        ({"warmup_steps": "many"}, "warmup_steps is 'many'"),
        ({"reward_scale": "automatic"}, "reward_scale is 'automatic'"),
        ({"policy_kwargs": {"share_features_extractor": True}}, "shared_encoder"),
        ({"policy_kwargs": {"features_extractor_class": "vgg"}}, "conv, resnet18"),
        ({"demo": [demonstration()]}, "it takes one Demonstration, or its file"),
    ],
)
def test_bad_arguments(kwargs, message):
    with pytest.raises((ValueError, OSError), match=message):
        small(stacked(), **kwargs)


def test_bad_combinations():
    demo = demonstration()
    with pytest.raises(ValueError, match="has no actions"):
        small(stacked(), demo=Demonstration(frames=demo.frames))
    loud = Demonstration(frames=demo.frames, actions=5 * demo.actions)
    with pytest.raises(ValueError, match=r"has action 3\.5 in dimension 0 of step 0"):
        small(stacked(), demo=loud, warmup_steps=0)
    with pytest.raises(ValueError, match="CnnPolicy needs image observations"):
        TD3BC("CnnPolicy", "Pendulum-v1", **OFF)
    with pytest.raises(ValueError, match="TD3BC needs a Box"):
        TD3BC("MlpPolicy", gym.make("CartPole-v1"), **OFF)
    with pytest.raises(ValueError, match="leave out VecNormalize"):
        small(VecNormalize(stacked()))
    small_frames = Demonstration(frames=demo.frames[:, :36, :36], actions=demo.actions)
    with pytest.raises(ValueError, match=r"36x36 frames .* policy sees 40x40"):
        small(stacked(), demo=small_frames)
    with pytest.raises(ValueError, match="n_steps=3 with dict observations"):
        TD3BC("MultiInputPolicy", DummyVecEnv([lambda: Reach(dict_obs=True)]), demo=demo)
    with pytest.raises(ValueError, match="observations="):
        TD3BC("MultiInputPolicy", DummyVecEnv([lambda: Reach(dict_obs=True)]), demo=demo, n_steps=1)
    with pytest.raises(ValueError, match="by the actor's loss alone"):
        TD3BC("MlpPolicy", "Pendulum-v1", policy_kwargs={"share_features_extractor": True}, **OFF)
    pendulum = TD3BC("MlpPolicy", "Pendulum-v1", **TD3_OWN, **{**OFF, "warmup_steps": 10})
    with pytest.raises(ValueError, match="needs a guide"):
        pendulum.learn(20)


def test_vectors_that_would_not_fit_into_memory(monkeypatch):
    left = SimpleNamespace(available=10**5)
    monkeypatch.setattr("psutil.virtual_memory", lambda: left)
    with pytest.raises(MemoryError, match=r"enough memory .*: set buffer_size lower"):
        TD3BC("MlpPolicy", "Pendulum-v1", **TD3_OWN, **OFF)


def test_a_disturbed_guide_is_executed_and_the_undisturbed_cloned(monkeypatch):
    def disturbed(self):
        return np.array([0.6, -0.4], np.float32)

    monkeypatch.setattr(Reach, "disturbed_action", disturbed, raising=False)
    envs = [Reach() for _ in range(2)]
    env = VecFrameStack(DummyVecEnv([lambda e=e: e for e in envs]), 2)
    model = small(env, warmup_steps=150, learning_starts=1_000)
    model.learn(100)
    stored = model.replay_buffer.actions[: model.replay_buffer.total]
    for i, one in enumerate(envs):
        np.testing.assert_allclose(stored[:, i], np.stack(one.executed), atol=1e-6)
    np.testing.assert_allclose(stored[..., 1], -0.4, atol=1e-6)
    assert model.success_buffer.episodes > 2
    _, cloned = model.success_buffer.sample(300)
    np.testing.assert_allclose(cloned[:, 1], 0.1, atol=1e-6)


def test_episodes_that_calibrate_are_not_kept(monkeypatch):
    def calibrating(self, action, step=Reach.step):
        *rest, info = step(self, action)
        info["retrieval"]["calibrating"] = True
        return *rest, info

    monkeypatch.setattr(Reach, "step", calibrating)
    model = small(stacked())
    model.learn(55)
    assert model.success_buffer.episodes == 1  # the demonstration


def test_own_successes_are_kept_where_asked():
    for keep, more in ((False, False), (True, True)):
        model = small(stacked(), keep_own_successes=keep, warmup_steps=20, bc_pretrain_steps=200)
        model.learn(30)
        guided = model.success_buffer.episodes
        model.learn(150, reset_num_timesteps=False)
        assert (model.success_buffer.episodes > guided) == more
        assert np.mean(model.ep_success_buffer) > 0


def test_actor_rests_in_warmup_where_asked():
    model = small(stacked(), actor_in_warmup=False, bc_pretrain_steps=0, warmup_steps=60)
    before = [p.clone() for p in model.actor.mu.parameters()]
    critic = [p.clone() for p in model.critic.qf0.parameters()]
    model.learn(50)
    assert model._n_updates > 0
    assert all(th.equal(a, b) for a, b in zip(before, model.actor.mu.parameters(), strict=True))
    assert not all(
        th.equal(a, b) for a, b in zip(critic, model.critic.qf0.parameters(), strict=True)
    )
    model.learn(60, reset_num_timesteps=False)
    assert not all(th.equal(a, b) for a, b in zip(before, model.actor.mu.parameters(), strict=True))


def test_q_leaves_an_encoder_of_the_actors_own_alone_where_asked():
    for trains in (True, False):
        kwargs = {"shared_encoder": False, "q_trains_encoder": trains}
        model = small(stacked(), demo=None, bc_coef=0.0, warmup_steps=0, policy_kwargs=kwargs)
        before = [p.clone() for p in model.actor.features_extractor.parameters()]
        model.learn(60)
        after = model.actor.features_extractor.parameters()
        assert all(th.equal(a, b) for a, b in zip(before, after, strict=True)) != trains


def test_lambda_by_success_is_saved_with_the_model(tmp_path):
    model = small(stacked(), bc_schedule="success", warmup_steps=20, bc_pretrain_steps=200)
    model.learn(400)
    assert model.bc_coef_now() < model.bc_coef
    model.save(tmp_path / "model.zip")
    again = TD3BC.load(tmp_path / "model.zip", buffer_size=10)
    assert again.bc_coef_now() == model.bc_coef_now()


def test_after_the_warm_up_the_guide_leaves_the_policy_alone():
    model = small(stacked(), warmup_steps=20, exploration_std=0.0)
    model.learn(150)
    second = model.replay_buffer.actions[60 : model.replay_buffer.total, 0, 1]
    assert not np.isclose(second, 0.1).any()


@pytest.mark.parametrize("averaged", [True, False])
def test_which_weights_act(averaged):
    env = stacked()
    model = small(env, policy_kwargs={"averaged": averaged}).learn(100)
    seen = env.reset()
    acts = (model.actor_target if averaged else model.actor)(model.policy.obs_to_tensor(seen)[0])
    predicted, _ = model.predict(seen, deterministic=True)
    np.testing.assert_allclose(predicted, acts.detach().numpy(), atol=1e-6)
    other = (model.actor if averaged else model.actor_target)(model.policy.obs_to_tensor(seen)[0])
    assert not np.allclose(predicted, other.detach().numpy(), atol=1e-6)


def test_the_average_of_bc_updates_forgets_how_they_began():
    model = small(stacked(), learning_rate=1e-3)
    model.set_logger(Logger(None, []))
    model.pretrain_bc(60)
    begun = {k: v.clone() for k, v in model.actor_target.state_dict().items()}
    model.pretrain_bc(1)
    for name, value in model.actor.state_dict().items():
        assert th.allclose(model.actor_target.state_dict()[name], value, atol=2e-3), name
        assert not th.equal(begun[name], model.actor_target.state_dict()[name]), name


def test_q_comes_in_as_the_bc_term_falls():
    model = small(stacked(), bc_schedule="success", bc_coef=2.0, q_coef=0.5)
    assert (model.bc_coef_now(), model.q_coef_now()) == (2.0, 0.0)
    model._by_success.share = 0.25
    assert (model.bc_coef_now(), model.q_coef_now()) == (0.5, 0.375)
    by_time = small(stacked(), bc_coef=2.0, q_coef=0.5)
    assert by_time.q_coef_now() == 0.5


def test_attributes_replaced_at_load_replace_what_set_up_made_of_them(tmp_path):
    env = stacked()
    small(env, bc_schedule="success").save(tmp_path / "model")
    changed = {"gamma": 0.9, "n_steps": 1, "bc_floor": 0.1}
    loaded = TD3BC.load(tmp_path / "model", env=env, demo=demonstration(), **changed)
    assert (loaded.replay_buffer.gamma, loaded.replay_buffer.n_steps) == (0.9, 1)
    assert loaded._by_success.floor == 0.1
    vectors = {**TD3_OWN, **OFF, "n_steps": 3}
    TD3BC("MlpPolicy", "Pendulum-v1", **vectors).save(tmp_path / "vectors")
    TD3BC.load(tmp_path / "vectors", env=gym.make("Pendulum-v1"), n_steps=1).learn(110)


def test_learning_anew_begins_at_the_whole_of_lambda():
    model = small(stacked(), bc_schedule="success", warmup_steps=20, bc_pretrain_steps=200)
    model.learn(400)
    assert model.bc_coef_now() < model.bc_coef
    model.learn(2)
    assert (model.bc_coef_now(), model.q_coef_now()) == (model.bc_coef, 0.0)


def test_a_guide_at_the_bounds_of_a_float64_space(monkeypatch):
    def guide_action(self):
        return np.array([-0.1, 0.1], np.float32)  # float32(0.1) is above 0.1

    monkeypatch.setattr(Reach, "guide_action", guide_action)
    env = Reach()
    env.action_space = spaces.Box(-0.1, 0.1, (2,), np.float64)
    model = small(VecFrameStack(DummyVecEnv([lambda: env]), 2), bc_coef=0.0, demo=None)
    seen, step = [], env.step

    def noted(action):
        seen.append(action)
        return step(action)

    monkeypatch.setattr(env, "step", noted)
    model.learn(30)
    assert len(seen) == 30
    assert all(env.action_space.contains(action) for action in seen)


class Normalised(BaseFeaturesExtractor):
    """An encoder with BatchNorm."""

    def __init__(self, observation_space, features_dim=16):
        super().__init__(observation_space, features_dim)
        pixels = int(np.prod(observation_space.shape))
        self.net = th.nn.Sequential(
            th.nn.Flatten(), th.nn.Linear(pixels, features_dim), th.nn.BatchNorm1d(features_dim)
        )

    def forward(self, observations):
        return self.net(observations)


def test_the_average_has_the_statistics_of_a_batch_norm():
    kwargs = {"features_extractor_class": Normalised, "shared_encoder": False}
    model = small(stacked(), policy_kwargs=kwargs)
    model.set_logger(Logger(None, []))
    model.pretrain_bc(20)
    of, to = (a.features_extractor.net[2] for a in (model.actor, model.actor_target))
    assert of.running_var.ne(1).any()
    th.testing.assert_close(to.running_mean, of.running_mean)
    th.testing.assert_close(to.running_var, of.running_var)
