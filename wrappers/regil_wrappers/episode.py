"""One environment's current episode, held beside the demonstration.

* ``Episode`` - its pictures, what has moved in them, and their alignment
"""

from __future__ import annotations

import copy
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from regil_wrappers.apart import Apart, arm_at_start, register_apart, round_point, taken_up
from regil_wrappers.frames import FrameSource
from regil_wrappers.matching import Point
from regil_wrappers.registration import Displacement, moved_back, register, shift_since
from regil_wrappers.retrieval import Retriever

__all__ = ["Episode"]

_TAKEN = 16.0  # px at 84 pixels round where the hand grasps: what is taken up is there
_PLACE = 14.0  # px at 84 pixels round where what it holds ends


class Episode:
    """Gives a retriever the pictures of one environment, one episode after the other.

    Call `begin` where an episode begins, then `picture` for each frame.

    Args:
        retriever: what the pictures are for.
        frames: where they come from.
        moves_back: whether they are moved back by what has moved since the demonstration began.
    """

    def __init__(self, retriever: Retriever, frames: FrameSource, moves_back: bool) -> None:
        self.retriever = retriever
        self.frames = frames
        self._moves_back = moves_back
        self._said: set[str] = set()
        self._taken: NDArray[np.bool_] | None = None
        self._arms: dict[int, NDArray[np.bool_]] = {}  # by the step of the grasp
        self.begin()

    def begin(self) -> None:
        """Forget the last episode."""
        self.retriever.reset()
        self._last: NDArray[np.uint8] | None = None
        self._first: NDArray[np.uint8] | None = None
        self._registered = False
        self._displacement: Displacement | None = None

    def another(self) -> Episode:
        """The next one of the same environment, begun, with a retriever of its own."""
        twin = copy.copy(self)
        twin.retriever = self.retriever.another()
        twin.begin()
        return twin

    def picture(self, raw: Any) -> NDArray[np.uint8]:
        """The picture to align, (H, W, 3) uint8, from what `FrameSource.raw` gave."""
        self._last = seen = self.frames.picture(raw)
        if self._first is None:
            self._first = seen.copy()
        return moved_back(seen, self.displacement) if self._moves_back else seen

    @property
    def last(self) -> NDArray[np.uint8]:
        """The last picture, (H, W, 3) uint8, as the camera saw it.

        Raises:
            ValueError: before the first one.
        """
        if self._last is None:
            raise ValueError("there is no picture yet: call reset() of the environment")
        return self._last

    @property
    def displacement(self) -> Displacement | None:
        """What moved between the demonstration's first picture and this episode's; None: nothing.

        Found when it is first asked for in an episode (about 0.1 s at 84x84, longer by its pixels).

        Raises:
            ValueError: before the first picture.
        """
        if self._first is None:
            raise ValueError("there is no picture yet: call reset() of the environment")
        if not self._registered:
            first = self.frames.recorded_first
            self._displacement = found = register(first, self._first, self._without_arm)
            self._registered = True
            if found is not None and any(found.camera):
                x, y = found.camera
                self._say_once(
                    "the camera has moved since the demonstration",
                    f"what stands still is shifted by ({x:.1f}, {y:.1f}) pixels, which is taken "
                    "out",
                )
            if found is not None and found.another_scene and self._moves_back:
                self._say_once(
                    "camera or scene are others than the demonstration's",
                    f"{found.changed:.0%} of the picture differ; pictures are not moved back "
                    "(register) while that lasts",
                )
        return self._displacement

    def _say_once(self, what: str, how: str) -> None:
        if what not in self._said:
            self._said.add(what)
            warnings.warn(f"{what}: {how}", stacklevel=3)

    def apart(self, grasp: int, near: tuple[Point, Point] | None = None) -> Apart:
        """How far what the demonstration takes up has moved, and what else; found anew each time.

        Args:
            grasp: the step in which its gripper closes.
            near: (x, y) px, where the demonstration's hand grasps and where it ends. Then only what
                stands near them counts, and not the arm: other things may move too. None: all does.

        Raises:
            ValueError: before the first picture.
        """
        if self._first is None:
            raise ValueError("there is no picture yet: call reset() of the environment")
        if self._taken is None:
            self._taken = taken_up(self.frames.recorded, grasp)
        taken, among = self._taken, self._without_arm
        if near is None:
            taken = taken if among is None else taken & among
        else:
            arm = self._arm_of(grasp)
            at_grasp, at_end = near
            taken = taken & self._round(at_grasp, _TAKEN) & ~arm
            if taken.any():  # where the hand ends, seen from what it holds
                ys, xs = np.nonzero(taken)
                at_end = np.array([xs.mean(), ys.mean()]) + at_end - at_grasp
            among = (self._round(at_grasp, _TAKEN) | self._round(at_end, _PLACE)) & ~arm
        return register_apart(self.frames.recorded_first, self._first, taken, among)

    @property
    def _without_arm(self) -> NDArray[np.bool_] | None:
        """The pixels that count where the arm starts elsewhere: it would be what has moved."""
        if not self.frames.hand_starts_elsewhere:
            return None
        return ~self._arm_of(len(self.frames.recorded) // 4)

    def _arm_of(self, grasp: int) -> NDArray[np.bool_]:
        if grasp not in self._arms:
            self._arms[grasp] = arm_at_start(self.frames.recorded, grasp)
        return self._arms[grasp]

    def _round(self, point: Point, radius: float) -> NDArray[np.bool_]:
        height, width = self.frames.recorded_first.shape[:2]
        return round_point((height, width), point, radius)

    def shift_at(self, point: Point) -> Point:
        """How far what stands round a point (x, y) px has shifted since the demonstration began.

        The point is as the camera sees it now; light, and a turn of the camera, are taken out.

        Raises:
            ValueError: before the first picture.
        """
        if self._first is None:
            raise ValueError("there is no picture yet: call reset() of the environment")
        return shift_since(self.frames.recorded_first, self._first, point)
