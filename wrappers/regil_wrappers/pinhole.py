"""The camera, as a hand sees it that has moved: action units to pixels and back.

* ``Pinhole`` - projects places, given in action units from where the hand starts an episode
* ``fit_pinhole`` - the camera that explains how the hand's picture shifted when it moved
* ``nearest_to_path`` - how deep a pixel's ray is taken to end
* ``solve_displacement`` - the displacement in action units that a shift in pixels stands for

An action unit is the way the hand goes in one step under an action of 1.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["Pinhole", "fit_pinhole", "nearest_to_path", "solve_displacement"]

Floats = NDArray[np.float64]

_STARTS = 8
_AROUND = range(0, 360, 60)  # degrees
_FOCAL_STD = 0.1  # of the logarithm
_DEPTH_STD = 0.7  # of the logarithm
_HAND_STD = 2.5  # px at 84 pixels
_SHIFT_STD = 0.4  # px at 84 pixels, in the fit
_TARGET_STD = 0.5  # px at 84 pixels, of a registered shift
_GROWTH_STD = 0.06  # of the logarithm of a registered growth


@dataclass(frozen=True)
class Pinhole:
    """A camera in the frame of the hand's start.

    Attributes:
        rotation: (3,) rotation vector, action axes to camera axes (x right, y down, z forward).
        focal: px.
        depth: action units from the camera to the hand's start, along the camera's z.
        hand: (2,) px (x, y), where the hand's start is seen.
        size: (height, width) px of the pictures.
        mirror: +1, or -1 where the picture is mirrored left to right.
        cost: of the fit; smaller is better. It compares fits to the same pictures only.
    """

    rotation: tuple[float, float, float]
    focal: float
    depth: float
    hand: tuple[float, float]
    size: tuple[int, int]
    mirror: int
    cost: float

    @property
    def matrix(self) -> Floats:
        """(3, 3), action axes to camera axes."""
        return cast("Floats", cv2.Rodrigues(np.array(self.rotation, float))[0])

    @property
    def _centre(self) -> Floats:
        height, width = self.size
        return np.array([(width - 1) / 2, (height - 1) / 2])

    def _direction(self, pixel: Any) -> Floats:
        x, y = (np.asarray(pixel, float) - self._centre) / self.focal
        return np.array([self.mirror * x, y, 1.0])

    def in_camera(self, places: Floats) -> Floats:
        """Places (..., 3) in action units, in the camera's axes."""
        seen: Floats = self.depth * self._direction(self.hand) + places @ self.matrix.T
        return seen

    def depths(self, places: Floats) -> Floats:
        """How far before the camera places (..., 3) are, (...,) in action units."""
        return self.in_camera(places)[..., 2]

    def project(self, places: Floats) -> Floats:
        """Places (..., 3) in action units as pixels (..., 2), x and y."""
        seen = self.in_camera(places)
        ahead = np.maximum(seen[..., 2:], 0.07 * self.depth)
        flat = seen[..., :2] / ahead * np.array([self.mirror, 1])
        return cast("Floats", self._centre + self.focal * flat)

    def ray(self, pixel: Any) -> tuple[Floats, Floats]:
        """Origin (3,) and unit direction (3,) of a pixel's ray, in action units."""
        origin = -self.depth * self._direction(self.hand) @ self.matrix
        direction = self._direction(pixel) @ self.matrix
        return origin, direction / np.linalg.norm(direction)

    def as_dict(self) -> dict[str, Any]:
        """JSON values; `Pinhole.from_dict` reads them."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Pinhole:
        """What `as_dict` gave, perhaps by way of JSON.

        Raises:
            ValueError: if something is missing or not a finite number.
        """
        try:
            camera = cls(
                rotation=_numbers(values["rotation"], 3),
                focal=float(values["focal"]),
                depth=float(values["depth"]),
                hand=_numbers(values["hand"], 2),
                size=(int(values["size"][0]), int(values["size"][1])),
                mirror=int(values["mirror"]),
                cost=float(values["cost"]),
            )
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise ValueError(f"{values!r} is not a calibrated camera ({error!r})") from error
        flat = [*camera.rotation, camera.focal, camera.depth, *camera.hand, camera.cost]
        if not np.isfinite(flat).all() or min(camera.focal, camera.depth, *camera.size) <= 0:
            raise ValueError(f"{values!r} is not a calibrated camera: its numbers must be finite")
        if camera.mirror not in (1, -1):
            raise ValueError(f"{values!r} is not a calibrated camera: mirror must be 1 or -1")
        return camera


def _numbers(values: Any, n: int) -> Any:
    if len(values) != n:
        raise ValueError(f"{values!r} must be {n} numbers")
    return tuple(float(v) for v in values)


def fit_pinhole(
    before: Floats,
    after: Floats,
    shifts: Floats,
    hand: Floats,
    size: tuple[int, int],
    mirror: int,
    length: float,
    seed: int = 0,
) -> Pinhole:
    """The camera that explains the hand's shifts, from several starts; Cauchy loss.

    Priors: log focal ~ N(log(1.01 side), .1), log depth ~ N(log(7 length), .7), and the hand's
    pixel.

    Args:
        before: (n, 3) action units, where the hand was.
        after: (n, 3) action units, where it went.
        shifts: (n, 2) px, how its picture shifted.
        hand: (2,) px, where it is seen at the start.
        size: (height, width) px of the pictures.
        mirror: +1, or -1 where the picture is mirrored left to right.
        length: the scale of the scene in action units: about how far targets move.
        seed: of the starts.

    Returns:
        the fit of least cost.
    """
    from scipy.optimize import least_squares  # type: ignore[import-untyped]
    from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]

    unit = min(size) / 84
    focal, depth = np.log(85 * unit), np.log(7 * length)

    def camera(x: Floats, cost: float = 0.0) -> Pinhole:
        return Pinhole(
            rotation=(x[0], x[1], x[2]),
            focal=float(np.exp(x[3])),
            depth=float(np.exp(x[4])),
            hand=(x[5], x[6]),
            size=size,
            mirror=mirror,
            cost=cost,
        )

    def residuals(x: Floats) -> Floats:
        c = camera(x)
        r = (c.project(after) - c.project(before) - shifts) / (_SHIFT_STD * unit)
        priors = [(x[3] - focal) / _FOCAL_STD, (x[4] - depth) / _DEPTH_STD]
        priors += list((x[5:] - hand) / (_HAND_STD * unit))
        return np.concatenate([np.sqrt(2 * np.log1p(r * r / 2)).ravel(), priors])

    def fitted(starts: Iterable[Floats]) -> list[Any]:
        return [
            least_squares(residuals, [*start, focal, depth, *hand], max_nfev=60) for start in starts
        ]

    fits = fitted(Rotation.random(_STARTS, random_state=seed).as_rotvec())
    if min(fit.cost for fit in fits) > shifts.size:
        # Chance has missed it: most cameras stand about, upright, and look a little down
        around = [Rotation.from_euler("xz", [-110, turn], degrees=True) for turn in _AROUND]
        fits += fitted(rotation.inv().as_rotvec() for rotation in around)
    best = min(fits, key=lambda fit: fit.cost)
    found = camera(best.x, float(best.cost))
    # Plain numbers, so that the camera can be written as JSON
    return Pinhole.from_dict(found.as_dict())


def nearest_to_path(camera: Pinhole, pixel: Any, path: Floats) -> Floats:
    """Where a pixel's ray passes nearest to a path: (3,) action units.

    Args:
        camera: calibrated.
        pixel: (x, y) px.
        path: (n, 3) action units.
    """
    origin, direction = camera.ray(pixel)
    along = origin + ((path - origin) @ direction)[:, None] * direction
    return cast("Floats", along[np.linalg.norm(along - path, axis=1).argmin()])


def solve_displacement(
    camera: Pinhole, place: Floats, shift: Any, growth: float | None, plane: Floats
) -> tuple[Floats, float]:
    """The displacement in action units that explains a shift and a growth in the picture.

    Args:
        camera: calibrated.
        place: (3,) action units, where what moved stood.
        shift: (x, y) px.
        growth: size after over size before; None to leave it out.
        plane: (3,) action units, standard deviations of displacements along each axis.

    Returns:
        (3,) action units; and the misfit: by how many standard deviations shift, growth and plane
        disagree with it (the root of their sum of squares).
    """
    from scipy.optimize import least_squares

    unit = min(camera.size) / 84
    pixel, depth = camera.project(place), camera.depths(place)

    def residuals(x: Floats) -> Floats:
        r = [(camera.project(place + x) - pixel - shift) / (_TARGET_STD * unit), x / plane]
        if growth is not None:
            nearer = depth / np.maximum(camera.depths(place + x), 0.07 * camera.depth)
            r.append(np.atleast_1d(np.log(nearer / growth) / _GROWTH_STD))
        return np.concatenate(r)

    found = least_squares(residuals, np.zeros(3), max_nfev=40)
    return cast("Floats", found.x), float(np.sqrt(2 * found.cost))
