"""Rewards that are known when an episode has ended: none is sampled before."""

from __future__ import annotations

import io

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from regil_wrappers import RetrievalGuideWrapper, RetrievalRewardWrapper
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecFrameStack,
    VecNormalize,
    VecTransposeImage,
)
from toy import Reach, demonstration

from regil_sb3 import TD3BC, relabelling
from regil_sb3.relabelling import (
    AfterFirstEpisode,
    EpisodeRewardDictReplayBuffer,
    EpisodeRewardFrameReplayBuffer,
    EpisodeRewardNStepReplayBuffer,
    EpisodeRewardReplayBuffer,
)

GAMMA = 0.9
KINDS = {
    "one step": (EpisodeRewardReplayBuffer, {}),
    "little memory": (
        EpisodeRewardReplayBuffer,
        {"optimize_memory_usage": True, "handle_timeout_termination": False},
    ),
    "three steps": (EpisodeRewardNStepReplayBuffer, {"n_steps": 3, "gamma": GAMMA}),
    "dict": (EpisodeRewardDictReplayBuffer, {}),
    "frames": (EpisodeRewardFrameReplayBuffer, {"n_stack": 2, "gamma": GAMMA}),
    "frames, three steps": (
        EpisodeRewardFrameReplayBuffer,
        {"n_stack": 2, "n_steps": 3, "gamma": GAMMA},
    ),
}


class Late(gym.Env):
    """Observations say which episode of which environment, and which step, they belong to.

    Steps return 0; the reward of step t is `truth(environment, episode, t)`.
    """

    def __init__(self, number=0, kind="one step", lengths=(1, 9)):
        self.number, self.kind, self.lengths = number, kind, lengths
        vector = spaces.Box(-1, 255, (3,), np.float32)
        self.observation_space = {
            "dict": spaces.Dict({"at": vector}),
            "frames": spaces.Box(0, 255, (4, 4, 3), np.uint8),
        }.get(kind.split(",")[0], vector)
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)
        self.rewards_at_episode_end = True
        self.episode = -1

    def _obs(self):
        at = np.array([self.number + 1, self.episode + 1, self.t], np.float32)
        if self.kind == "dict":
            return {"at": at}
        if self.kind.startswith("frames"):
            return np.tile(at.astype(np.uint8), (4, 4, 1))
        return at

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.episode = 0, self.episode + 1
        self.length = int(self.np_random.integers(*self.lengths, endpoint=True))
        return self._obs(), {}

    def step(self, action):
        self.t += 1
        over = self.t == self.length
        info = {"retrieval": {}}
        if over:
            steps = [truth(self.number, self.episode, t) for t in range(self.length)]
            info["retrieval"] = {
                "episode_rewards": np.array(steps, np.float32),
                "episode_scale": 7.0,
            }
        return (
            self._obs(),
            0.0,
            over and self.episode % 2 == 0,
            over and self.episode % 2 == 1,
            info,
        )


def truth(number, episode, t):
    return -(1 + t + 20 * episode + 5_000 * number) / 1_000


def make(kind, n_envs, lengths=(1, 9)):
    env = DummyVecEnv([lambda i=i: Late(i, kind, lengths) for i in range(n_envs)])
    env.seed(0)
    if kind.startswith("frames"):
        env = VecFrameStack(VecTransposeImage(env), 2, "first")
    return env


def buffer_of(kind, env, size, **kwargs):
    cls, own = KINDS[kind]
    args = (size, env.observation_space, env.action_space, "cpu", env.num_envs)
    return cls(*args, **{**own, **kwargs})


def where(kind, observations):
    """(environment, episode, step) of sampled observations, (B, 3)."""
    at = observations["at"] if kind == "dict" else observations
    at = at.numpy().astype(int)
    if kind.startswith("frames"):
        at = at[:, -3:, 0, 0]
    return at - [1, 1, 0]


