"""Scripted experts for the paper's six LIBERO tasks.

Their steps are those of `regil_sb3.envs.osc_experts`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from regil_sb3.envs import NoExpertError
from regil_sb3.envs.libero_tasks import LIBERO_TASKS
from regil_sb3.envs.osc_experts import CAREFUL, EXACT, Action, Arm, Floats, above

__all__ = ["make_expert"]

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
        NoExpertError: where the task has none.
    """
    for short, expert in _EXPERTS.items():
        if LIBERO_TASKS[task] == LIBERO_TASKS[short]:
            return expert(Arm(env, env.obj_body_id))
    raise NoExpertError(
        f"regil/libero-{task}-v0 has no scripted expert: those are {', '.join(_EXPERTS)}; "
        "`regil convert` takes LIBERO's public demonstrations"
    )


def _carry(
    arm: Arm, thing: str, rim: Floats, target: Callable[[Arm], Floats], lift: float
) -> Iterator[Action]:
    """Take a vessel by its rim, and set it down on something."""
    rim_place = arm.body(thing) + rim
    yield from arm.go(above(rim_place, 0.1))
    yield from arm.go(rim_place, CAREFUL, EXACT)
    yield from arm.grasp()
    held = arm.place - arm.body(thing)
    yield from arm.go(above(arm.place, lift))
    down = target(arm) + held
    yield from arm.go(np.array([down[0], down[1], arm.place[2]]))
    yield from arm.go(down, CAREFUL, EXACT)
    yield from arm.release()
    yield from arm.go(above(arm.place, 0.1))
    yield from arm.rest()


def _open_drawer(arm: Arm) -> Iterator[Action]:
    """Reach for the top drawer's handle with level fingers, and pull."""
    handle = arm.body("wooden_cabinet_1") + _HANDLE
    arm.turn(("x", -80))
    yield from arm.go(handle + np.array([0, 0.12, 0.02]))
    yield from arm.go(handle, CAREFUL, EXACT)
    yield from arm.grasp()
    yield from arm.go(arm.place + np.array([0, 0.24, 0]), CAREFUL)
    yield from arm.rest()


def _shelve_book(arm: Arm, book: str) -> Iterator[Action]:
    """Take a standing book by its top, lay it down in the air, and push it into the shelf."""
    top = above(arm.body(book), _BOOK_TOP)
    yaw = (np.degrees(arm.yaw(book)) - 90 + 90) % 180 - 90
    arm.turn(("z", yaw))
    yield from arm.go(above(top, 0.1))
    yield from arm.go(top, CAREFUL, EXACT)
    yield from arm.grasp()
    yield from arm.go(above(arm.place, 0.2))
    shelf = arm.site("wooden_two_layer_shelf_1_top_region")
    arm.turn(("x", 85))
    yield from arm.go(shelf + np.array([0, -0.3, 0.02]))
    yield from arm.go(shelf + np.array([0, -0.1, 0.0]), CAREFUL)
    yield from arm.rest()


def _on_plate(arm: Arm) -> Floats:
    return above(arm.body("plate_1"), 0.02)


def _on_cabinet(arm: Arm) -> Floats:
    return above(arm.site("wooden_cabinet_1_top_side"), 0.02)


_EXPERTS: dict[str, Callable[[Arm], Iterator[Action]]] = {
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
