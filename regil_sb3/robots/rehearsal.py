"""A robot to rehearse with: camera and arm of a simulated robot in a process of its own.

What a real robot does to a program it does, too: pictures come late, twice or not at all, the arm
stops by itself when nobody speaks to it, and both can fail at any time.

* ``Rehearsal`` - the process, and the wire to it; gives ``camera``, ``arm`` and ``clock``
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import numpy.typing as npt

from regil_sb3.robots.interfaces import ArmState, Clock, Picture, RealClock, RobotError
from regil_sb3.robots.rehearsal_scene import TASKS
from regil_sb3.robots.rehearsal_server import FAULTS, Disturbances

__all__ = ["Disturbances", "Rehearsal"]

_STARTS = 60.0  # s that the process may take to come up
_SETTLED = 0.004  # m/s: the hand stands still


class Rehearsal:
    """A simulated robot.

    Args:
        task: "reach", "insert" or "open".
        size: height and width of the camera's pictures, in pixels.
        rate: pictures a second.
        disturbances: of the camera.
        real_time: whether time passes by itself. Else it passes when ``clock`` is slept on: the
            same program runs as fast as it can compute, and its control never misses a deadline.

    Attributes:
        camera: as ``RobotEnv`` takes it.
        arm: likewise.
        clock: likewise.
        truth: what only a simulator knows: "solved", "target" (3,) m, "lid" (radians), "speed"
            (m/s), "held" (since when the arm holds still as it was told, or None), "alone" (when it
            last did so by itself, for want of commands).

    Raises:
        ValueError: an unknown task.
        RobotError: the process did not start.
    """

    truth: dict[str, Any]

    def __init__(
        self,
        task: str,
        size: int = 84,
        rate: float = 30.0,
        disturbances: Disturbances | None = None,
        real_time: bool = True,
    ) -> None:
        if task not in TASKS:
            raise ValueError(f"task {task!r} is not one of {', '.join(TASKS)}")
        ours = disturbances or Disturbances()
        here, there = socket.socketpair()
        numbers = (ours.latency, ours.jitter, ours.dropped, ours.duplicated, ours.lighting)
        words = (there.fileno(), task, size, rate, int(real_time), *numbers)
        self._process = subprocess.Popen(
            [sys.executable, "-m", "regil_sb3.robots.rehearsal_server", *map(str, words)],
            pass_fds=[there.fileno()],
            start_new_session=True,  # a terminal's Ctrl-C is the program's; the socket's end is its
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )
        there.close()
        self._socket = here
        self._connection = Connection(os.dup(here.fileno()))
        self._sending = threading.Lock()
        self._listener: threading.Thread | None = None
        self._picture: Picture | None = None
        self._gone: str | None = None
        self._state: ArmState | None = None
        self.truth = {"held": None, "speed": 0.0}
        try:
            if not self._connection.poll(_STARTS):
                raise RobotError(f"the rehearsal robot did not start within {_STARTS:.0f} s")
            _, start = self._connection.recv()
        except (EOFError, RobotError) as error:
            self._process.kill()
            self.close()
            raise RobotError(f"the rehearsal robot did not start {error}".strip()) from None
        self.camera = _Camera(self)
        self.arm = _Arm(self)
        self.clock: Clock = RealClock() if real_time else _LockStep(self._pass_time, start)
        if real_time:
            self._listener = threading.Thread(target=self._listen, daemon=True)
            self._listener.start()
            end = time.monotonic() + _STARTS
            while self._state is None and time.monotonic() < end:
                time.sleep(0.001)
        else:
            self._pass_time(start + 0.05)

    def inject(self, fault: str) -> None:
        """Let something fail.

        Raises:
            ValueError: an unknown fault.
        """
        if fault not in FAULTS:
            raise ValueError(f"fault {fault!r} is not one of {', '.join(FAULTS)}")
        self.send("inject", fault)

    def reset(
        self, off: float, light: float, seed: int, hand: npt.NDArray[np.float64] | None = None
    ) -> None:
        """Put the scene back: what a person would do beside a real robot.

        Args:
            off: how far the target stands from its fixed place, along x (m).
            light: factor on the lamps.
            seed: of the camera's disturbances.
            hand: where the hand is put; None leaves it where it is.
        """
        self.send("reset", hand, off, light, seed)

    def send(self, *order: Any) -> None:
        """Put an order on the wire.

        Raises:
            RobotError: the process is gone.
        """
        try:
            with self._sending:
                self._connection.send(order)
        except OSError as error:
            raise RobotError(f"arm: the rehearsal robot is gone ({error})") from None

    def close(self) -> None:
        """End the process."""
        self._socket.shutdown(socket.SHUT_RDWR)
        if self._listener is not None:
            self._listener.join()
        self._connection.close()
        self._socket.close()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _listen(self) -> None:
        try:
            while True:
                self._take(self._connection.recv())
        except (EOFError, OSError):
            self._gone = self._gone or "camera: the rehearsal robot is gone"

    def _pass_time(self, until: float) -> None:
        """Lock step: let time pass in the process, and take what arrives."""
        try:
            self.send("advance", until)
            while (message := self._connection.recv())[0] != "done":
                self._take(message)
        except (EOFError, OSError):
            self._gone = "camera: the rehearsal robot is gone"  # time passes all the same

    def _take(self, message: tuple[Any, ...]) -> None:
        kind, *rest = message
        if kind == "state":
            position, closed, moment, error, self.truth = rest
            self._state = ArmState(position, closed, moment, error)
        elif kind == "picture":
            self._picture = Picture(*rest)
        else:
            self._gone = rest[0]


class _Camera:
    name = "rehearsal"

    def __init__(self, robot: Rehearsal) -> None:
        self._robot = robot

    def read(self) -> Picture | None:
        if self._robot._gone is not None:
            raise RobotError(self._robot._gone)
        return self._robot._picture

    def recover(self) -> None:
        self._robot.send("recover camera")
        self._robot._gone = None

    def close(self) -> None:
        pass  # camera and arm are one process, which the arm ends


class _Arm:
    def __init__(self, robot: Rehearsal) -> None:
        self._robot = robot

    def state(self) -> ArmState:
        state = self._robot._state
        if state is None:
            raise RobotError("arm: it has said nothing yet")
        return state

    def move(self, position: npt.NDArray[np.float64], closed: bool) -> None:
        self._robot.send("move", position, closed)

    def stop(self) -> None:
        self._robot.send("stop")

    def recover(self) -> None:
        self._robot.send("recover arm")

    def close(self) -> None:
        self._robot.close()


class _LockStep:
    """Time that passes when somebody sleeps."""

    def __init__(self, pass_time: Callable[[float], None], start: float) -> None:
        self._pass_time = pass_time
        self._now = start + 0.05
        self._checks: list[tuple[float, float, Callable[[], None]]] = []  # due, period, what

    def now(self) -> float:
        return self._now

    def sleep_until(self, moment: float) -> None:
        while self._now < moment:
            until = min([moment, *(due for due, _, _ in self._checks)])
            if until > self._now:
                self._pass_time(until)
                self._now = until
            for i, (due, period, check) in enumerate(self._checks):
                if due <= self._now:
                    self._checks[i] = (due + period, period, check)
                    check()

    def every(self, period: float, check: Callable[[], None]) -> Callable[[], None]:
        self._checks.append((self._now + period, period, check))

        def end() -> None:
            self._checks = [entry for entry in self._checks if entry[2] is not check]

        return end
