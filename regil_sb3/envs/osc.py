"""What environments on robosuite's simulation have in common, LIBERO's and its own.

* ``OSCEnv`` - an arm under operational-space control (OSC_POSE), and what the camera sees of it
* ``reset_simulation`` - a new episode, decided by a seed alone
* ``seeded`` - numpy's global generator, from which these simulations draw
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box

from regil_sb3.envs.osc_experts import Action
from regil_sb3.envs.rendering import Renderer

__all__ = ["CONTROL_RATE", "OSCEnv", "reset_simulation", "seeded"]

Frame = npt.NDArray[np.uint8]

CONTROL_RATE = 20
"""Hz."""

_COLLISION_SHAPES = 0  # the group of geoms that robosuite does not draw
_STATE_BOUND = 10.0  # m
_STEP_CM = 1.3  # that the hand goes in a step under an action of 1, in free air


class OSCEnv(gym.Env[npt.NDArray[Any], npt.NDArray[np.float32]], ABC):
    """An arm that moves its hand as it is told, and success as the end of the episode.

    Subclasses check what a user chose, make the simulation, and call `_set_up` once.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def _set_up(
        self,
        sim: Any,
        *,
        obs: str,
        camera: str,
        size: int,
        action_repeat: int,
        random_object: bool,
        render_mode: str | None,
        render_size: int | None,
        max_steps: int,
        sites: bool = False,
        facts: dict[str, Any] | None = None,
    ) -> None:
        """Define spaces and metadata.

        Args:
            sim: robosuite's environment, without its renderer.
            obs: as of the environment, and so are the following.
            camera: see `obs`.
            size: see `obs`.
            action_repeat: see `obs`.
            random_object: see `obs`.
            render_mode: see `obs`.
            render_size: see `obs`.
            max_steps: see `obs`.
            sites: whether MuJoCo's sites are drawn.
            facts: of `metadata["regil"]`, where they differ from those below.
        """
        model = sim.sim.model._model
        self.render_mode = render_mode
        self._sim = sim
        self._obs_kind = obs
        self._size, self._render_size = size, size if render_size is None else render_size
        self._action_repeat, self._max_steps = action_repeat, max_steps
        self._random_object = random_object
        self._camera = model.camera(camera).id
        self._sites = sites
        self._renderer: Renderer | None = None
        self._expert: Iterator[Action] | None = None
        self._steps: int | None = None

        self.action_space = Box(-1.0, 1.0, (sim.action_dim,), np.float32)
        if obs == "pixels":
            self.observation_space = Box(0, 255, (size, size, 3), np.uint8)
        else:
            shape = self._state().shape
            self.observation_space = Box(-_STATE_BOUND, _STATE_BOUND, shape, np.float32)
        control_rate = CONTROL_RATE / action_repeat
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
                **(facts or {}),
            },
        }

    @abstractmethod
    def _place(self, seed: int | None) -> None:
        """Begin an episode in the simulation."""

    @abstractmethod
    def _step_simulation(self, action: npt.NDArray[np.float32]) -> bool:
        """Play one control step: whether the task is solved."""

    @abstractmethod
    def _make_expert(self) -> Iterator[Action]:
        """The task's expert at the beginning of an episode, or `ValueError` in one line."""

    @abstractmethod
    def _measure(self) -> npt.NDArray[np.float64]:
        """The state, (n,), not yet clipped."""

    @abstractmethod
    def targets(self) -> npt.NDArray[np.float64]:
        """Where what the task is about stands, (n, 3) m."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[Any], dict[str, Any]]:
        """Place the objects and start an episode.

        Args:
            seed: seeds the generator that places the objects; `None` draws on from it.
            options: none are known; ignored.

        Returns:
            The observation and `{"is_success": False}`.
        """
        super().reset(seed=seed)
        self._place(seed)
        self._expert, self._steps = None, 0
        return self._observe(), {"is_success": False}

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[Any], float, bool, bool, dict[str, Any]]:
        """Play an action `action_repeat` times, or until success.

        Args:
            action: (n,) float32 of the action space's n, clipped to [-1, 1].

        Returns:
            Observation, reward (1 for success), whether the task is solved (terminated), whether
            the time is over (truncated), and `{"is_success": bool}`.

        Raises:
            ValueError: where the action is not (n,) or not finite, or before the first `reset`.
        """
        if self._steps is None:
            raise ValueError("step() was called before reset(): call reset() first")
        action = np.asarray(action, np.float32)
        shape = self.action_space.shape
        assert shape is not None
        if action.shape != shape or not np.isfinite(action).all():
            raise ValueError(f"action {action} must be {shape[0]} finite numbers")
        action = np.clip(action, -1.0, 1.0)
        success = False
        for _ in range(self._action_repeat):
            success = self._step_simulation(action)
            if success:
                break
        self._steps += 1
        truncated = not success and self._steps >= self._max_steps
        return self._observe(), float(success), success, truncated, {"is_success": success}

    def expert_action(self) -> Action:
        """Ask the task's scripted expert what to do now; it counts on being asked once a step.

        Returns:
            (n,) float32 within the action space.

        Raises:
            ValueError: where the task has no expert, or before the first `reset`.
        """
        if self._steps is None:
            raise ValueError("expert_action() was asked before reset(): call reset() first")
        if self._expert is None:
            self._expert = self._make_expert()
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
                sim.model._model,
                self._camera,
                size,
                hidden=[_COLLISION_SHAPES],
                sites=self._sites,
            )
        frame: Frame = self._renderer.draw(sim.data._data, size)[::-1].copy()
        return frame

    def render(self) -> Frame | None:
        """Draw the current scene, (render_size, render_size, 3) uint8 and upright.

        Returns:
            The picture, or `None` where `render_mode` is `None`.
        """
        return None if self.render_mode is None else self.encoder_frame(self._render_size)

    def close(self) -> None:
        """Free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _draws(self) -> np.random.Generator:
        """What an episode's places are drawn from; always the same where nothing is random."""
        return self.np_random if self._random_object else np.random.default_rng(0)

    def _observe(self) -> npt.NDArray[Any]:
        return self.encoder_frame(self._size) if self._obs_kind == "pixels" else self._state()

    def _state(self) -> npt.NDArray[np.float32]:
        return np.clip(self._measure(), -_STATE_BOUND, _STATE_BOUND).astype(np.float32)


def reset_simulation(env: Any, draws: np.random.Generator) -> None:
    """Begin an episode, with places drawn until the objects do not overlap.

    Args:
        env: robosuite's environment.
        draws: one number of it decides the whole episode.

    Raises:
        ValueError: no places were found.
    """
    from robosuite.utils.errors import RandomizationError  # type: ignore[import-untyped]

    gripper = env.robots[0].gripper  # its opening is kept outside the simulation
    gripper.current_action = np.zeros(gripper.dof)
    with seeded(int(draws.integers(2**32))):
        for _ in range(100):
            try:
                env.reset()
            except RandomizationError:
                continue
            return
    raise ValueError("the simulation found no places for its objects in 100 attempts")


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """numpy's global generator seeded here, and as it was afterwards."""
    before = np.random.get_state()
    np.random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(before)
