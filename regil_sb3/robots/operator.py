"""A person beside the robot.

* ``Keyboard`` - success, abort and pause from a terminal; moving the hand is ``regil record``'s
"""

from __future__ import annotations

import os
import select
import sys
import termios
import threading
import tty

__all__ = ["Keyboard"]


class Keyboard:
    """Keys pressed in a terminal: the `Operator` of a `RobotEnv`.

    ``s`` success; ``x`` abort: the arm stops and the episode ends; space pauses and goes on; Enter
    says that what was asked for is done.

    Args:
        descriptor: of the terminal; None is standard input's.

    Raises:
        ValueError: it is no terminal.
    """

    def __init__(self, descriptor: int | None = None) -> None:
        self._descriptor = sys.stdin.fileno() if descriptor is None else descriptor
        if not os.isatty(self._descriptor):
            raise ValueError("the operator's keys come from a terminal, and this is none")
        self._before = termios.tcgetattr(self._descriptor)
        tty.setcbreak(self._descriptor)
        self._success = self._abort = self._pause = False
        self._ready = threading.Event()
        self._ends = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def succeeded(self) -> bool:
        """Whether ``s`` was pressed since this was last asked."""
        pressed, self._success = self._success, False
        return pressed

    def aborted(self) -> bool:
        """Whether ``x`` was pressed; until `ready`."""
        return self._abort

    def paused(self) -> bool:
        """Whether space was pressed an odd number of times."""
        return self._pause

    def ready(self, message: str) -> None:
        """Print what is to be done, and wait for Enter."""
        print(f"{message} (Enter)", file=sys.stderr, flush=True)
        self._ready.clear()
        self._ready.wait()
        self._abort = self._success = False

    def close(self) -> None:
        """Give the terminal back as it was."""
        if self._ends:
            return
        self._ends = True
        self._thread.join()
        termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._before)

    def _run(self) -> None:
        while not self._ends:
            if select.select([self._descriptor], [], [], 0.05)[0]:
                for key in os.read(self._descriptor, 64).decode(errors="ignore"):
                    self._press(key)

    def _press(self, key: str) -> None:
        self._success |= key == "s"
        self._abort |= key == "x"
        self._pause ^= key == " "
        if key in "\r\n":
            self._ready.set()
