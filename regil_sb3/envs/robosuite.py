"""robosuite's own tasks as Gymnasium environments that learn from pixels.

For robosuite 1.4, whose controllers these are; 1.5 has others, and needs a numpy below 2.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from typing import Any
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt
from gymnasium.utils import EzPickle

from regil_sb3.envs import ROBOSUITE_ROBOTS, ROBOSUITE_TASKS
from regil_sb3.envs.choices import check_choices, check_positive
from regil_sb3.envs.osc import CONTROL_RATE, OSCEnv, reset_simulation, seeded
from regil_sb3.envs.osc_experts import Action
from regil_sb3.envs.rendering import prepare_graphics
from regil_sb3.envs.robosuite_experts import make_expert
from regil_sb3.envs.robosuite_import import import_robosuite

__all__ = ["CAMERAS", "RobosuiteEnv"]

CAMERAS = ("agentview", "frontview", "birdview", "robot0_eye_in_hand", "robot0_robotview")
"""robosuite's own cameras that every task has."""

_SETTLE = 10  # steps in which what was placed above the table falls onto it
_ALONE = ("lift", "door")  # tasks whose one thing is all that moves
_FLAT = "robot0_head_"  # meshes of Sawyer's head


class RobosuiteEnv(OSCEnv, EzPickle):
    """A task of robosuite's for one arm, and success as the end of the episode.

    Registered as `regil/robosuite-<task>-<robot>-v0`. An action moves the hand: translation along
    the axes of the world (first three dimensions; a step of 1 asks for 5 cm, of which a Panda makes
    about 1.3 in its 50 ms), rotation about them (next three; 1 asks for half a radian), and the
    gripper (last; positive closes; wipe has none). The reward is 1 where robosuite's own check of
    success holds, else 0. Success terminates; after `max_steps` agent steps the episode is
    truncated. `info["is_success"]` is there on every step.

    Objects and the arm's joints are placed as robosuite places them, from the generator that
    `reset(seed=)` seeds. What robosuite draws once, such as the size of Lift's cube, is the same
    in every instance.

    Args:
        task: one of `ROBOSUITE_TASKS`.
        robot: one of `ROBOSUITE_ROBOTS`.
        obs: `"pixels"` for (size, size, 3) uint8 frames, or `"state"` for (n,) float32, robosuite's
            own `robot0_proprio-state` and `object-state` (clipped to +-10).
        camera: one of `CAMERAS`.
        size: height and width of the frames in pixels.
        action_repeat: how many control steps (50 ms each) an action lasts.
        random_object: whether each `reset` draws new places; if not, they are always the same.
        render_mode: `None` or `"rgb_array"`.
        render_size: height and width of what `render()` returns; `None` stands for `size`.
        max_steps: agent steps after which an episode is truncated.

    Raises:
        ValueError: where an argument is none of the above.
        ImportError: where robosuite is not installed, or in another version.
    """

    def __init__(
        self,
        task: str,
        robot: str = "panda",
        obs: str = "pixels",
        camera: str = "agentview",
        size: int = 84,
        action_repeat: int = 1,
        random_object: bool = True,
        render_mode: str | None = None,
        render_size: int | None = None,
        max_steps: int = 150,
    ) -> None:
        EzPickle.__init__(
            self,
            task,
            robot,
            obs,
            camera,
            size,
            action_repeat,
            random_object,
            render_mode,
            render_size,
            max_steps,
        )
        if task not in ROBOSUITE_TASKS:
            near = difflib.get_close_matches(task, ROBOSUITE_TASKS) or ROBOSUITE_TASKS
            raise ValueError(f"task {task!r} is not one of robosuite's: try {', '.join(near)}")
        if robot not in ROBOSUITE_ROBOTS:
            raise ValueError(f"robot {robot!r} is not one of {', '.join(ROBOSUITE_ROBOTS)}")
        render_size = size if render_size is None else render_size
        check_choices(obs, camera, CAMERAS, render_mode)
        check_positive(
            size=size, action_repeat=action_repeat, render_size=render_size, max_steps=max_steps
        )
        prepare_graphics()
        sim = _make_simulation(task, robot)
        self._task = task
        # Measured when asked for: robosuite does so 25 times a step
        self._observables, sim._observables = sim._observables, {}
        self._set_up(
            sim,
            obs=obs,
            camera=camera,
            size=size,
            action_repeat=action_repeat,
            random_object=random_object,
            render_mode=render_mode,
            render_size=render_size,
            max_steps=max_steps,
            facts={
                "crowded": task not in _ALONE,
                **({} if sim.robots[0].gripper.dof else {"gripper_dim": "none"}),
            },
        )

    def targets(self) -> npt.NDArray[np.float64]:
        """Where what the task is about stands, (n, 3) m: by its handle, where it has one."""
        env, data = self._sim, self._sim.sim.data
        if self._task == "wipe":
            return np.array([env._get_wipe_information()[1]])  # the middle of what is to be wiped
        places = []
        for thing in env.model.mujoco_objects:
            if thing.name.startswith("Visual") or _left_out(env, thing.name):
                continue
            handle = thing.important_sites.get("handle")
            places.append(
                data.get_site_xpos(handle) if handle else data.get_body_xpos(thing.root_body)
            )
        return np.array(places)

    def _place(self, seed: int | None) -> None:
        self._sim._observables = self._observables  # some tasks say here which of them hold
        reset_simulation(self._sim, self._draws())
        self._sim._observables = {}
        idle = np.zeros(self._sim.action_dim)
        if self._sim.robots[0].gripper.dof:
            idle[-1] = -1.0
        for _ in range(_SETTLE):
            self._sim.step(idle)

    def _step_simulation(self, action: npt.NDArray[np.float32]) -> bool:
        self._sim.step(action)
        return bool(self._sim._check_success())

    def _make_expert(self) -> Iterator[Action]:
        return make_expert(self._task, self._sim)

    def _measure(self) -> npt.NDArray[np.float64]:
        self._sim._observables = self._observables
        measured = self._sim._get_observations(force_update=True)
        self._sim._observables = {}
        state: npt.NDArray[np.float64] = np.concatenate(
            [measured["robot0_proprio-state"], measured["object-state"]]
        )
        return state


