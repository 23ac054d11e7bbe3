"""Crash-safe checkpoints, from which training goes on as if it had never stopped.

* ``CheckpointCallback`` - saves now and then, and when the process is told to end
* ``Preempted`` - ends a process that was told to: exit status 75, "try again"

A checkpoint executes nothing when it is read: it is JSON and arrays
(`regil_sb3.checkpoint.generations`).
"""

from __future__ import annotations

import os
import signal
import threading
import time
import warnings
from os import PathLike
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from regil_sb3 import __version__
from regil_sb3.background import at_rest
from regil_sb3.checkpoint.generations import Generations
from regil_sb3.checkpoint.learner_state import check_can_be_kept, learner_state, load_learner_state
from regil_sb3.td3bc import TD3BC
from regil_sb3.watch import require_finite_parameters

__all__ = ["CheckpointCallback", "Preempted"]

TRY_AGAIN = 75  # EX_TEMPFAIL of sysexits.h
_KEPT = (str, bool, int, float, np.number, np.bool_)
_SHARE = 0.05  # of the time, at most, goes into saving


class Preempted(SystemExit):
    """The process was told to end (SIGTERM), and training can go on later."""

    def __init__(self) -> None:
        super().__init__(TRY_AGAIN)


class CheckpointCallback(BaseCallback):
    """Saves all that decides how learning goes on, so that it may be killed at any moment.

    Going on from a checkpoint, `TD3BC` learns to the last bit what it would have learned without
    the interruption, where each environment is wrapped in `ReplayableEpisode`
    (regil_sb3.checkpoint.open_episode) and its episodes follow from its generator and the actions.
    Else the open episodes are ended as truncated, and a warning says so.

    SIGTERM (a scheduler's preemption) and Ctrl-C save after the step that is under way, and end in
    `Preempted` (exit status 75) or KeyboardInterrupt. What takes longer than ``grace`` is broken
    off then; the last checkpoint stays.

    Example:
        >>> from regil_sb3 import TD3BC
        >>> from regil_sb3.checkpoint import CheckpointCallback
        >>> def life(folder, env, steps):
        ...     model = TD3BC("MlpPolicy", env, bc_coef=0, warmup_steps=0, buffer_size=100)
        ...     checkpoints = CheckpointCallback(folder, steps=20)
        ...     done = checkpoints.restore(model)  # 0 where there is no checkpoint yet
        ...     anew = not checkpoints.restored
        ...     model.learn(steps - done, checkpoints, reset_num_timesteps=anew)
        ...     return done
        >>> env = ReplayableEpisode(gym.make("Pendulum-v1"))
        >>> life(folder, env, 50), life(folder, env, 70)
        (0, 40)

    Args:
        folder: of the checkpoints.
        seconds: between two of them, or more, where saving would else take over a twentieth of the
            time.
        steps: instead: environment steps between two of them.
        keep: how many stay.
        max_bytes: what all may take on disk; the oldest go first, the newest never. None: anything.
        grace: seconds from SIGTERM or Ctrl-C to the end of the process.
        log: a text file that goes back to what it held then: a logger's.

    Attributes:
        restored: whether `restore` found a checkpoint; the first one is of step 0, and ``learn``
            must not begin anew after it, either.

    Raises:
        ValueError: an argument is out of range; from `restore` and ``learn``, if the model does not
            fit, or holds what a checkpoint does not.
    """

    def __init__(
        self,
        folder: str | PathLike[str],
        seconds: float = 300.0,
        steps: int | None = None,
        keep: int = 2,
        max_bytes: int | None = None,
        grace: float = 20.0,
        log: Path | None = None,
    ) -> None:
        super().__init__()
        if seconds < 0 or grace <= 0 or (steps is not None and steps < 1):
            raise ValueError(
                f"seconds={seconds}, steps={steps}, grace={grace}: they must be positive"
            )
        self.generations = Generations(Path(folder), keep, max_bytes)
        self.seconds, self.steps, self.grace, self.log = seconds, steps, grace, log
        self.restored = False
        self._process = os.getpid()
        self._told: int | None = None  # the signal that came
        self._saving = False
        self._before: dict[int, Any] = {}  # signals' handlers of others
        self._saved_at = 0  # the step of the last checkpoint
        self._tried_at = 0  # the step at which the last one was to be saved
        self._reached = 0  # the last step that was seen; a smaller one is of another learn()
        self._began_anew = False  # learn() did, and no checkpoint is of it yet
        self._had_some = False  # whether there were checkpoints
        self._next = 0.0  # the time of the next one, on time.monotonic
        self._failed = ""
        self._pending: list[dict[str, Any]] = []  # of the logger

    def restore(self, model: TD3BC) -> int:
        """Bring a new model to where the newest checkpoint left one like it.

        Returns:
            the steps it has learned for; 0 where there is no checkpoint (``restored`` says so), or
            it is of the beginning.

        Raises:
            ValueError: the checkpoint is of another model or of other environments.
            MemoryError: it would not fit into memory.
        """
        state = self.generations.load()
        self.restored = state is not None
        if state is None:
            return 0
        check_can_be_kept(model)
        try:
            lost = load_learner_state(model, state["learner"])
        except (LookupError, TypeError, AttributeError) as error:
            raise ValueError(
                f"the checkpoint in {self.generations.folder} was written by regil-sb3 "
                f"{self.generations.written_by}, and regil-sb3 {__version__} cannot go on from it "
                f"({type(error).__name__}: {error}): go on with that version, or remove the folder "
                "to begin anew"
            ) from error
        if lost:
            warnings.warn(
                f"going on at step {model.num_timesteps}, the open episodes are ended as "
                f"truncated: {'; '.join(lost)}",
                stacklevel=2,
            )
        if self.log is not None and state["log"] is not None:
            self.log.write_text(state["log"], encoding="utf-8")
        self._pending = state["logger"]
        self._saved_at = self._tried_at = self._reached = model.num_timesteps
        self._had_some = True
        return int(model.num_timesteps)

    def save(self) -> None:
        """Save now.

        Raises:
            OSError: it could not be written; the earlier ones are as they were.
            FloatingPointError: a parameter is not finite; likewise.
        """
        model = self.model
        assert isinstance(model, TD3BC)
        with at_rest(model):
            self._save(model)

    def _save(self, model: TD3BC) -> None:
        require_finite_parameters(model)
        has_log = self.log is not None and self.log.exists()
        # Figures, films and hyperparameters that are not yet logged are not kept
        values = self.logger.name_to_value.items()
        names = {name for name, value in values if isinstance(value, _KEPT)}
        self._saving = True
        try:
            self.generations.save(
                {
                    "learner": learner_state(model),
                    "logger": [
                        {name: value for name, value in part.items() if name in names}
                        for part in _logged(self.logger)
                    ],
                    "log": self.log.read_text(encoding="utf-8") if self.log and has_log else None,
                }
            )
        finally:
            self._saving = False
        self._saved_at, self._had_some = self.num_timesteps, True
        self._began_anew = False

    def _on_training_start(self) -> None:
        assert isinstance(self.model, TD3BC)
        check_can_be_kept(self.model)
        self._told = None
        if self.num_timesteps < self._reached:
            self._tried_at, self._began_anew = self.num_timesteps, True
        if self._pending:
            for part, kept in zip(_logged(self.logger), self._pending, strict=False):
                part.update(kept)  # older checkpoints hold two parts
            self._pending = []
        self._next = time.monotonic() + self.seconds
        if threading.current_thread() is threading.main_thread():
            self._process = os.getpid()
            for number in (signal.SIGTERM, signal.SIGINT):
                self._before[number] = signal.signal(number, self._tell)

    def _on_rollout_start(self) -> None:
        self._reached = self.num_timesteps
        if self._told is not None:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            is_saved = self.num_timesteps == self._saved_at and not self._began_anew
            if not is_saved or not self.generations.numbers:
                self._save_or_warn()
            raise self._end(self._told)
        missing = not self.generations.numbers
        if missing and self._had_some:
            self._had_some = False
            warnings.warn(
                f"the checkpoints in {self.generations.folder} are gone: training goes on, and one "
                f"is saved at step {self.num_timesteps}",
                stacklevel=2,
            )
            self._save_or_warn()
        elif (missing or self._began_anew) and not self._failed:
            self._save_or_warn()
        elif self.steps is not None:
            if self.num_timesteps - self._tried_at >= self.steps:
                self._save_or_warn()
        elif time.monotonic() >= self._next:
            self._save_or_warn()

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self.close()

    def close(self) -> None:
        """Leave signals to who had them before; done at the end of ``learn``."""
        for number, handler in self._before.items():
            # None: not set from Python
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        if self._before:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        self._before = {}

    def _save_or_warn(self) -> None:
        began, self._tried_at = time.monotonic(), self.num_timesteps
        try:
            self.save()
            self._failed = ""
        except OSError as error:
            if str(error) != self._failed:
                self._failed = str(error)
                last = f"the last one is of step {self._saved_at}"
                warnings.warn(
                    f"the checkpoint at step {self.num_timesteps} could not be saved ({error}): "
                    f"training goes on; {last if self.generations.numbers else 'there is none'}",
                    stacklevel=2,
                )
        took = time.monotonic() - began
        self._next = time.monotonic() + max(self.seconds, took * (1 / _SHARE - 1))

    def _tell(self, number: int, _: FrameType | None) -> None:
        """A signal came: save at the next step, or else end all the same."""
        if os.getpid() != self._process:  # an environment's, forked from this one
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)
        if self._told is not None:  # a second time; a save that is broken off loses no other
            raise self._end(self._told)
        self._told = number
        self._before.setdefault(signal.SIGALRM, signal.signal(signal.SIGALRM, self._break_off))
        signal.setitimer(signal.ITIMER_REAL, self.grace)

    def _break_off(self, number: int, _: FrameType | None) -> None:
        if self._saving:  # it is nearly done, and the end comes right after it
            return
        raise self._end(self._told if self._told is not None else number)

    @staticmethod
    def _end(number: int) -> BaseException:
        return KeyboardInterrupt() if number == signal.SIGINT else Preempted()


def _logged(logger: Logger) -> list[dict[str, Any]]:
    """What it has been given and has not written yet."""
    return [logger.name_to_value, logger.name_to_count, logger.name_to_excluded]
