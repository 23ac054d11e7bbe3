"""What TD3BC is compared with: each against its paper's equation, and on a task it must solve."""

from __future__ import annotations

import json
import signal
from contextlib import closing
from dataclasses import replace

import gymnasium as gym
import numpy as np
import ot
import pytest
import torch as th
from gymnasium import spaces
from regil_wrappers import Demonstration, RetrievalGuideWrapper, RetrievalRewardWrapper
from regil_wrappers.transport import band, context_costs, cosine_costs
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack
from toy import demonstration, stacked
from toy_env import ToyReach

from regil_sb3.baselines import (
    BAKU,
    BC,
    ROT,
    ReverseForwardCurriculum,
    locally_weighted,
    vinn_act,
)
from regil_sb3.baselines.baku import BAKUPolicy
from regil_sb3.checkpoint import CheckpointCallback
from regil_sb3.cli import main
from regil_sb3.evaluation import evaluate, policy_act
from regil_sb3.recording import record_expert
from regil_sb3.settings import ALGOS, Settings, comparisons, make_settings
from regil_sb3.td3bc import encode
from regil_sb3.training import make_env, train

ENV = "regil/metaworld-button-press-v0"
SMALL = {"chunk": 4, "width": 64, "layers": 1, "dropout": 0.0}


class Corner(gym.Env):
    """A dot that goes right, then down, from one place: who cuts the corner, or misses it, fails.

    Success needs the demonstrator's 16 actions, each nearly right.
    """

    PATH = tuple([(0.8, 0.0)] * 8 + [(0.0, 0.8)] * 8)
    observation_space = spaces.Box(0, 255, (40, 40, 3), np.uint8)
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def _obs(self):
        frame = np.zeros((40, 40, 3), np.uint8)
        x, y = np.clip(self.at, 0, 36).astype(int)
        frame[y : y + 4, x : x + 4] = 255
        return frame

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at, self.steps = np.array([4.0, 4.0]), 0
        return self._obs(), {}

    def step(self, action):
        self.at = self.at + 4 * np.asarray(action)
        self.steps += 1
        x, y = self.at
        success = bool(abs(x - 29.6) < 3 and abs(y - 29.6) < 3)
        strayed = not (abs(y - 4) < 3 or abs(x - 29.6) < 3)
        return (
            self._obs(),
            0.0,
            success,
            not success and (strayed or self.steps >= 18),
            {"is_success": success},
        )


@pytest.fixture(scope="module")
def corner():
    env = Corner()
    frames = [env.reset()[0]]
    frames += [env.step(np.array(a, np.float32))[0] for a in Corner.PATH]
    demo = Demonstration(np.stack(frames), np.array(Corner.PATH, np.float32))
    return demo, VecFrameStack(DummyVecEnv([Corner]), 2)


def success(model, env) -> float:
    return float(np.mean(evaluate(policy_act(model), env, 1).successes))


@pytest.mark.parametrize("untrained", [True, False])
def test_bc_overfits_the_demonstration(corner, untrained):
    demo, env = corner
    model = BC("CnnPolicy", env, demo=demo, warmup_steps=0, buffer_size=1, seed=0,
               learning_rate=1e-3, policy_kwargs={"random_shift": 0})  # fmt: skip
    if untrained:
        assert success(model, env) == 0
        return
    assert model.learn(375).num_timesteps == 375
    assert success(model, env) == 1
    assert model.replay_buffer.size() == 0  # no step was made for it


@pytest.mark.parametrize("head", ["mse", "gaussian"])
def test_baku_overfits_the_demonstration(corner, tmp_path, head):
    demo, env = corner
    kwargs = {**SMALL, "head": head, "random_shift": 0, "smoothing": 0.1}
    model = BAKU("CnnPolicy", env, demo=demo, seed=0, policy_kwargs=kwargs, learning_rate=1e-3,
                 batch_size=32)  # fmt: skip
    assert success(model, env) == 0
    model.learn(200)
    assert success(model, env) == 1
    model.save(tmp_path / "model")
    loaded = BAKU.load(tmp_path / "model")
    assert loaded.num_timesteps == 200
    obs = env.reset()
    for ours, theirs in zip(model.predict(obs, deterministic=True),
                            loaded.predict(obs, deterministic=True), strict=True):  # fmt: skip
        np.testing.assert_array_equal(ours, theirs)
    resumed = BAKU.load(tmp_path / "model", env=env, demo=demo)
    resumed.learn(5, reset_num_timesteps=False)
    assert resumed.num_timesteps == 205


