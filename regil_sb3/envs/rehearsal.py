"""The paper's Reach, Insert and Open on the rehearsal robot.

``RehearsalEnv`` is ``RobotEnv`` with a simulated robot behind it, in a process of its own: what
learns here learns on a real robot by the same code.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from gymnasium.utils import EzPickle

from regil_sb3.envs.robot import Operator, RobotEnv
from regil_sb3.robots.experts import Expert
from regil_sb3.robots.interfaces import ArmState, Picture
from regil_sb3.robots.limits import Limits, Patience
from regil_sb3.robots.rehearsal import Disturbances, Rehearsal
from regil_sb3.robots.rehearsal_scene import TASKS

__all__ = ["RehearsalEnv"]

_ARGUMENTS = (
    *("task", "random_object", "start_noise", "real_time", "size", "latency", "jitter"),
    *(
        "dropped",
        "duplicated",
        "lighting",
        "max_steps",
        "record_to",
        "patience",
        "operator",
        "render_mode",
    ),
)
_HOME = (0.0, 0.48, 0.18)
_LOW, _HIGH = (-0.25, 0.38), (0.25, 0.72)  # m, of the workspace


class RehearsalEnv(RobotEnv, EzPickle):
    """A task of the paper's on the rehearsal robot.

    Registered as `regil/rehearsal-<task>-v0`. Targets move to the left and to the right by as much
    as in the paper, and episodes have its length: Reach -14 to 8 cm and 125 steps, Insert -4.5 to
    4.5 cm and 150, Open -4 to 7 cm and 175. An action moves the hand by up to 1 cm along an axis.

    Args:
        task: "reach", "insert" or "open".
        random_object: whether each episode draws a place for the target.
        start_noise: the hand starts up to so far from home, along each axis (m).
        real_time: whether time passes by itself, 30 steps a second. Else the same program runs as
            fast as it can, and the hand is put at its start instead of going there.
        size: height and width of observations.
        latency: as the next four, of the camera: see `regil_sb3.robots.rehearsal.Disturbances`.
        jitter: see there.
        dropped: see there.
        duplicated: see there.
        lighting: see there.
        max_steps: None takes the paper's.
        record_to: see `RobotEnv`.
        patience: see `RobotEnv`.
        operator: see `RobotEnv`.
        render_mode: None or "rgb_array".

    Raises:
        ValueError: where an argument is none of the above.
        ImportError: where MuJoCo is not installed.
    """

    def __init__(
        self,
        task: str,
        random_object: bool = True,
        start_noise: float = 0.0,
        real_time: bool = False,
        size: int = 84,
        latency: float = 0.01,
        jitter: float = 0.0,
        dropped: float = 0.0,
        duplicated: float = 0.0,
        lighting: float = 0.0,
        max_steps: int | None = None,
        record_to: str | None = None,
        patience: Patience | None = None,
        operator: Operator | None = None,
        render_mode: str | None = None,
    ) -> None:
        given = locals()
        EzPickle.__init__(self, *(given[name] for name in _ARGUMENTS))
        if task not in TASKS:
            raise ValueError(f"task {task!r} is not one of {', '.join(TASKS)}")
        self._task = TASKS[task]
        self._random_object, self._lighting = random_object, lighting
        self._real_time = real_time
        disturbances = Disturbances(latency, jitter, dropped, duplicated, lighting)
        self.robot = Rehearsal(task, size, 30.0, disturbances, real_time)
        self._expert = Expert(task)
        try:
            super().__init__(
                self.robot.camera,
                self.robot.arm,
                Limits((*_LOW, self._task.floor), (*_HIGH, 0.3)),
                _HOME,
                success=self._solved,
                reset_scene=self._reset_target,
                start_noise=(start_noise,) * 3,
                closed=self._task.closed,
                size=size,
                max_steps=max_steps or self._task.max_steps,
                patience=patience,
                operator=operator,
                record_to=record_to,
                clock=self.robot.clock,
                render_mode=render_mode,
            )
        except BaseException:
            self.robot.close()
            raise
        self.metadata["regil"]["exists_once"] = False  # each has a robot of its own
        # As the camera sees them, targets move to the left and to the right alone
        span = (self._task.span[1] - self._task.span[0]) / 2 / self.limits.delta
        self.metadata["regil"]["plane"] = [span, 0.1 * span, 0.2]

    def _solved(self, picture: Picture, state: ArmState) -> bool:
        return bool(self.robot.truth["solved"])

    def _reset_target(self, hand: npt.NDArray[np.float64] | None = None) -> None:
        off = self.np_random.uniform(*self._task.span) if self._random_object else 0.0
        light = 1 + self.np_random.uniform(-self._lighting, self._lighting)
        self.robot.reset(off, light, int(self.np_random.integers(2**31)), hand)
        self._expert.begin()

    def _put_back(self, start: npt.NDArray[np.float64]) -> None:
        if self._real_time:
            super()._put_back(start)
        else:
            self._reset_target(start)

    def expert_action(self) -> npt.NDArray[np.float32]:
        """Ask the task's scripted expert, who knows where the target is, what to do now."""
        return self._expert.action(self._arm.state().position, self.robot.truth)
