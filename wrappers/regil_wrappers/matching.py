"""Two pictures laid on each other: what differs, and the shift and growth that make them agree.

* ``Pair`` and ``comparable`` - light and a turn of the camera taken out, and what still differs
* ``both_ways``, ``error``, ``refine`` - one shift and growth: warped, judged, made better

`regil_wrappers.registration` says what has moved; lengths "at 84 pixels" as there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from regil_wrappers.conditions import camera_shift, match_colours

__all__ = [
    "DIFFERENT",
    "TRUNCATION",
    "Floats",
    "Pair",
    "Picture",
    "Point",
    "blurred",
    "both_ways",
    "check_pictures",
    "comparable",
    "error",
    "moved_by",
    "refine",
    "square",
    "warped",
]

Picture = NDArray[np.uint8]
Floats = NDArray[np.float32]
Point = NDArray[np.float64]

DIFFERENT = 25.0
"""Of 255: a pixel that differs by more in some channel has changed."""
TRUNCATION = 76.5
"""Of 255: an error counts no more than this, so that what is hidden costs little."""
_SMALLEST = 12  # changed pixels at 84 pixels; fewer: nothing has moved
_SPECK = 4  # connected changed pixels at 84 pixels; fewer are noise
_MOST_GROWTH = (0.75, 1.35)
_FOUR = ((1, 0), (-1, 0), (0, 1), (0, -1))


@dataclass(frozen=True)
class Pair:
    """Two pictures of one scene, made comparable.

    Attributes:
        a: (H, W, 3) the first, as the camera of the second sees it.
        b: (H, W, 3) the second, in the light of the first.
        unit: px that one pixel is "at 84 pixels".
        camera: (2,) px (x, y), how far what stands still has shifted; that is taken out.
        share: of the pixels that differ.
        changed: (H, W) 1 where they differ and are no specks; None where nothing has moved.
        hull: (H, W) 1 in the convex hull of these, a little larger.
    """

    a: Floats
    b: Floats
    unit: float
    camera: Point
    share: float
    changed: Floats | None
    hull: Floats | None


def comparable(
    reference: Picture, picture: Picture, among: NDArray[np.bool_] | None = None
) -> Pair:
    """Take light and a turn of the camera out, and find what still differs.

    Args:
        reference: (H, W, 3) uint8, the first picture.
        picture: (H, W, 3) uint8, the second.
        among: (H, W) the pixels that count; None: all.

    Raises:
        ValueError: if they do not compare.
    """
    check_pictures(reference, picture)
    unit = min(picture.shape[:2]) / 84
    camera = camera_shift(reference, picture)
    seen_by_both = None
    if camera.any():
        matrix = moved_by(camera)
        inside = np.ones(picture.shape[:2], np.uint8)
        size = (picture.shape[1], picture.shape[0])
        inside = np.asarray(cv2.warpAffine(inside, matrix, size, flags=cv2.INTER_NEAREST))
        seen_by_both = inside.astype(np.uint8)
        reference = warped(reference, matrix, inverse=False)
    a, b = reference.astype(np.float32), match_colours(reference, picture)
    share = float((np.abs(a - b).max(axis=2) > DIFFERENT).mean())
    changed, hull = _changed(a, b, unit, seen_by_both, among) or (None, None)
    return Pair(a, b, unit, camera, share, changed, hull)


def check_pictures(a: Picture, b: Picture) -> None:
    """Refuse pictures that do not compare.

    Raises:
        ValueError: if they differ in shape or are not uint8 (H, W, 3).
    """
    for x in (a, b):
        if x.dtype != np.uint8 or x.ndim != 3 or x.shape[2] != 3 or x.shape != a.shape:
            raise ValueError(
                f"pictures are {a.dtype} {a.shape} and {b.dtype} {b.shape}: give two of one shape, "
                f"uint8 (H, W, 3)"
            )


def moved_by(shift: Any) -> NDArray[np.float64]:
    """(2, 3) the affine matrix of a shift (x, y)."""
    return np.array([[1, 0, shift[0]], [0, 1, shift[1]]], float)


def blurred(picture: Floats, std: float) -> Floats:
    """Blurred by a Gaussian of this standard deviation in px."""
    return cast("Floats", cv2.GaussianBlur(picture, (0, 0), std))


def square(side: float, unit: float) -> NDArray[np.uint8]:
    """A kernel of an odd number of ones, about ``side`` at 84 pixels."""
    n = max(1, round(side * unit)) | 1
    return np.ones((n, n), np.uint8)


def _changed(
    a: Floats,
    b: Floats,
    unit: float,
    seen_by_both: NDArray[np.uint8] | None,
    among: NDArray[np.bool_] | None,
) -> tuple[Floats, Floats] | None:
    """Pixels that differ, and their convex hull, a little larger; None where too few do.

    Where the camera has moved (``seen_by_both``: what both pictures show), edges cannot be brought
    to lie exactly on each other: there a thing counts only if some of its pixels differ from
    everything within a pixel of them.
    """
    changed = (np.abs(a - b).max(axis=2) > DIFFERENT).astype(np.uint8)
    if among is not None:
        changed[~among] = 0
    core = changed
    if seen_by_both is not None:
        near = square(3, unit)
        beyond = np.maximum(
            np.maximum(b - cv2.dilate(a, near), cv2.erode(a, near) - b),
            np.maximum(a - cv2.dilate(b, near), cv2.erode(b, near) - a),
        )
        changed *= seen_by_both
        core = changed * (beyond.max(axis=2) > DIFFERENT)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(core, connectivity=8)
    small = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] < _SPECK * unit**2)
    core[np.isin(labels, small)] = 0
    if core.sum() < _SMALLEST * unit**2:
        return None
    if seen_by_both is not None:
        core = cv2.dilate(core, square(3, unit)).astype(np.uint8) * changed
    hull = np.zeros_like(core)
    points = cast("NDArray[np.int32]", cv2.findNonZero(core))
    cv2.fillConvexPoly(hull, cv2.convexHull(points), (1,))
    return core.astype(np.float32), cv2.dilate(hull, square(5, unit)).astype(np.float32)


def _matrix(centre: Point, shift: Point, growth: float) -> NDArray[np.float64]:
    offset = centre + shift - growth * centre
    return np.array([[growth, 0, offset[0]], [0, growth, offset[1]]])


def warped(picture: NDArray[Any], matrix: NDArray[np.float64], inverse: bool) -> NDArray[Any]:
    """Warped by a matrix (2, 3), or back where ``inverse``; the border repeats."""
    flags = cv2.INTER_LINEAR | (cv2.WARP_INVERSE_MAP if inverse else 0)
    size = (picture.shape[1], picture.shape[0])
    return cast(
        "NDArray[Any]",
        cv2.warpAffine(picture, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE),
    )


def both_ways(
    a: Floats, b: Floats, centre: Point, shift: Point, growth: float
) -> tuple[Floats, Floats]:
    """The second picture moved back, and the first moved forward."""
    matrix = _matrix(centre, shift, growth)
    return warped(b, matrix, inverse=True), warped(a, matrix, inverse=False)


def _truncated(a: Floats, b: Floats, weights: Floats, truncation: float) -> float:
    e = cv2.transform(cv2.absdiff(a, b), _MEAN)
    np.minimum(e, truncation, out=e)
    return float(cv2.multiply(e, weights).sum() / max(float(weights.sum()), 1e-6))


_MEAN = np.full((1, 3), 1 / 3, np.float32)


def error(
    a: Floats,
    b: Floats,
    before: Floats,
    after: Floats,
    centre: Point,
    shift: Point,
    growth: float,
    truncation: float = TRUNCATION,
) -> float:
    """Mean truncated difference of the pictures, on weighted pixels of the first and second."""
    back, forward = both_ways(a, b, centre, shift, growth)
    return _truncated(back, a, before, truncation) + _truncated(forward, b, after, truncation)


def refine(
    a: Floats,
    b: Floats,
    before: Floats,
    after: Floats,
    centre: Point,
    shift: Point,
    growth: float,
    unit: float,
) -> tuple[Point, float]:
    """Coordinate descent on shift and growth with ever smaller steps."""

    def cost(shift: Point, growth: float) -> float:
        if not _MOST_GROWTH[0] < growth < _MOST_GROWTH[1]:
            return math.inf
        return error(a, b, before, after, centre, shift, growth) + 3 * abs(math.log(growth))

    least = cost(shift, growth)
    for step, ratio in ((1.0, 1.04), (0.5, 1.02), (0.25, 1.01), (0.1, 1.005)):
        for _ in range(8):
            near = [(shift + step * unit * np.array(d), growth) for d in _FOUR]
            near += [(shift, growth * ratio), (shift, growth / ratio)]
            costs = [cost(*x) for x in near]
            best = int(np.argmin(costs))
            if costs[best] >= least - 1e-6:
                break
            least, (shift, growth) = costs[best], near[best]
    return shift, growth
