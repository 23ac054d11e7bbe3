"""Environments that ship with regil-sb3, registered by `import regil_sb3`.

Gymnasium from 1.0 on reads no entry points: whoever wants the ids imports the package. Nothing here
imports a simulator, torch or stable-baselines3.
"""

from __future__ import annotations

from typing import Any

from regil_sb3.envs.libero_tasks import LIBERO_TASKS

__all__ = [
    "EVALUATION_SEEDS",
    "LIBERO_TASKS",
    "METAWORLD_TASKS",
    "REHEARSAL_TASKS",
    "ROBOSUITE_ROBOTS",
    "ROBOSUITE_TASKS",
    "NoExpertError",
    "exists_once",
    "register_envs",
]


class NoExpertError(ValueError):
    """An environment has no scripted expert."""


EVALUATION_SEEDS = 1_000_000
"""Seeds from here on belong to evaluation: a demonstration must not know what it is tested on."""

METAWORLD_TASKS = (
    "assembly",
    "basketball",
    "bin-picking",
    "box-close",
    "button-press",
    "button-press-topdown",
    "button-press-topdown-wall",
    "button-press-wall",
    "coffee-button",
    "coffee-pull",
    "coffee-push",
    "dial-turn",
    "disassemble",
    "door-close",
    "door-lock",
    "door-open",
    "door-unlock",
    "drawer-close",
    "drawer-open",
    "faucet-close",
    "faucet-open",
    "hammer",
    "hand-insert",
    "handle-press",
    "handle-press-side",
    "handle-pull",
    "handle-pull-side",
    "lever-pull",
    "peg-insert-side",
    "peg-unplug-side",
    "pick-out-of-hole",
    "pick-place",
    "pick-place-wall",
    "plate-slide",
    "plate-slide-back",
    "plate-slide-back-side",
    "plate-slide-side",
    "push",
    "push-back",
    "push-wall",
    "reach",
    "reach-wall",
    "shelf-place",
    "soccer",
    "stick-pull",
    "stick-push",
    "sweep",
    "sweep-into",
    "window-close",
    "window-open",
)
"""Meta-World's v3 tasks by their own names, without `-v3`."""

REHEARSAL_TASKS = ("reach", "insert", "open")
"""The paper's tasks on a real robot."""


ROBOSUITE_TASKS = (
    "door",
    "lift",
    "nut-assembly",
    "nut-assembly-round",
    "nut-assembly-square",
    "pick-place",
    "pick-place-bread",
    "pick-place-can",
    "pick-place-cereal",
    "pick-place-milk",
    "stack",
    "wipe",
)
"""robosuite's tasks for one arm, in kebab case. Its `NutAssemblySingle` and `PickPlaceSingle` are
left out: which object they take, no seed decides."""

ROBOSUITE_ROBOTS = {
    "iiwa": "IIWA",
    "jaco": "Jaco",
    "kinova3": "Kinova3",
    "panda": "Panda",
    "sawyer": "Sawyer",
    "ur5e": "UR5e",
}
"""robosuite's arms, by the names they have in ids."""


def exists_once(env: Any) -> bool:
    """Whether a Gymnasium environment says that it is a robot (``metadata["regil"]``).

    There is no second one, and what was done with it is not done again.
    """
    from regil_wrappers.frames import stated  # here, for ids need none of what it imports

    return bool(stated(env.unwrapped.metadata).get("exists_once", False))


def register_envs() -> None:
    """Register `regil/<simulator>-<task>-v0`: metaworld, libero, robosuite and rehearsal.

    robosuite's name the arm too: `regil/robosuite-<task>-<robot>-v0`.

    `regil/metaworld-<task>-state-v0` is the first with `obs="state", render_mode="rgb_array"`: for
    policies that see no picture, and rewards that do (`image="render"`).

    The time limit is not Gymnasium's: it sits inside the environment (`max_steps`), where it
    counts agent steps under the action repeat and truncates.
    """
    simulators = {
        "metaworld": ("regil_sb3.envs.metaworld:MetaWorldEnv", METAWORLD_TASKS),
        "libero": ("regil_sb3.envs.libero:LiberoEnv", LIBERO_TASKS),
        "rehearsal": ("regil_sb3.envs.rehearsal:RehearsalEnv", REHEARSAL_TASKS),
    }
    for simulator, (entry_point, tasks) in simulators.items():
        for task in tasks:
            _register(f"{simulator}-{task}", entry_point, task=task)
    for task in METAWORLD_TASKS:
        seen = {"obs": "state", "render_mode": "rgb_array"}
        _register(f"metaworld-{task}-state", simulators["metaworld"][0], task=task, **seen)
    for task in ROBOSUITE_TASKS:
        for robot in ROBOSUITE_ROBOTS:
            entry_point = "regil_sb3.envs.robosuite:RobosuiteEnv"
            _register(f"robosuite-{task}-{robot}", entry_point, task=task, robot=robot)


def _register(name: str, entry_point: str, **kwargs: str) -> None:
    from gymnasium.envs.registration import register, registry

    env_id = f"regil/{name}-v0"
    if env_id not in registry:  # calling it twice is harmless and warns of nothing
        register(env_id, entry_point=entry_point, kwargs=kwargs)


register_envs()
