"""SB3's vector twins: to the bit what as many wrapped environments give, for any algorithm."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import toy_camera
import toy_env
from regil_wrappers import Demonstration, RetrievalGuideWrapper, RetrievalRewardWrapper
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecExtractDictObs,
    VecFrameStack,
    VecMonitor,
    VecTransposeImage,
)

from regil_sb3 import TD3BC, VecRetrievalGuide, VecRetrievalReward
from regil_sb3.relabelling import AfterFirstEpisode, EpisodeRewardReplayBuffer, rewards_come_late

LENGTHS = (7, 12, 7)


def small() -> dict[str, Any]:
    extractor = {"features_extractor_kwargs": {"features_dim": 16}}
    return {"policy_kwargs": {**extractor, "net_arch": [8]}, "device": "cpu", "seed": 0}


def toy(steps: int, **settings: Any) -> gym.Env[Any, Any]:
    return gym.wrappers.TimeLimit(toy_env.ToyReach(frozen=False, **settings), steps)


def wrapped(steps: int, demo: Any, make: Any = toy, **settings: Any) -> gym.Env[Any, Any]:
    shared = {k: v for k, v in settings.items() if k not in ("reward", "mode")}
    env = RetrievalGuideWrapper(make(steps), demo, **shared)
    return RetrievalRewardWrapper(env, demo, **settings)


def together(demo: Any, kind: Any = DummyVecEnv, make: Any = toy, **settings: Any) -> VecEnv:
    shared = {k: v for k, v in settings.items() if k not in ("reward", "mode")}
    env = VecRetrievalReward(kind([partial(make, n) for n in LENGTHS]), demo, **settings)
    return VecRetrievalGuide(env, demo, **shared)


def same(a: Any, b: Any) -> None:
    if isinstance(b, dict):
        assert set(a) == set(b)
        for name in b:
            same(a[name], b[name])
    elif isinstance(b, (list, tuple)):
        for x, y in zip(a, b, strict=True):
            same(x, y)
    else:
        np.testing.assert_array_equal(a, b)
        assert np.asarray(a).dtype == np.asarray(b).dtype


def play(envs: tuple[VecEnv, VecEnv], steps: int) -> int:
    """Both the same way, all they return compared; how many episodes ended."""
    rng = np.random.default_rng(1)
    for env in envs:
        env.seed(4)
    same(*(env.reset() for env in envs))
    ended = 0
    for _ in range(steps):
        same(*(list(env.reset_infos) for env in envs))
        for name in ("guide_action", "plain_action"):
            same(*(env.env_method(name, indices=[2, 0]) for env in envs))
        actions = rng.uniform(-1, 1, (3, 2)).astype(np.float32)
        a, b = (env.step(actions) for env in envs)
        same(a, b)
        ended += int(a[2].sum())
    for name in ("reward_scale", "rewards_at_episode_end", "alignment", "target_shift"):
        assert all(env.has_attr(name) for env in envs)
        assert envs[0].get_attr(name, [1, 2]) == envs[1].get_attr(name, [1, 2])
    assert not any(env.has_attr("nothing") for env in envs)
    for env in envs:
        env.close()
    return ended


@pytest.mark.parametrize(
    ("kind", "reward"),
    [(DummyVecEnv, "sdtw"), (DummyVecEnv, "orca"), (DummyVecEnv, "ot"), (SubprocVecEnv, "sdtw")],
)
def test_as_wrapped_environments(kind: Any, reward: str, demo_path: str) -> None:
    settings = {"reward": reward, "mode": "add" if reward == "ot" else "replace", "k": 3}
    each = DummyVecEnv([partial(wrapped, n, demo_path, **settings) for n in LENGTHS])
    assert play((together(demo_path, kind, **settings), each), 16) >= 5


@pytest.mark.parametrize(
    ("obs", "image"), [("dict", "obs:front"), ("channels_first", "obs"), ("pixels", "obs")]
)
def test_pictures_from_anywhere(obs: str, image: str, demo_path: str) -> None:
    make = partial(toy, obs=obs)
    each = DummyVecEnv([partial(wrapped, n, demo_path, make, image=image) for n in LENGTHS])
    assert play((together(demo_path, make=make, image=image), each), 16) >= 5


def test_transposed_inside_and_stacked_outside(demo_path: str) -> None:
    inside = VecTransposeImage(DummyVecEnv([partial(toy, n) for n in LENGTHS]))
    one = VecRetrievalReward(inside, demo_path)
    two = VecRetrievalGuide(VecTransposeImage(together(demo_path)), demo_path)  # shares
    stacked = VecFrameStack(one, 2)
    stacked.seed(0)
    two.seed(0)
    assert stacked.reset().shape == (3, 6, 48, 48)
    two.reset()
    for _ in range(9):
        actions = np.full((3, 2), 0.3, np.float32)
        _, a, dones, infos = stacked.step(actions)
        _, b, _, others = two.step(actions)
        np.testing.assert_array_equal(a, b)
        assert [i["retrieval"]["end"] for i in infos] == [i["retrieval"]["end"] for i in others]
        if dones.any():
            assert infos[0]["terminal_observation"].shape == (6, 48, 48)
    assert two.latency.steps == 10
    assert one.alignments[0] == two.alignments[0]


@pytest.mark.parametrize("algorithm", [SAC, PPO])
def test_algorithms_that_know_nothing(algorithm: Any, demo_path: str) -> None:
    """A policy that sees the state is rewarded for pictures."""

    def make(steps: int) -> gym.Env[Any, Any]:
        env = toy(steps, obs="state", render_mode="rgb_array")
        return gym.wrappers.AddRenderObservation(
            env, render_only=False, render_key="front", obs_key="state"
        )

    venv: VecEnv = DummyVecEnv([partial(make, n) for n in LENGTHS])
    venv = VecRetrievalReward(venv, demo_path, image="obs:front")
    venv = VecMonitor(VecExtractDictObs(venv, "state"))
    own = {"n_steps": 8, "batch_size": 8} if algorithm is PPO else {"learning_starts": 12}
    model = algorithm("MlpPolicy", venv, policy_kwargs={"net_arch": [8]}, device="cpu", **own)
    model.learn(48)
    assert all(p.isfinite().all() for p in model.policy.parameters())
    assert all(episode["r"] < 0 for episode in model.ep_info_buffer)
    if algorithm is SAC:
        assert (model.replay_buffer.rewards[:16] <= 0).all()
        assert model.replay_buffer.rewards[:16].any()


def test_rewards_of_whole_episodes(demo_path: str) -> None:
    venv = VecRetrievalReward(
        DummyVecEnv([partial(toy, n) for n in LENGTHS]), demo_path, reward="tot"
    )
    assert rewards_come_late(venv)
    model = SAC(
        "CnnPolicy",
        venv,
        replay_buffer_class=EpisodeRewardReplayBuffer,
        learning_starts=30,
        buffer_size=300,
        batch_size=4,
        **small(),
    )
    model.learn(60, callback=AfterFirstEpisode())
    size = model.replay_buffer.size()
    assert size > 10
    assert (model.replay_buffer.rewards[:size] < 0).all()


def test_td3bc_as_with_wrapped_environments(demo: Demonstration, demo_path: str) -> None:
    """Warm-up, success buffer and training: the same model to the last bit."""

    def make(steps: int) -> gym.Env[Any, Any]:
        return gym.wrappers.TimeLimit(toy_env.ToyReach(), steps)

    lengths = (40, 9)
    each = DummyVecEnv([partial(wrapped, n, demo_path, make) for n in lengths])
    venv = VecRetrievalGuide(DummyVecEnv([partial(make, n) for n in lengths]), demo_path)
    models = []
    for env in (each, VecRetrievalReward(venv, demo_path)):
        model = TD3BC(
            "CnnPolicy",
            env,
            demo=demo,
            warmup_steps=40,
            learning_starts=40,
            buffer_size=200,
            batch_size=4,
            bc_pretrain_steps=1,
            **small(),
        )
        models.append(model.learn(56))
    a, b = models
    assert a.used_reward_scale == b.used_reward_scale
    assert b.success_buffer.episodes > 1
    np.testing.assert_array_equal(a.replay_buffer.rewards, b.replay_buffer.rewards)
    for x, y in zip(a.policy.parameters(), b.policy.parameters(), strict=True):
        assert th.equal(x, y)


def test_guides_that_correct() -> None:
    demo = toy_camera.record()
    settings = {"correction": "servo", "disturbance": 0.5}
    make = toy_camera.ToyCamera
    kinds = set()
    each = DummyVecEnv([lambda: RetrievalGuideWrapper(make(max_steps=60), demo, **settings)] * 2)
    venv = DummyVecEnv([lambda: make(max_steps=60)] * 2)
    venv.seed(5)  # before it is wrapped, as make_vec_env does
    each.seed(5)
    envs = (VecRetrievalGuide(venv, demo, **settings), each)
    same(*(env.reset() for env in envs))
    for _ in range(140):
        actions = [np.stack(env.env_method("disturbed_action")) for env in envs]
        same(*actions)
        a, b = (env.step(actions[0]) for env in envs)
        same(a, b)
        kinds.update(info["retrieval"]["guide"] for info in a[3])
    assert {"calibration", "corrected"} <= kinds
    known = envs[0].env_method("calibration")
    assert known == each.env_method("calibration")
    fresh = VecRetrievalGuide(DummyVecEnv([make] * 2), demo, **settings)
    fresh.env_method("set_calibration", known[0])
    assert fresh.env_method("calibration") == [known[0]] * 2


class Forgets(VecTransposeImage):
    """Throws the last observations away."""

    def step_wait(self) -> Any:
        *others, infos = super().step_wait()
        for info in infos:
            info.pop("terminal_observation", None)
        return *others, infos


def test_what_does_not_fit(demo_path: str) -> None:
    def of(**settings: Any) -> VecEnv:
        return DummyVecEnv([partial(toy, n, **settings) for n in LENGTHS])

    forgets = VecRetrievalReward(Forgets(of()), demo_path)
    forgets.seed(0)
    forgets.reset()
    guide = VecRetrievalGuide(of(), demo_path)

    def forget() -> None:
        for _ in range(7):
            forgets.step(np.zeros((3, 2), np.float32))

    each = DummyVecEnv([partial(wrapped, n, demo_path) for n in LENGTHS])
    for make, message in (
        (lambda: VecRetrievalReward(toy(3), demo_path), "is no VecEnv of Stable-Baselines3"),
        (lambda: VecRetrievalReward(of(obs="state"), demo_path), "not one RGB picture"),
        (lambda: VecRetrievalReward(VecFrameStack(of(), 2), demo_path), "stacking outside"),
        (
            lambda: VecRetrievalReward(
                of(obs="state", render_mode="rgb_array"), demo_path, image="render"
            ),
            "image='render', but these environments begin the next episode before",
        ),
        (lambda: VecRetrievalReward(of(camera="beside"), demo_path), "has 'beside'"),
        (lambda: VecRetrievalReward(each, demo_path), "has a retrieval wrapper already"),
        (lambda: VecRetrievalReward(guide, demo_path, k=4), "k=4, but"),
        (guide.guide_action, r"call reset\(\)"),
        (lambda: guide.step(np.zeros((2, 2))), r"shape \(2, 2\): 3 environments take \(3, 2\)"),
        (forget, "environment 0 ended without infos"),
    ):
        with pytest.raises(ValueError, match=message) as caught:
            make()
        assert "\n" not in str(caught.value)
