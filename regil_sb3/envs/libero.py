"""LIBERO's tasks as Gymnasium environments that learn from pixels."""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box
from gymnasium.utils import EzPickle

from regil_sb3.envs import EVALUATION_SEEDS, LIBERO_TASKS
from regil_sb3.envs.choices import check_choices, check_positive
from regil_sb3.envs.libero_experts import Action, make_expert
from regil_sb3.envs.libero_import import bddl_file, import_libero, initial_states
from regil_sb3.envs.rendering import Renderer, prepare_graphics

__all__ = ["CAMERAS", "LiberoEnv"]

Frame = npt.NDArray[np.uint8]

CAMERAS = (
    *("agentview", "frontview", "birdview", "sideview"),
    *("robot0_eye_in_hand", "robot0_robotview"),
)
"""LIBERO's own cameras; its papers use the first."""

_CONTROL_RATE = 20  # Hz
_COLLISION_SHAPES = 0  # the group of geoms that LIBERO does not draw
_IDLE = np.array([0, 0, 0, 0, 0, 0, -1], np.float32)  # holds still, with an open gripper
_SETTLE = 10  # steps in which what was placed above the table falls onto it
_STATE_BOUND = 10.0  # m
_STEP_CM = 1.3  # that the hand goes in a step under an action of 1, in free air


class LiberoEnv(gym.Env[npt.NDArray[Any], npt.NDArray[np.float32]], EzPickle):
    """A LIBERO task: a Panda arm, several objects, and success as the end of the episode.

    Registered as `regil/libero-<suite>-<task>-v0`, with the suites 90, 10, spatial, object and
    goal, and under the short names of `SHORT_LIBERO_TASKS`. An action moves the hand: translation
    along the axes of the world (first three dimensions; a step of 1 asks for 5 cm, of which about
    1 is made in its 50 ms), rotation about them (next three; 1 asks for half a radian), and the
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

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

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
        self._sim = _make_simulation(*LIBERO_TASKS[task])
        self._states = initial_states(*LIBERO_TASKS[task])
        model = self._sim.sim.model._model
        self._placed = model.body_pos.copy(), model.body_quat.copy()

        self.render_mode = render_mode
        self._task = task
        self._obs_kind = obs
        self._size, self._render_size = size, render_size
        self._action_repeat, self._max_steps = action_repeat, max_steps
        self._random_object = random_object
        self._camera = model.camera(camera).id
        self._renderer: Renderer | None = None
        self._expert: Iterator[Action] | None = None
        self._steps: int | None = None

        self.action_space = Box(-1.0, 1.0, (7,), np.float32)
        if obs == "pixels":
            self.observation_space = Box(0, 255, (size, size, 3), np.uint8)
        else:
            shape = self._state().shape
            self.observation_space = Box(-_STATE_BOUND, _STATE_BOUND, shape, np.float32)
        control_rate = _CONTROL_RATE / action_repeat
        self.metadata = {
            **self.metadata,
            "render_fps": round(control_rate),
            "regil": {
                "camera": camera,
                "render": {"shadows": False, "reflections": False, "samples": 0},
                "image_size": [size, size],
                "action_repeat": action_repeat,
                "control_rate": control_rate,
                "translation_dims": [0, 1, 2],
                "rotation_dims": [3, 4, 5],
                "gripper_dim": 6,
                "settle_time": 0.5,
                "start_std": [0.8 / action_repeat] * 3,
                "plane": [8 / action_repeat, 8 / action_repeat, 0.5 / action_repeat],
                "crowded": True,
                "mirror": 1,
                "step_cm": _STEP_CM * action_repeat,
            },
        }

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[Any], dict[str, Any]]:
        """Place the objects, let them fall, and start an episode.

        Args:
            seed: seeds the generator that places the objects; `None` draws on from it. From
                1,000,000 to 1,999,999 it names one of LIBERO's initial states.
            options: none are known; ignored.

        Returns:
            The observation and `{"is_success": False}`.
        """
        import mujoco  # type: ignore[import-untyped]

        super().reset(seed=seed)
        fixed = None
        if not self._random_object:
            fixed = 0
        elif seed is not None and EVALUATION_SEEDS <= seed < 2 * EVALUATION_SEEDS:
            fixed = (seed - EVALUATION_SEEDS) % len(self._states)
        env, model = self._sim, self._sim.sim.model._model
        # Fixtures are placed by moving them in the model, which a reset does not take back
        model.body_pos[:], model.body_quat[:] = self._placed
        gripper = env.robots[0].gripper  # its opening is kept outside the simulation
        gripper.current_action = np.zeros(gripper.dof)
        # LIBERO's initial states say nothing of fixtures, which are drawn all the same
        draws = self.np_random if self._random_object else np.random.default_rng(0)
        with _seeded(int(draws.integers(2**32))):
            _reset(env)
        if fixed is not None:
            env.sim.set_state_from_flattened(self._states[fixed])
            mujoco.mj_forward(model, env.sim.data._data)
            env._post_process()
        for _ in range(_SETTLE):
            env.step(_IDLE)
        self._expert, self._steps = None, 0
        return self._observe(), {"is_success": False}

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[Any], float, bool, bool, dict[str, Any]]:
        """Play an action `action_repeat` times, or until success.

        Args:
            action: (7,) float32, clipped to [-1, 1].

        Returns:
            Observation, reward (1 for success), whether the task is solved (terminated), whether
            the time is over (truncated), and `{"is_success": bool}`.

        Raises:
            ValueError: where the action is not (7,) or not finite, or before the first `reset`.
        """
        if self._steps is None:
            raise ValueError("step() was called before reset(): call reset() first")
        action = np.asarray(action, np.float32)
        if action.shape != (7,) or not np.isfinite(action).all():
            raise ValueError(f"action {action} must be 7 finite numbers")
        action = np.clip(action, -1.0, 1.0)
        success = False
        for _ in range(self._action_repeat):
            success = bool(self._sim.step(action)[2])
            if success:
                break
        self._steps += 1
        truncated = not success and self._steps >= self._max_steps
        return self._observe(), float(success), success, truncated, {"is_success": success}

    def expert_action(self) -> Action:
        """Ask the task's scripted expert what to do now; it counts on being asked once a step.

        Returns:
            (7,) float32 within the action space.

        Raises:
            ValueError: where the task has no expert, or before the first `reset`.
        """
        if self._steps is None:
            raise ValueError("expert_action() was asked before reset(): call reset() first")
        if self._expert is None:
            self._expert = make_expert(self._task, self._sim)
        return next(self._expert)

    def encoder_frame(self, size: int) -> Frame:
        """Draw the current scene for an encoder that wants larger pictures.

        Args:
            size: height and width in pixels.

        Returns:
            (size, size, 3) uint8, upright.
        """
        sim = self._sim.sim
        if self._renderer is None:
            self._renderer = Renderer(
                sim.model._model, self._camera, size, hidden=[_COLLISION_SHAPES], sites=True
            )
        frame: Frame = self._renderer.draw(sim.data._data, size)[::-1].copy()
        return frame

    def render(self) -> Frame | None:
        """Draw the current scene, (render_size, render_size, 3) uint8 and upright.

        Returns:
            The picture, or `None` where `render_mode` is `None`.
        """
        return None if self.render_mode is None else self.encoder_frame(self._render_size)

    def targets(self) -> npt.NDArray[np.float64]:
        """Where what the task is about stands, (n, 3) m: what LIBERO calls objects of interest."""
        env = self._sim
        bodies = [env.obj_body_id[name] for name in env.obj_of_interest if name in env.obj_body_id]
        return np.array(env.sim.data.body_xpos[bodies])

    def close(self) -> None:
        """Free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _observe(self) -> npt.NDArray[Any]:
        return self.encoder_frame(self._size) if self._obs_kind == "pixels" else self._state()

    def _state(self) -> npt.NDArray[np.float32]:
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
        state: npt.NDArray[np.float32] = np.concatenate(parts).astype(np.float32)
        return np.clip(state, -_STATE_BOUND, _STATE_BOUND)


