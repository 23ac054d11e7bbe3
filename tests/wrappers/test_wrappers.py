from __future__ import annotations

import json
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import toy_env
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from regil_wrappers import (
    Demonstration,
    RetrievalGuideWrapper,
    RetrievalRewardWrapper,
    Retriever,
    vector,
)
from regil_wrappers.rewards import demonstration_tau
from toy_env import ToyReach

WRAPPERS = [RetrievalGuideWrapper, RetrievalRewardWrapper]


def play(env: Any, actions: Any, seed: int = 0) -> list[Any]:
    steps = [env.reset(seed=seed)]
    for action in actions:
        steps.append(env.step(action))
    return steps


def test_a_replay_is_guided_and_rewarded_with_zero(demo: Demonstration) -> None:
    env = RetrievalRewardWrapper(RetrievalGuideWrapper(ToyReach(), demo), demo)
    _, info = env.reset(seed=0)
    assert info["retrieval"]["end"] == info["retrieval"]["cost"] == 0
    assert demo.actions is not None
    for t in range(len(demo.actions)):
        action = env.get_wrapper_attr("guide_action")()
        np.testing.assert_array_equal(action, demo.actions[t])
        np.testing.assert_array_equal(info["retrieval"]["guide_action"], action)
        _, reward, terminated, truncated, info = env.step(action)
        assert reward == 0
        assert info["retrieval"]["end"] == t + 1
    assert terminated
    assert not truncated
    assert info["is_success"]
    assert info["retrieval"]["env_reward"] == 1
    # At the end of the demonstration: its last action.
    np.testing.assert_array_equal(env.get_wrapper_attr("guide_action")(), demo.actions[-1])


def test_info_is_a_few_plain_numbers(demo: Demonstration) -> None:
    env = RetrievalRewardWrapper(RetrievalGuideWrapper(ToyReach(), demo), demo)
    _, info = env.reset(seed=0)
    assert set(info["retrieval"]) == {"demonstration", "start", "end", "cost", "guide_action"}
    info = env.step(env.action_space.sample())[4]
    retrieval = info["retrieval"]
    own = {"demonstration", "start", "end", "cost", "guide_action", "env_reward"}
    assert set(retrieval) == own
    assert info["is_success"] is False
    retrieval["guide_action"] = retrieval["guide_action"].tolist()
    assert json.loads(json.dumps(retrieval)) == retrieval


def test_observations_actions_and_endings_pass_through(demo: Demonstration) -> None:
    actions = np.random.default_rng(0).uniform(-1, 1, (45, 2)).astype(np.float32)
    bare = play(ToyReach(frozen=False), actions[:40], seed=5)
    guided = play(RetrievalGuideWrapper(ToyReach(frozen=False), demo), actions[:40], seed=5)
    rewarded = play(RetrievalRewardWrapper(ToyReach(frozen=False), demo), actions[:40], seed=5)
    for a, b, c in zip(bare, guided, rewarded, strict=True):
        np.testing.assert_array_equal(a[0], b[0])
        np.testing.assert_array_equal(a[0], c[0])
    for a, b, c in zip(bare[1:], guided[1:], rewarded[1:], strict=True):
        assert a[1:4] == b[1:4]  # the guide does not touch the reward
        assert a[2:4] == c[2:4]
        assert c[4]["retrieval"]["env_reward"] == a[1]
        assert c[1] <= 0


def test_the_reward_is_that_of_the_retriever(demo: Demonstration) -> None:
    actions = np.random.default_rng(1).uniform(-1, 1, (12, 2))
    steps = play(RetrievalRewardWrapper(ToyReach(), demo, k=3, horizon=2), actions)
    retriever = Retriever(demo, k=3, horizon=2)
    for step in steps:
        alignment = retriever.step(step[0])
        assert step[-1]["retrieval"]["cost"] == alignment.cost
        if len(step) == 5:
            assert step[1] == -alignment.cost / alignment.window


