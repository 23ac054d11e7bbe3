"""Every episode on disk, whatever happens."""

from __future__ import annotations

import queue
import threading
import warnings
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from regil_wrappers import Demonstration

from regil_sb3.robots.interfaces import RobotError

__all__ = ["EpisodeWriter"]


class EpisodeWriter:
    """Writes each episode as a demonstration's file, in a thread of its own.

    What cannot be written (a full disk) stays in memory and is tried again: by ``retry``, and for
    the last time by ``close``.

    Args:
        folder: made where it is missing.

    Attributes:
        error: why the last attempt failed; None where it did not.

    Raises:
        ValueError: the folder cannot be made.
    """

    def __init__(self, folder: str | Path) -> None:
        self._folder = Path(folder)
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ValueError(f"record_to {str(folder)!r} cannot be made: {error}") from error
        self.error: str | None = None
        self._frames: list[npt.NDArray[np.uint8]] = []
        self._actions: list[npt.NDArray[np.float32]] = []
        self._successes: list[bool] = []
        self._queue: queue.Queue[Demonstration | None] = queue.Queue()
        self._unwritten: list[tuple[Path, Demonstration]] = []
        self._count = 0
        self._started = datetime.now().strftime("%Y%m%d-%H%M%S-%f")
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def begin(self, frame: npt.NDArray[np.uint8]) -> None:
        """An episode begins with this frame."""
        self._frames, self._actions, self._successes = [frame], [], [False]

    def add(
        self, action: npt.NDArray[np.float32], frame: npt.NDArray[np.uint8], success: bool
    ) -> None:
        """This was done, and that was seen."""
        self._actions.append(action)
        self._frames.append(frame)
        self._successes.append(success)

    def end(self, metadata: dict[str, Any]) -> None:
        """The episode is over; one without a single step is none."""
        if self._actions:
            episode = Demonstration(
                np.stack(self._frames),
                actions=np.stack(self._actions),
                successes=np.array(self._successes),
                metadata=metadata,
            )
            self._queue.put(episode)
        self._frames, self._actions, self._successes = [], [], []

    def retry(self) -> None:
        """Try again to write what could not be written, now that there may be room."""
        self._queue.join()
        for path, episode in list(self._unwritten):
            self._write(path, episode)

    def close(self) -> None:
        """Write everything.

        Raises:
            RobotError: an episode could not be written.
        """
        self._queue.put(None)
        self._thread.join()
        self.require_all_written()

    def require_all_written(self) -> None:
        """Try again to write what could not be written.

        Raises:
            RobotError: it still cannot.
        """
        self.retry()
        if self._unwritten:
            raise RobotError(
                f"{len(self._unwritten)} episodes could not be written to {self._folder}: "
                f"{self.error}"
            )

    def _run(self) -> None:
        while (episode := self._queue.get()) is not None:
            path = self._folder / f"{self._started}-{self._count:05d}.hdf5"
            self._count += 1
            self._unwritten.append((path, episode))
            self._write(path, episode)
            self._queue.task_done()
        self._queue.task_done()

    def _write(self, path: Path, episode: Demonstration) -> None:
        try:
            episode.save(path)
        except Exception as error:  # whatever it is, no episode is lost and others follow
            self.error = (
                f"{path.name} was not written ({getattr(error, 'strerror', None) or error})"
            )
            warnings.warn(f"{self.error}; it is kept in memory", RuntimeWarning, stacklevel=2)
        else:
            self._unwritten = [(p, e) for p, e in self._unwritten if p != path]
            self.error = None