@pytest.mark.slow
@pytest.mark.timeout(3_600)
@pytest.mark.parametrize("preset", ["bc", "baku"])
def test_the_presets_overfit_metaworlds_demonstration(tmp_path, preset):
    """As they are shipped, from the one start that the demonstration begins at."""
    demo = record_expert(ENV, seed=0)
    settings = make_settings(ENV, preset, seed=0)
    train(settings, demo, tmp_path / "run")
    model = ALGOS[settings.algo].load(tmp_path / "run/model.zip")
    with closing(make_env(settings, tmp_path / "run/demo.hdf5")) as env:
        assert evaluate(policy_act(model), env, 1, demo.metadata["seed"]).successes == [True]


def test_baku_averages_what_it_said_of_a_step():
    """Against temporal ensembling as it is defined: w_i = exp(-m i), the oldest first."""
    n, chunk, m = 2, 3, 0.5
    space = spaces.Box(np.float32([-1, 0]), np.float32([1, 4]))
    pictures = spaces.Box(0, 255, (3, 40, 40), np.uint8)
    kwargs = {**SMALL, "chunk": chunk, "smoothing": m}
    policy = BAKUPolicy(pictures, space, lambda _: 1e-3, **kwargs)
    rng = np.random.default_rng(0)
    said = rng.uniform(-1, 1, (6, n, chunk, 2)).astype(np.float32)
    begins = np.array([[1, 1], [0, 0], [0, 0], [0, 1], [0, 0], [0, 0]], bool)
    state = None
    since = [0, 0]
    for t in range(len(said)):
        policy._chunks = lambda *_, t=t: th.as_tensor(said[t])
        obs = np.zeros((n, 3, 40, 40), np.uint8)
        action, state = policy.predict(obs, state, begins[t])
        for env in range(n):
            since[env] = t if begins[t, env] else since[env]
            told = [said[b, env, t - b] for b in range(max(since[env], t - chunk + 1), t + 1)]
            weights = np.exp(-m * np.arange(len(told)))
            mean = (weights[:, None] * told).sum(axis=0) / weights.sum()
            np.testing.assert_allclose(action[env], [mean[0], 2 * (mean[1] + 1)], rtol=1e-5)


def test_baku_sees_chunks_and_repeats_the_last_action(corner):
    demo, env = corner
    model = BAKU("CnnPolicy", env, demo=demo, policy_kwargs=SMALL)
    path = np.array([*Corner.PATH, *[Corner.PATH[-1]] * 3], np.float32)
    for t in range(16):
        np.testing.assert_allclose(model._chunks[t], path[t : t + 4])


def test_parameter_counts_are_those_of_the_docstring():
    space = spaces.Box(0, 255, (6, 84, 84), np.uint8)
    policy = BAKUPolicy(space, spaces.Box(-1, 1, (4,)), lambda _: 1e-3)
    count = sum(p.numel() for p in policy.actor.parameters())
    assert f"{count:,}" in BAKU.__doc__


@pytest.mark.parametrize("averaged", [True, False])
def test_which_of_bakus_weights_act(corner, averaged):
    demo, env = corner
    kwargs = {**SMALL, "averaged": averaged}
    model = BAKU("CnnPolicy", env, demo=demo, seed=0, policy_kwargs=kwargs)
    mean = [p.detach().clone() for p in model.policy.actor.parameters()]
    for done in range(1, 31):
        model.learn(1, reset_num_timesteps=False)
        share = 10 / (10 + done)
        for average, new in zip(mean, model.policy.actor.parameters(), strict=True):
            average.lerp_(new.detach(), share)
    for ours, theirs in zip(model.policy.actor_target.parameters(), mean, strict=True):
        th.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-6)
    policy, obs = model.policy, env.reset()
    _, (said,) = policy.predict(obs)
    acts, other = policy.actor_target, policy.actor
    acts, other = (acts, other) if averaged else (other, acts)
    with th.no_grad():
        seen = policy.obs_to_tensor(obs)[0]
        np.testing.assert_allclose(said[:, 0], policy(seen, acts)[0], atol=1e-6)
        assert np.abs(said[:, 0] - policy(seen, other)[0].numpy()).max() > 1e-3