def test_mode_weight_and_divisor(demo: Demonstration) -> None:
    actions = np.full((6, 2), -1.0)

    def rewards(**settings: Any) -> list[float]:
        env = RetrievalRewardWrapper(ToyReach(), demo, horizon=3, **settings)
        return [step[1] for step in play(env, actions)[1:]]

    plain = rewards()
    assert min(plain) < 0
    assert rewards(weight=0.5) == pytest.approx([r / 2 for r in plain])
    windows = [2, 3, 4, 4, 4, 4]
    by_horizon = [r * window / 4 for r, window in zip(plain, windows, strict=True)]
    assert rewards(divisor="horizon") == pytest.approx(by_horizon)

    env = RetrievalRewardWrapper(gym.wrappers.TransformReward(ToyReach(), lambda r: 7), demo)
    added = RetrievalRewardWrapper(
        gym.wrappers.TransformReward(ToyReach(), lambda r: 7), demo, mode="add"
    )
    for one, two in zip(play(env, actions)[1:], play(added, actions)[1:], strict=True):
        assert two[1] == one[1] + 7
        assert two[4]["retrieval"]["env_reward"] == one[4]["retrieval"]["env_reward"] == 7


def test_reward_scale(demo: Demonstration) -> None:
    env = RetrievalRewardWrapper(ToyReach(), demo)
    assert env.reward_scale == 1 / demonstration_tau(env.retriever.embeddings)
    still = Demonstration(np.repeat(demo.frames[:1], 9, axis=0))
    with pytest.raises(ValueError, match="has no scale"):
        _ = RetrievalRewardWrapper(ToyReach(), still).reward_scale


def test_reset_starts_a_new_window(demo: Demonstration) -> None:
    env = RetrievalRewardWrapper(ToyReach(), demo)
    actions = np.full((8, 2), 1.0)
    first = play(env, actions)
    again = play(env, actions)
    for a, b in zip(first, again, strict=True):
        assert a[-1] == b[-1]
    env.reset()
    assert env.alignment.window == 1


@pytest.mark.parametrize("outer_is_guide", [True, False])
def test_stacked_wrappers_share_one_retriever(demo_path: str, outer_is_guide: bool) -> None:
    inner, outer = WRAPPERS[::-1] if outer_is_guide else WRAPPERS
    between = gym.wrappers.TimeLimit(inner(ToyReach(), demo_path), 30)
    env = outer(between, demo_path)
    assert env.retriever is env.get_wrapper_attr("retriever") is between.env.retriever
    calls = []
    encode = env.retriever.encoder.encode
    env.retriever.encoder = type(
        "Counting", (), {"encode": lambda self, frames: calls.append(1) or encode(frames)}
    )()
    play(env, np.zeros((3, 2)))
    assert len(calls) == 4
    assert env.alignment == between.env.alignment


@pytest.mark.parametrize(
    "change", [{"k": 4}, {"horizon": 3}, {"step_pattern": "strap"}, {"image": "render"}]
)
def test_stacked_wrappers_with_unequal_settings(demo_path: str, change: dict[str, Any]) -> None:
    env = RetrievalGuideWrapper(ToyReach(render_mode="rgb_array"), demo_path)
    (name,) = change
    with pytest.raises(ValueError, match=f"{name}=.*share one alignment, give both the same"):
        RetrievalRewardWrapper(env, demo_path, **change)


def test_stacked_wrappers_with_unequal_demonstrations(demo: Demonstration, demo_path: str) -> None:
    env = RetrievalGuideWrapper(ToyReach(), demo)
    with pytest.raises(ValueError, match=r"demo=.*reach\.hdf5.*inside has <Demonstration>"):
        RetrievalRewardWrapper(env, demo_path)


@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_gymnasiums_checker(wrapper: Any, demo_path: str) -> None:
    env = wrapper(gym.make("ToyReach-v0", frozen=False, disable_env_checker=True), demo_path)
    with warnings.catch_warnings():
        # It asks for the bare environment only.
        warnings.filterwarnings("ignore", message=".*environment.*different from the unwrapped.*")
        check_env(env, skip_render_check=True)


