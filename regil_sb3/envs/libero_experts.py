"""Scripted experts for the paper's six LIBERO tasks.

They know where everything is, which no policy does, and are asked once a step: each is a generator
of actions, and moves on when a place is reached.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from regil_sb3.envs.libero_tasks import LIBERO_TASKS

__all__ = ["Action", "make_expert"]

Action = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]

_GAIN = 15.0  # of full actions for each metre that is left
_TURN_GAIN = 1.0  # of full actions for each radian
_FREE, _CAREFUL = 1.0, 0.5  # of full actions: fastest, and near contact
_NEAR, _EXACT = 0.015, 0.006  # m: a place counts as reached, on the way and for fingers
_LONGEST = 60  # steps until a place is given up as out of reach
_GRASP, _RELEASE = 14, 8  # steps that fingers are given

_RIM = np.array([0.0, 0.047, 0.034])  # m, from a bowl's origin to its rim, where fingers fit
_MUG_RIM = np.array([0.0, 0.037, 0.118])
_HANDLE = np.array([0.003, 0.101, 0.184])  # m, from a cabinet's origin to its top drawer's handle
_BOOK_TOP = 0.115  # m, from a standing book's foot to where it is held


def make_expert(task: str, env: Any) -> Iterator[Action]:
    """Start the expert of a task, where there is one.

    Args:
        task: one of `LIBERO_TASKS`.
        env: LIBERO's environment of that task, at the beginning of an episode.

    Yields:
        (7,) float32 actions, as many as are asked for.

    Raises:
        ValueError: where the task has none.
    """
    for short, expert in _EXPERTS.items():
        if LIBERO_TASKS[task] == LIBERO_TASKS[short]:
            return expert(_Arm(env))
    raise ValueError(
        f"regil/libero-{task}-v0 has no scripted expert: those are {', '.join(_EXPERTS)}; "
        "`regil convert` takes LIBERO's public demonstrations"
    )


class _Arm:
    """The arm, and where things are."""

    def __init__(self, env: Any) -> None:
        self._env = env
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
        place: Floats = self._env.sim.data.body_xpos[self._env.obj_body_id[name]].copy()
        return place

    def site(self, name: str) -> Floats:
        """(3,) m, the middle of one of LIBERO's regions."""
        place: Floats = self._env.sim.data.get_site_xpos(name).copy()
        return place

    def yaw(self, name: str) -> float:
        """How far an object is turned about the vertical, in radians."""
        w, _, _, z = self._env.sim.data.body_xquat[self._env.obj_body_id[name]]
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

    def go(self, place: Floats, speed: float = _FREE, near: float = _NEAR) -> Iterator[Action]:
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

    def grasp(self) -> Iterator[Action]:
        """Close the gripper."""
        self.gripper = 1.0
        yield from self.hold(_GRASP)

    def release(self) -> Iterator[Action]:
        """Open the gripper."""
        self.gripper = -1.0
        yield from self.hold(_RELEASE)

    def rest(self) -> Iterator[Action]:
        """Stay there for ever."""
        while True:
            yield self._action(np.zeros(3), np.zeros(3))

    def _action(self, move: Floats, rotate: Floats) -> Action:
        action: Action = np.concatenate([move, rotate, [self.gripper]]).astype(np.float32)
        return action


def _above(place: Floats, height: float) -> Floats:
    above: Floats = place + np.array([0, 0, height])
    return above


def _carry(
    arm: _Arm, thing: str, rim: Floats, target: Callable[[_Arm], Floats], lift: float
) -> Iterator[Action]:
    """Take a vessel by its rim, and set it down on something."""
    rim_place = arm.body(thing) + rim
    yield from arm.go(_above(rim_place, 0.1))
    yield from arm.go(rim_place, _CAREFUL, _EXACT)
    yield from arm.grasp()
    held = arm.place - arm.body(thing)
    yield from arm.go(_above(arm.place, lift))
    down = target(arm) + held
    yield from arm.go(np.array([down[0], down[1], arm.place[2]]))
    yield from arm.go(down, _CAREFUL, _EXACT)
    yield from arm.release()
    yield from arm.go(_above(arm.place, 0.1))
    yield from arm.rest()


def _open_drawer(arm: _Arm) -> Iterator[Action]:
    """Reach for the top drawer's handle with level fingers, and pull."""
    handle = arm.body("wooden_cabinet_1") + _HANDLE
    arm.turn(("x", -80))
    yield from arm.go(handle + np.array([0, 0.12, 0.02]))
    yield from arm.go(handle, _CAREFUL, _EXACT)
    yield from arm.grasp()
    yield from arm.go(arm.place + np.array([0, 0.24, 0]), _CAREFUL)
    yield from arm.rest()


def _shelve_book(arm: _Arm, book: str) -> Iterator[Action]:
    """Take a standing book by its top, lay it down in the air, and push it into the shelf."""
    top = _above(arm.body(book), _BOOK_TOP)
    yaw = (np.degrees(arm.yaw(book)) - 90 + 90) % 180 - 90
    arm.turn(("z", yaw))
    yield from arm.go(_above(top, 0.1))
    yield from arm.go(top, _CAREFUL, _EXACT)
    yield from arm.grasp()
    yield from arm.go(_above(arm.place, 0.2))
    shelf = arm.site("wooden_two_layer_shelf_1_top_region")
    arm.turn(("x", 85))
    yield from arm.go(shelf + np.array([0, -0.3, 0.02]))
    yield from arm.go(shelf + np.array([0, -0.1, 0.0]), _CAREFUL)
    yield from arm.rest()


def _on_plate(arm: _Arm) -> Floats:
    return _above(arm.body("plate_1"), 0.02)


def _on_cabinet(arm: _Arm) -> Floats:
    return _above(arm.site("wooden_cabinet_1_top_side"), 0.02)


_EXPERTS: dict[str, Callable[[_Arm], Iterator[Action]]] = {
    "kitchen1-drawer": _open_drawer,
    "kitchen1-bowl-on-cabinet": partial(
        _carry, thing="akita_black_bowl_1", rim=_RIM, target=_on_cabinet, lift=0.32
    ),
    "kitchen1-bowl-on-plate": partial(
        _carry, thing="akita_black_bowl_1", rim=_RIM, target=_on_plate, lift=0.12
    ),
    "kitchen2-bowl-on-plate": partial(
        _carry, thing="akita_black_bowl_2", rim=_RIM, target=_on_plate, lift=0.12
    ),
    "living5-mug-on-plate": partial(
        _carry, thing="red_coffee_mug_1", rim=_MUG_RIM, target=_on_plate, lift=0.22
    ),
    "study4-book": partial(_shelve_book, book="black_book_1"),
}
