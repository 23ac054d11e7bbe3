"""The pinhole camera: fitted to what a known one shows, and solved back."""

from __future__ import annotations

import json
from typing import Any

import cv2
import numpy as np
import pytest
from regil_wrappers.pinhole import Pinhole, fit_pinhole, nearest_to_path, solve_displacement
from scipy.spatial.transform import Rotation

PLANE = np.array([10.0, 10.0, 0.5])


def looking_down(
    mirror: int = 1, size: tuple[int, int] = (84, 84), angle: float = 0.6, **changes: Any
) -> Pinhole:
    """A camera that looks at the table from the side, `angle` rad below the horizontal."""
    # x of the action to the right, y away from the camera, z up
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.array([[1, 0, 0], [0, -s, -c], [0, c, -s]], float)
    values = {
        "rotation": tuple(cv2.Rodrigues(matrix)[0].ravel().tolist()),
        "focal": 88.0 * min(size) / 84,
        "depth": 75.0,
        "hand": (45.0 * size[1] / 84, 36.0 * size[0] / 84),
        "size": size,
        "mirror": mirror,
        "cost": 0.0,
    }
    return Pinhole(**{**values, **changes})


def calibration_moves() -> tuple[np.ndarray, np.ndarray]:
    """Along each axis to 5, 0, -5 and 0: (12, 3) before and after."""
    before, after = [], []
    for axis in np.eye(3):
        stops = [0, 5, 0, -5, 0]
        before += [axis * s for s in stops[:-1]]
        after += [axis * s for s in stops[1:]]
    return np.stack(before), np.stack(after)


def fitted(camera: Pinhole, noise: float = 0.0, seed: int = 0, mirror: int = 0) -> Pinhole:
    before, after = calibration_moves()
    shifts = camera.project(after) - camera.project(before)
    shifts += np.random.default_rng(seed).normal(0, noise, shifts.shape)
    return fit_pinhole(
        before, after, shifts, np.array(camera.hand), camera.size, mirror or camera.mirror, 10.0
    )


def test_projection_by_hand() -> None:
    camera = Pinhole((0, 0, 0), 100.0, 50.0, (41.5, 41.5), (84, 84), 1, 0.0)
    np.testing.assert_allclose(camera.project(np.zeros(3)), (41.5, 41.5))
    np.testing.assert_allclose(camera.project(np.array([5.0, -2.0, 0.0])), (51.5, 37.5))
    np.testing.assert_allclose(camera.project(np.array([5.0, 0.0, 50.0])), (46.5, 41.5))
    assert camera.depths(np.array([0.0, 0.0, 50.0])) == 100
    mirrored = Pinhole((0, 0, 0), 100.0, 50.0, (41.5, 41.5), (84, 84), -1, 0.0)
    np.testing.assert_allclose(mirrored.project(np.array([5.0, -2.0, 0.0])), (31.5, 37.5))


@pytest.mark.parametrize("mirror", [1, -1])
def test_the_hand_is_seen_where_it_is_and_rays_go_back(mirror: int) -> None:
    camera = looking_down(mirror)
    np.testing.assert_allclose(camera.project(np.zeros(3)), camera.hand)
    places = np.random.default_rng(0).uniform(-15, 15, (20, 3))
    for place in places:
        origin, direction = camera.ray(camera.project(place))
        assert np.linalg.norm(direction) == pytest.approx(1)
        off = np.cross(place - origin, direction)
        assert np.linalg.norm(off) < 1e-9
    np.testing.assert_allclose(camera.project(places)[3], camera.project(places[3]))


@pytest.mark.parametrize("mirror", [1, -1])
@pytest.mark.parametrize("size", [(84, 84), (128, 128), (120, 160)])
def test_fit_to_exact_shifts(mirror: int, size: tuple[int, int]) -> None:
    camera = looking_down(mirror, size)
    found = fitted(camera)
    assert found.cost < 1
    before, after = calibration_moves()
    unit = min(size) / 84
    for places in (before, after):
        np.testing.assert_allclose(found.project(places), camera.project(places), atol=0.5 * unit)
    # depth and focal length are known up to their priors; what is asked of them later is this
    far = np.array([8.0, 12.0, -9.0])
    moved = np.array([7.0, -6.0, 0.0])
    shift = camera.project(far + moved) - camera.project(far)
    place = nearest_to_path(found, camera.project(far), far[None])
    np.testing.assert_allclose(place, far, atol=1.5)
    np.testing.assert_allclose(
        solve_displacement(found, place, shift, None, PLANE)[0], moved, atol=0.8
    )


def test_fit_to_noisy_shifts() -> None:
    camera = looking_down()
    place = np.array([4.0, 10.0, -8.0])
    moved = np.array([-8.0, 5.0, 0.0])
    shift = camera.project(place + moved) - camera.project(place)
    off = []
    for seed in range(5):
        found = fitted(camera, noise=0.3, seed=seed)
        assert found.cost > fitted(camera).cost
        solved, _ = solve_displacement(found, place, shift, None, PLANE)
        off.append(np.linalg.norm(solved - moved))
    assert np.median(off) < 1.5
    assert max(off) < 3


def test_one_wrong_shift_does_little() -> None:
    camera = looking_down()
    before, after = calibration_moves()
    shifts = camera.project(after) - camera.project(before)
    shifts[2] += (9, -7)  # registered on something else
    hand = np.array(camera.hand)
    found = fit_pinhole(before, after, shifts, hand, camera.size, 1, 10.0)
    np.testing.assert_allclose(found.project(after), camera.project(after), atol=1)


