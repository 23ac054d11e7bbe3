"""What a guide remembers while an episode goes on.

* ``Guide`` - suggests one environment's actions, from where it is in the demonstration
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from regil_wrappers.apart import Apart
from regil_wrappers.correction import Servo
from regil_wrappers.matching import Point
from regil_wrappers.registration import Displacement
from regil_wrappers.retrieval import Alignment

__all__ = ["Guide"]


class Guide:
    """Suggests actions: the demonstrator's where the agent is now, corrected or not.

    With several demonstrations, those of the one that is aligned with. The guide makes progress
    where the aligned frame of a demonstration is beyond all of it that the episode has seen.

    Call `begin` with the alignment of an episode's first frame, then `after` each step.

    Args:
        actions: of each demonstration, (T, A) float32.
        offset: frames added to the aligned one.
        patience: steps without progress after which the guide plays on; None: never.
        servo: corrects actions for where the target is; None: nothing does.
    """

    def __init__(
        self,
        actions: Sequence[NDArray[np.float32]],
        offset: int = 0,
        patience: int | None = None,
        servo: Servo | None = None,
    ) -> None:
        self._actions = actions
        self._offset = offset
        self._patience = patience
        self.servo = servo
        self._alignment: Alignment | None = None
        self._furthest: dict[int, int] = {}  # frame of each demonstration that was aligned with
        self._waiting = 0

    def begin(
        self,
        alignment: Alignment,
        displacement: Callable[[], Displacement | None],
        apart: Callable[[int, tuple[Point, Point] | None], Apart],
        shift_at: Callable[[Point], Point],
        seed: int | None = None,
    ) -> None:
        """Begin an episode.

        Args:
            alignment: of its first frame.
            displacement: says what has moved since the demonstration began; asked only where a
                correction uses it.
            apart: says the same of what the demonstration takes up, given the step in which it
                does, and of what else moved, perhaps only near two points; likewise.
            shift_at: says how far what stands round a point has shifted; likewise.
            seed: of the correction's choices; None leaves their stream as it is.
        """
        self._alignment = alignment
        self._furthest = {alignment.demonstration: alignment.end}
        self._waiting = 0
        if self.servo is not None:
            if seed is not None:
                self.servo.reseed(seed)
            self.servo.settle()  # an episode may have been left, or resumed, after its last move
            if not self.servo.calibrated:
                self.servo.reset()
                return
            found = displacement() if self.servo.cameras else None
            grasp, hand = self.servo.grasp_to_look_at(found), self.servo.hand_pixel
            self.servo.reset(
                found,
                None if grasp is None else apart(grasp, self.servo.near),
                hand=None if hand is None else shift_at(hand),
            )

    def after(
        self,
        action: Any,
        suggested: NDArray[np.float32],
        alignment: Alignment,
        picture: NDArray[np.uint8],
        success: bool | None,
    ) -> None:
        """A step was made.

        Args:
            action: what was executed, (A,).
            suggested: what `action` had said.
            alignment: of the frame that followed.
            picture: that frame, as the camera saw it.
            success: whether the episode ended well; None: it goes on.
        """
        self._alignment = alignment
        furthest = self._furthest.get(alignment.demonstration, -1)
        self._waiting = 0 if alignment.end > furthest else self._waiting + 1
        self._furthest[alignment.demonstration] = max(furthest, alignment.end)
        if self.servo is not None:
            self.servo.executed(np.asarray(action, np.float32), suggested, picture)
            if success is not None:
                self.servo.finish(success)

    def action(self) -> NDArray[np.float32]:
        """What to do now, (A,) float32.

        Raises:
            ValueError: before the first episode.
        """
        corrected = self.servo.action() if self.servo is not None else None
        return self.plain() if corrected is None else corrected

    def disturbed(self) -> NDArray[np.float32]:
        """What to execute now where `action` is what to learn, (A,) float32.

        Raises:
            ValueError: before the first episode.
        """
        pushed = self.servo.disturbed() if self.servo is not None else None
        return self.action() if pushed is None else pushed

    def plain(self) -> NDArray[np.float32]:
        """The demonstrator's own action here, (A,) float32.

        Raises:
            ValueError: before the first episode.
        """
        if self._alignment is None:
            raise ValueError(
                "there is no alignment before the first frame: call reset() of the environment"
            )
        demo, frame = self._alignment.demonstration, self._alignment.end
        if self._patience is not None and self._waiting >= self._patience:
            frame = self._furthest[demo] + self._waiting - self._patience
        frame += self._offset
        actions = self._actions[demo]
        action: NDArray[np.float32] = actions[min(max(frame, 0), len(actions) - 1)].copy()
        return action

    @property
    def target_shift(self) -> NDArray[np.float64] | None:
        """(3,) action units: where this episode's target is believed to have gone; None: unknown.

        Unknown without a correction, while it calibrates, and where it replays plainly.
        """
        if self.servo is None or self.servo.kind not in ("corrected", "released"):
            return None
        return self.servo.target_shift

    @property
    def place_shift(self) -> NDArray[np.float64] | None:
        """(3,) action units: the same of where the target is brought.

        What `target_shift` is, unless the correction changes after a grasp.
        """
        if self.servo is None or self.servo.kind != "released":
            return self.target_shift
        return self.servo.place_shift

    def calibration(self) -> dict[str, Any] | None:
        """What a correction has learned about camera and task, as JSON values.

        None before its calibration is over, and without a correction.
        """
        return None if self.servo is None else self.servo.state()

    def set_calibration(self, calibration: dict[str, Any]) -> None:
        """Take over another guide's calibration: same demonstration, same camera.

        Raises:
            ValueError: if it is not one, or from pictures of another size.
        """
        if self.servo is None:
            raise ValueError("a guide without correction takes no calibration")
        self.servo.load_state(calibration)

    def lasting(self) -> dict[str, Any] | None:
        """All that stays when an episode ends; None where nothing does."""
        return None if self.servo is None else self.servo.lasting()

    def set_lasting(self, lasting: dict[str, Any] | None) -> None:
        """Take over what `lasting` gave.

        Raises:
            ValueError: if it is not from such a guide.
        """
        if (self.servo is None) != (lasting is None):
            raise ValueError("what lasts of a guide with correction is not for one without")
        if self.servo is not None and lasting is not None:
            self.servo.set_lasting(lasting)

    def said(self) -> dict[str, Any]:
        """What ``info["retrieval"]`` holds of it."""
        said: dict[str, Any] = {"guide_action": self.action()}
        if self.servo is not None:
            said |= {"guide": self.servo.kind, "calibrating": self.servo.calibrating}
        return said
