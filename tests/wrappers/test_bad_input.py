"""What does not fit is refused with one line, when the wrapper is made or at the first reset."""

from __future__ import annotations

import dataclasses
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import toy_env
from regil_wrappers import Demonstration, RetrievalGuideWrapper, RetrievalRewardWrapper
from regil_wrappers.frames import check_upright
from toy_env import ToyReach


def refused(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_no_demonstration() -> None:
    with pytest.raises(FileNotFoundError, match="record one with 'regil record"):
        RetrievalRewardWrapper(ToyReach(), "nowhere.hdf5")


def test_another_image_size(demo_path: str) -> None:
    refused(
        lambda: RetrievalRewardWrapper(ToyReach(size=84), demo_path),
        r"demo '.*reach\.hdf5' has 48x48 frames but the environment gives 84x84: "
        r"record it again with --size 84$",
    )
    env = RetrievalRewardWrapper(
        ToyReach(size=84, obs="state", render_mode="rgb_array"), demo_path, image="render"
    )
    refused(env.reset, r"48x48 frames but the environment gives 84x84")
    wide = gym.wrappers.ResizeObservation(ToyReach(), (48, 64))
    refused(lambda: RetrievalRewardWrapper(wide, demo_path), "gives 48x64: .* at that size")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("camera", "beside", "recorded with camera 'above' but the environment has 'beside'"),
        ("render", {"shadows": True}, "recorded with render {'shadows': False} but"),
        ("action_repeat", 2, "recorded with action_repeat 1 but the environment has 2"),
        ("render", {"light": (1, 2)}, "recorded with render {'shadows': False} but"),
    ],
)
def test_other_settings_than_recorded(demo_path: str, name: str, value: Any, message: str) -> None:
    env = ToyReach()
    env.metadata["regil"][name] = value
    refused(lambda: RetrievalRewardWrapper(env, demo_path), message)
    del env.metadata["regil"][name]
    RetrievalRewardWrapper(env, demo_path)


@pytest.mark.parametrize(
    ("look", "message"),
    [
        ("upside down", "is that of .* upside down: fix"),
        ("mirrored", "is that of .* mirrored: fix"),
        ("turned by 180 degrees", "is that of .* turned by 180 degrees: fix"),
        ("red and blue exchanged", "is that of .* with red and blue exchanged: fix"),
    ],
)
@pytest.mark.parametrize("frozen", [True, False])
def test_a_turned_picture(demo_path: str, look: str, message: str, frozen: bool) -> None:
    for seed in range(5):
        env = RetrievalRewardWrapper(ToyReach(look=look, frozen=frozen), demo_path)
        refused(lambda env=env, seed=seed: env.reset(seed=seed), message)


def test_objects_elsewhere_are_no_turned_picture(demo_path: str) -> None:
    env = RetrievalRewardWrapper(ToyReach(frozen=False), demo_path)
    for seed in range(100):
        env._frames._first_is_checked = False  # type: ignore[union-attr]
        env.reset(seed=seed)


def test_mirrored_objects_on_an_even_background_are_no_turned_picture() -> None:
    """The background does not say which way up it is, so it must not be guessed from the object."""
    frame = np.full((84, 84, 3), 230, np.uint8)
    frame[10:40, 10:30] = (200, 40, 40)
    for turned in (frame[::-1], frame[:, ::-1], frame[::-1, ::-1]):
        check_upright(np.ascontiguousarray(turned), frame, "demo")


def test_settings_are_compared_as_a_file_gives_them_back(demo: Demonstration) -> None:
    env = ToyReach()
    env.metadata["regil"]["render"] = {"light": (1.0, 0.5), "at": np.zeros(2)}
    env.metadata["regil"]["render"]["kind"] = gym.vector.AutoresetMode.DISABLED  # no JSON value
    kind = str(gym.vector.AutoresetMode.DISABLED)
    as_read = {"light": [1.0, 0.5], "at": [0.0, 0.0], "kind": kind}
    RetrievalRewardWrapper(
        env, dataclasses.replace(demo, metadata={**demo.metadata, "render": as_read})
    )


def test_things_that_change_places_are_no_exchanged_colours() -> None:
    def scene(red: int, blue: int) -> Any:
        frame = np.full((84, 84, 3), (170, 130, 90), np.uint8)  # a wooden table
        frame[30:50, red : red + 20] = (220, 30, 30)
        frame[30:50, blue : blue + 20] = (30, 30, 220)
        return frame

    check_upright(scene(50, 10), scene(10, 50), "demo")
    refused(lambda: check_upright(scene(10, 50)[..., ::-1], scene(10, 50), "demo"), "red and blue")


