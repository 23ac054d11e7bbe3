"""The guide wrapper's arguments for correction: what they take, and where they hold."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import toy_camera
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from regil_wrappers import Demonstration, RetrievalGuideWrapper, RetrievalRewardWrapper
from toy_camera import ToyCamera
from toy_env import ToyReach


@pytest.fixture(scope="module")
def touch() -> Demonstration:
    return toy_camera.record()


@pytest.fixture(scope="module")
def path(touch: Demonstration, tmp_path_factory: pytest.TempPathFactory) -> str:
    file: Path = tmp_path_factory.mktemp("demos") / "touch.hdf5"
    touch.save(file)
    return str(file)


def stack(path: str, **settings: Any) -> Any:
    env = RetrievalGuideWrapper(ToyCamera(), path, correction="servo", **settings)
    return RetrievalRewardWrapper(env, path)


def follow(env: Any, steps: int, seed: int = 3) -> list[Any]:
    out = [env.reset(seed=seed)[1]["retrieval"]]
    for _ in range(steps):
        *_, terminated, truncated, info = env.step(env.get_wrapper_attr("guide_action")())
        out.append(info["retrieval"])
        if terminated or truncated:
            out.append(env.reset()[1]["retrieval"])
    return out


def test_the_spec_rebuilds_a_correcting_guide(path: str) -> None:
    env = RetrievalGuideWrapper(
        gym.make("ToyCamera-v0", max_episode_steps=60, disable_env_checker=True),
        path,
        correction="servo",
        translation_dims=[0, 1, 2],
        gripper_dim=3,
        plane=[7.0, 7.0, 0.4],
        mirror=1,
        disturbance=0.5,
    )
    assert env.spec is not None
    played = follow(env, 130)
    for spec in (env.spec, EnvSpec.from_json(env.spec.to_json())):
        made = gym.make(spec)
        assert made.spec == env.spec
        for a, b in zip(played, follow(made, 130), strict=True):
            np.testing.assert_array_equal(a["guide_action"], b["guide_action"])
            assert a["guide"] == b["guide"]
        assert made.get_wrapper_attr("calibration")() == env.calibration()
    assert env.calibration() is not None


def test_info_is_plain(path: str) -> None:
    env = stack(path)
    for info in follow(env, 3):
        assert {"guide", "calibrating", "guide_action", "start", "end", "cost"} <= set(info)
        info["guide_action"] = info["guide_action"].tolist()
        assert json.loads(json.dumps(info)) == info
    assert info["guide"] == "calibration"
    assert info["calibrating"] is True
    assert "guide" not in follow(RetrievalGuideWrapper(ToyCamera(), path), 1)[0]


@pytest.mark.parametrize(
    ("made_with", "image"),
    [
        ({}, "obs"),
        ({"obs": "dict"}, "obs:front"),
        ({"obs": "state", "render_mode": "rgb_array"}, "render"),
    ],
)
def test_pictures_from_anywhere(path: str, made_with: dict[str, Any], image: str) -> None:
    env = RetrievalGuideWrapper(ToyCamera(**made_with), path, image=image, correction="servo")
    reached = 0
    for seed in range(8):
        env.reset(seed=seed)
        over = False
        while not over:
            *_, terminated, truncated, info = env.step(env.guide_action())
            over = terminated or truncated
        reached += info["is_success"]
    assert reached >= 5  # the first two calibrate


def test_what_is_declared_where(path: str) -> None:
    said = ToyCamera(declares=False)
    env = RetrievalGuideWrapper(said, path, correction="servo")
    assert env._servo is not None  # the defaults: [0, 1, 2], 3, [10, 10, 0.5], "auto"
    own = RetrievalGuideWrapper(ToyCamera(), path, correction="servo", plane=[4.0, 4.0, 0.5])
    far = {}
    for name, guide in (("default", env), ("said", stack(path).env), ("argument", own)):
        guide.reset(seed=0)
        far[name] = 0.0
        for _ in range(50):
            assert guide._servo.kind == "calibration" or name == "argument"
            guide.step(guide.guide_action())
            if guide._servo.kind == "plain":
                break
            far[name] = max(far[name], float(np.abs(guide.unwrapped.hand).max()))
    assert far == {"default": 5.0, "said": 4.0, "argument": 2.0}  # half of what the plane says


def test_without_a_gripper(touch: Demonstration) -> None:
    env = RetrievalGuideWrapper(ToyCamera(), touch, correction="servo", gripper_dim="none")
    info = follow(env, 110)
    assert all(step["guide_action"][3] == 0 for step in info if step["guide"] == "calibration")
    assert env.calibration() is None  # a robot is not kept waiting for it
    env.reset()
    assert env.calibration() is not None


def test_with_the_reward_in_one_stack(path: str) -> None:
    env = stack(path)
    outer = RetrievalGuideWrapper(
        RetrievalRewardWrapper(ToyCamera(), path), path, correction="servo"
    )
    for a, b in zip(follow(env, 100), follow(outer, 100), strict=True):
        np.testing.assert_array_equal(a["guide_action"], b["guide_action"])


@pytest.mark.parametrize("vector", [SyncVectorEnv, AsyncVectorEnv])
def test_in_vector_environments(vector: Any, path: str) -> None:
    """Each environment calibrates for itself, or takes over another's calibration."""
    together = vector([partial(stack, path)] * 2)
    alone = stack(path)
    try:
        _, infos = together.reset(seed=[5, 6])
        _, info = alone.reset(seed=5)
        done = False
        for _ in range(150):
            actions = np.stack(together.call("guide_action"))
            own = alone.get_wrapper_attr("guide_action")()
            np.testing.assert_array_equal(actions[0], own)
            *_, terminated, truncated, infos = together.step(actions)
            if done:  # this step of the vector was the reset
                _, info = alone.reset()
                done = False
            else:
                *_, a, b, info = alone.step(own)
                done = a or b
            assert (terminated[0] or truncated[0]) == done
            assert infos["retrieval"]["guide"][0] == info["retrieval"]["guide"]
        found = together.call("calibration")
        assert found[0] == alone.get_wrapper_attr("calibration")()
        assert found[0] is not None
        together.call("set_calibration", found[0])
        assert together.call("calibration")[1] == found[0]
    finally:
        together.close()