class Constant(th.nn.Flatten):
    """An encoder that comes with weights of its own."""

    def __init__(self, observation_space, features_dim):
        super().__init__()
        self.features_dim = features_dim
        self.own = th.nn.Linear(int(np.prod(observation_space.shape)), features_dim)
        th.nn.init.constant_(self.own.weight, 0.5)

    def forward(self, images):
        return self.own(super().forward(images))


def test_baku_leaves_the_weights_of_an_encoder_of_ones_own(corner):
    demo, env = corner
    kwargs = {**SMALL, "features_extractor_class": Constant}
    model = BAKU("CnnPolicy", env, demo=demo, policy_kwargs=kwargs)
    assert (model.policy.actor.features_extractor.own.weight == 0.5).all()


def test_baku_goes_on_only_with_its_demonstration(corner, tmp_path):
    demo, env = corner
    BAKU("CnnPolicy", env, demo=demo, policy_kwargs=SMALL).save(tmp_path / "model")
    with pytest.raises(ValueError, match="needs demo= to learn"):
        BAKU.load(tmp_path / "model", env=env).learn(2)
    demo.save(tmp_path / "demo.hdf5")
    again = BAKU.load(tmp_path / "model", env=env, demo=str(tmp_path / "demo.hdf5"))
    assert again.learn(2).num_timesteps == 2


@pytest.mark.parametrize("algorithm", [BC, BAKU])
def test_learning_rates_that_fall(corner, algorithm):
    demo, env = corner
    own = {"policy_kwargs": SMALL} if algorithm is BAKU else {"warmup_steps": 0, "buffer_size": 1}
    model = algorithm("CnnPolicy", env, demo=demo, learning_rate=lambda left: 1e-3 * left, **own)
    model.learn(20)
    optimizer = model.policy.optimizer if algorithm is BAKU else model.actor.optimizer
    assert optimizer.param_groups[0]["lr"] == pytest.approx(1e-3 / 20)


def test_bc_keeps_no_checkpoints_and_leaves_signals_as_they_were(corner, tmp_path):
    demo, env = corner
    before = signal.getsignal(signal.SIGINT)
    model = BC("CnnPolicy", env, demo=demo, warmup_steps=0, buffer_size=1)
    with pytest.raises(ValueError, match="a checkpoint cannot hold a BC, which makes no steps"):
        model.learn(5, CheckpointCallback(tmp_path))
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize(
    ("change", "said"),
    [({"head": "gmm"}, "head is 'gmm'"), ({"width": 30}, "multiple of heads=4"),
     ({"chunk": 0}, "chunk is 0"), ({"features_extractor_class": "vit"}, "'vit' is unknown")],
)  # fmt: skip
def test_baku_refuses(corner, change, said):
    demo, env = corner
    with pytest.raises(ValueError, match=said):
        BAKU("CnnPolicy", env, demo=demo, policy_kwargs=change)
    with pytest.raises(ValueError, match="needs demo="):
        BAKU("CnnPolicy", env)


def rot(**kwargs):
    settings = {"warmup_steps": 0, "buffer_size": 200, "batch_size": 8, "learning_starts": 0,
                "bc_pretrain_steps": 3, "seed": 0, **kwargs}  # fmt: skip
    return ROT("CnnPolicy", stacked(), demo=demonstration(), **settings)


class Says(th.nn.Module):
    """A network whose answer is known."""

    def __init__(self, answer):
        super().__init__()
        self.answer = answer

    def forward(self, inputs):
        return self.answer(inputs) if callable(self.answer) else th.tensor(self.answer)


def test_rots_weight_on_a_batch_made_by_hand():
    model = rot(bc_coef=3.0)
    # Q(o, a) = a[0]; the first critic says more, and the smaller of both counts
    model.critic.q_networks = [Says(lambda x: x[:, -2:-1] + 1), Says(lambda x: x[:, -2:-1])]
    model.bc_actor.mu = Says([[0.5, 0.0], [-0.5, 0.9], [0.1, 0.9], [0.0, 0.0]])
    model.actor.mu = Says([[0.2, 0.9], [-0.2, 0.0], [0.1, 0.0], [0.3, 0.0]])
    images = th.zeros(4, *model.observation_space.shape)
    model._before_actor(images, th.zeros(4, 7))
    assert model.soft_q == 0.25  # better by cloning, worse, as good (which is not better), worse
    assert model.bc_coef_now() == 3.0 * 0.25
    assert model.q_coef_now() == 0.75


