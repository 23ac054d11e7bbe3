"""What scripted experts of robosuite's arms do: go somewhere, turn, grasp.

They know where everything is, which no policy does, and are asked once a step: each is a generator
of actions, and moves on when a place is reached.

* ``Arm`` - the arm, and where things are
* ``above`` - a place higher up
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["CAREFUL", "EXACT", "FREE", "NEAR", "Action", "Arm", "Floats", "above"]

Action = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]

FREE, CAREFUL = 1.0, 0.5
"""Of full actions: fastest, and near contact."""
NEAR, EXACT = 0.015, 0.006
"""m: a place counts as reached, on the way and for fingers."""

_GAIN = 15.0  # of full actions for each metre that is left
_TURN_GAIN = 1.0  # of full actions for each radian
_LONGEST = 60  # steps until a place is given up as out of reach


class Arm:
    """The arm, and where things are.

    Args:
        env: robosuite's environment, at the beginning of an episode.
        bodies: MuJoCo's numbers of objects and fixtures, by name.
    """

    def __init__(self, env: Any, bodies: Mapping[str, int]) -> None:
        self._env = env
        self._bodies = bodies
        self._home = self._turned
        self.gripper = -1.0
        self._goal = self._home

    @property
    def place(self) -> Floats:
        """(3,) m, between the fingertips."""
        site = self._env.robots[0].eef_site_id
        place: Floats = self._env.sim.data.site_xpos[site].copy()
        return place

    @property
    def _turned(self) -> Any:
        from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]

        site = self._env.robots[0].eef_site_id
        return Rotation.from_matrix(self._env.sim.data.site_xmat[site].reshape(3, 3))

    def body(self, name: str) -> Floats:
        """(3,) m, the origin of an object or a fixture."""
        place: Floats = self._env.sim.data.body_xpos[self._bodies[name]].copy()
        return place

    def site(self, name: str) -> Floats:
        """(3,) m, the middle of one of MuJoCo's sites."""
        place: Floats = self._env.sim.data.get_site_xpos(name).copy()
        return place

    def yaw(self, name: str) -> float:
        """How far an object is turned about the vertical, in radians."""
        w, _, _, z = self._env.sim.data.body_xquat[self._bodies[name]]
        return float(2 * np.arctan2(z, w))

    def turn(self, *turns: tuple[str, float]) -> None:
        """From now on hold the hand turned about the world's axes, from how it began.

        Args:
            turns: axes and degrees, one after the other.
        """
        from scipy.spatial.transform import Rotation

        self._goal = self._home
        for axis, degrees in turns:
            self._goal = Rotation.from_euler(axis, degrees, degrees=True) * self._goal

    def go(self, place: Floats, speed: float = FREE, near: float = NEAR) -> Iterator[Action]:
        """Move the hand to a place (3,) m, and turn it as it is to be."""
        for _ in range(_LONGEST):
            off = place - self.place
            turn = (self._goal * self._turned.inv()).as_rotvec()
            if np.linalg.norm(off) < near and np.linalg.norm(turn) < 0.15:
                return
            move = np.clip(_GAIN * off, -speed, speed)
            rotate = np.clip(_TURN_GAIN * turn, -0.5, 0.5)
            rotate[np.abs(rotate) < 0.03] = 0.0
            yield self._action(move, rotate)

    def hold(self, steps: int) -> Iterator[Action]:
        """Stay where it is."""
        for _ in range(steps):
            yield self._action(np.zeros(3), np.zeros(3))

    def grasp(self, steps: int = 14) -> Iterator[Action]:
        """Close the gripper."""
        self.gripper = 1.0
        yield from self.hold(steps)

    def release(self, steps: int = 8) -> Iterator[Action]:
        """Open the gripper."""
        self.gripper = -1.0
        yield from self.hold(steps)

    def rest(self) -> Iterator[Action]:
        """Stay there for ever."""
        while True:
            yield self._action(np.zeros(3), np.zeros(3))

    def _action(self, move: Floats, rotate: Floats) -> Action:
        action: Action = np.concatenate([move, rotate, [self.gripper]]).astype(np.float32)
        return action


def above(place: Floats, height: float) -> Floats:
    """The place (3,) m that lies that many metres above another."""
    above: Floats = place + np.array([0, 0, height])
    return above
