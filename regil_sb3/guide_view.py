"""What a correcting guide sees in one episode: where the target went, and the path it makes of it.

* ``GuideView`` - pixels of an episode's first picture
* ``guide_view`` - from a demonstration, that picture and a calibration
* ``guide_picture`` - the two first pictures with all that, as inline SVG
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from regil_wrappers import Demonstration
from regil_wrappers.correction import Servo
from regil_wrappers.pinhole import nearest_to_path
from regil_wrappers.registration import register

from regil_sb3.pictures import data_uri

__all__ = ["GuideView", "guide_picture", "guide_view"]

Pixels = npt.NDArray[np.float64]


class GuideView(NamedTuple):
    """Pixels (x, y) of the pictures, unless said otherwise."""

    moved: Pixels  # (2, 2): where what moved stood, and where it was found
    believed: Pixels  # (2,): where the camera would see it after `shift`
    shift: npt.NDArray[np.float64]  # (3,) action units
    path: Pixels  # (T, 2): the demonstrated path of the hand
    corrected: Pixels  # (T, 2): the corrected one


def guide_view(
    demo: Demonstration, first: npt.NDArray[np.uint8], calibration: dict[str, Any]
) -> GuideView | None:
    """What the guide makes of an episode's first picture; None where it would not correct.

    Args:
        demo: with actions.
        first: (H, W, 3) uint8.
        calibration: what `RetrievalGuideWrapper.calibration` gave.

    Raises:
        ValueError: if the calibration is damaged or does not belong to the demonstration.
    """
    if demo.actions is None:
        raise ValueError("the demonstration has no actions")
    low, high = (np.array(demo.metadata[f"action_{x}"], np.float32) for x in ("low", "high"))
    dims, plane = calibration.get("translation_dims"), calibration.get("plane")
    if dims is None or plane is None:
        raise ValueError("the calibration says neither translation_dims nor plane")
    height, width = demo.frames.shape[1:3]
    servo = Servo((height, width), demo.actions, low, high, dims, None, plane)
    servo.load_state(calibration)
    found = register(demo.frames[0], first)
    if not servo.cameras or found is None:
        return None
    servo.reset(found, kind="corrected")
    camera = servo.camera
    if camera is None:
        return None
    place = nearest_to_path(camera, found.point, servo.demonstrated_path())
    return GuideView(
        moved=np.stack([found.point, np.add(found.point, found.shift)]),
        believed=camera.project(place + servo.target_shift),
        shift=servo.target_shift,
        path=camera.project(servo.demonstrated_path()),
        corrected=camera.project(servo.corrected_path()),
    )


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
    marks = (
        line(view.path, 0, "#ff9c5a")
        + ring(view.moved[0], 0, "#ff9c5a")
        + line(view.moved, right, "#ffffff")
        + ring(view.moved[0], right, "#ff9c5a")
        + ring(view.believed, right, "#6cabff")
        + line(view.corrected, right, "#6cabff")
    )
    x, y, z = view.shift
    return (
        f'<svg class="matrix" viewBox="0 0 {2 * width + 4} {height}" role="img" '
        f'aria-label="what the guide sees">{images}{marks}</svg>'
        '<p class="soft small">Left: the first picture of the demonstration, where what moved '
        "stood (ring) and the hand's path (orange). Right: the first picture of the evaluation "
        "episode; white: how far it was found to have moved; blue: where the target is believed "
        f"to be, and the corrected path. Displacement ({x:.1f}, {y:.1f}, {z:.1f}) action units.</p>"
    )
