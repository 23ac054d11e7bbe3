"""Two things that moved apart: the one that a demonstration takes up, and where it brings it.

* ``Apart`` - how far each has moved
* ``taken_up`` - the pixels of the demonstration's first picture that show what it takes up
* ``arm_at_start`` - the pixels of it that show the arm
* ``register_apart`` - finds both

Points, shifts and lengths "at 84 pixels" as in `regil_wrappers.registration`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from regil_wrappers.matching import (
    DIFFERENT,
    Floats,
    Pair,
    Picture,
    Point,
    blurred,
    both_ways,
    comparable,
    error,
    moved_by,
    refine,
    square,
    warped,
)
from regil_wrappers.registration import Displacement

__all__ = ["Apart", "arm_at_start", "register_apart", "round_point", "taken_up"]

Mask = NDArray[np.bool_]
Shifts = NDArray[np.int_]

_LIFTED = 8  # steps after the gripper closes: what it holds has left its place
_GONE = 0.75  # of the pictures after that in which a pixel must differ from the first
_LEFT = 0.6  # of the pictures on the way to the grasp in which a pixel of the arm differs
_ROUND_ARM = 7  # px at 84 pixels, the side by which these are widened
_REACH = 26  # px at 84 pixels: shifts up to this are looked for
_CAP = 60.0  # of 255: a pixel that is off by more is off by this
_PULL = 0.4  # error (of 255) of each changed pixel that a pixel of shift must save
_SECOND = 4.0  # pixels whose full error a second shift must save
_TRUSTED = 2.0  # the weight of pixels that are known to show what is taken up
_NEAR_BEST = 0.15  # of the largest error: by how much these may fit worse than they can
_TRIED = 80  # shifts of the one that are tried with every shift of the other
_LEAST = 4  # pixels at 84 pixels; what shows fewer is not refined
_SHOWN = 10  # pixels at 84 pixels that must show the place in both pictures
_ASIDE = 5.0  # px at 84 pixels: the place is no nearer to what is taken up
_CLEARLY = 3.0  # of 255: by how much the better of two shifts must explain a pixel


@dataclass(frozen=True)
class Apart:
    """What moved between two pictures.

    Attributes:
        taken: of what the demonstration takes up; None: it stands where it stood.
        place: of what else moved; None: nothing did.
    """

    taken: Displacement | None
    place: Displacement | None

    def believed(self, worst: float) -> bool:
        """Whether more moved than what is taken up, each with a ratio of at most ``worst``."""
        return self.place is not None and self.worst <= worst

    @property
    def worst(self) -> float:
        """The larger of their ratios; 0 where nothing moved."""
        return max((one.ratio for one in (self.taken, self.place) if one is not None), default=0.0)


def taken_up(pictures: NDArray[np.uint8], grasp: int) -> Mask:
    """The pixels of the first picture whose content is gone once something has been taken up.

    The arm's own are among them: they tell nothing where the arm starts in the same pose.

    Args:
        pictures: (T, H, W, 3) uint8, a demonstration's.
        grasp: the step in which the gripper closes.

    Returns:
        (H, W) bool.
    """
    first = pictures[0].astype(np.float32)
    later = pictures[min(grasp + _LIFTED, len(pictures) - 2) :].astype(np.float32)
    gone: Mask = (np.abs(later - first).max(axis=3) > DIFFERENT).mean(axis=0) > _GONE
    return gone


def arm_at_start(pictures: NDArray[np.uint8], grasp: int) -> Mask:
    """The pixels of the first picture that show the arm, and those near them.

    They are those whose content is gone while the hand is on its way, before it is where it grasps.

    Args:
        pictures: (T, H, W, 3) uint8, a demonstration's.
        grasp: the step in which the gripper closes.

    Returns:
        (H, W) bool.
    """
    first = pictures[0].astype(np.float32)
    on_the_way = pictures[max(1, grasp // 4) : max(2, 2 * grasp // 3)].astype(np.float32)
    gone = (np.abs(on_the_way - first).max(axis=3) > DIFFERENT).mean(axis=0) > _LEFT
    unit = min(first.shape[:2]) / 84
    return np.asarray(cv2.dilate(gone.astype(np.uint8), square(_ROUND_ARM, unit)) > 0)


def round_point(shape: tuple[int, int], point: Point, radius: float) -> Mask:
    """(H, W) bool: the pixels within a radius, px at 84 pixels, of a point (x, y)."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    return np.asarray(np.hypot(x - point[0], y - point[1]) <= radius * min(shape) / 84)


