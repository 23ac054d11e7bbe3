"""Two things that moved apart, by as much as they were moved here."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from regil_wrappers.apart import Apart, arm_at_start, register_apart, round_point, taken_up
from regil_wrappers.path import Path
from regil_wrappers.registration import Displacement
from test_registration import SIZE, paste, textured

CUP, SHELF = np.array([28.0, 56.0]), np.array([54.0, 30.0])  # px, in the first picture


def scene(cup: Any = (0, 0), shelf: Any = (0, 0), growth: float = 1.0, size: int = SIZE) -> Any:
    """(size, size, 3) uint8: a cup (None: it is gone) and a shelf, moved by px at 84 pixels."""
    unit = size / SIZE
    picture = cv2.resize(textured(SIZE, 9)[:10, :10], (size, size)) * 0.4 + 90
    picture = paste(picture, textured(round(20 * unit), 5), (SHELF + shelf) * unit, growth)
    if cup is not None:
        picture = paste(picture, textured(round(10 * unit), 3), (CUP + cup) * unit)
    return picture.round().clip(0, 255).astype(np.uint8)


def taken(size: int = SIZE) -> Any:
    """(size, size) bool: the cup, as `taken_up` finds it."""
    return taken_up(np.stack([scene(size=size)] * 3 + [scene(None, size=size)] * 12), 2)


def off_by(found: Displacement | None, shift: Any) -> float:
    assert found is not None
    return float(np.linalg.norm(np.subtract(found.shift, shift)))


@pytest.mark.parametrize(
    ("cup", "shelf"),
    [((6, -3), (-7, 4)), ((-9, 2), (3, 9)), ((3.5, 3.5), (-12, 0)), ((8, 8), (8, -6))],
)
def test_each_has_its_shift(cup: Any, shelf: Any) -> None:
    found = register_apart(scene(), scene(cup, shelf), taken())
    assert off_by(found.taken, cup) < 0.5
    assert off_by(found.place, shelf) < 0.5
    assert found.taken is not None
    assert found.place is not None
    assert np.abs(found.taken.point - CUP).max() < 4
    assert np.abs(found.place.point - SHELF).max() < 9
    assert max(found.taken.ratio, found.place.ratio) < 0.5


def test_the_place_grows() -> None:
    found = register_apart(scene(), scene((-5, -4), (6, 3), growth=1.12), taken())
    assert off_by(found.taken, (-5, -4)) < 0.5
    assert found.place is not None
    assert found.place.growth == pytest.approx(1.12, abs=0.05)


@pytest.mark.parametrize("size", [48, 168])
def test_pictures_of_other_sizes(size: int) -> None:
    unit = size / SIZE
    moved = scene((6, -3), (-7, 4), size=size)
    found = register_apart(scene(size=size), moved, taken(size))
    assert off_by(found.taken, np.array([6, -3]) * unit) < 0.7 * max(unit, 1)
    assert off_by(found.place, np.array([-7, 4]) * unit) < 0.7 * max(unit, 1)


def test_one_of_them_stands() -> None:
    cup_only = register_apart(scene(), scene((7, 4)), taken())
    assert off_by(cup_only.taken, (7, 4)) < 0.5
    assert cup_only.place is None
    shelf_only = register_apart(scene(), scene((0, 0), (7, 4)), taken())
    assert shelf_only.taken is None
    assert off_by(shelf_only.place, (7, 4)) < 0.5
    assert register_apart(scene(), scene(), taken()) == Apart(None, None)


def test_what_the_cup_covers_has_not_moved() -> None:
    rng = np.random.default_rng(0)
    for cup in rng.integers(-16, 17, (12, 2)):
        moved = register_apart(scene(), scene(cup), taken())
        assert moved.place is None, cup


def test_another_light_and_noise() -> None:
    noise = np.random.default_rng(0).normal(0, 4, (SIZE, SIZE, 3))
    seen = (scene((6, -3), (-7, 4)) * 0.85 + noise).clip(0, 255).astype(np.uint8)
    found = register_apart(scene(), seen, taken())
    assert off_by(found.taken, (6, -3)) < 0.7
    assert off_by(found.place, (-7, 4)) < 0.7


def test_what_is_taken_up_is_what_is_gone() -> None:
    mask = taken()
    ys, xs = np.nonzero(mask)
    assert 90 <= mask.sum() <= 121  # 10 x 10, and a rim
    np.testing.assert_allclose([xs.mean(), ys.mean()], CUP, atol=1)
    # hidden for a while is not gone
    hidden = [scene()] * 3 + [scene(None)] * 6 + [scene()] * 6
    assert not taken_up(np.stack(hidden), 0).any()


def test_pictures_that_do_not_compare() -> None:
    with pytest.raises(ValueError, match="give two of one shape"):
        register_apart(scene(), scene()[:40], taken())


# -- the path --------------------------------------------------------------------------------------


def path(steps: int = 60, grasp: int | None = 20) -> Path:
    gripper = np.full(steps, -1.0, np.float32)
    if grasp is not None:
        gripper[grasp:] = 1
    return Path(np.full((steps, 3), 0.5), gripper)


def test_the_correction_changes_over_after_the_grasp() -> None:
    one, two = np.array([4.0, 0, 0]), np.array([0, 8.0, 0])
    way = path()
    off = np.stack([way.corrected(i, one, two) for i in range(60)]) - way.places
    assert np.linalg.norm(off[0]) < 1  # it grows, it does not jump
    np.testing.assert_allclose(off[9:31], [one] * 22)
    np.testing.assert_allclose(off[36], (one + two) / 2)
    np.testing.assert_allclose(off[42:], [two] * 18)
    np.testing.assert_allclose(way.corrected(59, one, None) - way.places[59], one)
    # beyond the end the last action goes on
    np.testing.assert_allclose(way.corrected(61, one, two) - way.corrected(59, one, two), 1)
    # where little is left, it has changed over before the end
    short = path(32)
    np.testing.assert_allclose(short.corrected(31, one, two) - short.places[31], two)
    np.testing.assert_allclose(short.corrected(22, one, two) - short.places[22], one)


def test_a_path_without_a_grasp() -> None:
    for way in (path(grasp=None), Path(np.ones((5, 3)), None), path(grasp=0)):
        assert way.grasp is None
        with pytest.raises(ValueError, match="nothing is taken up"):
            way.split()
    before, after = path().split()
    assert len(before) == 30
    assert len(after) == 30
    assert path().gripper_moves(15, 20)
    assert not path().gripper_moves(15, 19)


def test_what_moves_elsewhere_does_not_count() -> None:
    """A third thing, larger than both, goes its own way."""

    def crowded(third: Any, *moved: Any) -> Any:
        picture = scene(*moved).astype(np.float32)
        picture = paste(picture, textured(24, 8), np.array([64.0, 66.0]) + third)
        return picture.round().clip(0, 255).astype(np.uint8)

    first, later = crowded((0, 0)), crowded((5, 5), (6, -3), (-7, 4))
    near = round_point((SIZE, SIZE), CUP, 14) | round_point((SIZE, SIZE), SHELF, 18)
    found = register_apart(first, later, taken(), near)
    assert off_by(found.taken, (6, -3)) < 0.5
    assert off_by(found.place, (-7, 4)) < 0.5
    everywhere = register_apart(first, later, taken())
    assert off_by(everywhere.place, (-7, 4)) > 2


def test_the_arm_is_what_leaves_before_the_grasp() -> None:
    def with_arm(x: float, cup: Any = (0, 0)) -> Any:
        picture = paste(scene(cup).astype(np.float32), textured(12, 6), np.array([x, 14.0]))
        return picture.round().clip(0, 255).astype(np.uint8)

    pictures = np.stack([with_arm(14)] + [with_arm(60)] * 9 + [with_arm(60, None)] * 12)
    arm = arm_at_start(pictures, 9)
    assert arm[10:18, 10:18].all()
    assert not arm[50:62, 22:34].any()  # the cup goes later