def test_rot_learns_with_that_weight_and_keeps_what_it_cloned(tmp_path):
    model = rot()
    model.learn(60)
    assert model._n_updates > 0
    logged = model.logger.name_to_value
    assert logged["train/bc_coef"] == pytest.approx(model.bc_coef * model.soft_q)
    assert logged["train/q_coef"] == pytest.approx(1 - model.soft_q)
    model.save(tmp_path / "model")
    loaded = ROT.load(tmp_path / "model")
    images = th.rand(3, *model.observation_space.shape, device=model.device)
    with th.no_grad():
        before, own, after = (
            actor.mu(encode(actor, images))
            for actor in (model.bc_actor, model.actor, loaded.bc_actor)
        )
    np.testing.assert_array_equal(before, after)
    assert not th.equal(before, own)


@pytest.mark.parametrize("reward", ["ot", "tot"])
def test_rewards_of_recorded_episodes_are_pots_transport(demo, reward):
    """Frames in, rewards out: the whole way of a run, against POT's Sinkhorn."""
    env = RetrievalRewardWrapper(ToyReach(frozen=False), demo=demo, reward=reward)
    rng = np.random.default_rng(0)
    memory = env.retriever.embeddings
    for seed in range(3):
        env.reset(seed=seed)
        seen, over = [env.retriever.embedding], False
        while not over:
            *_, terminated, truncated, info = env.step(rng.uniform(-0.3, 1, 2).astype(np.float32))
            seen.append(env.retriever.embedding)
            over = terminated or truncated
        mean = memory.mean(axis=0)
        costs = cosine_costs(np.stack(seen) - mean, memory - mean)
        t, n = costs.shape
        if reward == "tot":
            costs = context_costs(costs, 3)
            solved = np.where(band(t, n), costs, 1e9)
        else:
            solved = costs
        plan = ot.sinkhorn(
            np.full(t, 1 / t), np.full(n, 1 / n), solved, 0.01, method="sinkhorn_log",
            numItermax=100, stopThr=0, warn=False,
        )  # fmt: skip
        expected = -(plan * costs).sum(axis=1)[1:]  # the first frame is no step's outcome
        np.testing.assert_allclose(info["retrieval"]["episode_rewards"], expected, atol=1e-5)


def test_vinns_action_is_locally_weighted_regression():
    actions = np.array([[1, 0], [0, 1], [0.5, -1]], np.float32)
    distances = np.array([2.0, 0.5, 1.0, 0.6])  # of four frames: the last one has action 2's
    weights = np.exp([-0.5, -0.6])
    expected = (weights[0] * actions[1] + weights[1] * actions[2]) / weights.sum()
    np.testing.assert_allclose(locally_weighted(distances, actions, 2), expected, rtol=1e-6)
    np.testing.assert_array_equal(locally_weighted(distances, actions, 1), actions[1])
    far = locally_weighted(distances + 1e4, actions, 2)  # exp(-1e4) is 0
    np.testing.assert_allclose(far, expected, rtol=1e-6)


def test_vinn_plays_in_an_environment(corner):
    demo, _ = corner
    env = DummyVecEnv([lambda: RetrievalGuideWrapper(Corner(), demo=demo, k=1, horizon=2)])
    assert evaluate(vinn_act(demo, 1), env, 1).successes == [True]


class Start(Corner):
    """Begins anywhere on the first leg's start, by its seed; seed 0 is the demonstration's."""

    def reset(self, *, seed=None, options=None):
        obs, info = super().reset(seed=seed)
        self.began = seed
        return obs, info


def backwards(demo, **arguments):
    from_0 = replace_metadata(demo, {"seed": 0})
    return ReverseForwardCurriculum(Start(), from_0, **arguments)


def replace_metadata(demo, metadata):
    return Demonstration(demo.frames, demo.actions, metadata=metadata)


