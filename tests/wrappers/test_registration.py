"""Registration: pictures whose displacement is known, because it was put there."""

from __future__ import annotations

import warnings
from typing import Any

import cv2
import numpy as np
import pytest
from regil_wrappers import Demonstration, RetrievalRewardWrapper
from regil_wrappers.conditions import camera_shift, match_colours
from regil_wrappers.registration import (
    Displacement,
    local_shift,
    moved_back,
    register,
    shift_since,
)
from toy_env import ToyReach

SIZE = 84
HOME = np.array([40.0, 44.0])  # px, where the thing stands in the first picture


def textured(side: int, seed: int) -> np.ndarray:
    """(side, side, 3) float32: blots of colour."""
    rng = np.random.default_rng(seed)
    small = rng.uniform(20, 235, (max(2, side // 4), max(2, side // 4), 3)).astype(np.float32)
    return cv2.resize(small, (side, side), interpolation=cv2.INTER_CUBIC).clip(0, 255)


def paste(picture: np.ndarray, thing: np.ndarray, centre: Any, growth: float = 1.0) -> np.ndarray:
    """Draw a thing (h, w, 3) into a picture, centred below a pixel."""
    height, width = thing.shape[:2]
    x, y = np.asarray(centre) - growth * (np.array([width, height]) - 1) / 2
    matrix = np.array([[growth, 0, x], [0, growth, y]])
    size = picture.shape[1::-1]
    alpha = cv2.warpAffine(np.ones((height, width), np.float32), matrix, size)[..., None]
    return picture * (1 - alpha) + alpha * cv2.warpAffine(
        thing, matrix, size, borderMode=cv2.BORDER_REPLICATE
    )


def scene(at: Any = HOME, growth: float = 1.0, size: int = SIZE, seed: int = 0) -> np.ndarray:
    """(size, size, 3) uint8: an uneven table, something that stands still, and the thing."""
    unit = size / SIZE
    picture = cv2.resize(textured(SIZE, 9)[:10, :10], (size, size)) * 0.4 + 90
    picture = paste(picture, textured(round(14 * unit), 3), np.array([18.0, 20.0]) * unit)
    picture = paste(picture, textured(round(16 * unit), seed), np.asarray(at) * unit, growth)
    return picture.round().clip(0, 255).astype(np.uint8)


def off_by(found: Displacement | None, shift: Any) -> float:
    """How many px the shift found is off."""
    assert found is not None
    return float(np.linalg.norm(np.subtract(found.shift, shift)))


@pytest.mark.parametrize(
    "shift", [(6, 0), (-9, 4), (0, 12), (3.5, -7.25), (18.3, 5.6), (-1.5, 2.0)]
)
def test_a_shift(shift: tuple[float, float]) -> None:
    found = register(scene(), scene(HOME + shift))
    assert off_by(found, shift) < 0.3
    assert found is not None
    assert found.growth == pytest.approx(1, abs=0.03)
    assert found.ratio < 0.35
    # the point is on the thing, where it stood
    assert np.abs(found.point - HOME).max() < 8


@pytest.mark.parametrize("size", [48, 128, 168])
def test_pictures_of_other_sizes(size: int) -> None:
    shift = np.array([7.0, -5.0])
    found = register(scene(size=size), scene(HOME + shift, size=size))
    assert off_by(found, shift * size / SIZE) < 0.5 * size / SIZE


def test_pictures_that_are_not_square() -> None:
    a, b = (np.pad(p, ((0, 0), (20, 24), (0, 0)), mode="edge") for p in _pair((8.0, 3.0)))
    assert off_by(register(a, b), (8, 3)) < 0.4


def _pair(shift: Any) -> tuple[np.ndarray, np.ndarray]:
    return scene(), scene(HOME + shift)


@pytest.mark.parametrize("growth", [0.85, 1.15, 1.25])
def test_growth(growth: float) -> None:
    shift = (5.0, 6.0)
    found = register(scene(), scene(HOME + np.array(shift), growth))
    assert found is not None
    assert found.growth == pytest.approx(growth, abs=0.05)
    # what stood at the point, not the thing's middle, has moved so far
    wanted = HOME + np.array(shift) + growth * (found.point - HOME) - found.point
    assert off_by(found, wanted) < 0.5


@pytest.mark.parametrize("gain", [0.8, 1.2])
def test_another_brightness(gain: float) -> None:
    a, b = _pair((7.0, -4.0))
    brighter = (b.astype(np.float32) * gain).clip(0, 255).astype(np.uint8)
    assert off_by(register(a, brighter), (7, -4)) < 0.5
    # alone it is no movement
    assert register(a, (a.astype(np.float32) * gain).clip(0, 255).astype(np.uint8)) is None


def test_another_colour_of_the_light() -> None:
    a = scene()
    tinted = (a * np.array([0.85, 1.0, 1.1]) + np.array([4, 0, -6])).clip(0, 255).round()
    matched = match_colours(a, tinted.astype(np.uint8))
    assert matched.dtype == np.float32
    assert np.abs(matched - a).mean() < 2 < np.abs(tinted - a).mean()


def test_noise() -> None:
    rng = np.random.default_rng(0)
    a, b = _pair((-8.0, 5.0))
    noisy = (b + rng.normal(0, 8, b.shape)).clip(0, 255).astype(np.uint8)
    assert off_by(register(a, noisy), (-8, 5)) < 0.6


def test_nothing_moved() -> None:
    assert register(scene(), scene()) is None
    rng = np.random.default_rng(0)
    noisy = (scene() + rng.normal(0, 5, (SIZE, SIZE, 3))).clip(0, 255).astype(np.uint8)
    assert register(scene(), noisy) is None
    even = np.full((SIZE, SIZE, 3), 120, np.uint8)
    assert register(even, even) is None


def test_an_even_thing_on_an_even_table() -> None:
    """No texture but the outline."""
    table = np.full((SIZE, SIZE, 3), 120, np.float32)
    square = np.full((12, 12, 3), (200, 40, 40), np.float32)
    a, b = (paste(table, square, at).astype(np.uint8) for at in (HOME, HOME + np.array([9, -6])))
    assert off_by(register(a, b), (9, -6)) < 0.5


def test_something_else_is_no_match() -> None:
    """The thing left and another came: the ratio says that this is no movement."""
    found = register(scene(seed=0), scene(HOME + np.array([9, 5]), seed=8))
    moved = register(scene(seed=0), scene(HOME + np.array([9, 5]), seed=0))
    assert found is not None
    assert moved is not None
    assert found.ratio > 0.6 > 0.35 > moved.ratio


def test_a_small_distractor() -> None:
    a, b = _pair((8.0, 6.0))
    b = paste(b.astype(np.float32), textured(8, 21), (70, 16)).astype(np.uint8)
    assert off_by(register(a, b), (8, 6)) < 1


def test_local_shift_sees_what_is_near() -> None:
    table = textured(SIZE, 9).clip(60, 180)
    hand, other = textured(12, 4), textured(12, 5)

    def picture(hand_at: Any, other_at: Any) -> np.ndarray:
        return paste(paste(table, hand, hand_at), other, other_at).round().astype(np.uint8)

    before = picture((30, 40), (66, 66))
    after = picture((33.4, 37.8), (61, 66))
    near = local_shift(before, after, np.array([31.7, 38.9]))
    np.testing.assert_allclose(near, (3.4, -2.2), atol=0.3)
    far = local_shift(before, after, np.array([63.5, 66.0]))
    np.testing.assert_allclose(far, (-5, 0), atol=0.3)
    np.testing.assert_array_equal(local_shift(before, after, np.array([10.0, 10.0])), (0, 0))


def test_moved_back_undoes_a_shift() -> None:
    a, b = _pair((8.0, 0.0))
    back = moved_back(b, register(a, b))
    window = np.s_[36:52, 32:48]
    assert np.abs(back[window].astype(int) - a[window]).mean() < 4
    assert np.abs(b[window].astype(int) - a[window]).mean() > 15
    assert moved_back(b, None) is b


def test_it_is_deterministic() -> None:
    assert register(*_pair((6.0, 3.0))) == register(*_pair((6.0, 3.0)))


@pytest.mark.parametrize(
    ("second", "shown"),
    [
        (np.zeros((84, 80, 3), np.uint8), r"\(84, 80, 3\)"),
        (np.zeros((84, 84, 3), np.float32), "float32"),
        (np.zeros((84, 84), np.uint8), r"\(84, 84\)"),
    ],
)
def test_pictures_that_do_not_compare(second: np.ndarray, shown: str) -> None:
    points = (
        lambda a, b, find=find: find(a, b, np.zeros(2)) for find in (local_shift, shift_since)
    )
    for call in (register, *points):
        with pytest.raises(ValueError, match=shown):
            call(scene(), second)


# -- a camera that has moved -----------------------------------------------------------------------


def turned(shift: Any, at: Any = HOME, extra: int = 20) -> np.ndarray:
    """The scene, all of it shifted by px, with what comes into view at the border."""
    wide = np.pad(scene(at), ((extra, extra), (extra, extra), (0, 0)), mode="reflect")
    x, y = np.array([extra, extra]) - shift
    matrix = np.array([[1, 0, -x], [0, 1, -y]], float)
    return cv2.warpAffine(wide, matrix, (SIZE, SIZE))


@pytest.mark.parametrize("shift", [(3, -3), (-4.5, 1.5), (0, 6.2), (1.2, 0)])
def test_the_camera_has_moved(shift: tuple[float, float]) -> None:
    for at in (HOME, HOME + np.array([9, -6])):
        found = camera_shift(scene(), turned(shift, at))
        np.testing.assert_allclose(found, shift, atol=0.3)
    np.testing.assert_allclose(camera_shift(scene(), turned(shift)[:, :, ::1]), shift, atol=0.3)


def test_the_camera_stands() -> None:
    rng = np.random.default_rng(0)
    for at in (HOME, HOME + np.array([14, -9])):
        picture = scene(at)
        noisy = (picture + rng.normal(0, 8, picture.shape)).clip(0, 255).astype(np.uint8)
        dark = (picture * 0.8).astype(np.uint8)
        for other in (picture, noisy, dark, turned((0.3, 0.2), at)):
            np.testing.assert_array_equal(camera_shift(scene(), other), (0, 0))


@pytest.mark.parametrize("camera", [(3.0, -3.0), (-4.5, 1.5)])
def test_what_moved_is_found_beside_a_moved_camera(camera: tuple[float, float]) -> None:
    found = register(scene(), turned(camera, HOME + np.array([9, 5])))
    assert off_by(found, (9, 5)) < 0.7
    assert found is not None
    np.testing.assert_allclose(found.camera, camera, atol=0.3)
    # as the camera sees it now
    assert np.abs(found.point - HOME - camera).max() < 8
    assert found.changed < 0.2


def test_only_the_camera_has_moved() -> None:
    found = register(scene(), turned((4.0, -2.0)))
    assert found is not None
    assert found.shift == (0, 0)
    assert found.growth == 1
    assert found.ratio == 0
    back = moved_back(turned((4.0, -2.0)), found)
    assert np.abs(back.astype(int) - scene())[8:-8, 8:-8].mean() < 3


def test_another_place_is_mostly_changed() -> None:
    elsewhere = cv2.resize(textured(SIZE, 30), (SIZE, SIZE)).astype(np.uint8)
    found = register(scene(), elsewhere)
    assert found is not None
    assert found.changed > 0.5
    near = register(scene(), scene(HOME + np.array([9, 5])))
    assert near is not None
    assert near.changed < 0.15


@pytest.mark.parametrize("light", [0.7, 1.0, 1.2])
@pytest.mark.parametrize("camera", [(0.0, 0.0), (3.0, -3.0), (-4.5, 1.5), (0.0, 6.2)])
def test_light_and_camera_shift_nothing_round_a_point(
    light: float, camera: tuple[float, float]
) -> None:
    for moved in ((0.0, 0.0), (3.4, -2.2), (5.0, 4.0)):
        second = turned(camera, HOME + np.array(moved)) * light
        second = second.round().clip(0, 255).astype(np.uint8)
        point = HOME + np.array(camera) + np.array(moved) / 2
        found = shift_since(scene(), second, point)
        np.testing.assert_allclose(found, moved, atol=0.4 if any(moved) else 0.2)


def test_another_scene_is_not_moved_back(demo: Demonstration) -> None:
    one, two = (textured(SIZE, seed).astype(np.uint8) for seed in (1, 2))
    found = register(one, two)
    assert found is not None
    assert found.another_scene
    np.testing.assert_array_equal(moved_back(two, found), two)
    noise = np.random.default_rng(0).integers(0, 256, demo.frames.shape, np.uint8)
    other = Demonstration(noise, demo.actions, metadata=demo.metadata)
    env = RetrievalRewardWrapper(ToyReach(), other, register=True)
    with pytest.warns(UserWarning, match="pictures are not moved back"):
        env.reset(seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.reset(seed=1)  # said once
