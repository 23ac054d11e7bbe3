"""The vector twins: to the bit what as many wrapped environments give, with one encoder call."""

from __future__ import annotations

import copy
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import toy_camera
import toy_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers.vector import DictInfoToList
from regil_wrappers import Demonstration, make_encoder, vector, wrappers
from regil_wrappers.reward_signals import AT_EPISODE_END, AT_EVERY_STEP
from toy_camera import ToyCamera
from toy_env import ToyReach

LENGTHS = (7, 12, 7, 9)  # two episodes end together, the others by themselves
MODES = list(AutoresetMode)
ORDERS = ["guide reward", "reward guide"]
Vector = VectorEnv[Any, Any, Any]


def toy(steps: int, **settings: Any) -> gym.Env[Any, Any]:
    return gym.wrappers.TimeLimit(ToyReach(frozen=False, **settings), steps)


class Talks(gym.Wrapper):  # type: ignore[type-arg]
    """Has infos of the same name."""

    def step(self, action: Any) -> Any:
        *others, info = super().step(action)
        return *others, {**info, "retrieval": {"cost": -1, "mine": 2}}


def stack(room: Any, env: Any, demo: Any, order: str, guide: Any, **settings: Any) -> Any:
    """`room` has the wrappers for one environment, or for several."""
    shared = {k: v for k, v in settings.items() if k not in ("reward", "mode", "weight")}
    for name in order.split():
        if name == "guide":
            env = room.RetrievalGuideWrapper(env, demo, **shared, **guide)
        else:
            env = room.RetrievalRewardWrapper(env, demo, **settings)
    return env


def both(
    resets: AutoresetMode,
    demo: Any,
    order: str = "guide reward",
    made: Any = toy,
    kind: Any = SyncVectorEnv,
    lengths: tuple[int, ...] = LENGTHS,
    guide: dict[str, Any] | None = None,
    **settings: Any,
) -> tuple[Any, Any]:
    """Environments wrapped together, and wrapped each."""
    how = {"order": order, "guide": guide or {}, **settings}
    plain = [partial(made, n) for n in lengths]
    each = [partial(lambda n: stack(wrappers, made(n), demo, **how), n) for n in lengths]
    together = stack(vector, kind(plain, autoreset_mode=resets), demo, **how)
    return together, SyncVectorEnv(each, autoreset_mode=resets)


def same(a: Any, b: Any, held: Any = True) -> None:
    """The same values of the same types, where the environments have them."""
    if isinstance(b, dict):
        assert set(a) == set(b)
        for name in b:
            same(a[name], b[name], b.get(f"_{name}", True))
    elif isinstance(b, np.ndarray) and b.ndim and not np.isscalar(held):
        for x, y in zip(a[held], b[held], strict=True):
            same(x, y)
    else:
        assert np.asarray(a).dtype == np.asarray(b).dtype
        np.testing.assert_array_equal(a, b)


def play(envs: tuple[Vector, Vector], mode: AutoresetMode, steps: int, choose: Any = None) -> int:
    """Both the same way, all they return compared; how many episodes ended."""
    rng = np.random.default_rng(1)
    n = envs[0].num_envs
    seeds = [5, 3, 7, 8][:n]

    def reset(**given: Any) -> None:  # options anew: an environment takes the mask out of them
        for a, b in zip(*(env.reset(**copy.deepcopy(given)) for env in envs), strict=True):
            same(a, b)

    reset(seed=seeds if choose is None else 5)
    ended = 0
    for t in range(steps):
        actions = rng.uniform(-1, 1, envs[0].action_space.shape).astype(np.float32)
        if choose is not None:
            actions = choose(actions)
        results = [env.step(actions) for env in envs]
        for a, b in zip(*results, strict=True):
            same(a, b)
        over = results[0][2] | results[0][3]
        ended += over.sum()
        if mode == AutoresetMode.DISABLED and over.any():
            reset(options={"reset_mask": over, "x": 1})
        if choose is None and t == 6:  # an episode has ended, one goes on and one is not asked
            reset(seed=seeds, options={"reset_mask": np.array([True, True, False, False][:n])})
        if choose is None and t == 14:
            reset(seed=2)
    for env in envs:
        env.close()
    return int(ended)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("order", ORDERS)
