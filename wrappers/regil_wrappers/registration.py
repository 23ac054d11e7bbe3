"""Two pictures of one scene: how far what differs has moved, and how much it has grown.

* ``Displacement`` - the answer
* ``register`` - finds it: what stood at p in one picture stands at centre + shift + growth * (p -
  centre) in the other
* ``local_shift`` - the shift of what stands round one point, for pictures that follow each other
* ``shift_since`` - the same for first pictures of two episodes
* ``moved_back`` - a picture warped so that what moved stands where it stood

A change of the light, and a camera that has turned a little, are taken out first
(`regil_wrappers.conditions`).

Points are (x, y) in pixels, x to the right and y down. Lengths below that are given "at 84 pixels"
grow with the shorter side of the picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from regil_wrappers.matching import (
    DIFFERENT,
    TRUNCATION,
    Floats,
    Picture,
    Point,
    blurred,
    both_ways,
    check_pictures,
    comparable,
    error,
    moved_by,
    refine,
    square,
    warped,
)

__all__ = ["Displacement", "local_shift", "moved_back", "register", "shift_since"]

_HULL_WEIGHT = 0.2  # of the unchanged pixels between changed ones
_COARSE = 42  # side of the pictures of the coarse search
_REACH = 14  # how far it looks, in pixels of these
_PULL = 0.51  # error (of 255) that a pixel of coarse shift must save
_GROWTHS = (0.88, 1.0, 1.12)
_ELSEWHERE = 0.35  # of the picture: where more has changed, it is not one thing that moved


@dataclass(frozen=True)
class Displacement:
    """What moved between two pictures.

    Attributes:
        point: (x, y) px, where it stood at the time of the first picture, as the camera of the
            second sees it.
        shift: (x, y) px, from there to where it stands in the second.
        growth: its size in the second picture over that in the first.
        ratio: error left after moving it back, over the error before; near 0 is a good match, and
            near 1 no match at all.
        changed: share of the picture's pixels that differ, once light and camera are taken out.
        camera: (x, y) px, how far what stands still has shifted, because the camera moved.
    """

    point: tuple[float, float]
    shift: tuple[float, float]
    growth: float
    ratio: float
    changed: float = 0.0
    camera: tuple[float, float] = (0.0, 0.0)

    @property
    def another_scene(self) -> bool:
        """Whether so much of the picture has changed that it is not one thing that moved."""
        return self.changed > _ELSEWHERE


def register(
    reference: Picture, picture: Picture, among: NDArray[np.bool_] | None = None
) -> Displacement | None:
    """What moved from one picture to the other, and how far.

    Pixels that differ are taken, and the shift and growth sought that make both pictures agree on
    them, both ways: first on a grid over small pictures, then below a pixel on the pixels that the
    grid's answer explains. One rigid thing is assumed to have moved; the rest stands still, or
    shifts by what a small turn of the camera makes of it.

    Args:
        reference: (H, W, 3) uint8, the first picture.
        picture: (H, W, 3) uint8, the second, from the same camera.
        among: (H, W), the pixels that count; None: all. What is elsewhere may move by itself.

    Returns:
        the displacement, or None where nothing has moved. Where only the camera has, a shift of 0.

    Raises:
        ValueError: if the pictures differ in shape or are not uint8 (H, W, 3).
    """
    pair = comparable(reference, picture, among)
    a, b, unit, camera = pair.a, pair.b, pair.unit, pair.camera
    turned = (float(camera[0]), float(camera[1]))
    changed, hull = pair.changed, pair.hull
    if changed is None or hull is None:
        if not camera.any():
            return None
        middle = ((picture.shape[1] - 1) / 2, (picture.shape[0] - 1) / 2)
        return Displacement(middle, (0.0, 0.0), 1.0, 0.0, pair.share, turned)
    weights = np.maximum(cv2.dilate(changed, square(3, unit)), hull * _HULL_WEIGHT)
    shift, growth = _coarse(a, b, weights, unit)

    ys, xs = np.nonzero(hull)
    centre = np.array([xs.min() + xs.max(), ys.min() + ys.max()]) / 2
    smooth_a, smooth_b = blurred(a, 0.8 * unit), blurred(b, 0.8 * unit)
    before, after = weights, weights
    seen = changed
    for _ in range(3):
        shift, growth = refine(smooth_a, smooth_b, before, after, centre, shift, growth, unit)
        there, here = both_ways(a, b, centre, shift, growth)
        explained = [
            changed * (np.abs(x - y).mean(axis=2) < DIFFERENT) for x, y in ((there, a), (here, b))
        ]
        if min(x.sum() for x in explained) < 8 * unit**2:
            break
        seen = explained[0]
        before, after = (
            cv2.morphologyEx(
                cv2.dilate(x, square(3, unit)), cv2.MORPH_CLOSE, square(5, unit)
            ).astype(np.float32)
            for x in explained
        )
    left = error(a, b, weights, weights, centre, shift, growth)
    still = error(a, b, weights, weights, centre, np.zeros(2), 1.0)
    ys, xs = np.nonzero(seen)
    point = np.array([xs.mean(), ys.mean()])
    moved = centre + shift + growth * (point - centre) - point
    return Displacement(
        point=(float(point[0]), float(point[1])),
        shift=(float(moved[0]), float(moved[1])),
        growth=float(growth),
        ratio=left / max(still, 1e-9),
        changed=pair.share,
        camera=turned,
    )


def moved_back(picture: Picture, displacement: Displacement | None) -> Picture:
    """The picture shifted so that what moved stands where it stood in the first picture.

    Growth is left alone. Where the camera has moved too, its shift is taken back with it.

    Args:
        picture: (H, W, 3) uint8, like the second picture of `register`.
        displacement: what `register` found; None, or one of another scene, changes nothing.

    Returns:
        (H, W, 3) uint8; the border repeats.
    """
    if displacement is None or displacement.another_scene:
        return picture
    x, y = np.add(displacement.shift, displacement.camera)
    return warped(picture, moved_by((x, y)), inverse=True)


def local_shift(before: Picture, after: Picture, point: Point, radius: float = 8.0) -> Point:
    """How far what stands round a point has moved between two pictures that follow each other.

    Args:
        before: (H, W, 3) uint8.
        after: (H, W, 3) uint8.
        point: (2,) px (x, y), midway between where it stood and where it stands.
        radius: std of the Gaussian weights round the point, px at 84 pixels.

    Returns:
        (2,) px; 0 where nothing changed near the point.

    Raises:
        ValueError: if the pictures differ in shape or are not uint8 (H, W, 3).
    """
    check_pictures(before, after)
    return _shift_round(point, before.astype(np.float32), after.astype(np.float32), radius)


def shift_since(reference: Picture, picture: Picture, point: Point, radius: float = 8.0) -> Point:
    """How far what stands round a point has moved since another episode's first picture.

    As `local_shift`, but a change of the light and a small turn of the camera are no movement.

    Args:
        reference: (H, W, 3) uint8, the first picture.
        picture: (H, W, 3) uint8, the second.
        point: (2,) px (x, y), as the camera of the second sees it.
        radius: std of the Gaussian weights round the point, px at 84 pixels.

    Returns:
        (2,) px; 0 where nothing changed near the point.

    Raises:
        ValueError: if the pictures differ in shape or are not uint8 (H, W, 3).
    """
    pair = comparable(reference, picture)
    return _shift_round(point, pair.a, pair.b, radius)


def _shift_round(point: Point, a: Floats, b: Floats, radius: float) -> Point:
    unit = min(a.shape[:2]) / 84
    changed = (np.abs(a - b).max(axis=2) > DIFFERENT).astype(np.uint8)
    weights = cv2.dilate(changed, square(3, unit)) * _gaussian(a, point, radius * unit)
    if weights.sum() < 3 * unit**2:
        return np.zeros(2)
    a, b = blurred(a, unit), blurred(b, unit)

    def cost(shift: Point) -> float:
        return error(a, b, weights, weights, point, shift, 1.0, truncation=60.0)

    grid = np.arange(-8, 9, 2) * unit
    shift = min((np.array([x, y]) for y in grid for x in grid), key=cost)
    least = cost(shift)
    for step in (1.0, 0.5, 0.25, 0.12, 0.06):
        for _ in range(6):
            near = [shift + step * unit * np.array(d) for d in _EIGHT]
            costs = [cost(x) for x in near]
            best = int(np.argmin(costs))
            if costs[best] >= least - 1e-6:
                break
            least, shift = costs[best], near[best]
    return shift


_EIGHT = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1))


def _gaussian(picture: Floats, point: Point, radius: float) -> Floats:
    y, x = np.mgrid[: picture.shape[0], : picture.shape[1]]
    squared = (x - point[0]) ** 2 + (y - point[1]) ** 2
    weights: Floats = np.exp(-squared / (2 * radius**2)).astype(np.float32)
    return weights


def _coarse(a: Floats, b: Floats, weights: Floats, unit: float) -> tuple[Point, float]:
    """The best shift (px of the pictures) and growth on a grid, from small pictures."""
    size = (round(a.shape[1] / unit / 84 * _COARSE), round(a.shape[0] / unit / 84 * _COARSE))
    a, b, weights = (_shrunk(x, size) for x in (a, b, weights))
    ys, xs = np.nonzero(weights)
    rows, columns = slice(ys.min(), ys.max() + 1), slice(xs.min(), xs.max() + 1)
    centre = np.array([xs.min() + xs.max(), ys.min() + ys.max()]) / 2
    w = weights[rows, columns]
    w = w / w.sum()
    pad = _REACH + 3
    shifts = np.arange(-_REACH, _REACH + 1)
    best = (np.inf, np.zeros(2), 1.0)
    for growth in _GROWTHS:
        there, here = (_padded(x, pad) for x in both_ways(a, b, centre, np.zeros(2), growth))
        # In the second picture moved back, a shift is divided by the growth.
        back = np.clip(np.round(shifts / growth).astype(int), -pad, pad)
        for dy, back_y in zip(shifts, back, strict=True):
            total = _row_errors(there, a[rows, columns], w, rows, columns, pad, back_y, back)
            total += _row_errors(here, b[rows, columns], w, rows, columns, pad, -dy, -shifts)
            total += _PULL * np.hypot(shifts, dy) + 2 * abs(np.log(growth))
            i = int(total.argmin())
            if total[i] < best[0]:
                best = (float(total[i]), np.array([shifts[i], dy], float), growth)
    return best[1] * unit * 84 / _COARSE, best[2]


def _shrunk(picture: Floats, size: tuple[int, int]) -> Floats:
    return cast("Floats", cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


def _padded(picture: Floats, pad: int) -> Floats:
    padded = cv2.copyMakeBorder(picture, pad, pad, pad, pad, cv2.BORDER_REPLICATE)
    return cast("Floats", padded)


def _row_errors(
    padded: Floats,
    patch: Floats,
    weights: Floats,
    rows: slice,
    columns: slice,
    pad: int,
    dy: int,
    dxs: NDArray[np.int_],
) -> NDArray[np.float64]:
    """Weighted truncated errors of a patch against a padded picture, for one dy and every dx."""
    band = padded[pad + dy + rows.start : pad + dy + rows.stop]
    windows = np.stack([band[:, pad + dx + columns.start : pad + dx + columns.stop] for dx in dxs])
    windows -= patch
    np.abs(windows, out=windows)
    errors = np.minimum(windows.mean(axis=3), TRUNCATION)
    return cast("NDArray[np.float64]", np.einsum("nhw,hw->n", errors, weights).astype(float))
