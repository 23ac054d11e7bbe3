"""Meta-World's tasks as Gymnasium environments that learn from pixels.

`MetaWorldEnv` works on Meta-World's task classes directly: its own `gym.make` ids ignore
`reset(seed=)` and draw the goal.
"""

from __future__ import annotations

import difflib
import warnings
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box
from gymnasium.utils import EzPickle

from regil_sb3.envs import METAWORLD_TASKS
from regil_sb3.envs.choices import check_choices, check_positive
from regil_sb3.envs.rendering import Renderer, prepare_graphics

__all__ = ["CAMERAS", "MetaWorldEnv"]

Frame = npt.NDArray[np.uint8]

_AS_SHIPPED = ("corner4", "corner", "corner2", "corner3", "topview", "behindGripper", "gripperPOV")
_MOVED = {
    # name: (camera it starts from, position in m, quaternion w x y z)
    "corner-near": ("corner", (-0.5, 0.2, 0.4), (0.30521, -0.23086, -0.55734, 0.73684)),
    "corner3-near": ("corner3", (0.7, 0.1, 0.4), (0.3191, -0.21125, 0.50999, -0.77036)),
}
CAMERAS = (*_AS_SHIPPED, *_MOVED)
"""Cameras by name: Meta-World's own as shipped, and two moved closer to the table, as other papers
on imitation from pixels use them (`corner3-near` for hammer, door and window, `corner-near` for
the rest). The default `corner4` is `corner2` moved to (0.75, 0.075, 0.7) m."""

_STATE_BOUND = 10.0  # m; Meta-World's own bounds are infinite, and checkers warn of that