def play(env, buffer, steps, check=lambda: None):
    """Fill a buffer as SB3 does; the lengths of all episodes, by environment and episode."""
    lengths = {}
    obs = env.reset()
    for _ in range(steps):
        action = np.zeros((env.num_envs, 1), np.float32)
        following, reward, done, infos = env.step(action)
        seen = {k: v.copy() for k, v in following.items()} if isinstance(obs, dict) else None
        terminal = seen if seen is not None else following.copy()
        for i in np.flatnonzero(done):
            last = infos[i]["terminal_observation"]
            if seen is not None:
                terminal["at"][i] = last["at"]
            else:
                terminal[i] = last
            episode = len([key for key in lengths if key[0] == i])
            lengths[i, episode] = len(infos[i]["retrieval"]["episode_rewards"])
        buffer.add(obs, terminal, action, reward, done, infos)
        obs = following
        if buffer.size():
            check()
    return lengths


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("size", [24, 10_000])  # wraps around in the midst of episodes, or never
@pytest.mark.parametrize("kind", KINDS)
def test_every_sample_has_the_rewards_of_its_episode(kind, size, n_envs):
    env = make(kind, n_envs)
    buffer = buffer_of(kind, env, size, scale=1.0)
    n_steps = KINDS[kind][1].get("n_steps", 1)
    batches = []
    lengths = play(env, buffer, 250, lambda: batches.append(buffer.sample(16)))
    assert len(batches) > 200
    seen = set()
    for batch in batches:
        for k, (number, episode, t) in enumerate(where(kind, batch.observations)):
            seen.add((number, episode, t))
            length = lengths[number, episode]
            last = min(t + n_steps, length)
            rewards = [truth(number, episode, s) for s in range(t, last)]
            expected = sum(GAMMA**i * r for i, r in enumerate(rewards))
            assert batch.rewards[k].item() == pytest.approx(expected, rel=1e-5)
            if batch.discounts is not None:
                assert batch.discounts[k].item() == pytest.approx(GAMMA ** (last - t))
            terminal = last == length and (episode % 2 == 0 or kind == "little memory")
            assert batch.dones[k].item() == terminal
            if kind != "little memory" or not terminal:  # SB3 keeps none there
                after = where(kind, batch.next_observations)[k]
                assert after.tolist() == [number, episode, last]
    assert len(seen) > min(size, 200)
    assert len({number for number, _, _ in seen}) == n_envs


@pytest.mark.parametrize("kind", KINDS)
def test_an_episode_given_up_is_never_stored(kind):
    env = make(kind, 3, (30, 30))
    buffer = buffer_of(kind, env, 500, scale=1.0)
    play(env, buffer, 40)
    assert buffer.size() == 90
    if kind.startswith("frames"):
        buffer.close_episodes()  # TD3BC says so, others do not
    play(env, buffer, 31)  # which resets the environments
    assert buffer.size() == 180
    episodes = {tuple(at[:2]) for at in where(kind, buffer.sample(2_000).observations)}
    assert episodes == {(i, episode) for i in range(3) for episode in (0, 2)}


def test_the_first_episode_fixes_one_scale_for_all_environments():
    env = make("one step", 3)
    buffer = buffer_of("one step", env, 100)

    def end(env_index, rewards, scale):
        done = np.arange(3) == env_index
        infos = [{}, {}, {}]
        infos[env_index] = {
            "retrieval": {"episode_rewards": np.array(rewards), "episode_scale": scale}
        }
        obs = np.zeros((3, 3), np.float32)
        buffer.add(obs, obs, np.zeros((3, 1)), np.full(3, 0.5), done, infos)

    end(2, [0.0], np.inf)  # fixes none
    assert buffer.scale is None
    end(1, [-1.0, -4.0], 2.0)
    end(2, [-1.0], 9.0)
    assert buffer.scale == 2
    assert buffer.rewards[:4, 0].tolist() == [0.5, -1.5, -7.5, -1.5]  # added to what steps returned


def test_what_cannot_work_gets_one_line():
    env = make("one step", 2)
    buffer = buffer_of("one step", env, 16)
    with pytest.raises(ValueError, match=r"^no episode has ended yet"):
        buffer.sample(4)
    obs = np.zeros((2, 3), np.float32)
    rest = (np.zeros((2, 1)), np.zeros(2))
    with pytest.raises(ValueError, match="environment 1 ended without info"):
        buffer.add(obs, obs, *rest, np.array([False, True]), [{}, {"retrieval": {"end": 3}}])
    buffer.forget_open_episodes()
    going_on = (obs, obs, *rest, np.zeros(2, bool), [{}, {}])
    for _ in range(15):
        buffer.add(*going_on)
    with pytest.raises(ValueError, match="environment 0 has not ended after 16 steps"):
        buffer.add(*going_on)
    buffer.reset()
    buffer.add(obs, obs, *rest, np.ones(2, bool), 2 * [{"retrieval": {"episode_rewards": [-1.0]}}])
    assert buffer.size() == 2
    with pytest.raises(ValueError, match="set norm_reward=False"):
        buffer.sample(4, env=VecNormalize(env))
    assert buffer.sample(4, env=VecNormalize(env, norm_reward=False)).rewards.tolist() == 4 * [[-1]]
    env.envs[1].rewards_at_episode_end = False
    with pytest.raises(ValueError, match="give all environments the same reward"):
        relabelling.rewards_come_late(env)