def test_a_stack(mode: AutoresetMode, order: str, demo_path: str) -> None:
    envs = both(mode, demo_path, order, lambda n: Talks(toy(n)))
    assert play(envs, mode, 30) >= 8


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("reward", [*AT_EVERY_STEP, *AT_EPISODE_END])
def test_every_reward(mode: AutoresetMode, reward: str, demo_path: str) -> None:
    settings = {"reward": reward, "mode": "add", "weight": 0.5, "k": 3, "horizon": 2}
    envs = both(mode, demo_path, "reward", **settings)
    assert envs[0].reward_scale == envs[1].get_attr("reward_scale")[0]
    assert envs[0].rewards_at_episode_end == (reward in AT_EPISODE_END)
    assert play(envs, mode, 28) >= 8


@pytest.mark.parametrize("mode", MODES)
def test_in_processes_without_copies(mode: AutoresetMode, demo_path: str) -> None:
    envs = both(mode, demo_path, kind=partial(AsyncVectorEnv, copy=False), reward="ot")
    assert play(envs, mode, 25) >= 6


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("made_with", "image"),
    [
        ({"obs": "dict"}, "obs:front"),
        ({"obs": "channels_first"}, "obs"),
        ({"obs": "state", "render_mode": "rgb_array"}, "render"),
    ],
)
def test_pictures_from_anywhere(
    mode: AutoresetMode, made_with: dict[str, Any], image: str, demo_path: str
) -> None:
    kind = AsyncVectorEnv if image == "render" else SyncVectorEnv
    make = partial(both, mode, demo_path, made=partial(toy, **made_with), kind=kind, image=image)
    if image == "render" and mode == AutoresetMode.SAME_STEP:
        refused(make, "image='render', but these environments begin the next episode before")
    else:
        assert play(make(), mode, 15) >= 4


class Counted:
    """An encoder that wants larger pictures, and counts its calls and what it was given."""

    frame_size = 64
    slow = False
    cache_key = None

    def __init__(self) -> None:
        self.given: list[tuple[int, ...]] = []

    def encode(self, frames: np.ndarray) -> np.ndarray:
        self.given.append(frames.shape)
        return make_encoder("pixels").encode(frames)


@pytest.mark.parametrize("mode", MODES)
def test_one_call_of_the_encoder(mode: AutoresetMode, demo: Demonstration) -> None:
    encoder = Counted()
    env, _ = both(mode, demo, encoder=encoder)
    encoder.given.clear()
    env.reset(seed=0)
    assert encoder.given == [(4, 48, 48, 3)]
    ends = [n for n in LENGTHS if n == 7]
    for _ in range(7):
        env.step(np.zeros((4, 2), np.float32))
    assert len(encoder.given) == 8
    new = len(ends) if mode == AutoresetMode.SAME_STEP else 0
    assert encoder.given[-1] == (4 + new, 48, 48, 3)
    assert env.latency.steps == 8
    if mode == AutoresetMode.DISABLED:
        _, infos = env.reset(options={"reset_mask": np.array([True, False, True, False])})
        assert encoder.given[-1] == (2, 48, 48, 3)
        assert infos["retrieval"]["_cost"].tolist() == [True, False, True, False]


@pytest.mark.parametrize("kind", [SyncVectorEnv, AsyncVectorEnv])
def test_larger_pictures_for_the_encoder(kind: Any) -> None:
    larger = toy_env.record(encoder_size=64)
    for mode in MODES:
        encoder = Counted()
        make = partial(both, mode, larger, kind=kind, encoder=encoder)
        if mode == AutoresetMode.SAME_STEP:
            refused(make, "holds 64-pixel encoder_frames, but these environments begin")
            continue
        assert play(make(), mode, 10) >= 3
        assert {shape[1:] for shape in encoder.given} == {(64, 64, 3)}