def register_apart(
    reference: Picture, picture: Picture, taken: Mask, among: Mask | None = None
) -> Apart:
    """How far what is taken up has moved, and how far what else has.

    The two shifts are sought that together explain the most of what differs: each pixel of what is
    taken up must be found again under the first, every other one under either. Both are then
    refined, with a growth each, on the pixels that they explain better than the other.

    Args:
        reference: (H, W, 3) uint8, the demonstration's first picture.
        picture: (H, W, 3) uint8, the episode's first, from the same camera.
        taken: (H, W) bool, of `taken_up`.
        among: (H, W) bool, the pixels that count; None: all. What is elsewhere may move by itself.

    Raises:
        ValueError: if the pictures differ in shape or are not uint8 (H, W, 3).
    """
    pair = comparable(reference, picture, among)
    if pair.changed is None:
        return Apart(None, None)
    mask = taken.astype(np.float32)
    if pair.camera.any():
        mask = (warped(mask, moved_by(pair.camera), inverse=False) > 0.5).astype(np.float32)
    own = _largest(pair.changed * mask, pair.unit)
    rest = pair.changed * (1 - mask)
    fits = [
        None if shift is None else _Fit(_middle(pair.changed), shift, 1.0)
        for shift in _search(pair, own, rest)
    ]
    for turn in range(3):
        for i, (fit, masks) in enumerate(zip(fits, _explained(pair, own, rest, fits), strict=True)):
            if fit is None or min(m.sum() for m in masks) < _LEAST * pair.unit**2:
                continue
            centre = _middle(masks[0]) if turn == 0 else fit.centre
            a, b = (blurred(x, 0.8 * pair.unit) for x in (pair.a, pair.b))
            before, after = (_widened(m, pair.unit) for m in masks)
            found = refine(a, b, before, after, centre, fit.shift, fit.growth, pair.unit)
            fits[i] = _Fit(centre, *found)
    explained = _explained(pair, own, rest, fits)
    taken_one, place = (_displacement(pair, fit, m) for fit, m in zip(fits, explained, strict=True))
    if place is not None:
        before, after = explained[1]
        seen = before * ~_arrived(own, fits[0], pair.unit)
        if not _stands_alone(place, (seen, after), own, pair.unit):
            place = None
    return Apart(taken_one, place)


@dataclass(frozen=True)
class _Fit:
    centre: Point
    shift: Point
    growth: float


def _stands_alone(
    place: Displacement, masks: tuple[Floats, Floats], own: Floats, unit: float
) -> bool:
    """Whether it is more than the rim of what is taken up, badly matched."""
    if min(m.sum() for m in masks) < _SHOWN * unit**2:
        return False
    ys, xs = np.nonzero(own)
    away = np.hypot(xs - place.point[0], ys - place.point[1])
    return not len(away) or float(away.min()) > _ASIDE * unit


def _arrived(own: Floats, fit: _Fit | None, unit: float) -> Mask:
    """Where what is taken up has gone: what it covers there has not moved."""
    if fit is None:
        return np.zeros(own.shape, bool)
    _, there = both_ways(own, own, fit.centre, fit.shift, fit.growth)
    return np.asarray(cv2.dilate((there > 0.3).astype(np.uint8), square(5, unit)) > 0)


def _widened(mask: Floats, unit: float) -> Floats:
    return cast("Floats", cv2.dilate(mask, square(3, unit)))


def _middle(mask: Floats) -> Point:
    ys, xs = np.nonzero(mask)
    return np.array([xs.min() + xs.max(), ys.min() + ys.max()]) / 2


def _largest(mask: Floats, unit: float) -> Floats:
    """The largest group of pixels that are near each other."""
    near = cv2.dilate(mask, square(5, unit)).astype(np.uint8)
    n, labels = cv2.connectedComponents(near, connectivity=8)
    sizes = [float((mask * (labels == i)).sum()) for i in range(1, n)]
    largest: Floats = mask * (labels == 1 + int(np.argmax(sizes))) if sizes else mask
    return largest


