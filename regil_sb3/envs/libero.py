"""LIBERO's tasks as Gymnasium environments that learn from pixels."""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.utils import EzPickle

from regil_sb3.envs import EVALUATION_SEEDS, LIBERO_TASKS
from regil_sb3.envs.choices import check_choices, check_positive
from regil_sb3.envs.libero_experts import make_expert
from regil_sb3.envs.libero_import import bddl_file, import_libero, initial_states
from regil_sb3.envs.osc import CONTROL_RATE, OSCEnv, reset_simulation, seeded
from regil_sb3.envs.osc_experts import Action
from regil_sb3.envs.rendering import prepare_graphics

__all__ = ["CAMERAS", "LiberoEnv"]

CAMERAS = (
    *("agentview", "frontview", "birdview", "sideview"),
    *("robot0_eye_in_hand", "robot0_robotview"),
)
"""LIBERO's own cameras; its papers use the first."""

_IDLE = np.array([0, 0, 0, 0, 0, 0, -1], np.float32)  # holds still, with an open gripper
_SETTLE = 10  # steps in which what was placed above the table falls onto it


class LiberoEnv(OSCEnv, EzPickle):
    """A LIBERO task: a Panda arm, several objects, and success as the end of the episode.

    Registered as `regil/libero-<suite>-<task>-v0`, with the suites 90, 10, spatial, object and
    goal, and under the short names of `SHORT_LIBERO_TASKS`. An action moves the hand: translation
    along the axes of the world (first three dimensions; a step of 1 asks for 5 cm, of which about
    1.3 are made in its 50 ms), rotation about them (next three; 1 asks for half a radian), and the
    gripper (last; positive closes). The reward is 1 where LIBERO's own predicate holds, else 0.
    Success terminates; after `max_steps` agent steps the episode is truncated.
    `info["is_success"]` is there on every step.

    The objects' places are drawn as LIBERO draws them, from the generator that `reset(seed=)`
    seeds. LIBERO's 50 fixed initial states are kept for evaluation: seed 1,000,000 + i takes state
    i, modulo their number. Each episode begins after 10 steps in which the objects fall into
    place.

    Its assets are found through the environment variable `REGIL_LIBERO_ASSETS`.

    Args:
        task: one of `LIBERO_TASKS`.
        obs: `"pixels"` for (size, size, 3) uint8 frames, or `"state"` for (n,) float32: the hand's
            position, quaternion (w x y z) and fingers, position and quaternion of each object, and
            the fixtures' joints and positions (m, rad; clipped to +-10).
        camera: one of `CAMERAS`.
        size: height and width of the frames in pixels.
        action_repeat: how many control steps (50 ms each) an action lasts.
        random_object: whether each `reset` draws new places; if not, it is always LIBERO's first
            initial state.
        render_mode: `None` or `"rgb_array"`.
        render_size: height and width of what `render()` returns; `None` stands for `size`.
        max_steps: agent steps after which an episode is truncated.

    Raises:
        ValueError: where an argument is none of the above, or assets are missing.
        ImportError: where LIBERO is not installed.
    """

    def __init__(
        self,
        task: str,
        obs: str = "pixels",
        camera: str = "agentview",
        size: int = 128,
        action_repeat: int = 1,
        random_object: bool = True,
        render_mode: str | None = None,
        render_size: int | None = None,
        max_steps: int = 400,
    ) -> None:
        EzPickle.__init__(
            self,
            task,
            obs,
            camera,
            size,
            action_repeat,
            random_object,
            render_mode,
            render_size,
            max_steps,
        )
        if task not in LIBERO_TASKS:
            near = difflib.get_close_matches(task, LIBERO_TASKS, cutoff=0.3) or list(LIBERO_TASKS)
            raise ValueError(f"task {task!r} is not one of LIBERO's: try {', '.join(near[:3])}")
        render_size = size if render_size is None else render_size
        check_choices(obs, camera, CAMERAS, render_mode)
        check_positive(
            size=size, action_repeat=action_repeat, render_size=render_size, max_steps=max_steps
        )
        prepare_graphics()
        sim = _make_simulation(*LIBERO_TASKS[task])
        self._states = initial_states(*LIBERO_TASKS[task])
        model = sim.sim.model._model
        self._task = task
        self._placed = model.body_pos.copy(), model.body_quat.copy()

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
            sites=True,
        )

    def _place(self, seed: int | None) -> None:
        import mujoco  # type: ignore[import-untyped]

        fixed = None
        if not self._random_object:
            fixed = 0
        elif seed is not None and EVALUATION_SEEDS <= seed < 2 * EVALUATION_SEEDS:
            fixed = (seed - EVALUATION_SEEDS) % len(self._states)
        env, model = self._sim, self._sim.sim.model._model
        # Fixtures are placed by moving them in the model, which a reset does not take back
        model.body_pos[:], model.body_quat[:] = self._placed
        # LIBERO's initial states say nothing of fixtures, which are drawn all the same
        reset_simulation(env, self._draws())
        if fixed is not None:
            env.sim.set_state_from_flattened(self._states[fixed])
            mujoco.mj_forward(model, env.sim.data._data)
            env._post_process()
        for _ in range(_SETTLE):
            env.step(_IDLE)

    def _step_simulation(self, action: npt.NDArray[np.float32]) -> bool:
        return bool(self._sim.step(action)[2])

    def _make_expert(self) -> Iterator[Action]:
        return make_expert(self._task, self._sim)

    def targets(self) -> npt.NDArray[np.float64]:
        """Where what the task is about stands, (n, 3) m: what LIBERO calls objects of interest."""
        env = self._sim
        bodies = [env.obj_body_id[name] for name in env.obj_of_interest if name in env.obj_body_id]
        return np.array(env.sim.data.body_xpos[bodies])

    def _measure(self) -> npt.NDArray[np.float64]:
        env, data = self._sim, self._sim.sim.data
        robot = env.robots[0]
        hand = robot.eef_site_id
        parts = [
            data.site_xpos[hand],
            data.get_body_xquat(robot.robot_model.eef_name),
            data.qpos[robot._ref_gripper_joint_pos_indexes],
        ]
        for name in env.objects_dict:
            body = env.obj_body_id[name]
            parts += [data.body_xpos[body], data.body_xquat[body]]
        for name, fixture in env.fixtures_dict.items():
            parts.append(data.body_xpos[env.obj_body_id[name]])
            parts += [np.atleast_1d(data.get_joint_qpos(joint)) for joint in fixture.joints]
        state: npt.NDArray[np.float64] = np.concatenate(parts)
        return state


def _make_simulation(suite: str, task: str) -> Any:
    """LIBERO's own environment, without its renderer and its observations."""
    envs = import_libero()
    from libero.libero.envs import bddl_utils  # type: ignore[import-untyped]
    from robosuite.controllers import load_controller_config  # type: ignore[import-untyped]

    file = str(bddl_file(suite, task))
    problem = bddl_utils.get_problem_info(file)["problem_name"]
    try:
        with seeded(0):
            env = envs.TASK_MAPPING[problem](
                file,
                robots=["Panda"],
                controller_configs=load_controller_config(default_controller="OSC_POSE"),
                initialization_noise="default",  # as in the fixed initial states
                use_camera_obs=False,
                has_offscreen_renderer=False,
                control_freq=CONTROL_RATE,
                ignore_done=True,
                hard_reset=False,  # it would compile the model again in every episode
            )
    except (OSError, ValueError) as error:
        reason = str(error).splitlines()[-1] if str(error) else repr(error)
        raise ValueError(f"LIBERO's assets lack something that {task} needs: {reason}") from error
    env._observables = {}  # they would be measured 25 times a step
    return env