@pytest.mark.parametrize("mode", MODES)
def test_several_demonstrations(mode: AutoresetMode) -> None:
    demos = [toy_env.record(seed, frozen=False) for seed in range(3)]
    envs = both(mode, demos, reward="progress", k=9, horizon=3, step_pattern="strap")
    assert play(envs, mode, 25) >= 6


@pytest.mark.parametrize("mode", MODES)
def test_pictures_moved_back(mode: AutoresetMode) -> None:
    envs = both(
        mode,
        toy_camera.record(),
        made=lambda n: ToyCamera(max_steps=n),
        lengths=(3, 5),
        register=True,
    )
    assert play(envs, mode, 6) >= 2


@pytest.mark.parametrize(("mode", "order"), [*zip(MODES, [*ORDERS, ORDERS[0]], strict=True)])
def test_guides_that_correct(mode: AutoresetMode, order: str) -> None:
    """Each calibrates for itself, then goes where its target is."""
    demo = toy_camera.record()
    guide = {"correction": "servo", "disturbance": 0.5}
    made = lambda n: ToyCamera(max_steps=n)  # noqa: E731
    envs = both(mode, demo, order, made, lengths=(60, 66), guide=guide)
    inner = envs[0] if order.endswith("guide") else envs[0].env
    kinds = set()

    def follow(_: Any) -> Any:
        actions = inner.guide_action()
        same(actions, np.stack(envs[1].call("guide_action")))
        same(inner.plain_action(), np.stack(envs[1].call("plain_action")))
        kinds.update(guide.servo.kind for guide in inner._guides.guides)
        for a, b in zip(inner.target_shift, envs[1].get_attr("target_shift"), strict=True):
            same(a, b)
        return inner.disturbed_action()

    assert play(envs, mode, 140, follow) >= 4
    assert {"calibration", "corrected"} <= kinds
    known = list(envs[1].call("calibration"))
    assert inner.calibration() == known
    assert known[0] is not None
    fresh, _ = both(mode, demo, "guide", made, lengths=(60, 66), guide=guide)
    fresh.set_calibration(known[0])
    assert fresh.calibration() == [known[0]] * 2


def test_guided_replay(demo: Demonstration, demo_path: str) -> None:
    env = SyncVectorEnv([ToyReach] * 3)
    env = vector.RetrievalGuideWrapper(env, demo_path)
    env = vector.RetrievalRewardWrapper(env, demo_path)
    env.reset(seed=0)
    assert demo.actions is not None
    for t, action in enumerate(demo.actions):
        suggested = env.env.guide_action()
        np.testing.assert_array_equal(suggested, np.stack([action] * 3))
        _, rewards, terminations, _, infos = env.step(suggested)
        assert rewards.tolist() == [0, 0, 0]
        assert [a.end for a in env.alignments] == [t + 1] * 3
    assert terminations.all()
    assert infos["is_success"].all()


def test_infos_as_a_list(demo_path: str) -> None:
    env = vector.RetrievalRewardWrapper(
        SyncVectorEnv([partial(toy, n) for n in (3, 3)]), demo_path, reward="ot"
    )
    env = DictInfoToList(env)
    _, infos = env.reset(seed=0)
    assert [set(info["retrieval"]) for info in infos] == [
        {"demonstration", "start", "end", "cost"}
    ] * 2
    for _ in range(3):
        *_, infos = env.step(np.zeros((2, 2), np.float32))
    for info in infos:
        assert info["retrieval"]["episode_rewards"].shape == (3,)
        assert info["retrieval"]["env_reward"] == 0


def test_episodes_of_several_lengths_that_end_together(demo_path: str) -> None:
    env = vector.RetrievalRewardWrapper(
        SyncVectorEnv([partial(toy, n) for n in (3, 7)]), demo_path, reward="tot"
    )
    env.reset(seed=0)
    for _ in range(7):  # the first one is reset in the fourth step
        *_, infos = env.step(np.zeros((2, 2), np.float32))
    assert [len(rewards) for rewards in infos["retrieval"]["episode_rewards"]] == [3, 7]