class Diary(BaseCallback):
    """Writes down each environment's actions and, when an episode ends, its rewards."""

    def __init__(self):
        super().__init__()
        self.open, self.scale, self.rewards = {}, None, {}

    def _on_step(self):
        actions, infos = self.locals["buffer_actions"], self.locals["infos"]
        for i, (action, done) in enumerate(zip(actions, self.locals["dones"], strict=True)):
            self.open.setdefault(i, []).append(action.astype(np.float32).tobytes())
            if done:
                late = infos[i]["retrieval"]
                assert len(late["episode_rewards"]) == len(self.open[i])
                self.scale = self.scale or late["episode_scale"]
                scaled = (self.scale * late["episode_rewards"].astype(np.float64)).tolist()
                for t, written in enumerate(self.open.pop(i)):
                    self.rewards[written] = scaled[t:]
        return True


def spy(monkeypatch, cls):
    """Every batch that a class's buffers serve, with what a diary knew then."""
    batches = []
    sample = cls.sample

    def spied(self, *args, **kwargs):
        batch = sample(self, *args, **kwargs)
        batches.append((batch.actions.numpy().copy(), batch.rewards.numpy().copy()))
        return batch

    monkeypatch.setattr(cls, "sample", spied)
    return batches


def check(batches, diary, n_steps=1, gamma=0.99):
    """No placeholder: each sampled reward is its own action's."""
    sampled = 0
    for actions, rewards in batches:
        for action, reward in zip(actions, rewards[:, 0], strict=True):
            own = diary.rewards[action.astype(np.float32).tobytes()][:n_steps]
            expected = sum(gamma**i * r for i, r in enumerate(own))
            assert expected < 0
            assert reward == pytest.approx(expected, rel=1e-4)
            sampled += 1
    return sampled


def retrieval_env(n_envs, reward="tot"):
    demo = demonstration()
    env = DummyVecEnv([lambda: RetrievalRewardWrapper(Reach(), demo, reward=reward)] * n_envs)
    env.seed(0)
    return env


def test_sac_with_tot_never_samples_a_placeholder(monkeypatch):
    batches = spy(monkeypatch, EpisodeRewardReplayBuffer)
    model = SAC(
        "CnnPolicy",
        retrieval_env(3),
        replay_buffer_class=EpisodeRewardReplayBuffer,
        learning_starts=3,  # before any episode can have ended
        buffer_size=60,
        batch_size=8,
        seed=0,
        policy_kwargs={"features_extractor_kwargs": {"features_dim": 16}, "net_arch": [16]},
    )
    before = [p.detach().clone() for p in model.actor.parameters()]
    diary = Diary()
    model.learn(180, callback=[diary, AfterFirstEpisode()])
    assert model.replay_buffer.full
    assert check(batches, diary) == 8 * len(batches) > 8 * 40
    # the first episode of all sums to -10
    first = next(iter(diary.rewards.values()))
    assert sum(first) == pytest.approx(-10, rel=1e-4)
    assert all(p.isfinite().all() for p in model.actor.parameters())
    pairs = zip(before, model.actor.parameters(), strict=True)
    assert any(not th.equal(a, b) for a, b in pairs)


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("algorithm", [SAC, TD3, DDPG])
def test_any_off_policy_algorithm(monkeypatch, algorithm, n_envs):
    batches = spy(monkeypatch, EpisodeRewardNStepReplayBuffer)
    model = algorithm(
        "MlpPolicy",
        make("three steps", n_envs),
        replay_buffer_class=EpisodeRewardNStepReplayBuffer,
        replay_buffer_kwargs={"n_steps": 3, "gamma": 0.99},
        learning_starts=1 if algorithm is SAC else 10_000,
        buffer_size=50,
        batch_size=8,
        policy_kwargs={"net_arch": [8]},
    )
    diary = Diary()
    model.learn(30, callback=[diary, AfterFirstEpisode()])  # random actions: each its own
    model.learning_starts = 0
    if algorithm is not SAC:
        model.train(5, batch_size=8)
    assert check(batches, diary, n_steps=3) > 0


def test_without_the_callback_sb3_is_told_what_to_do():
    model = SAC(
        "MlpPolicy",
        make("one step", 1, (9, 9)),
        replay_buffer_class=EpisodeRewardReplayBuffer,
        learning_starts=1,
        buffer_size=50,
    )
    with pytest.raises(ValueError, match=r"AfterFirstEpisode\(\)"):
        model.learn(20)