def _search(pair: Pair, own: Floats, rest: Floats) -> tuple[Point | None, Point | None]:
    """Shifts of what is taken up and of the rest, from pictures at 84 pixels; None: it stands."""
    a, b = (blurred(_at_84(x, pair.unit), 0.6) for x in (pair.a, pair.b))
    changed, own, rest = (
        (_at_84(x, pair.unit) > 0.3).astype(np.float32) for x in (pair.changed, own, rest)
    )
    grid = range(-_REACH, _REACH + 1)
    shifts = np.array([(x, y) for y in grid for x in grid if x or y])
    # What is taken up must arrive where something has changed
    closed = cv2.morphologyEx(changed, cv2.MORPH_CLOSE, np.ones((5, 5)))
    may = _widened(cast("Floats", closed), 1.0)
    every = np.ones_like(changed)
    n_own, n_changed = int(own.sum()), int(changed.sum())
    pull = _PULL * n_changed * np.hypot(*shifts.T)
    others = np.concatenate(
        [_errors(a, b, rest, every, shifts), _errors(b, a, changed, every, -shifts)], axis=1
    )
    alone = others.sum(axis=1) + pull
    least = _SECOND * _CAP
    best: tuple[float, int | None, int | None]
    best = (float(alone.min()) + _TRUSTED * n_own * _CAP, None, int(alone.argmin()))
    if n_own >= _LEAST:
        trusted = _TRUSTED * _errors(a, b, own, may, shifts).sum(axis=1)
        near_best = trusted <= trusted.min() + _NEAR_BEST * _CAP * _TRUSTED * n_own
        tried = np.flatnonzero(near_best)
        tried = tried[np.argsort((alone + trusted)[tried], kind="stable")[:_TRIED]]
        i = int(tried[0])
        best = min(best, (float(alone[i] + trusted[i]), i, None), key=lambda one: one[0])
        for i in map(int, tried):
            total = np.minimum(others, others[i]).sum(axis=1) + pull + pull[i] + trusted[i] + least
            j = int(total.argmin())
            best = min(best, (float(total[j]), i, j), key=lambda one: one[0])
    found = [None if k is None else shifts[k] * pair.unit for k in best[1:]]
    return found[0], found[1]


def _at_84(x: Floats | None, unit: float) -> Floats:
    assert x is not None
    size = (round(x.shape[1] / unit), round(x.shape[0] / unit))
    way = cv2.INTER_AREA if unit > 1 else cv2.INTER_LINEAR
    return x if unit == 1 else cast("Floats", cv2.resize(x, size, interpolation=way))


def _errors(a: Floats, b: Floats, mask: Floats, may: Floats, shifts: Shifts) -> Floats:
    """How far a's pixels in the mask are from b's, moved by each shift: (shifts, pixels).

    Where they would arrive outside ``may``, they are off by the most that counts.
    """
    ys, xs = np.nonzero(mask)
    wide, allowed = (
        cv2.copyMakeBorder(x, _REACH, _REACH, _REACH, _REACH, border, value=0)
        for x, border in ((b, cv2.BORDER_REPLICATE), (may, cv2.BORDER_CONSTANT))
    )
    y, x = (v[None] + shifts[:, i : i + 1] + _REACH for v, i in ((ys, 1), (xs, 0)))
    off = np.zeros(y.shape, np.float32)
    for channel in range(3):
        off += np.abs(wide[y, x, channel] - a[ys, xs, channel])
    return np.where(allowed[y, x] > 0, np.minimum(off / 3, _CAP), _CAP).astype(np.float32)


def _explained(
    pair: Pair, own: Floats, rest: Floats, fits: list[_Fit | None]
) -> list[tuple[Floats, Floats]]:
    """For each shift, the pixels of the first picture and of the second that it explains.

    What is taken up is known in the first picture; of the rest, what the other explains is left
    out.
    """
    changed = cast("Floats", pair.changed)
    a, b = (blurred(x, 0.8 * pair.unit) for x in (pair.a, pair.b))
    off = []
    for fit in fits:
        if fit is None:
            off.append([np.full_like(changed, np.inf)] * 2)
            continue
        there, here = both_ways(a, b, fit.centre, fit.shift, fit.growth)
        off.append([np.abs(there - a).mean(axis=2), np.abs(here - b).mean(axis=2)])
    explained = []
    for i in range(2):
        better = [off[i][v] < off[1 - i][v] - _CLEARLY for v in range(2)]
        first = own if i == 0 else rest * better[0]
        before, after = first * (off[i][0] < DIFFERENT), changed * better[1]
        explained.append(
            (before.astype(np.float32), (after * (off[i][1] < DIFFERENT)).astype(np.float32))
        )
    return explained


def _displacement(
    pair: Pair, fit: _Fit | None, masks: tuple[Floats, Floats]
) -> Displacement | None:
    if fit is None or not masks[0].any():
        return None
    ys, xs = np.nonzero(masks[0])
    point = np.array([xs.mean(), ys.mean()])
    moved = fit.centre + fit.shift + fit.growth * (point - fit.centre) - point
    before, after = (_widened(m, pair.unit) for m in masks)
    left = error(pair.a, pair.b, before, after, fit.centre, fit.shift, fit.growth)
    still = error(pair.a, pair.b, before, after, fit.centre, np.zeros(2), 1.0)
    return Displacement(
        point=(float(point[0]), float(point[1])),
        shift=(float(moved[0]), float(moved[1])),
        growth=float(fit.growth),
        ratio=left / max(still, 1e-9),
        changed=pair.share,
        camera=(float(pair.camera[0]), float(pair.camera[1])),
    )
