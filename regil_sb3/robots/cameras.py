"""Cameras: whatever OpenCV opens, and Intel RealSense.

Each grabs in a thread of its own, so that reading never waits. A picture's time is that of its
arrival in this computer.
"""

from __future__ import annotations

import contextlib
import threading
import time
from importlib import import_module
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from regil_sb3.robots.interfaces import Picture, RobotError, first_line

__all__ = ["GrabbingCamera", "OpenCVCamera", "RealSenseCamera"]

_FROZEN = 3  # times that a picture comes again: no sensor's does


class GrabbingCamera:
    """Keeps the newest picture; subclasses open, grab (which may wait) and release."""

    def __init__(self, name: str, size: tuple[int, int], rate: int) -> None:
        self.name, self._size, self._rate = name, size, rate
        self._picture: Picture | None
        self._error: str | None
        self._start()

    def _start(self) -> None:
        self._picture, self._error, self._ends = None, None, False
        self._repeats = 0
        self._open()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def read(self) -> Picture | None:
        """The newest picture; None before the first.

        Raises:
            RobotError: the camera is gone.
        """
        if self._error is not None:
            raise RobotError(self._error)
        return self._picture

    def recover(self) -> None:
        """Open it again, if it is gone, or repeats one picture.

        Raises:
            RobotError: it cannot be opened.
        """
        if self._error is not None or not self._thread.is_alive() or self._repeats >= _FROZEN:
            self.close()
            try:
                self._start()
            except Exception as error:  # of whatever kind a driver's library raises
                named = "" if isinstance(error, ValueError) else f"camera {self.name}: "
                self._error = named + first_line(error)
                raise RobotError(self._error) from None

    def close(self) -> None:
        """Give it back."""
        self._ends = True
        self._thread.join(2.0)
        self._release()

    def _run(self) -> None:
        while not self._ends:
            try:
                image = self._grab()
            except Exception as error:  # see above
                self._error = f"camera {self.name}: {first_line(error)}"
                return
            before, self._picture = self._picture, Picture(image, time.monotonic())
            same = before is not None and np.array_equal(before.image, image)
            self._repeats = self._repeats + 1 if same else 0

    def _wrong_size(self, height: int, width: int) -> ValueError:
        return ValueError(
            f"camera {self.name} gives {width}x{height} pictures, not "
            f"{self._size[0]}x{self._size[1]}: ask for a resolution that it has"
        )

    def _open(self) -> None:
        raise NotImplementedError

    def _grab(self) -> npt.NDArray[np.uint8]:
        raise NotImplementedError

    def _release(self) -> None:
        raise NotImplementedError


class OpenCVCamera(GrabbingCamera):
    """A camera that OpenCV opens: USB, network, or a film in place of one.

    Args:
        source: its number, or an address or file.
        size: width and height in pixels.
        rate: pictures a second to ask for.

    Raises:
        ValueError: there is no such camera, or not with that resolution.
    """

    def __init__(
        self, source: int | str = 0, size: tuple[int, int] = (640, 480), rate: int = 30
    ) -> None:
        self._source = source
        super().__init__(f"opencv:{source}", size, rate)

    def _open(self) -> None:
        self._capture = cv2.VideoCapture(self._source)
        if not self._capture.isOpened():
            raise ValueError(f"camera {self.name} cannot be opened: is it there, and free?")
        for what, value in (
            (cv2.CAP_PROP_FRAME_WIDTH, self._size[0]),
            (cv2.CAP_PROP_FRAME_HEIGHT, self._size[1]),
            (cv2.CAP_PROP_FPS, self._rate),
            (cv2.CAP_PROP_BUFFERSIZE, 1),
        ):
            self._capture.set(what, value)
        good, image = self._capture.read()
        if not good or image.shape[:2] != self._size[::-1]:
            self._capture.release()
            if good:
                raise self._wrong_size(*image.shape[:2])
            raise ValueError(f"camera {self.name} gives no picture")

    def _grab(self) -> npt.NDArray[np.uint8]:
        good, image = self._capture.read()
        if not good:
            raise OSError("it gives no more pictures")
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8)

    def _release(self) -> None:
        self._capture.release()


class RealSenseCamera(GrabbingCamera):
    """The colour camera of an Intel RealSense (D435 and its kind); needs ``pyrealsense2``.

    Args:
        serial: of the device; None takes the first.
        size: width and height in pixels.
        rate: pictures a second.

    Raises:
        ImportError: ``pyrealsense2`` is not installed.
        ValueError: there is no such camera, or not with that resolution and rate.
    """

    def __init__(
        self, serial: str | None = None, size: tuple[int, int] = (640, 480), rate: int = 30
    ) -> None:
        self._serial = serial
        try:
            pyrealsense2: Any = import_module("pyrealsense2")
        except ModuleNotFoundError:
            raise ImportError(
                "pyrealsense2 is not installed: pip install 'regil-sb3[realsense]'"
            ) from None
        self._library: Any = pyrealsense2
        super().__init__(f"realsense:{serial or 'first'}", size, rate)

    def _open(self) -> None:
        library = self._library
        config = library.config()
        if self._serial is not None:
            config.enable_device(self._serial)
        config.enable_stream(library.stream.color, *self._size, library.format.rgb8, self._rate)
        self._pipeline = library.pipeline()
        try:
            self._pipeline.start(config)
        except RuntimeError as error:
            raise ValueError(
                f"camera {self.name} cannot be opened at {self._size[0]}x{self._size[1]}, "
                f"{self._rate} Hz: {error}"
            ) from None

    def _grab(self) -> npt.NDArray[np.uint8]:
        frames = self._pipeline.wait_for_frames(1000)
        # A copy: the library uses the memory again
        return np.array(frames.get_color_frame().get_data(), np.uint8)

    def _release(self) -> None:
        with contextlib.suppress(RuntimeError):  # it was never started, or is unplugged
            self._pipeline.stop()
