"""What a correcting guide sees in one episode: what went where, and the path it makes of it.

* ``Moved`` - one thing that moved
* ``GuideView`` - pixels of an episode's first picture
* ``guide_view`` - from a demonstration, that picture and a calibration
* ``guide_picture`` - the two first pictures with all that, as inline SVG
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from regil_wrappers import Demonstration
from regil_wrappers.apart import Apart, register_apart, taken_up
from regil_wrappers.correction import Servo
from regil_wrappers.pinhole import nearest_to_path
from regil_wrappers.registration import Displacement, register

from regil_sb3.report.pictures import data_uri

__all__ = ["GuideView", "Moved", "guide_picture", "guide_view"]

Pixels = npt.NDArray[np.float64]

_COLOURS = ("#6cabff", "#8fcf6c")  # of each thing that moved
_NAMES = ("blue", "green")


class Moved(NamedTuple):
    """One thing that moved, in pixels (x, y) unless said otherwise."""

    what: str
    seen: Pixels  # (2, 2): where it stood, and where it was found
    believed: Pixels  # (2,): where the camera would see it after `shift`
    shift: npt.NDArray[np.float64]  # (3,) action units


class GuideView(NamedTuple):
    """Pixels (x, y) of the pictures."""

    things: list[Moved]  # the target; or what is taken up and where it is brought
    path: Pixels  # (T, 2): the demonstrated path of the hand
    corrected: Pixels  # (T, 2): the corrected one


def guide_view(
    demo: Demonstration, first: npt.NDArray[np.uint8], calibration: dict[str, Any]
) -> GuideView | None:
    """What the guide makes of an episode's first picture; None where it would not correct.

    Where pictures show that what is taken up and the place to which it is brought moved apart, both
    are in it.

    Args:
        demo: with actions; where it states no limits of them, 1, or the largest, is taken.
        first: (H, W, 3) uint8.
        calibration: what `RetrievalGuideWrapper.calibration` gave.

    Raises:
        ValueError: if the calibration is damaged or does not belong to the demonstration.
    """
    if demo.actions is None:
        raise ValueError("the demonstration has no actions")
    most = np.maximum(np.abs(demo.actions).max(axis=0), 1)
    said = (demo.metadata[f"action_{x}"] for x in ("low", "high"))
    low, high = (
        np.array(limit if x is None else x, np.float32)
        for x, limit in zip(said, (-most, most), strict=True)
    )
    dims, plane = calibration.get("translation_dims"), calibration.get("plane")
    if dims is None or plane is None:
        raise ValueError("the calibration says neither translation_dims nor plane")
    height, width = demo.frames.shape[1:3]
    gripper = calibration.get("gripper_dim")  # older ones do not say it
    servo = Servo((height, width), demo.actions, low, high, dims, gripper, plane)
    servo.load_state(calibration)
    found = register(demo.frames[0], first)
    if not servo.cameras or found is None:
        return None
    apart: Apart | None = None
    if servo.grasp is not None and any(way[0] == "released" for way in calibration["ways"]):
        apart = register_apart(demo.frames[0], first, taken_up(demo.frames, servo.grasp))
        # What cannot be believed leaves the place where it stood, and is one target then
        servo.reset(found, apart, kind="released")
    if apart is None or not servo.place_shift.any():
        servo.reset(found, kind="corrected")
    camera = servo.camera
    if camera is None:
        return None
    path = servo.demonstrated_path()

    def moved(what: str, one: Displacement, shift: Pixels) -> Moved:
        place = nearest_to_path(camera, one.point, path)
        seen = np.stack([one.point, np.add(one.point, one.shift)])
        return Moved(what, seen, camera.project(place + shift), shift)

    if servo.kind == "released" and apart is not None:
        named = (
            ("what is taken up", apart.taken, servo.target_shift),
            ("the place to which it is brought", apart.place, servo.place_shift),
        )
        things = [moved(what, one, shift) for what, one, shift in named if one is not None]
    else:
        things = [moved("the target", found, servo.target_shift)]
    return GuideView(things, camera.project(path), camera.project(servo.corrected_path()))


def guide_picture(demo: Demonstration, first: npt.NDArray[np.uint8], view: GuideView | None) -> str:
    """The two first pictures, side by side."""
    if view is None:
        return ""
    height, width = first.shape[:2]

    def line(pixels: Pixels, left: float, colour: str) -> str:
        points = " ".join(f"{left + x + 0.5:.1f},{y + 0.5:.1f}" for x, y in pixels)
        return f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width=".8"/>'

    def ring(pixel: Pixels, left: float, colour: str) -> str:
        x, y = pixel + 0.5
        return (
            f'<circle cx="{left + x:.1f}" cy="{y:.1f}" r="4" fill="none" stroke="{colour}" '
            'stroke-width=".8"/>'
        )

    right = width + 4.0
    images = "".join(
        f'<image class="pixels" x="{x}" width="{width}" height="{height}" '
        f'href="{data_uri(picture, ".png")}"/>'
        for x, picture in ((0.0, demo.frames[0]), (right, first))
    )
    marks = line(view.path, 0, "#ff9c5a") + line(view.corrected, right, _COLOURS[0])
    said = []
    for thing, colour, name in zip(view.things, _COLOURS, _NAMES, strict=False):
        marks += (
            ring(thing.seen[0], 0, colour)
            + ring(thing.seen[0], right, "#ff9c5a")
            + line(thing.seen, right, "#ffffff")
            + ring(thing.believed, right, colour)
        )
        x, y, z = thing.shift
        said.append(f"{thing.what} ({name}) by ({x:.1f}, {y:.1f}, {z:.1f})")
    return (
        f'<svg viewBox="0 0 {2 * width + 4} {height}" role="img" '
        f'aria-label="what the guide sees">{images}{marks}</svg>'
        '<p class="soft small">Left: the first picture of the demonstration, with a ring where '
        "what moved stood, and the hand's path (orange). Right: the first picture of the "
        "evaluation episode; white: from where it stood (orange ring) to where it was found; "
        "rings: where it is believed to be; blue line: the corrected path. Moved, in action "
        f"units: {'; '.join(said)}.</p>"
    )