def _left_out(env: Any, name: str) -> bool:
    """Whether a task for one of several objects has put this one away."""
    chosen = getattr(env, "obj_to_use", None)
    return chosen is not None and name != chosen


def _make_simulation(task: str, robot: str) -> Any:
    """robosuite's own environment, without its renderer."""
    import_robosuite()
    from robosuite.controllers import load_controller_config  # type: ignore[import-untyped]
    from robosuite.environments.base import REGISTERED_ENVS  # type: ignore[import-untyped]

    name = "".join(word.capitalize() for word in task.split("-"))
    with seeded(0):
        return _loading_again(REGISTERED_ENVS[name])(
            robots=ROBOSUITE_ROBOTS[robot],
            controller_configs=load_controller_config(default_controller="OSC_POSE"),
            use_camera_obs=False,
            has_offscreen_renderer=False,
            control_freq=CONTROL_RATE,
            ignore_done=True,
            hard_reset=False,  # it would compile the model again in every episode
        )


def _loading_again(cls: Any) -> Any:
    """A class of robosuite's whose models load in MuJoCo 3: it wants a volume of every mesh."""

    def initialize(self: Any, xml_string: str | None = None) -> None:
        root = ElementTree.fromstring(xml_string or self.model.get_xml())
        for mesh in root.iter("mesh"):
            if mesh.get("name", "").startswith(_FLAT):
                mesh.set("inertia", "shell")  # seen, and of no weight
        cls._initialize_sim(self, ElementTree.tostring(root, encoding="unicode"))

    # Under the same name: robosuite keeps classes by name
    return type(cls)(cls.__name__, (cls,), {"_initialize_sim": initialize})