def solve(env, demo, begun, good=True):
    """Play the rest of the demonstration, or nothing but stray."""
    for action in demo.actions[begun:]:
        *_, reward, terminated, truncated, _ = env.step(action if good else np.array([0, -1.0]))
        if terminated or truncated:
            return reward
    return reward


def test_starts_go_back_through_the_demonstration_then_anywhere(corner):
    demo, _ = corner
    env = backwards(demo, stride=6, recent=2, spread=0.0, starts=5)
    begun = []
    while env.reverse:
        obs, _ = env.reset()
        begun.append(env.unwrapped.steps)
        np.testing.assert_array_equal(obs, demo.frames[begun[-1]])
        good = len(begun) != 3  # one failure holds it up
        assert solve(env, demo, begun[-1], good) == good
        env.set_lasting_state(env.lasting_state())
    assert begun == [10, 10, 4, 4, 4, 0, 0]
    for _ in range(200):  # seed 1 is solved always, seed 2 now and then
        env.reset()
        seed = env.unwrapped.began
        solve(env, demo, 0, seed == 1 or (seed == 2 and env.unwrapped.np_random.random() < 2))
        if seed == 2:
            env._solved[2].append(False)
    env._rng = np.random.default_rng(0)
    starts = [(env.reset(), env.unwrapped.began)[1] for _ in range(3000)]
    counts = np.bincount(starts, minlength=5) / 3000
    np.testing.assert_allclose(counts, np.array([2, 1, 3, 2, 2]) / 10, atol=0.03)


def test_an_episode_asked_for_by_its_seed_is_that_one(corner):
    demo, _ = corner
    env = backwards(demo)
    for _ in range(3):
        env.reset(seed=77)
        assert (env.unwrapped.began, env.unwrapped.steps) == (77, 0)
        solve(env, demo, 0)
    assert env.begin == 12  # nothing was counted


def test_a_curriculum_refuses(corner):
    demo, _ = corner
    with pytest.raises(ValueError, match=r"actions and metadata..seed.., as `regil record`"):
        ReverseForwardCurriculum(Start(), demo)
    with pytest.raises(ValueError, match="stride=0, recent=3, starts=200 must be at least 1"):
        backwards(demo, stride=0)
    other = Demonstration(demo.frames, -demo.actions, metadata={"seed": 0})
    with pytest.raises(ValueError, match=r"ends at its step .* of 16: record it in this"):
        ReverseForwardCurriculum(Start(), other).reset()


BC_TRAINS = ("bc", "baku", "ablation-reg-bc", "reward-")
"""Presets whose encoder behaviour cloning trains, as ours."""


@pytest.mark.parametrize("name", comparisons())
def test_a_comparison_changes_what_it_names_and_no_more(name):
    for env in (ENV, "regil/libero-kitchen1-drawer-v0"):
        ours, theirs = make_settings(env), make_settings(env, name)
        named = {key.partition(".")[0] for key in comparisons()[name]}
        for key in ("env_kwargs", "frame_stack", "n_envs", "eval_episodes", "policy"):
            assert getattr(ours, key) == getattr(theirs, key)
        assert theirs.steps == ours.steps or "n_timesteps" in named
        for key, value in theirs.hyperparams.items():
            assert key in named or ours.hyperparams[key] == value, key
        more = len(comparisons()[name].get("env_wrapper", []))
        assert len(theirs.wrappers("x")) == len(ours.wrappers("x")) + more
        for (_, a), (_, b) in zip(ours.wrappers("x"), theirs.wrappers("x"), strict=False):
            assert {k for k in a if a[k] != b[k]} <= named
        if ALGOS[theirs.algo] is not BAKU:
            network, own = (s.hyperparams["policy_kwargs"] for s in (theirs, ours))
            # what trains an encoder on few or no steps to clone is the critic
            trained = {**own, "shared_encoder": True}
            assert network == (own if name.startswith(BC_TRAINS) else trained)


STATE = "regil/metaworld-drawer-close-state-v0"


@pytest.mark.parametrize("name", [n for n in comparisons() if n != "baku"])
def test_a_comparison_fits_a_policy_that_sees_the_state(name):
    assert not make_settings(STATE, name).hyperparams["policy_kwargs"]