def test_another_scene_is_no_turned_picture() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        a, b = (
            np.kron(rng.integers(0, 256, (7, 7, 3)), np.ones((12, 12, 1))).astype(np.uint8)
            for _ in range(2)
        )
        check_upright(a, b, "demo")


def test_fewer_frames_than_the_horizon(demo: Demonstration) -> None:
    short = Demonstration(demo.frames[:4])
    refused(
        lambda: RetrievalRewardWrapper(ToyReach(), short, k=2),
        r"4 frames, fewer than horizon \+ 1 = 5: choose horizon=3",
    )


def test_the_guide_needs_actions(demo: Demonstration, tmp_path: Any) -> None:
    Demonstration(demo.frames).save(tmp_path / "video.hdf5")
    refused(
        lambda: RetrievalGuideWrapper(ToyReach(), tmp_path / "video.hdf5"),
        r"demo '.*video\.hdf5' has no actions",
    )
    RetrievalRewardWrapper(ToyReach(), tmp_path / "video.hdf5").reset()


def with_space(space: gym.Space[Any]) -> ToyReach:
    env = ToyReach()
    env.action_space = space  # type: ignore[assignment]
    return env


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (gym.spaces.Discrete(3), r"the action space is Discrete\(3\): a guide needs continuous"),
        (gym.spaces.Box(-1, 1, (2, 2)), "a Box of shape"),
        (gym.spaces.Box(-1, 1, (4,)), "actions of size 2 but the environment takes 4"),
        (gym.spaces.Box(-0.5, 0.5, (2,)), r"in dimension \d of step \d+ .* takes \[-0.5, 0.5\]"),
    ],
)
def test_actions_that_do_not_fit(demo_path: str, space: Any, message: str) -> None:
    refused(lambda: RetrievalGuideWrapper(with_space(space), demo_path), message)
    RetrievalRewardWrapper(with_space(space), demo_path)  # the reward plays none of them


def shown(*shape: int, dtype: Any = np.uint8, key: str | None = None) -> ToyReach:
    env = ToyReach()
    space: gym.Space[Any] = gym.spaces.Box(0, 255, shape, dtype)
    env.observation_space = space if key is None else gym.spaces.Dict({key: space})
    return env


@pytest.mark.parametrize(
    ("env", "image", "message"),
    [
        (ToyReach(obs="state"), "obs", r"float32 \(4,\), not one RGB picture.*image='render'"),
        (ToyReach(obs="state"), "render", r"render_mode='rgb_array'.*made with None"),
        (ToyReach(obs="dict"), "obs", r"image='obs' with dict.*\['obs:front', 'render'\]"),
        (ToyReach(obs="dict"), "obs:state", r"image='obs:state' with dict.*'obs:front'"),
        (ToyReach(), "obs:front", "image='obs:front': use 'obs' or 'render'"),
        (ToyReach(), "pixels", "image='pixels'"),
        (gym.wrappers.GrayscaleObservation(ToyReach()), "obs", r"uint8 \(48, 48\), not one RGB"),
        (
            gym.wrappers.TransformObservation(
                ToyReach(),
                lambda frame: np.repeat(frame, 3, axis=2),
                gym.spaces.Box(0, 255, (48, 48, 9), np.uint8),
            ),
            "obs",
            r"\(48, 48, 9\), .*put frame stacking outside",
        ),
        (shown(4, 48, 48, 3), "obs", r"\(4, 48, 48, 3\), .*put frame stacking outside"),
        (shown(48, 48, 3, dtype=np.float32), "obs", r"float32 \(48, 48, 3\), .*convert .* uint8"),
        (shown(48, 48, 1), "obs", r"uint8 \(48, 48, 1\), .*give three channels, RGB"),
        (shown(48, 48, 4), "obs", r"uint8 \(48, 48, 4\), .*give three channels, RGB"),
        (gym.wrappers.GrayscaleObservation(ToyReach()), "obs", "give three channels, RGB"),
        (shown(48, 48, 3, dtype=np.float32, key="front"), "obs:front", "convert them to uint8"),
    ],
)
def test_no_picture(demo_path: str, env: Any, image: str, message: str) -> None:
    refused(lambda: RetrievalRewardWrapper(env, demo_path, image=image), message)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"encoder": "clip"}, r"encoder 'clip': unknown: choose one of \['clip-"),
        ({"encoder": 3}, "encoder=3: give a name, or an object with encode"),
        ({"k": 0}, "k=0"),
        ({"horizon": "4"}, "horizon='4'"),
        ({"step_pattern": "dtw"}, "step_pattern='dtw'"),
    ],
)
@pytest.mark.parametrize("wrapper", [RetrievalGuideWrapper, RetrievalRewardWrapper])
def test_settings_of_both(
    demo_path: str, wrapper: Any, settings: dict[str, Any], message: str
) -> None:
    refused(lambda: wrapper(ToyReach(), demo_path, **settings), message)