def test_the_spec_rebuilds_the_stack(demo_path: str) -> None:
    env = gym.make("ToyReach-v0", frozen=False, max_episode_steps=25)
    env = RetrievalGuideWrapper(env, demo_path, k=4, horizon=3, guide_patience=6)
    env = RetrievalRewardWrapper(env, demo_path, k=4, horizon=3, mode="add", weight=0.5)
    assert env.spec is not None
    for spec in (env.spec, EnvSpec.from_json(env.spec.to_json())):
        made = gym.make(spec)
        assert made.spec == env.spec
        assert isinstance(made, RetrievalRewardWrapper)
        assert made.env.guide_patience == 6  # type: ignore[attr-defined]
        assert made.retriever is made.get_wrapper_attr("retriever")
        actions = np.random.default_rng(3).uniform(-1, 1, (10, 2))
        for a, b in zip(play(env, actions, 4), play(made, actions, 4), strict=True):
            assert a[-1]["retrieval"]["cost"] == b[-1]["retrieval"]["cost"]
            assert len(a) == 2 or a[1] == b[1]


def test_path_objects_are_saved_as_text(demo_path: str) -> None:
    from pathlib import Path

    env = RetrievalGuideWrapper(gym.make("ToyReach-v0"), Path(demo_path))
    assert env.spec is not None
    assert env.spec.additional_wrappers[-1].kwargs["demo"] == demo_path  # type: ignore[index]


def test_a_demonstration_object_has_no_spec(demo: Demonstration, demo_path: str) -> None:
    env = RetrievalGuideWrapper(gym.make("ToyReach-v0"), demo)
    assert env.spec is None
    assert gym.wrappers.TimeLimit(env, 10).spec is None

    class Mean:
        def encode(self, frames: np.ndarray) -> np.ndarray:
            return frames.mean(axis=(1, 2)).astype(np.float32)

    assert RetrievalGuideWrapper(gym.make("ToyReach-v0"), demo_path, encoder=Mean()).spec is None


@pytest.mark.parametrize(
    ("made_with", "image"),
    [
        ({"obs": "pixels"}, "obs"),
        ({"obs": "channels_first"}, "obs"),
        ({"obs": "dict"}, "obs:front"),
        ({"obs": "state", "render_mode": "rgb_array"}, "render"),
        ({"obs": "dict", "render_mode": "rgb_array"}, "render"),
    ],
)
def test_pictures_from_anywhere(demo: Demonstration, made_with: dict[str, Any], image: str) -> None:
    env = RetrievalRewardWrapper(ToyReach(**made_with), demo, image=image)
    assert demo.actions is not None
    steps = play(env, demo.actions)
    assert [step[-1]["retrieval"]["end"] for step in steps] == list(range(len(demo)))
    assert all(step[1] == 0 for step in steps[1:])


class Larger:
    """An encoder that wants larger pictures than the observation, and remembers what it got."""

    frame_size = 96

    def __init__(self) -> None:
        self.shapes: set[tuple[int, ...]] = set()

    def encode(self, frames: np.ndarray) -> np.ndarray:
        self.shapes.add(frames.shape[1:])
        return frames[:, ::4, ::4].reshape(len(frames), -1).astype(np.float32)


def test_an_encoder_may_want_larger_pictures() -> None:
    larger = toy_env.record(encoder_size=64)
    assert larger.actions is not None
    encoder = Larger()
    for obs in ("pixels", "channels_first"):
        steps = play(RetrievalRewardWrapper(ToyReach(obs=obs), larger, encoder), larger.actions)
        assert encoder.shapes == {(64, 64, 3)}  # the size that was recorded
        assert all(step[1] == 0 for step in steps[1:])

    for demo, env in (
        (toy_env.record(), ToyReach()),
        (larger, gym.wrappers.ResizeObservation(Foreign(), (48, 48))),
    ):
        encoder = Larger()
        RetrievalRewardWrapper(env, demo, encoder).reset(seed=0)
        assert encoder.shapes == {(48, 48, 3)}


class Foreign(gym.Wrapper):  # type: ignore[type-arg]
    """Says nothing about itself, as other people's environments do."""

    def __init__(self) -> None:
        super().__init__(ToyReach(says_settings=False))

    def has_wrapper_attr(self, name: str) -> bool:
        return name != "encoder_frame" and super().has_wrapper_attr(name)


