"""A robot as a Gymnasium environment: a camera, an arm, and a clock that does not wait.

``RobotEnv`` is the same for a real robot and for the one to rehearse with
(``regil_sb3.robots.rehearsal``); nothing in it knows which it has.
"""

from __future__ import annotations

import contextlib
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import cv2
import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box

from regil_sb3.robots.episodes import EpisodeWriter
from regil_sb3.robots.interfaces import (
    Arm,
    ArmState,
    Camera,
    Clock,
    Picture,
    RealClock,
    RobotError,
    first_line,
)
from regil_sb3.robots.limits import Limits, Patience
from regil_sb3.robots.timing import StepTimes

__all__ = ["Operator", "RobotEnv"]

_CHECKS = 4  # of the watchdog, in a control period
_REACHED = 0.006  # m: the hand is where it was sent
_ATTEMPTS = 3  # to get ready for an episode
_HOMING = 20.0  # s until a hand that does not get home is given up
_RECOVERY = 10.0  # s until a camera or arm that does not come back is given up


class Operator(Protocol):
    """A person beside the robot."""

    def succeeded(self) -> bool:
        """Whether the success key was pressed since this was last asked."""

    def aborted(self) -> bool:
        """Whether the arm is to be stopped and the episode to end; stays so until ``ready``."""

    def paused(self) -> bool:
        """Whether the arm is to hold still for a while."""

    def ready(self, message: str) -> None:
        """Say what is to be done, and wait until it is."""

    def close(self) -> None:
        """No more is asked: the environment is closed."""