def refused(message: str, **settings: Any) -> None:
    demo = toy_camera.record()
    with pytest.raises(ValueError, match=message) as caught:
        RetrievalGuideWrapper(ToyCamera(), demo, **{"correction": "servo", **settings})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("message", "settings"),
    [
        (r"translation_dims=\[0, 1\]: name the three", {"translation_dims": [0, 1]}),
        (r"translation_dims=\[0, 0, 1\]: name the three", {"translation_dims": [0, 0, 1]}),
        (r"\(0 to 3\)", {"translation_dims": [0, 1, 7]}),
        ("gripper_dim=2: it must be", {"gripper_dim": 2}),
        ("gripper_dim=9: it must be", {"gripper_dim": 9}),
        (r"gripper_dim=0\.5: it must be", {"gripper_dim": 0.5}),
        ("plane=.*three positive", {"plane": [1.0, 0.0, 1.0]}),
        ("plane=.*three positive", {"plane": [1.0, 1.0]}),
        ("plane=.*three positive", {"plane": [1.0, float("nan"), 1.0]}),
        ("plane=.*three positive", {"plane": [1.0, float("inf"), 1.0]}),
        ("mirror=2: choose", {"mirror": 2}),
        ("correction='pid': choose one of", {"correction": "pid"}),
        ("disturbance=-1: it must be", {"disturbance": -1}),
        ("disturbance=1.0: a guide without", {"disturbance": 1.0, "correction": "none"}),
    ],
)
def test_arguments_that_do_not_fit(message: str, settings: dict[str, Any]) -> None:
    refused(message, **settings)


class Upwards(ToyCamera):
    """Takes no negative actions: they cannot be deltas."""

    def __init__(self) -> None:
        super().__init__()
        self.action_space = gym.spaces.Box(0, 1, (4,), np.float32)


def test_actions_that_cannot_be_deltas(touch: Demonstration) -> None:
    upwards = Demonstration(touch.frames, np.abs(touch.actions), metadata={"env_id": "x"})
    with pytest.warns(UserWarning, match=r"takes \[0, 1\], which cannot be a delta.*without corr"):
        env = RetrievalGuideWrapper(Upwards(), upwards, correction="servo")
    assert follow(env, 2)[0]["guide_action"] == pytest.approx(upwards.actions[0])
    with pytest.raises(ValueError, match="cannot be a delta"):
        RetrievalGuideWrapper(
            Upwards(), upwards, correction="servo", translation_dims=[0, 1, 2], gripper_dim="none"
        )


class Unbounded(ToyCamera):
    """One dimension has no limits."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        high = np.ones(4, np.float32)
        high[dim] = np.inf
        self.action_space = gym.spaces.Box(-high, high)


def test_actions_without_limits(touch: Demonstration) -> None:
    for dim, named in ((1, r"translation_dims=\[0, 1, 2\]"), (3, "gripper_dim=3")):
        message = rf"{named}: dimension {dim} takes \[-inf, inf\], and .*finite Box"
        with pytest.raises(ValueError, match=message) as caught:
            RetrievalGuideWrapper(Unbounded(dim), touch, correction="servo", gripper_dim=3)
        assert "\n" not in str(caught.value)
    # what the message says to do
    bounded = gym.wrappers.TransformAction(
        Unbounded(1), lambda action: action, gym.spaces.Box(-1, 1, (4,), np.float32)
    )
    env = RetrievalGuideWrapper(bounded, touch, correction="servo")
    usual = RetrievalGuideWrapper(ToyCamera(), touch, correction="servo")
    for a, b in zip(follow(env, 20), follow(usual, 20), strict=True):
        np.testing.assert_array_equal(a["guide_action"], b["guide_action"])
    # others need none
    loose = RetrievalGuideWrapper(Unbounded(3), touch, correction="servo", gripper_dim="none")
    assert all(np.isfinite(info["guide_action"]).all() for info in follow(loose, 100))


def test_too_few_dimensions(demo_path: str) -> None:
    """Where nothing is declared it is said in one line, and plain replay goes on."""
    with pytest.warns(UserWarning, match=r"translation_dims=\[0, 1, 2\]: .*without corr") as said:
        env = RetrievalGuideWrapper(ToyReach(), demo_path, correction="servo", disturbance=0.5)
    assert len(said) == 1
    assert said[0].filename == __file__
    plain = RetrievalGuideWrapper(ToyReach(), demo_path)
    for a, b in zip(follow(env, 10), follow(plain, 10), strict=True):
        np.testing.assert_array_equal(a["guide_action"], b["guide_action"])
    np.testing.assert_array_equal(env.disturbed_action(), env.guide_action())
    assert env.calibration() is None
