"""Arms: Franka's (Panda, FR3), through franky.

An arm for ``RobotEnv`` is five methods (``interfaces.Arm``): others are written as this one is.
"""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np
import numpy.typing as npt

from regil_sb3.robots.interfaces import ArmState, RobotError, first_line

__all__ = ["FrankaArm"]

_POLL = 0.01  # s
_GRASP_SPEED = 0.1  # m/s


class FrankaArm:
    """A Franka arm with its gripper, moved through its position: the hand keeps its direction.

    Each ``move`` replaces the motion under way by a new one, which franky plans anew (Ruckig),
    within the limits of ``dynamics``. The arm stops by itself at collisions, and where the network
    fails.

    Args:
        host: address of the robot.
        dynamics: share of the arm's own limits of speed, acceleration and jerk.
        force: of the gripper (N).
        real_time: whether the computer has a real-time kernel; if not, franky does not insist.

    Raises:
        ImportError: ``franky-control`` is not installed.
        ValueError: the robot does not answer.
    """

    def __init__(
        self, host: str, dynamics: float = 0.5, force: float = 20.0, real_time: bool = False
    ) -> None:
        try:
            franky: Any = import_module("franky")
        except ModuleNotFoundError:
            raise ImportError("franky is not installed: pip install 'regil-sb3[franka]'") from None
        self._franky: Any = franky
        config = franky.RealtimeConfig.Enforce if real_time else franky.RealtimeConfig.Ignore
        try:
            self._robot = franky.Robot(host, realtime_config=config)
            self._gripper = franky.Gripper(host)
        except Exception as error:  # libfranka's own are not Python classes of one kind
            raise ValueError(f"the Franka arm at {host} does not answer: {error}") from None
        self._robot.relative_dynamics_factor = dynamics
        self._force = force
        self._lock = threading.Lock()
        self._held = False
        self._closed: bool | None = None  # not known: the first move says it
        self._direction = self._robot.current_pose.end_effector_pose.quaternion
        self._ends = False
        self._clock: Any = None  # the robot's own
        self._state = self._asked(None)
        self._thread = threading.Thread(target=self._poll, daemon=True)
        self._thread.start()

    def state(self) -> ArmState:
        """The newest state; its time stands still where the robot's own does."""
        return self._state

    def move(self, position: npt.NDArray[np.float64], closed: bool) -> None:
        """Go there, and close or open the gripper."""
        franky = self._franky
        with self._lock:
            if self._held:
                return
            target = franky.Affine(np.asarray(position, float), self._direction)
            motion = franky.CartesianMotion(target, franky.ReferenceType.Absolute)
            try:
                self._robot.move(motion, asynchronous=True)
                if closed != self._closed:
                    self._closed = closed
                    self._grip(closed)
            except Exception as error:  # see above
                raise RobotError(f"arm: {first_line(error)}") from None

    def stop(self) -> None:
        """Come to rest as fast as the limits allow."""
        with self._lock:
            self._held = True
            try:
                if self._robot.is_in_control:
                    self._robot.move(self._franky.CartesianStopMotion(), asynchronous=True)
            except Exception as error:  # see above
                raise RobotError(f"arm: {first_line(error)}") from None

    def recover(self) -> None:
        """Acknowledge errors, and be ready to move."""
        with self._lock:
            try:
                if self._robot.has_errors and not self._robot.recover_from_errors():
                    raise RobotError("arm: its errors cannot be acknowledged: look at the robot")
                self._robot.poll_motion()
            except RobotError:
                raise
            except Exception as error:  # see above
                if self._robot.has_errors:
                    raise RobotError(f"arm: {first_line(error)}") from None
            self._held = False

    def close(self) -> None:
        """Stop, and let the robot go."""
        try:
            self.stop()
        finally:
            self._ends = True
            self._thread.join(2.0)

    def _grip(self, closed: bool) -> None:
        if closed:
            width = self._gripper.max_width
            self._gripper.grasp_async(0.0, _GRASP_SPEED, self._force, epsilon_outer=width)
        else:
            self._gripper.open_async(_GRASP_SPEED)

    def _asked(self, before: ArmState | None) -> ArmState:
        """Ask the robot; what it says is as old as its own clock."""
        state = self._robot.state
        fresh = before is None or state.time != self._clock
        self._clock = state.time
        pose = self._robot.current_pose.end_effector_pose
        return ArmState(
            np.array(pose.translation, float).reshape(3),
            bool(self._closed),
            time.monotonic() if fresh or before is None else before.time,
            f"it is in error: {state.current_errors}" if self._robot.has_errors else None,
        )

    def _poll(self) -> None:
        while not self._ends:
            try:
                self._state = self._asked(self._state)
            except Exception as error:  # see above
                self._state = replace(self._state, error=first_line(error))
            time.sleep(_POLL)