def refused(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


class Unsaid(SyncVectorEnv):
    """Does not say how it resets."""

    def __init__(self) -> None:
        super().__init__([ToyReach])
        del self.metadata["autoreset_mode"]


def test_what_does_not_fit(demo_path: str) -> None:
    guide, reward = vector.RetrievalGuideWrapper, vector.RetrievalRewardWrapper
    three = SyncVectorEnv([ToyReach] * 3)
    for make, message in (
        (lambda: guide(ToyReach(), demo_path), "is no gymnasium.vector.VectorEnv: regil_wrappers"),
        (lambda: wrappers.RetrievalGuideWrapper(three, demo_path), "regil_wrappers.vector has"),
        (lambda: guide(Unsaid(), demo_path), "is None: it must say one of"),
        (
            lambda: reward(SyncVectorEnv([partial(ToyReach, obs="state")]), demo_path),
            r"observations are float32 \(4,\), not one RGB picture",
        ),
        (
            lambda: reward(SyncVectorEnv([ToyReach]), demo_path, image="render"),
            "image='render' needs render_mode='rgb_array'",
        ),
        (
            lambda: reward(SyncVectorEnv([partial(ToyReach, size=84)]), demo_path),
            "has 48x48 frames but the environment gives 84x84",
        ),
        (
            lambda: reward(SyncVectorEnv([partial(ToyReach, camera="beside")]), demo_path),
            "recorded with camera 'above' but the environment has 'beside'",
        ),
        (lambda: reward(guide(three, demo_path), demo_path, k=3), "k=3, but .* inside has 5"),
        (lambda: guide(three, demo_path, guide_patience=0), "guide_patience=0: "),
        (lambda: guide(three, demo_path, correction="more"), "correction='more': choose"),
        (lambda: reward(three, demo_path, mode="times"), "mode='times': choose"),
        (
            lambda: guide(
                SyncVectorEnv([lambda: wrappers.RetrievalGuideWrapper(ToyReach(), demo_path)]),
                demo_path,
            ),
            "each environment has a retrieval wrapper already",
        ),
    ):
        refused(make, message)
    env = guide(three, demo_path)
    rewarded = reward(three, demo_path)
    three.reset()  # not the wrappers
    refused(env.guide_action, r"call reset\(\)")
    refused(lambda: env.step(np.zeros((3, 2))), r"call reset\(\)")
    refused(lambda: rewarded.step(np.zeros((3, 2))), r"call reset\(\)")
    env.reset()
    refused(lambda: env.step(np.zeros((2, 2))), r"shape \(2, 2\): 3 environments take \(3, 2\)")
    refused(lambda: env.set_calibration({}), "takes no calibration")
    turned = SyncVectorEnv([ToyReach, partial(ToyReach, look="upside down")])
    refused(reward(turned, demo_path).reset, "upside down")


def test_a_step_without_final_observations(demo_path: str) -> None:
    class Forgets(SyncVectorEnv):
        def step(self, actions: Any) -> Any:
            *others, infos = super().step(actions)
            infos.pop("final_obs", None)
            return *others, infos

    env = vector.RetrievalRewardWrapper(
        Forgets([partial(toy, 2)], autoreset_mode=AutoresetMode.SAME_STEP), demo_path
    )
    env.reset(seed=0)
    env.step(np.zeros((1, 2)))
    refused(lambda: env.step(np.zeros((1, 2))), r"without infos\['final_obs'\]")


def test_a_deadline_is_for_all_together(demo_path: str) -> None:
    env = vector.RetrievalRewardWrapper(SyncVectorEnv([ToyReach] * 3), demo_path, deadline_ms=0.001)
    with pytest.warns(UserWarning, match="more than deadline_ms=0.001") as said:
        env.reset()
    assert len(said) == 1
    env.step(np.zeros((3, 2)))
    assert (env.latency.steps, env.latency.misses) == (2, 2)
