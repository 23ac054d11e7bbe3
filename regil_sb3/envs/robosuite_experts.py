"""Scripted experts for two of robosuite's tasks, Lift and Door.

Their steps are those of `regil_sb3.envs.osc_experts`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from regil_sb3.envs import NoExpertError
from regil_sb3.envs.osc_experts import CAREFUL, EXACT, Action, Arm, Floats, above

__all__ = ["make_expert"]

_TILT = -35.0  # degrees about x, without which the hand would touch the door above the handle
_DEEP = 0.012  # m that the fingers go below the middle of the handle, or they slip off
_PRESSED = np.deg2rad(80)  # how far the handle is turned; some 55 degrees free the door
_PULLED = (0.2, 0.5)  # rad that the door is turned; success is 0.3
_ROUGH = 0.03  # m: a place counts as reached while the handle gives way


def make_expert(task: str, env: Any) -> Iterator[Action]:
    """Start the expert of a task, where there is one.

    Args:
        task: one of `ROBOSUITE_TASKS`.
        env: robosuite's environment of that task, at the beginning of an episode.

    Yields:
        (7,) float32 actions, as many as are asked for.

    Raises:
        NoExpertError: where the task has none.
    """
    if task not in _EXPERTS:
        raise NoExpertError(
            f"robosuite's {task} has no scripted expert: those are {', '.join(_EXPERTS)}; "
            "`regil convert` takes robomimic's demonstrations"
        )
    bodies = {o.name: env.sim.model.body_name2id(o.root_body) for o in env.model.mujoco_objects}
    return _EXPERTS[task](Arm(env, bodies), env)


def _lift(arm: Arm, _: Any) -> Iterator[Action]:
    """Take the cube, however it is turned: closing fingers turn it straight."""
    cube = arm.body("cube")
    yield from arm.go(above(cube, 0.06))
    yield from arm.go(cube, CAREFUL, EXACT)
    yield from arm.grasp()
    yield from arm.go(above(cube, 0.15))
    yield from arm.rest()


def _open_door(arm: Arm, env: Any) -> Iterator[Action]:
    """Take the handle from above, press it down, and pull the door."""
    hinge, latch = map(env.sim.data._data.joint, env.door.joints)
    handle: Floats = env._handle_xpos.copy()
    spread, normal = handle - latch.xanchor, latch.xaxis
    post = hinge.xanchor.copy()
    bar = spread - spread @ normal * normal  # from the latch's axis to where it is held

    arm.turn(("x", _TILT))
    yield from arm.go(handle + np.array([0, 0.04, 0.08]), near=_ROUGH)
    held = above(handle, -_DEEP)
    yield from arm.go(held, CAREFUL, EXACT)
    yield from arm.grasp(10)
    down = np.array([0, 0, -np.linalg.norm(bar)])
    held = held - bar + np.cos(_PRESSED) * bar + np.sin(_PRESSED) * down
    yield from arm.go(held, near=_ROUGH)
    for angle in _PULLED:
        yield from arm.go(post + _about_z(held - post, angle), near=_ROUGH)
    yield from arm.rest()


def _about_z(place: Floats, angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    turned: Floats = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ place
    return turned


_EXPERTS: dict[str, Callable[[Arm, Any], Iterator[Action]]] = {"lift": _lift, "door": _open_door}