def test_guide_offset_is_clamped_to_the_demonstration(demo: Demonstration) -> None:
    assert demo.actions is not None
    for offset, wanted in ((1, 1), (3, 3), (-1, 0), (1000, len(demo.actions) - 1)):
        env = RetrievalGuideWrapper(ToyReach(), demo, guide_offset=offset)
        env.reset(seed=0)
        np.testing.assert_array_equal(env.guide_action(), demo.actions[wanted])


def test_the_guide_gives_a_copy(demo: Demonstration) -> None:
    env = RetrievalGuideWrapper(ToyReach(), demo)
    env.reset(seed=0)
    env.guide_action()[:] = 99
    assert env.guide_action().max() <= 1
    assert env.guide_action().dtype == np.float32


def test_as_many_frames_as_actions_repeats_the_last_action(demo: Demonstration) -> None:
    assert demo.actions is not None
    short = Demonstration(demo.frames[:-1], demo.actions, metadata=demo.metadata)
    env = RetrievalGuideWrapper(ToyReach(), short)
    env.reset(seed=0)
    for _ in range(len(demo.actions)):
        action = env.guide_action()
        _, _, terminated, _, _ = env.step(action)
    assert terminated
    np.testing.assert_array_equal(env.guide_action(), demo.actions[-1])


def test_another_rate_than_recorded(demo: Demonstration) -> None:
    """The toy takes 10 actions a second; a guide that replays at another speed is warned of."""
    slow = Demonstration(demo.frames, demo.actions, metadata={"control_rate": 5})
    with pytest.warns(UserWarning, match=r"recorded at 5 actions a second .* takes 10: ") as said:
        RetrievalGuideWrapper(ToyReach(), slow)
    assert len(said) == 1
    assert said[0].filename == __file__
    with pytest.warns(UserWarning, match="recorded at 5 actions a second") as said:
        vector.RetrievalGuideWrapper(gym.vector.SyncVectorEnv([ToyReach] * 3), slow)
    assert len(said) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        RetrievalRewardWrapper(ToyReach(), slow)
        RetrievalGuideWrapper(ToyReach(says_settings=False), slow)
        same = Demonstration(demo.frames, demo.actions, metadata={"control_rate": 10.0})
        RetrievalGuideWrapper(ToyReach(), same)


def test_patience_plays_on_from_the_furthest_frame(demo: Demonstration) -> None:
    """Each action of this demonstration is told apart by its number."""
    numbered = np.linspace(-1, 1, len(demo) - 1, dtype=np.float32)[:, None].repeat(2, axis=1)
    counted = Demonstration(demo.frames, numbered, metadata=demo.metadata)
    env = RetrievalGuideWrapper(ToyReach(), counted, guide_patience=3)
    env.reset(seed=0)

    def suggested() -> int:
        return int(np.abs(numbered[:, 0] - env.guide_action()[0]).argmin())

    for _ in range(2):
        env.step(np.ones(2))
    furthest = env.alignment.end
    assert suggested() == furthest > 0
    seen = []
    for _ in range(6):  # stand still
        env.step(np.zeros(2))
        seen.append(suggested())
    assert env.alignment.end == furthest
    assert seen == [furthest + n for n in (0, 0, 0, 1, 2, 3)]
    env.reset(seed=0)
    assert suggested() == 0


def test_without_patience_it_waits_for_ever(demo: Demonstration) -> None:
    env = RetrievalGuideWrapper(ToyReach(), demo)
    env.reset(seed=0)
    first = env.guide_action()
    for _ in range(20):
        env.step(np.zeros(2))
    np.testing.assert_array_equal(env.guide_action(), first)


def test_frame_stacking_outside(demo_path: str) -> None:
    env = RetrievalGuideWrapper(ToyReach(), demo_path)
    env = RetrievalRewardWrapper(env, demo_path)
    stacked = gym.wrappers.FrameStackObservation(env, 2)
    observation, info = stacked.reset(seed=0)
    assert observation.shape == (2, 48, 48, 3)
    _, reward, _, _, info = stacked.step(stacked.get_wrapper_attr("guide_action")())
    assert reward == info["retrieval"]["cost"] == 0
