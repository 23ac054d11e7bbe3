"""Two pictures of one scene: what differs everywhere, because light or camera have changed.

* ``match_colours`` - takes a change of brightness or colour out
* ``camera_shift`` - how far everything that stands still has shifted in the picture

Points are (x, y) in pixels; lengths "at 84 pixels" grow with the shorter side of the picture.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["camera_shift", "match_colours"]

Picture = NDArray[np.uint8]
Floats = NDArray[np.float32]
Point = NDArray[np.float64]

_UNEVEN = 12.0  # std of a channel; an evener one cannot tell a gain, only an offset
_REACH = 8  # px at 84 pixels: shifts up to this are found
_TRUNCATION = 30.0  # of 255: what moved by itself counts no more than this
_BETTER = 0.8  # the error must fall to this share of that without a shift
_TILES = 4  # along each side
_FLAT = 0.5  # of 255: a tile with less error shows no edge that could tell
_LEAST = 0.7  # px at 84 pixels: a smaller shift is none


def match_colours(reference: Picture, picture: Picture) -> Floats:
    """Gain and offset of each channel fitted robustly, and applied.

    Args:
        reference: (H, W, 3) uint8.
        picture: (H, W, 3) uint8, mostly the same scene.

    Returns:
        (H, W, 3) float32 in [0, 255]: the picture in the reference's brightness and colours.
    """
    matched = picture.astype(np.float32)
    for channel in range(3):
        x = matched[..., channel].ravel()
        y = reference[..., channel].astype(np.float32).ravel()
        gain, offset = 1.0, 0.0
        for threshold in (60.0, 25.0, 25.0):
            same = np.abs(gain * x + offset - y) < threshold
            if same.mean() < 0.07:
                break
            if x[same].std() < _UNEVEN:
                offset = float(np.median(y[same] - gain * x[same]))
                continue
            gain, offset = np.polyfit(x[same], y[same], 1)
        matched[..., channel] = np.clip(gain * x + offset, 0, 255).reshape(picture.shape[:2])
    return matched


def camera_shift(reference: Picture, picture: Picture) -> Point:
    """How far what stands still has shifted, because the camera moved a little.

    The shift that makes the pictures agree on most pixels; what moved by itself is the smaller part
    of them. A small turn of the camera shifts everything alike; of a push, and of a roll about its
    axis, this is the mean.

    Args:
        reference: (H, W, 3) uint8, the first picture.
        picture: (H, W, 3) uint8, the second.

    Returns:
        (2,) px (x, y): what stands still at p in the first stands at p + shift in the second;
        exactly 0 where the camera stands.
    """
    unit = min(reference.shape[:2]) / 84
    a = _blurred(reference.astype(np.float32), unit)
    b = _blurred(match_colours(reference, picture), unit)

    def errors_at(shift: Any) -> Floats:
        matrix = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], float)
        back = cv2.warpAffine(
            b, matrix, (a.shape[1], a.shape[0]), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        )
        edge = round(_REACH * unit)
        off = cv2.absdiff(back, a)[edge:-edge, edge:-edge].mean(axis=2)
        return np.asarray(np.minimum(off, _TRUNCATION), np.float32)

    def error(shift: Any) -> float:
        return float(errors_at(shift).mean())

    still = error(np.zeros(2))
    grid = np.arange(-_REACH, _REACH + 1, 2) * unit
    shift = min((np.array([x, y]) for y in grid for x in grid), key=error)
    least = error(shift)
    for step in (1.0, 0.5, 0.25, 0.1):
        for _ in range(4):
            near = [shift + step * unit * np.array(d) for d in _NEAR]
            errors = [error(x) for x in near]
            best = int(np.argmin(errors))
            if errors[best] >= least:
                break
            least, shift = errors[best], near[best]
    if least > _BETTER * still or np.linalg.norm(shift) < _LEAST * unit:
        return np.zeros(2)
    # One thing that moved before an even background would look the same, but in a few tiles only
    before, after = (_tiles(errors_at(x)) for x in (np.zeros(2), shift))
    uneven = before > _FLAT
    agree = uneven & (after < _BETTER * before)
    if uneven.sum() < _TILES**2 / 2 or agree.sum() < 0.5 * uneven.sum():
        return np.zeros(2)
    return shift


_NEAR = [(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y]


def _tiles(errors: Floats) -> Floats:
    """Means over _TILES x _TILES parts of the picture."""
    tiles = cv2.resize(errors, (_TILES, _TILES), interpolation=cv2.INTER_AREA)
    return np.asarray(tiles, np.float32)


def _blurred(picture: Floats, std: float) -> Floats:
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), std), np.float32)