class RobotEnv(gym.Env[npt.NDArray[np.uint8], npt.NDArray[np.float32]]):
    """A robot arm that is seen by one camera.

    An observation is the newest picture, cut to its central square. An action says how far the hand
    goes along x, y and z (first three, of ``limits.delta``) and whether the gripper closes (fourth,
    above 0). It is sent at once, kept within the limits, and the next observation is taken when the
    control period is over, whatever happens meanwhile. Success terminates, with reward 1; time
    limit and faults truncate.

    A watchdog looks four times a period, from a thread of its own, at the picture's and the
    arm's age, at the arm's errors, at the operator, and whether the next step is late. Where one
    is not as it should be, the arm is stopped first; then the reason is warned of, the episode
    ends, and ``info["fault"]`` says why. The next ``reset`` brings camera and arm back, or raises.

    Example:
        >>> from regil_sb3.envs.rehearsal import RehearsalEnv
        >>> env = RehearsalEnv("reach")  # a RobotEnv whose camera and arm are simulated
        >>> frame, info = env.reset(seed=0)
        >>> frame, reward, terminated, truncated, info = env.step(env.expert_action())
        >>> frame.shape, info["is_success"]
        ((84, 84, 3), False)
        >>> env.close()

    Args:
        camera: gives pictures.
        arm: moves.
        limits: of every motion, homing too.
        home: (3,) m, where the hand starts.
        success: whether what is seen now, with the arm's state, is success. The operator's key
            counts, too.
        reset_scene: puts the scene back, once the hand is home; asks the operator where there is
            one and this is None.
        operator: a person at the keyboard; closed with the environment.
        start_noise: (3,) m, the hand starts up to so far from home, drawn anew each episode.
        closed: whether an episode starts with a closed gripper.
        rate: control steps a second.
        size: height and width of observations, in pixels.
        max_steps: of an episode.
        patience: of the watchdog.
        record_to: a folder: every episode is written there, faulty ones too.
        clock: the time it lives in; None is real time.
        render_mode: None or "rgb_array".

    Raises:
        ValueError: home is outside the limits, or the camera's pictures are too small.
        RobotError: camera or arm do not answer.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012

    def __init__(
        self,
        camera: Camera,
        arm: Arm,
        limits: Limits,
        home: npt.ArrayLike,
        success: Callable[[Picture, ArmState], bool] | None = None,
        reset_scene: Callable[[], None] | None = None,
        operator: Operator | None = None,
        start_noise: npt.ArrayLike = (0.0, 0.0, 0.0),
        closed: bool = False,
        rate: float = 30.0,
        size: int = 84,
        max_steps: int = 150,
        patience: Patience | None = None,
        record_to: str | Path | None = None,
        clock: Clock | None = None,
        render_mode: str | None = None,
    ) -> None:
        self._home = np.asarray(home, float)
        self._noise = np.asarray(start_noise, float)
        if (
            self._home.shape != (3,)
            or not ((self._home >= limits.low) & (self._home <= limits.high)).all()
        ):
            raise ValueError(
                f"home {self._home.tolist()} must lie between {limits.low} and {limits.high}"
            )
        if self._noise.shape != (3,) or not (self._noise >= 0).all():
            raise ValueError(f"start_noise {self._noise.tolist()} must be 3 numbers of at least 0")
        for name, value in (("rate", rate), ("size", size), ("max_steps", max_steps)):
            if not value >= 1:
                raise ValueError(f"{name} {value!r} must be at least 1")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode {render_mode!r} must be 'rgb_array' or None")
        self.render_mode = render_mode
        self._camera, self._arm, self.limits = camera, arm, limits
        self._success, self._reset_scene = success, reset_scene
        self._operator = operator
        self._closed, self._size, self._max_steps = closed, size, max_steps
        self._period = 1.0 / rate
        self._patience = patience or Patience()
        self._clock: Clock = clock or RealClock()
        self._writer = EpisodeWriter(record_to) if record_to is not None else None
        self.times = StepTimes(self._period)

        self._lock = threading.RLock()
        self.fault: str | None = None
        self._watched = False  # whether the watchdog looks
        self._due = np.inf  # when the next step has to come
        self._paused = self._gone = False
        self._rests, self._tick = True, 0.0  # no step is due; when the next observation is
        self._unread = False  # an episode is open whose end the writer has not been told
        self._steps = -1  # of the episode; -1: there is none
        self._same, self._same_since = 0, np.zeros(3)

        self.action_space = Box(-1.0, 1.0, (4,), np.float32)
        self.observation_space = Box(0, 255, (size, size, 3), np.uint8)
        self.metadata = {
            **self.metadata,
            "render_fps": round(rate),
            "regil": {
                "camera": getattr(camera, "name", type(camera).__name__),
                "exists_once": True,
                "image_size": [size, size],
                "action_repeat": 1,
                "control_rate": rate,
                "translation_dims": [0, 1, 2],
                "gripper_dim": 3,
                # Targets stand on a table, within some 7 cm of where they stood
                "plane": [0.07 / limits.delta, 0.07 / limits.delta, 0.005 / limits.delta],
                "mirror": 1,
            },
        }
        if self._noise.any():
            std = np.maximum(self._noise / np.sqrt(3), 1e-3)  # of a uniform distribution
            self.metadata["regil"]["start_std"] = (std / limits.delta).tolist()
        self._end_watch = self._clock.every(self._period / _CHECKS, self._watch)
        try:
            self._picture = self._fresh(_RECOVERY)
        except BaseException:
            self.close()
            raise
        height, width = self._picture.image.shape[:2]
        if min(height, width) < size:
            self.close()
            raise ValueError(
                f"the camera gives {height}x{width} pictures, too small for size {size}: "
                "choose another of its resolutions"
            )

    # -- what Gymnasium calls --------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.uint8], dict[str, Any]]:
        """Bring the hand home and the scene back, and start an episode.

        Args:
            seed: of where the hand starts.
            options: none are known.

        Raises:
            RobotError: camera or arm failed and did not come back, or the hand did not get home.
        """
        super().reset(seed=seed)
        with self._lock:
            self._watched, self._due = False, np.inf
        self._end_episode("reset")
        start = self._home + self.np_random.uniform(-self._noise, self._noise)
        start = np.clip(start, self.limits.low, self.limits.high)
        for attempt in range(1, _ATTEMPTS + 1):
            self._recover()
            with self._lock:
                self._watched = True
            try:
                self._put_back(start)
                self._picture = self._fresh(_RECOVERY)
                self._require_no_fault()
                break
            except RobotError:
                if attempt == _ATTEMPTS:
                    raise
        self._target = self._arm.state().position.copy()
        self._steps, self._same = 0, 0
        self._rests = True
        if self._operator is not None:
            self._operator.succeeded()  # a key that came too late is not this episode's
        frame = self._observation()
        if self._writer is not None:
            self._writer.begin(frame)
            self._unread = True
        return frame, {"is_success": False}

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        """Send an action, and see what has come of it when the period is over.

        Args:
            action: (4,) float32, clipped to [-1, 1].

        Returns:
            Frame, 1 at success, terminated (success), truncated (time limit or fault), and
            ``{"is_success": bool}`` with ``"fault"``, one line, where there was one.

        Raises:
            ValueError: the action is not (4,) or not finite, or there was no ``reset``.
        """
        if self._steps < 0:
            raise ValueError("step() was called before reset(): call reset() first")
        action = np.asarray(action, np.float32)
        if action.shape != (4,) or not np.isfinite(action).all():
            self._stop("the policy's action is not 4 finite numbers")
            raise ValueError(f"action {action} must be 4 finite numbers")
        action = np.clip(action, -1.0, 1.0)
        self._hold_while_paused()
        now = self._clock.now()
        if self._rests:  # who begins may think as long as it takes: the arm stands still
            self._rests, self._tick = False, now + self._period
            self.times.begin(now)
        else:
            self._tick = self.times.arrived(now, self._tick)
        closed = bool(action[3] > 0)
        with self._lock:  # the watchdog cannot stop the arm between this question and the motion
            if self.fault is None:
                self._due = np.inf
                self._move(self._target + action[:3] * self.limits.delta, closed)
        if self.fault is None:
            self._clock.sleep_until(self._tick)
        success = self._see()
        self._steps += 1
        with self._lock:
            now = self._clock.now()
            self.times.left(now)
            self._tick += self._period
            fault = self.fault
            truncated = not success and (fault is not None or self._steps >= self._max_steps)
            over = success or truncated
            self._due = np.inf if over else self._tick + self._patience.step * self._period
        frame = self._observation()
        info: dict[str, Any] = {"is_success": success}
        if fault is not None:
            info["fault"] = fault
        if self._writer is not None:
            self._writer.add(action, frame, success)
        if over:
            with contextlib.suppress(RobotError):  # an arm that is lost was told before
                self._arm.stop()
            self._end_episode(fault)
        return frame, float(success), success, truncated, info

    def render(self) -> npt.NDArray[np.uint8] | None:
        """The newest observation, or None where ``render_mode`` is None."""
        return None if self.render_mode is None else self._observation()

    def close(self) -> None:
        """Stop the arm, write what is not yet written, and give camera and arm back.

        Raises:
            RobotError: an episode could not be written; the message says where it is not.
        """
        if self._gone:
            return
        self._gone = True
        with contextlib.ExitStack() as rest:  # each of these, from the last, whatever fails
            if self._writer is not None:
                rest.callback(self._writer.close)
                rest.callback(self._end_episode, "closed")
            # Keys that two listen to reach one of them
            if self._operator is not None and hasattr(self._operator, "close"):
                rest.callback(self._operator.close)
            rest.callback(self._camera.close)
            rest.callback(self._give_arm_back)
            rest.callback(self._end_watch)

    # -- what ours call --------------------------------------------------------------------------

    def pause(self) -> None:
        """Hold still: no step is late until ``resume``."""
        with self._lock:
            self._paused, self._due = True, np.inf
            try:
                self._arm.stop()
            except RobotError as error:
                self._stop(str(error))

    def resume(self) -> None:
        """Go on after ``pause``; an arm that a fault has stopped stays so until ``reset``."""
        with self._lock:
            self._watch()  # what went wrong since it last looked
            self._paused, self._rests = False, True
            if self.fault is not None:
                return
            try:
                self._arm.recover()
                self._target = self._arm.state().position.copy()
            except RobotError as error:
                self._stop(str(error))

    def encoder_frame(self, size: int) -> npt.NDArray[np.uint8]:
        """The newest picture for an encoder that wants it larger, (size, size, 3) uint8.

        Raises:
            ValueError: the camera's pictures are smaller.
        """
        image = self._picture.image
        side = min(image.shape[:2])
        if side < size:
            raise ValueError(f"the camera's pictures of {side} pixels are too small for {size}")
        top, left = (image.shape[0] - side) // 2, (image.shape[1] - side) // 2
        square = image[top : top + side, left : left + side]
        frame: npt.NDArray[np.uint8] = (
            square.copy()
            if side == size
            else cv2.resize(square, (size, size), interpolation=cv2.INTER_AREA).astype(np.uint8)
        )
        return frame

    # -- inside ----------------------------------------------------------------------------------

    def _observation(self) -> npt.NDArray[np.uint8]:
        return self.encoder_frame(self._size)

    def _move(self, wanted: npt.NDArray[np.float64], closed: bool) -> None:
        """Ask the arm to go there, as far as the limits allow; a fault where it cannot."""
        try:
            position = self._arm.state().position
            self._target = self.limits.next_target(self._target, wanted, position, self._period)
            self._arm.move(self._target, closed)
        except RobotError as error:
            self._stop(str(error))

    def _see(self) -> bool:
        """Take the newest picture; whether it is success."""
        try:
            picture, state = self._camera.read(), self._arm.state()
        except RobotError as error:
            self._stop(str(error))
            return False
        assert picture is not None
        if np.array_equal(picture.image, self._picture.image):
            self._same += 1
            if self._same == 1:
                self._same_since = state.position
        else:
            self._same = 0
        self._picture = picture
        moved = float(np.linalg.norm(state.position - self._same_since))
        if self._same >= self._patience.same and moved > 0.005:
            self._stop(
                f"camera: {self._same} pictures are the very same while the hand moved "
                f"{1000 * moved:.0f} mm"
            )
        if self.fault is not None:
            return False
        pressed = self._operator is not None and self._operator.succeeded()
        return pressed or (self._success is not None and bool(self._success(picture, state)))

    def _watch(self) -> None:
        """Stop the arm where something is wrong; called all the time, from anywhere."""
        with self._lock:
            if not self._watched or self.fault is not None:
                return
            try:
                why = self._what_is_wrong()
            except Exception as error:  # whatever a driver raises: nobody watches without this
                why = first_line(error)
            if why is not None:
                self._stop(why)

    def _what_is_wrong(self) -> str | None:
        now, period = self._clock.now(), self._period
        picture, state = self._camera.read(), self._arm.state()
        limit = self._patience.picture * period
        if picture is not None and now - picture.time > limit:
            return f"camera: no new picture for more than {1000 * limit:.0f} ms"
        limit = self._patience.state * period
        if now - state.time > limit:
            return f"arm: no word for more than {1000 * limit:.0f} ms"
        if state.error is not None:
            return f"arm: {state.error}"
        if self._operator is not None and self._operator.aborted():
            return "operator: aborted"
        if now > self._due:
            return f"late step: none for {1000 * (self._patience.step + 1) * period:.0f} ms"
        return None

    def _stop(self, why: str) -> None:
        with self._lock:
            try:
                self._arm.stop()
            except Exception as error:  # see above
                said = first_line(error)
                why = f"{why} ({said})" if said != why else why
            if self.fault is not None:
                return
            self.fault, self._due = why, np.inf
        warnings.warn(f"the arm was stopped: {why}", RuntimeWarning, stacklevel=2)

    def _give_arm_back(self) -> None:
        try:
            try:
                self._arm.stop()
            finally:
                self._arm.close()
        except RobotError as error:
            warnings.warn(f"the arm was not told to stop: {error}", stacklevel=2)

    def _require_no_fault(self) -> None:
        if self.fault is not None:
            raise RobotError(self.fault)

    def _end_episode(self, fault: str | None) -> None:
        self._steps = -1
        if self._writer is not None and self._unread:
            ours = self.metadata["regil"]
            kept = ("camera", "image_size", "action_repeat", "control_rate")
            self._writer.end({**{name: ours[name] for name in kept}, "fault": fault})
            self._unread = False

    def _recover(self) -> None:
        """Bring back what has failed; episodes that are not yet written get another chance."""
        aborted = self._operator is not None and self._operator.aborted()
        if self._operator is not None and (aborted or self.fault is not None):
            self._operator.ready(f"stopped ({self.fault}): make the robot ready, then go on")
        if self._writer is not None:
            self._writer.retry()
        failed = self.fault is not None or (
            self._writer is not None and self._writer.error is not None
        )
        end = self._clock.now() + _RECOVERY
        while failed:
            try:
                if self._writer is not None:
                    self._writer.require_all_written()
                self._camera.recover()
                self._arm.recover()
                self.fault = None
                self._picture = self._fresh(end - self._clock.now())
                if (error := self._arm.state().error) is not None:
                    raise RobotError(f"arm: {error}")
                failed = False
            except RobotError as error:
                if self._clock.now() >= end:
                    self.fault = str(error)
                    raise RobotError(
                        f"{error}; it did not come back in {_RECOVERY:.0f} s"
                    ) from None
                self._clock.sleep_until(self._clock.now() + self._period)
        if not self._paused:
            self._arm.recover()

    def _fresh(self, seconds: float) -> Picture:
        """Wait for a picture that is taken from now on."""
        asked = self._clock.now()
        while True:
            picture = self._camera.read()
            if picture is not None and picture.time >= asked:
                return picture
            if self._clock.now() > asked + seconds:
                raise RobotError(f"camera: no picture for {max(seconds, 0):.1f} s")
            self._require_no_fault()
            self._clock.sleep_until(self._clock.now() + self._period / _CHECKS)

    def _put_back(self, start: npt.NDArray[np.float64]) -> None:
        """Bring the hand to its start, above all that stands about, and the scene back."""
        above = self._arm.state().position * (1, 1, 0) + (0, 0, self._home[2])
        self._go(np.clip(above, self.limits.low, self.limits.high), self._closed)
        self._go(self._home, self._closed)
        if self._reset_scene is not None:
            self._reset_scene()
        elif self._operator is not None:
            self._operator.ready("put the scene back, then go on")
        self._go(start, self._closed)

    def _go(self, place: npt.NDArray[np.float64], closed: bool) -> None:
        """Move the hand in a straight line, within the limits."""
        self._target = self._arm.state().position.copy()
        end = self._clock.now() + _HOMING
        while np.linalg.norm(self._arm.state().position - place) > _REACHED:
            end += self._hold_while_operator_pauses()
            with self._lock:
                self._require_no_fault()
                self._move(place, closed)
            if self._clock.now() > end:
                self._stop(f"arm: it did not get to {place.round(3).tolist()}")
            self._clock.sleep_until(self._clock.now() + self._period)
            self._require_no_fault()

    def _hold_while_paused(self) -> None:
        """Wait while the program or the operator has paused."""
        self._hold_while_operator_pauses()
        while self._paused and self.fault is None:
            self._clock.sleep_until(self._clock.now() + self._period)

    def _hold_while_operator_pauses(self) -> float:
        """Returns how long (s) that was."""
        began = self._clock.now()
        if self._operator is None or not self._operator.paused() or self._paused:
            return 0.0
        self.pause()
        while self._operator.paused() and self.fault is None:
            self._clock.sleep_until(self._clock.now() + self._period)
        self.resume()
        return self._clock.now() - began