def td3bc(env, **kwargs):
    settings = {
        "demo": demonstration(),
        "buffer_size": 200,
        "learning_starts": 3,
        "batch_size": 8,
        "warmup_steps": 0,
        "bc_pretrain_steps": 0,
        "seed": 0,
    }
    return TD3BC("CnnPolicy", env, **{**settings, **kwargs})


@pytest.mark.parametrize("n_steps", [1, 3])
def test_td3bc_takes_the_right_buffer_by_itself(monkeypatch, n_steps):
    batches = spy(monkeypatch, EpisodeRewardFrameReplayBuffer)
    model = td3bc(VecFrameStack(retrieval_env(2), 2), n_steps=n_steps, gamma=0.9)
    diary = Diary()
    model.learn(90, callback=diary)
    assert type(model.replay_buffer) is EpisodeRewardFrameReplayBuffer
    assert check(batches, diary, n_steps, gamma=0.9) > 100
    assert model.used_reward_scale == pytest.approx(len(demonstration()) / 10 * 10 * (1 - 0.9))
    assert min(model._returns["retrieval_reward"]) < 0

    # What is saved of the buffer goes on with the same scale.
    saved = io.BytesIO()
    np.savez(saved, **model.replay_buffer.state())
    saved.seek(0)
    again = td3bc(VecFrameStack(retrieval_env(2), 2), n_steps=n_steps, gamma=0.9)
    again.replay_buffer.load_state(dict(np.load(saved)))
    assert again.replay_buffer.scale == model.replay_buffer.scale == diary.scale
    assert again.replay_buffer.size() == model.replay_buffer.size()
    stranger = td3bc(VecFrameStack(retrieval_env(2, "sdtw"), 2), n_steps=n_steps)
    with pytest.raises(ValueError, match="holds rewards of another kind"):
        again.replay_buffer.load_state(stranger.replay_buffer.state())


def test_td3bc_with_a_guide_and_ot_fills_its_success_buffer():
    demo = demonstration()

    def one():
        return RetrievalRewardWrapper(RetrievalGuideWrapper(Reach(), demo), demo, reward="ot")

    model = td3bc(DummyVecEnv([one, one]), demo=demo, warmup_steps=60)
    model.learn(90)
    assert model.success_buffer.episodes > 1
    assert model._n_updates > 0


@pytest.mark.parametrize(
    ("kind", "policy", "n_steps", "expected"),
    [
        ("one step", "MlpPolicy", 1, EpisodeRewardReplayBuffer),
        ("three steps", "MlpPolicy", 3, EpisodeRewardNStepReplayBuffer),
        ("dict", "MultiInputPolicy", 1, EpisodeRewardDictReplayBuffer),
    ],
)
def test_td3bc_without_images(kind, policy, n_steps, expected):
    settings = {"demo": None, "bc_coef": 0.0, "warmup_steps": 0, "n_steps": n_steps}
    model = TD3BC(
        policy, make(kind, 2), learning_starts=2, buffer_size=50, batch_size=4, **settings
    )
    model.learn(40)
    assert type(model.replay_buffer) is expected
    assert model._n_updates > 0


def test_td3bc_refuses_a_buffer_that_would_serve_placeholders(tmp_path):
    model = td3bc(retrieval_env(1, "sdtw"), bc_coef=0.0)
    model.save(tmp_path / "model")
    late = TD3BC.load(tmp_path / "model")
    late.set_env(retrieval_env(1))
    with pytest.raises(ValueError, match="would serve placeholders"):
        late.learn(10)


@pytest.mark.slow
@pytest.mark.timeout(1_800)
def test_sac_with_tot_on_meta_world(monkeypatch):
    from regil_sb3.recording import record_expert

    name = "regil/metaworld-button-press-v0"
    demo = record_expert(name)
    batches = spy(monkeypatch, EpisodeRewardReplayBuffer)

    def one():
        env = gym.make(name, obs="state", render_mode="rgb_array")
        return RetrievalRewardWrapper(env, demo, reward="tot", image="render")

    env = DummyVecEnv([one] * 3)
    model = SAC(
        "MlpPolicy",
        env,
        replay_buffer_class=EpisodeRewardReplayBuffer,
        buffer_size=10_000,
        batch_size=64,
        seed=0,
    )
    diary = Diary()
    model.learn(2_000, callback=[diary, AfterFirstEpisode()])
    env.close()
    sampled = check(batches, diary)
    print(f"{sampled} sampled rewards in {len(batches)} updates, scale {diary.scale:.1f}")
    assert sampled == 64 * len(batches) > 64 * 400
