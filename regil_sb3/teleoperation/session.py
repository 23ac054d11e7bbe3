"""Record a demonstration by hand.

* ``Session`` - the episode: steps, undo, success; knows no window and no device
* ``teleoperate`` - the loop of window, device and session, until a demonstration is kept
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from regil_wrappers import Demonstration
from regil_wrappers.frames import stated

from regil_sb3.envs import exists_once
from regil_sb3.recording import Recorder, check_seeds, make_env
from regil_sb3.teleoperation.devices import Axes, Command, Device, make_device
from regil_sb3.teleoperation.window import Window

__all__ = ["Clock", "Session", "teleoperate"]

_UNDONE = 1.0  # s of the environment that one undo takes back
_SETTLE = 0.3  # s in which time passes after the gripper was told to move, or when asked for
_USUAL_RATE = 20.0  # actions a second, where the environment does not say
_PAUSE = 1.0  # s before a film begins again


class Clock(Protocol):
    """What paces the loop."""

    def tick(self, rate: float) -> Any:
        """Wait until it is time for the next step."""
        ...


class Session:
    """One episode that a person plays.

    Args:
        recorder: takes it down.
        seed: of the episode.
    """

    def __init__(self, recorder: Recorder, seed: int) -> None:
        self.recorder = recorder
        self.repeatable = not exists_once(recorder.env)
        self.said = ""
        self.begin(seed)

    def begin(self, seed: int) -> None:
        """Begin an episode."""
        self.recorder.begin(seed)
        self.closed = False
        self._grips = [False]  # before each step, and now

    def step(self, action: npt.NDArray[np.float32], closed: bool) -> None:
        """Execute an action; ``closed`` is what the gripper was told."""
        self.recorder.step(action)
        self.closed = closed
        self._grips.append(closed)
        self.said = ""

    def succeed(self) -> bool:
        """The person says that it is done; whether there is anything to be done."""
        if not len(self.recorder):
            self.said = "nothing has been done yet"
            return False
        self.recorder.successes[-1] = self.recorder.over = True
        return True

    def undo(self, steps: int) -> None:
        """Take back the last steps: the others are replayed from the same seed.

        Where that leads elsewhere, the environment does not repeat itself: nothing of the episode
        can be kept then, and it begins anew. A robot is not made to repeat what it has done.
        """
        if not self.repeatable:
            self.said = "a robot takes nothing back: begin again"
            return
        old, grips = self.recorder, self._grips
        keep = max(len(old) - steps, 0)
        frames, actions, seed = old.frames[: keep + 1], old.actions[:keep], old.seed
        self.begin(seed)
        for action, closed in zip(actions, grips[1 : keep + 1], strict=True):
            if self.recorder.over:
                break
            self.step(action, closed)
        seen = self.recorder.frames
        if len(seen) != len(frames) or not all(map(np.array_equal, seen, frames)):
            self.begin(seed)
            self.said = (
                "this environment does not repeat itself, so nothing can be undone: "
                "the episode began again"
            )
            return
        self.said = f"undone: {len(grips) - 1 - keep} steps"


def teleoperate(
    env_id: str,
    device: Device | str = "keyboard",
    seed: int = 0,
    env_kwargs: dict[str, Any] | None = None,
    encoder_frame_size: int | None = None,
    live: bool = False,
    clock: Clock | None = None,
) -> Demonstration | None:
    """Let a person play until one episode is kept.

    The environment waits: a step is taken while something is pressed, so that a demonstration has
    no idle frames. When the environment says success, or the person does, the episode is shown
    again, to be kept, to be gone on with, or to be begun anew with the next seed.

    Args:
        env_id: id of an environment with continuous actions.
        device: "keyboard", "gamepad" or "spacemouse", or such an object. The keyboard's commands
            always work.
        seed: of the first episode.
        env_kwargs: arguments for `gymnasium.make`.
        encoder_frame_size: height and width (pixels) of the larger pictures to keep beside the
            frames, for an encoder that wants them; None keeps none.
        live: whether time passes also while nothing is pressed.
        clock: paces the loop; None: pygame's.

    Returns:
        T actions and T + 1 frames, ending with the first success; None where the person gave up.

    Raises:
        ValueError: where actions are not continuous, there are no pictures, no such device, no
            window, or a seed belongs to evaluation.
        ImportError: of one line, if a package is not installed.
    """
    check_seeds(seed)
    with closing(make_env(env_id, env_kwargs)) as env:
        recorder = Recorder(env, encoder_frame_size)
        name = device if isinstance(device, str) else type(device).__name__.lower()
        with closing(Window(f"regil record {env_id}")) as window:
            made = make_device(device) if isinstance(device, str) else device
            with closing(made):
                loop = _Loop(recorder, seed, made, window, live, clock)
                if not loop.run():
                    return None
        said = "success said by the environment" if loop.by_env else "success said by a person"
        return recorder.demonstration(env_id, provenance=[f"steered by hand ({name}), {said}"])


class _Loop:
    def __init__(
        self,
        recorder: Recorder,
        seed: int,
        device: Device,
        window: Window,
        live: bool,
        clock: Clock | None,
    ) -> None:
        said = stated(recorder.env.unwrapped.metadata)
        self._rate = float(said.get("control_rate") or _USUAL_RATE)
        self._axes = Axes.of(recorder.space, said)
        self._session = Session(recorder, seed)
        self._recorder, self._device, self._window = recorder, device, window
        self._live = live
        self._clock = clock or window.clock()
        self._settle = math.ceil(_SETTLE * self._rate)
        self._passing = 0  # steps in which time passes by itself
        self.by_env = False

    def run(self) -> bool:
        """Play; whether an episode is to be kept."""
        while True:
            if not self._play():
                return False
            answer = self._review()
            if answer == "success":
                return True
            if answer == "quit":
                return False
            if answer == "again":
                self._again()
            else:
                self._undo()

    def _commands(self) -> Iterator[Command]:
        """Everything that was pressed since it was last asked."""
        for event in self._window.events():
            yield from self._window.handle(event)
            yield from self._device.handle(event)
        yield from self._device.poll()

    def _play(self) -> bool:
        """Until the episode is over; False: the person gave up."""
        session = self._session
        while not self._recorder.over:
            closed = session.closed
            for command in self._commands():
                if command == "quit":
                    return False
                if command == "undo":
                    self._undo()
                    closed = session.closed
                elif command == "again":
                    self._again()
                    closed = False
                elif command == "success" and session.succeed():
                    self.by_env = False
                    return True
                elif command == "turn":
                    self._axes.quarters = (self._axes.quarters + 1) % 4
                    session.said = f"directions turned by {90 * self._axes.quarters} degrees"
                elif command == "wait":
                    self._passing = self._settle
                elif command == "gripper" and self._axes.gripper is not None:
                    closed = not closed
                    session.closed = closed
                    self._passing = self._settle
            motion = self._device.motion()
            if motion.any() or self._passing or self._live:
                session.step(self._axes.action(motion, closed), closed)
                self._passing = max(self._passing - 1, 0)
                self.by_env = self._recorder.solved
            self._show(self._window.sees(self._recorder))
            self._clock.tick(self._rate)
        self._passing = 0
        return True

    def _review(self) -> Command:
        """Show the episode over and over until something is decided."""
        recorder, solved = self._recorder, self._recorder.solved
        if not solved:
            why = (
                "the time is over" if recorder.timed_out else "the episode is over without success"
            )
            can = "undo and go on, or begin again" if self._session.repeatable else "begin again"
            self._session.said = f"{why}: {can}"
        pause = math.ceil(_PAUSE * self._rate)
        i = 0
        while True:
            for command in self._commands():
                if command in ("undo", "again", "quit") or (command == "success" and solved):
                    return command
            frame = recorder.frames[min(i, len(recorder))]
            i = (i + 1) % (len(recorder) + 1 + pause)
            self._show(frame, review="keep" if solved else "over")
            self._clock.tick(self._rate)

    def _undo(self) -> None:
        self._window.wait("taking back the last second")
        self._session.undo(math.ceil(_UNDONE * self._rate))
        self._passing = 0

    def _again(self) -> None:
        seed = self._recorder.seed + 1
        check_seeds(seed)
        self._session.begin(seed)
        self._session.said = ""
        self._passing = 0

    def _show(self, picture: npt.NDArray[np.uint8], review: str = "") -> None:
        recorder = self._recorder
        state = [f"seed {recorder.seed}", f"step {len(recorder)}"]
        if self._axes.gripper is not None:
            state.append("gripper closed" if self._session.closed else "gripper open")
        self._window.draw(picture, self._device.help, ", ".join(state), self._session.said, review)
