"""Record episodes as a `Demonstration`.

* ``Recorder`` - takes down one episode of an environment
* ``record_expert`` - its scripted expert's; ``NoExpertError`` where there is none
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from copy import deepcopy
from importlib.metadata import version
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from regil_wrappers.demonstration import Demonstration
from regil_wrappers.frames import stated

from regil_sb3.envs import EVALUATION_SEEDS, NoExpertError

__all__ = [
    "EVALUATION_SEEDS",
    "NoExpertError",
    "Recorder",
    "action_limits",
    "check_seeds",
    "make_env",
    "record_expert",
]

_PACKAGES = ("gymnasium", "metaworld", "mujoco", "numpy", "regil-sb3", "regil-wrappers")


def record_expert(
    env_id: str,
    seed: int = 0,
    env_kwargs: dict[str, Any] | None = None,
    encoder_frame_size: int | None = None,
    max_seeds: int = 20,
    progress: Callable[[str], None] | None = None,
) -> Demonstration:
    """Play the scripted expert until it succeeds, and keep that episode.

    The expert is asked once per agent step; its action is clipped to the action space, then
    executed and stored. The recording ends with the frame after the first success. Where an
    episode ends without one, the next seed is tried.

    Args:
        env_id: id of an environment that offers `expert_action() -> (A,) float32`.
        seed: first seed to try; `seed + 1`, ... follow.
        env_kwargs: arguments for `gymnasium.make`.
        encoder_frame_size: height and width (pixels) of the larger pictures to keep beside the
            frames, for an encoder that wants them; `None` keeps none.
        max_seeds: how many seeds to try.
        progress: called with one line for each seed tried.

    Returns:
        T actions and T + 1 frames: the environment's observations, or, where these are no
        images, pictures of its `image_size`, with the observations beside them.

    Raises:
        NoExpertError: where the environment has no scripted expert.
        ValueError: where a seed belongs to evaluation, or no seed leads to success.
    """
    check_seeds(seed, max_seeds)
    env = make_env(env_id, env_kwargs)
    try:
        if not hasattr(env.unwrapped, "expert_action"):
            raise NoExpertError(
                f"{env_id} has no scripted expert (no expert_action()): "
                "record it by hand (regil record --teleop keyboard), or elsewhere"
            )
        recorder = Recorder(env, encoder_frame_size)
        for tried in range(1, max_seeds + 1):
            now = seed + tried - 1
            recorder.begin(now)
            while not recorder.over:
                recorder.step(env.unwrapped.expert_action())
            if progress is not None:
                outcome = "solved" if recorder.solved else "not solved"
                progress(f"seed {now}: {outcome} after {len(recorder)} steps")
            if recorder.solved:
                return recorder.demonstration(env_id, seeds_tried=tried)
        raise ValueError(
            f"the scripted expert of {env_id} solved none of the seeds {seed} to "
            f"{seed + max_seeds - 1}: try another seed, or more steps an episode"
        )
    finally:
        env.close()


def make_env(env_id: str, env_kwargs: dict[str, Any] | None) -> gym.Env[Any, Any]:
    """The environment.

    Raises:
        ValueError: if it does not take these arguments.
    """
    try:
        return gym.make(env_id, **(env_kwargs or {}))
    except TypeError as error:  # an argument that it does not have
        raise ValueError(f"{env_id} cannot be made with {env_kwargs}: {error}") from error


def check_seeds(seed: int, many: int = 1) -> None:
    """Refuse seeds that belong to evaluation.

    Raises:
        ValueError: naming those that do not.
    """
    if seed < 0 or many < 1 or seed + many > EVALUATION_SEEDS:
        raise ValueError(
            f"seeds {seed} to {seed + many - 1} must lie between 0 and "
            f"{EVALUATION_SEEDS - 1}: those above are kept for evaluation"
        )


class Recorder:
    """Takes down one episode of an environment, one after the other.

    Pictures are the observations; of dict observations the first that is a picture; else the
    environment's ``encoder_frame`` in its ``image_size``, or what it renders. All other
    observations are kept beside them, further pictures included.

    Args:
        env: without retrieval wrappers.
        encoder_frame_size: height and width (pixels) of the larger pictures to keep beside the
            frames; None keeps none.

    Raises:
        ValueError: where actions are not continuous, there are no pictures, or ``encoder_frame``
            is all that draws them and no ``image_size`` is declared.
    """

    def __init__(self, env: gym.Env[Any, Any], encoder_frame_size: int | None = None) -> None:
        name = env.spec.id if env.spec else type(env.unwrapped).__name__
        if not isinstance(env.action_space, gym.spaces.Box):
            raise ValueError(f"{name} has actions {env.action_space}: only Box can be recorded")
        self.env = env
        self.space = env.action_space
        self._ours: Any = env.unwrapped
        self._encoder_size = encoder_frame_size
        space = env.observation_space
        parts = space.spaces if isinstance(space, gym.spaces.Dict) else {}
        self._keys = [key for key, part in parts.items() if is_picture(part)]
        self._pixels = is_picture(space)
        draws = hasattr(self._ours, "encoder_frame")
        if encoder_frame_size is not None and not draws:
            raise ValueError(f"{name} draws no larger pictures (no encoder_frame())")
        ours = stated(self._ours.metadata)
        if draws and not (self._pixels or self._keys or "image_size" in ours):
            raise ValueError(
                f"{name} draws its pictures (encoder_frame) but does not say in which size: "
                'declare metadata["regil"]["image_size"] = [HEIGHT, WIDTH]'
            )
        if not (self._pixels or self._keys or draws or env.render_mode == "rgb_array"):
            raise ValueError(
                f"{name} gives no pictures: make it with --env-kwargs render_mode=rgb_array"
            )

    def __len__(self) -> int:
        """Steps taken so far."""
        return len(self.actions)

    def begin(self, seed: int) -> None:
        """Begin the episode of a seed."""
        self.seed = seed
        self._observations: list[Any] = []
        self.frames: list[npt.NDArray[np.uint8]] = []
        self._encoder_frames: list[npt.NDArray[np.uint8]] = []
        self.actions: list[npt.NDArray[np.float32]] = []
        self.successes = [False]
        self.over = self.timed_out = False
        observation, _ = self.env.reset(seed=seed)
        self._see(observation)

    def step(self, action: npt.NDArray[np.floating[Any]]) -> None:
        """Execute an action, clipped to the action space, and take down what came of it."""
        clipped = np.clip(action, self.space.low, self.space.high).astype(np.float32)
        observation, _, terminated, truncated, info = self.env.step(clipped)
        self._see(observation)
        self.actions.append(clipped)
        self.successes.append(bool(info.get("is_success", terminated)))
        self.timed_out = truncated
        self.over = self.solved or terminated or truncated

    @property
    def solved(self) -> bool:
        """Whether the environment says so of the last frame."""
        return self.successes[-1]

    def _see(self, observation: Any) -> None:
        if self._pixels:
            frame = observation
        elif self._keys:
            frame = observation[self._keys[0]]
            observation = {k: v for k, v in observation.items() if k != self._keys[0]}
        else:
            frame = self.drawn()
        if not self._pixels:
            self._observations.append(deepcopy(observation))  # it may be written to again
        self.frames.append(np.array(frame))
        if self._encoder_size is not None:
            self._encoder_frames.append(self._ours.encoder_frame(self._encoder_size))

    def drawn(self, size: int | None = None) -> npt.NDArray[np.uint8]:
        """The scene as it is now, (H, W, 3) uint8; in so many pixels where it can be drawn so."""
        if hasattr(self._ours, "encoder_frame"):
            size = size or self._ours.metadata["regil"]["image_size"][0]
            return np.asarray(self._ours.encoder_frame(size), np.uint8)
        if self.env.render_mode == "rgb_array":
            return np.asarray(self.env.render(), np.uint8)
        return self.frames[-1]

    def demonstration(self, env_id: str, **metadata: Any) -> Demonstration:
        """The episode so far.

        Args:
            env_id: the environment's.
            metadata: more of it.
        """
        observations: Any = self._observations or None
        if observations is not None and isinstance(observations[0], dict):
            observations = {
                key: np.stack([o[key] for o in observations]) for key in observations[0]
            } or None
        elif observations is not None:
            observations = np.stack(observations)
        ours = stated(self.env.unwrapped.metadata)
        kept = ("camera", "render", "image_size", "action_repeat", "control_rate")
        return Demonstration(
            frames=np.stack(self.frames),
            actions=np.stack(self.actions),
            observations=observations,
            encoder_frames=np.stack(self._encoder_frames) if self._encoder_frames else None,
            successes=np.array(self.successes),
            metadata={
                **{name: ours[name] for name in kept if name in ours},
                "env_id": env_id,
                **action_limits(self.space),
                "seed": self.seed,
                # only what took part in this recording
                "versions": {
                    name: version(name)
                    for name in _PACKAGES
                    if name.replace("-", "_") in sys.modules
                },
                **metadata,
            },
        )


def action_limits(space: gym.spaces.Box) -> dict[str, list[float] | None]:
    """As metadata holds them: None where not all are finite."""
    sides = {"action_low": space.low, "action_high": space.high}
    return {name: v.tolist() if np.isfinite(v).all() else None for name, v in sides.items()}


def is_picture(space: gym.Space[Any]) -> bool:
    """Whether these are RGB pictures, uint8 (H, W, 3)."""
    return isinstance(space, gym.spaces.Box) and space.dtype == np.uint8 and space.shape[2:] == (3,)
