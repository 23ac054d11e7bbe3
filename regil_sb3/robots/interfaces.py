"""What an environment needs of a camera, an arm and a clock.

* ``Camera``, ``Arm`` - protocols of few methods, none of which waits
* ``Picture``, ``ArmState`` - what they give, with the time it was true
* ``Clock``, ``RealClock`` - the time that passes, and who is called as it does
* ``RobotError``, ``first_line`` - what is wrong, in one line
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

__all__ = ["Arm", "ArmState", "Camera", "Clock", "Picture", "RealClock", "RobotError", "first_line"]


class RobotError(OSError):
    """A camera, an arm or a person stopped the robot; the message says which, and why."""


@dataclass(frozen=True)
class Picture:
    """One picture of a camera.

    Attributes:
        image: (H, W, 3) uint8, RGB, upright.
        time: when it was taken, in the clock's seconds.
    """

    image: npt.NDArray[np.uint8]
    time: float


@dataclass(frozen=True)
class ArmState:
    """What an arm says of itself.

    Attributes:
        position: (3,) m, of the finger tips in the base's frame: forward, left, up or as the arm
            has it; the environment's limits are in the same frame.
        closed: whether the gripper was last told to close.
        time: when this was so, in the clock's seconds.
        error: why the arm does not move, or None.
    """

    position: npt.NDArray[np.float64]
    closed: bool
    time: float
    error: str | None = None


class Camera(Protocol):
    """Gives the newest picture. No method but ``recover`` waits."""

    def read(self) -> Picture | None:
        """The newest picture; None before the first.

        Raises:
            RobotError: the camera is gone.
        """

    def recover(self) -> None:
        """Try to bring a camera back that failed.

        Raises:
            RobotError: it did not come back.
        """

    def close(self) -> None:
        """Give the camera back."""


class Arm(Protocol):
    """Moves a hand. No method but ``recover`` waits, and each may be called from any thread."""

    def state(self) -> ArmState:
        """The newest state.

        Raises:
            RobotError: the arm does not answer.
        """

    def move(self, position: npt.NDArray[np.float64], closed: bool) -> None:
        """Go to (3,) m, and open or close the gripper: replaces what was asked before.

        Raises:
            RobotError: the arm does not take it.
        """

    def stop(self) -> None:
        """Hold still at once; no ``move`` counts until ``recover``.

        Raises:
            RobotError: the arm does not answer; arms stop by themselves then.
        """

    def recover(self) -> None:
        """Make a stopped or failed arm ready to move.

        Raises:
            RobotError: it is not.
        """

    def close(self) -> None:
        """Give the arm back, standing still."""


class Clock(Protocol):
    """The time that an environment lives in, in seconds."""

    def now(self) -> float:
        """What time it is."""

    def sleep_until(self, moment: float) -> None:
        """Let time pass until then."""

    def every(self, period: float, check: Callable[[], None]) -> Callable[[], None]:
        """Call ``check`` once a period, whatever else waits or computes; returns what ends it."""


class RealClock:
    """Time as it passes. ``every`` calls from a thread of its own."""

    def now(self) -> float:
        """Seconds of the system's monotonic clock, which all processes share."""
        return time.monotonic()

    def sleep_until(self, moment: float) -> None:
        """Sleep; returns at once where the moment has passed."""
        time.sleep(max(moment - time.monotonic(), 0.0))

    def every(self, period: float, check: Callable[[], None]) -> Callable[[], None]:
        """Call ``check`` once a period from a thread; returns what ends the thread."""
        ended = threading.Event()

        def run() -> None:
            due = time.monotonic() + period
            while not ended.wait(max(due - time.monotonic(), 0.0)):
                check()
                due = max(due + period, time.monotonic())

        thread = threading.Thread(target=run, daemon=True)
        thread.start()

        def end() -> None:
            ended.set()
            if thread is not threading.current_thread():
                thread.join()

        return end


def first_line(error: Exception) -> str:
    """What a library's error says, in one line."""
    return str(error).splitlines()[0] if str(error) else type(error).__name__