class MetaWorldEnv(gym.Env[npt.NDArray[Any], npt.NDArray[np.float32]], EzPickle):
    """A Meta-World v3 task: a robot arm, one object, and success as the end of the episode.

    Registered as `regil/metaworld-<task>-v0`. An action sends the hand up to 1 cm along each axis
    of the world (first three dimensions) and sets the fingers' effort (fourth; 1 closes), and is
    played `action_repeat` times, or until success. The reward is Meta-World's own, summed over
    these. Success terminates; after `max_steps` agent steps the episode is truncated.
    `info["is_success"]` is there on every step.

    Every `reset` places the object anew, from the generator that `reset(seed=)` seeds: the same
    seed gives the same frames, to the bit, in any instance on a machine. The mark Meta-World
    draws where the goal is stays invisible, so that tasks whose goal has no other picture
    (reach, push, pick-place and their kind) cannot be solved from pixels alone.

    Example:
        >>> import gymnasium as gym
        >>> import regil_sb3
        >>> env = gym.make("regil/metaworld-button-press-v0")
        >>> frame, info = env.reset(seed=0)
        >>> frame.shape, frame.dtype
        ((84, 84, 3), dtype('uint8'))
        >>> *_, info = env.step(env.unwrapped.expert_action())
        >>> info["is_success"]
        False
        >>> env.close()

    Args:
        task: Meta-World's name for the task, without `-v3`.
        obs: `"pixels"` for (size, size, 3) uint8 frames, or `"state"` for Meta-World's own vector,
            (39,) float32: hand position and opening, positions and quaternions of two objects,
            now and one simulator step before, and the goal (m; clipped to +-10).
        camera: one of `CAMERAS`.
        size: height and width of the frames in pixels.
        action_repeat: how many simulator steps (12.5 ms each) an action lasts.
        random_object: whether each `reset` draws a place for the object; if not, the object is at
            one place whatever the seed.
        render_mode: `None` or `"rgb_array"`.
        render_size: height and width of what `render()` returns; `None` stands for `size`.
        max_steps: agent steps after which an episode is truncated.

    Raises:
        ValueError: where an argument is none of the above.
        ImportError: where Meta-World is not installed.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 40}  # noqa: RUF012
    _SIMULATOR_RATE: ClassVar[float] = 80.0  # Hz: 5 substeps of 2.5 ms

    def __init__(
        self,
        task: str,
        obs: str = "pixels",
        camera: str = "corner4",
        size: int = 84,
        action_repeat: int = 2,
        random_object: bool = True,
        render_mode: str | None = None,
        render_size: int | None = None,
        max_steps: int = 125,
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
        if task not in METAWORLD_TASKS:
            near = difflib.get_close_matches(task, METAWORLD_TASKS) or METAWORLD_TASKS
            raise ValueError(f"task {task!r} is not one of Meta-World's: try {', '.join(near)}")
        render_size = size if render_size is None else render_size
        check_choices(obs, camera, CAMERAS, render_mode)
        check_positive(
            size=size, action_repeat=action_repeat, render_size=render_size, max_steps=max_steps
        )
        prepare_graphics()
        try:
            from metaworld.env_dict import ENV_CLS_MAP
            from metaworld.policies import ENV_POLICY_MAP
        except ModuleNotFoundError as error:
            raise ImportError(
                f"Meta-World is not installed ({error}): pip install 'regil-sb3[metaworld]'"
            ) from None
        import mujoco  # type: ignore[import-untyped]

        self.render_mode = render_mode
        self._obs_kind = obs
        self._size, self._render_size = size, render_size
        self._action_repeat, self._max_steps = action_repeat, max_steps
        self._random_object = random_object

        self._sim = sim = ENV_CLS_MAP[f"{task}-v3"]()
        self._expert: Any = ENV_POLICY_MAP[f"{task}-v3"]()  # type: ignore[abstract]
        sim._set_task_called = True
        sim._freeze_rand_vec, sim.seeded_rand_vec = False, True
        sim._partially_observable = False  # the scripted expert must know the goal
        del sim.sawyer_observation_space  # cached while the goal was still masked
        sim.max_path_length = max_steps * action_repeat + 1  # the limit is ours

        start, *pose = _MOVED.get(camera, (camera,))
        self._camera = sim.model.camera(start).id
        if pose:
            sim.model.cam_pos[self._camera], sim.model.cam_quat[self._camera] = pose
        mujoco.mj_forward(sim.model, sim.data)
        # Most of Meta-World's cameras hang upside down: their up axis points at the floor.
        self._upside_down = bool(sim.data.cam_xmat[self._camera, 7] < 0)
        self._renderer: Renderer | None = None
        self._state: npt.NDArray[np.float64] | None = None
        self._steps = 0

        self.action_space = Box(-1.0, 1.0, (4,), np.float32)
        if obs == "pixels":
            self.observation_space = Box(0, 255, (size, size, 3), np.uint8)
        else:
            self.observation_space = Box(-_STATE_BOUND, _STATE_BOUND, (39,), np.float32)
        control_rate = self._SIMULATOR_RATE / action_repeat
        self.metadata = {
            **self.metadata,
            "render_fps": round(control_rate),
            "regil": {
                "camera": camera,
                "render": {"shadows": False, "reflections": False, "samples": 0, "sites": False},
                "image_size": [size, size],
                "action_repeat": action_repeat,
                "control_rate": control_rate,
                "translation_dims": [0, 1, 2],
                "gripper_dim": 3,
                # An action moves the hand 1 cm a repeat; targets move by 10 cm in the plane.
                "plane": [10 / action_repeat, 10 / action_repeat, 0.5 / action_repeat],
                # Rows flipped alone mirror a camera that hangs upside down.
                "mirror": -1 if self._upside_down else 1,
                "step_cm": 1.0 * action_repeat,
            },
        }

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[Any], dict[str, Any]]:
        """Place the object and start an episode.

        Args:
            seed: seeds the generator that places the object; `None` draws on from it.
            options: none are known; ignored.

        Returns:
            The observation and `{"is_success": False}`.
        """
        import mujoco

        super().reset(seed=seed)
        sim = self._sim
        sim.np_random = self.np_random if self._random_object else np.random.default_rng(0)
        sim.reset()
        # Meta-World moves the object last and does not tell the kinematics: without this the
        # first frame and the first observation of some tasks show where it was before.
        mujoco.mj_forward(sim.model, sim.data)
        sim._prev_obs = sim._get_curr_obs_combined_no_goal()
        self._state = sim._get_obs()
        self._steps = 0
        return self._observe(), {"is_success": False}

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[Any], float, bool, bool, dict[str, Any]]:
        """Play an action `action_repeat` times, or until success.

        Args:
            action: (4,) float32, clipped to [-1, 1].

        Returns:
            Observation, Meta-World's reward summed over the repeats, whether the task is solved
            (terminated), whether the time is over (truncated), and `{"is_success": bool}`.

        Raises:
            ValueError: where the action is not (4,) or not finite, or before the first `reset`.
        """
        if self._state is None:
            raise ValueError("step() was called before reset(): call reset() first")
        action = np.asarray(action, np.float32)
        if action.shape != (4,) or not np.isfinite(action).all():
            raise ValueError(f"action {action} must be 4 finite numbers")
        action = np.clip(action, -1.0, 1.0)
        reward, success = 0.0, False
        for _ in range(self._action_repeat):
            self._state, part, _, _, info = self._sim.step(action)
            reward += float(part)
            success = bool(info["success"])
            if success:
                break
        self._steps += 1
        truncated = not success and self._steps >= self._max_steps
        return self._observe(), reward, success, truncated, {"is_success": success}

    def expert_action(self) -> npt.NDArray[np.float32]:
        """Ask Meta-World's scripted policy what to do now.

        Returns:
            (4,) float32 within the action space.

        Raises:
            ValueError: before the first `reset`.
        """
        if self._state is None:
            raise ValueError("expert_action() was asked before reset(): call reset() first")
        with warnings.catch_warnings():
            # It warns each time its gain asks for more than 1; the clip below is the answer.
            warnings.filterwarnings("ignore", "Constant", UserWarning)
            action = self._expert.get_action(self._state)
        return np.asarray(np.clip(action, -1.0, 1.0), np.float32)

    def encoder_frame(self, size: int) -> Frame:
        """Draw the current scene for an encoder that wants larger pictures.

        Args:
            size: height and width in pixels.

        Returns:
            (size, size, 3) uint8, upright.
        """
        if self._renderer is None:
            self._renderer = Renderer(self._sim.model, self._camera, size)
        frame = self._renderer.draw(self._sim.data, size)
        # OpenGL's rows run upwards: a camera that hangs upside down needs no flip of them.
        return frame if self._upside_down else frame[::-1].copy()

    def render(self) -> Frame | None:
        """Draw the current scene, (render_size, render_size, 3) uint8 and upright.

        Returns:
            The picture, or `None` where `render_mode` is `None`.
        """
        return None if self.render_mode is None else self.encoder_frame(self._render_size)

    def hand(self) -> npt.NDArray[np.float64]:
        """Where the hand is, (3,) m.

        Raises:
            ValueError: before the first `reset`.
        """
        if self._state is None:
            raise ValueError("hand() was asked before reset(): call reset() first")
        return np.array(self._state[:3])

    def targets(self) -> npt.NDArray[np.float64]:
        """Where what the task moves about stands, (1 or 2, 3) m."""
        return np.array(self._sim._last_rand_vec, float).reshape(-1, 3)

    def close(self) -> None:
        """Free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _observe(self) -> npt.NDArray[Any]:
        if self._obs_kind == "pixels":
            return self.encoder_frame(self._size)
        assert self._state is not None
        return np.clip(self._state, -_STATE_BOUND, _STATE_BOUND).astype(np.float32)