def test_the_papers_ablations():
    made = {name: make_settings(ENV, f"ablation-{name}").hyperparams
            for name in ("bc-rl", "reg-rl", "rl", "reg-bc")}  # fmt: skip
    without_guide = {n for n, h in made.items() if h["warmup_steps"] == h["guide_again"] == 0}
    assert without_guide == {"bc-rl", "rl"}
    assert {n for n, h in made.items() if h.get("bc_coef", 2.0) == 0} == {"reg-rl", "rl"}
    assert {n for n, h in made.items() if h.get("q_coef", 1.0) == 0} == {"reg-bc"}
    assert not made["bc-rl"]["keep_own_successes"]  # the demonstration alone


def test_our_presets_are_for_updates_beside_control_too():
    settings = make_settings(ENV, "quick", algo="td3bc-background")
    assert settings == replace(make_settings(ENV, "quick"), algo="td3bc-background")
    assert make_settings(ENV, "tot", algo="rot") == make_settings(ENV, "tot")
    for algo in ("td3bc", "td3bc-background"):
        with pytest.raises(ValueError, match=f"--algo {algo}: preset 'tot' is of rot"):
            make_settings(ENV, "tot", algo=algo)


def test_algo_and_preset_must_agree(capsys):
    words = ["train", "--env", ENV, "--preset", "tot", "--algo"]
    assert main([*words, "baku"]) == 2
    assert "'tot' is of rot" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("algo", "steps", "changes"),
    [
        ("rot", 45, ["bc_pretrain_steps=2", "buffer_size=300", "batch_size=8"]),
        ("baku", 2, ["policy_kwargs.layers=1", "batch_size=8"]),
    ],
)
def test_trained_and_evaluated_as_td3bc_is(tmp_path, monkeypatch, capsys, algo, steps, changes):
    monkeypatch.setattr("regil_sb3.training.BC_UPDATES", 2)
    run, demo = tmp_path / "run", tmp_path / "demo.hdf5"
    assert main(["record", ENV, "-o", str(demo)]) == 0
    words = ["train", "--algo", algo, "--env", ENV, "--demo", str(demo)]
    words += ["--steps", str(steps), "--episodes", "1", "--out", str(run)]
    for change in [*changes, "eval_episodes=1", "env_kwargs.max_steps=20"]:
        words += ["--set", change]
    assert main(words) == 0
    assert Settings.load(run / "config.yaml").algo == algo
    results = json.loads((run / "evaluation.json").read_text())
    assert results["steps"] == steps
    assert results["seeds"] == [1_000_000]
    card = (run / "README.md").read_text()
    assert f"# {ALGOS[algo].__name__} on `{ENV}`" in card
    assert f"from regil_sb3.baselines import {ALGOS[algo].__name__}\n" in card
    offline = algo == "baku"
    assert results["frames"] == (0 if offline else 2 * steps)
    assert {"policy", "guide", "vinn" if offline else "bc"} <= results.keys()
    assert main(["train", "--resume", str(run)]) == 2  # it has ended
    if offline:
        assert "has learned all its steps" in capsys.readouterr().err
        settings = Settings.load(run / "config.yaml")
        replace(settings, steps=4).save(run / "config.yaml")
        assert main(["train", "--resume", str(run), "--episodes", "1"]) == 0
        assert json.loads((run / "evaluation.json").read_text())["steps"] == 4


def test_rfcl_is_trained_by_its_preset(tmp_path):
    changes = ["bc_pretrain_steps=2", "buffer_size=300", "batch_size=8", "eval_episodes=1"]
    settings = make_settings(ENV, "rfcl", steps=45, overrides=[*changes, "learning_starts=20"])
    demo = record_expert(ENV, 0)
    train(settings, demo, tmp_path / "run")
    rows = (tmp_path / "run" / "progress.csv").read_text().splitlines()
    assert len(rows) > 1
    with closing(make_env(settings, tmp_path / "run" / "demo.hdf5")) as env:
        env.reset()  # seeded: as it is asked for
        env.reset()
        assert env.get_attr("begin") == [len(demo.actions) - 4]
        done, lengths = False, 0
        while not done:
            _, rewards, (done,), (info,) = env.step(demo.actions[[-1]])
            lengths += 1
        assert (rewards[0], lengths <= 4) == (float(info["is_success"]), True)