def test_the_wrong_mirror_explains_less_where_perspective_is_strong() -> None:
    near = looking_down(1, depth=25.0)
    assert fitted(near, mirror=-1).cost > 2 * fitted(near).cost


@pytest.mark.parametrize("mirror", [1, -1])
def test_a_displacement_is_solved_back(mirror: int) -> None:
    camera = looking_down(mirror)
    rng = np.random.default_rng(1)
    for _ in range(10):
        place = np.array([*rng.uniform(-10, 10, 2), rng.uniform(-10, 0)])
        moved = np.array([*rng.uniform(-12, 12, 2), 0.0])
        shift = camera.project(place + moved) - camera.project(place)
        growth = float(camera.depths(place) / camera.depths(place + moved))
        for g in (growth, None):
            found, misfit = solve_displacement(camera, place, shift, g, PLANE)
            np.testing.assert_allclose(found, moved, atol=0.25)
            assert misfit < 2.5  # the plane's share: displacements up to 1.2 std along two axes


def test_growth_tells_depth_where_the_plane_is_open() -> None:
    camera = looking_down(angle=0.0)  # along the table: y is depth
    place, moved = np.array([2.0, 5.0, -1.0]), np.array([0.0, -12.0, 0.0])
    shift = camera.project(place + moved) - camera.project(place)
    growth = float(camera.depths(place) / camera.depths(place + moved))
    with_growth, without = (
        solve_displacement(camera, place, shift, g, PLANE)[0] for g in (growth, None)
    )
    assert abs(with_growth[1] + 12) < 2.5 < 5 < abs(without[1] + 12)


def test_what_no_displacement_in_the_plane_explains_is_a_misfit() -> None:
    camera, place = looking_down(), np.array([2.0, 6.0, -10.0])
    shift = camera.project(place + np.array([9.0, 0.0, 0.0])) - camera.project(place)
    _, right = solve_displacement(camera, place, shift, 1.0, np.array([10.0, 10.0, 0.5]))
    _, wrong = solve_displacement(camera, place, shift, 1.0, np.array([0.5, 10.0, 10.0]))
    assert wrong > 8 > 1.5 > right


def test_no_shift_is_no_displacement() -> None:
    camera = looking_down()
    np.testing.assert_allclose(
        solve_displacement(camera, np.array([3.0, 5.0, -8.0]), (0, 0), 1.0, PLANE)[0], 0, atol=1e-6
    )


def test_nearest_to_path() -> None:
    camera = looking_down()
    path = np.array([[0.0, 0, 0], [3, 4, -2], [6, 8, -4], [9, 12, -6]])
    for place in path:
        np.testing.assert_allclose(
            nearest_to_path(camera, camera.project(place), path), place, atol=1e-9
        )
    # a pixel beside the path: on its own ray all the same
    pixel = camera.project(path[2]) + np.array([2, 1])
    found = nearest_to_path(camera, pixel, path)
    np.testing.assert_allclose(camera.project(found), pixel, atol=1e-9)
    assert np.linalg.norm(found - path, axis=1).min() < 4


def test_the_fit_is_deterministic_and_written_as_json() -> None:
    found = fitted(looking_down(), noise=0.2)
    assert found == fitted(looking_down(), noise=0.2)
    assert Pinhole.from_dict(json.loads(json.dumps(found.as_dict()))) == found


def test_shifts_that_say_nothing_leave_the_priors() -> None:
    before, after = calibration_moves()
    hand = np.array([40.0, 30.0])
    found = fit_pinhole(before, after, np.zeros((12, 2)), hand, (84, 84), 1, 10.0)
    assert np.isfinite([found.focal, found.depth, found.cost, *found.rotation]).all()
    assert found.cost > 5  # no camera sees a hand stand still that moves along three axes
    one = fit_pinhole(before[:1], after[:1], np.ones((1, 2)), hand, (84, 84), 1, 10.0)
    assert np.isfinite([one.focal, one.depth, one.cost]).all()


@pytest.mark.parametrize(
    "change",
    [
        {"focal": float("nan")},
        {"depth": -3.0},
        {"rotation": [0, 0]},
        {"hand": None},
        {"size": [84]},
        {"cost": "much"},
        {"mirror": 0},
    ],
)
def test_a_damaged_camera_is_refused(change: dict[str, Any]) -> None:
    values = {**looking_down().as_dict(), **change}
    with pytest.raises(ValueError, match="is not a calibrated camera"):
        Pinhole.from_dict(values)
    del values["mirror"]
    with pytest.raises(ValueError, match="mirror"):
        Pinhole.from_dict({**looking_down().as_dict(), "mirror": None})


@pytest.mark.parametrize("mirror", [1, -1])
@pytest.mark.parametrize("turn", range(0, 360, 45))
def test_a_camera_that_stands_anywhere_about_is_found(turn: int, mirror: int) -> None:
    rotation = Rotation.from_euler("xz", [-115, turn], degrees=True).inv().as_rotvec()
    camera = Pinhole(tuple(rotation), 85.4, 58.0, (40.9, 32.6), (84, 84), mirror, 0.0)
    moves = [(5.5 * np.eye(3)[axis] * side) for axis in range(3) for side in (1, -1)]
    before, after = np.zeros((6, 3)), np.stack(moves)
    shifts = camera.project(after) - camera.project(before)
    fit = fit_pinhole(before, after, shifts, np.array([41.0, 33.0]), (84, 84), mirror, 11.0)
    assert fit.cost < 2
    assert np.abs(fit.project(after) - camera.project(after)).max() < 1