@pytest.mark.parametrize(
    ("wrapper", "settings", "message"),
    [
        (RetrievalRewardWrapper, {"reward": "dtw"}, r"reward='dtw': choose one of \['sdtw"),
        (RetrievalRewardWrapper, {"mode": "both"}, "mode='both'"),
        (RetrievalRewardWrapper, {"weight": float("nan")}, "weight=nan"),
        (RetrievalRewardWrapper, {"divisor": 5}, "divisor=5"),
        (RetrievalGuideWrapper, {"guide_patience": 0}, "guide_patience=0"),
        (RetrievalGuideWrapper, {"guide_offset": 0.5}, "guide_offset=0.5"),
    ],
)
def test_settings_of_one(
    demo_path: str, wrapper: Any, settings: dict[str, Any], message: str
) -> None:
    refused(lambda: wrapper(ToyReach(), demo_path, **settings), message)


@pytest.mark.parametrize("wrapper", [RetrievalGuideWrapper, RetrievalRewardWrapper])
def test_resets_that_nobody_sees(demo_path: str, wrapper: Any) -> None:
    inside = gym.wrappers.TimeLimit(gym.wrappers.Autoreset(ToyReach()), 20)
    refused(lambda: wrapper(inside, demo_path), "put Autoreset outside this wrapper")
    between = gym.wrappers.Autoreset(RetrievalGuideWrapper(ToyReach(), demo_path))
    refused(lambda: wrapper(between, demo_path), "put Autoreset outside this wrapper")
    env = gym.wrappers.Autoreset(wrapper(ToyReach(), demo_path))
    env.reset(seed=0)
    for _ in range(40):
        *_, over, _ = env.step(np.zeros(2, np.float32))
    assert over
    info = env.step(np.zeros(2, np.float32))[-1]["retrieval"]
    assert env.get_wrapper_attr("alignment").window == 1
    assert info["cost"] == 0


def test_before_the_first_reset(demo_path: str) -> None:
    env = RetrievalGuideWrapper(ToyReach(), demo_path)
    refused(env.guide_action, r"call reset\(\)")


def test_a_picture_that_changes_its_size(demo: Demonstration) -> None:
    env = ToyReach(obs="state", render_mode="rgb_array")
    wrapped = RetrievalRewardWrapper(env, demo, image="render")
    wrapped.reset(seed=0)
    env.size = 40
    refused(lambda: wrapped.step(np.zeros(2)), r"frame 1 of the episode is uint8 \(40, 40, 3\)")


def test_no_picture_from_render(demo: Demonstration) -> None:
    env = ToyReach(obs="state", render_mode="rgb_array")
    wrapped = RetrievalRewardWrapper(env, demo, image="render")
    env.render = lambda: None  # type: ignore[method-assign, assignment, return-value]
    refused(wrapped.reset, r"picture is NoneType \(\): it must be uint8")
    for picture in (np.zeros((48, 48, 4), np.uint8), np.zeros((48, 48), np.uint8)):
        env.render = lambda picture=picture: picture  # type: ignore[method-assign, misc]
        refused(wrapped.reset, r"picture is uint8 \(48, 48.*\): it must be uint8 \(H, W, 3\), RGB")


def test_a_demonstration_of_a_foreign_environment_is_only_compared_by_size_and_sight(
    demo_path: str,
) -> None:
    env = ToyReach(says_settings=False)
    assert "regil" not in env.metadata
    RetrievalRewardWrapper(env, demo_path).reset()
    foreign = toy_env.record(says_settings=False)
    assert foreign.metadata["camera"] is None
    RetrievalRewardWrapper(ToyReach(camera="beside"), foreign).reset()