def _make_simulation(suite: str, task: str) -> Any:
    """LIBERO's own environment, without its renderer and its observations."""
    envs = import_libero()
    from libero.libero.envs import bddl_utils  # type: ignore[import-untyped]
    from robosuite.controllers import load_controller_config  # type: ignore[import-untyped]

    file = str(bddl_file(suite, task))
    problem = bddl_utils.get_problem_info(file)["problem_name"]
    try:
        with _seeded(0):
            env = envs.TASK_MAPPING[problem](
                file,
                robots=["Panda"],
                controller_configs=load_controller_config(default_controller="OSC_POSE"),
                initialization_noise="default",  # as in the fixed initial states
                use_camera_obs=False,
                has_offscreen_renderer=False,
                control_freq=_CONTROL_RATE,
                ignore_done=True,
                hard_reset=False,  # it would compile the model again in every episode
            )
    except (OSError, ValueError) as error:
        reason = str(error).splitlines()[-1] if str(error) else repr(error)
        raise ValueError(f"LIBERO's assets lack something that {task} needs: {reason}") from error
    env._observables = {}  # they would be measured 25 times a step
    return env


def _reset(env: Any) -> None:
    """Draw places until the objects do not overlap."""
    from robosuite.utils.errors import RandomizationError  # type: ignore[import-untyped]

    for _ in range(100):
        try:
            env.reset()
        except RandomizationError:
            continue
        return
    raise ValueError("LIBERO found no places for its objects in 100 attempts")


@contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """numpy's global generator, from which LIBERO draws, seeded here and as it was afterwards."""
    before = np.random.get_state()
    np.random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(before)
