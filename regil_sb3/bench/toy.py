"""A learner that lives for seconds, for tests and `regil bench faults`.

* ``Reach`` - an environment with a guide of its own; ``demonstration``, ``stacked``
* ``toy``, ``new_model`` - with what makes its open episodes come back, and TD3BC on it
* ``live``, ``digest`` - one life of a process, and all that decides how learning goes on, as a hash
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from regil_wrappers import Demonstration
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack

from regil_sb3.checkpoint import CheckpointCallback, ReplayableEpisode
from regil_sb3.checkpoint.learner_state import learner_state
from regil_sb3.td3bc import TD3BC

__all__ = [
    "STEPS",
    "Reach",
    "demonstration",
    "digest",
    "flat",
    "live",
    "new_model",
    "stacked",
    "toy",
]

STEPS = 200


class Reach(gym.Env[Any, Any]):
    """A white dot goes where it is sent; success in the right third. The guide goes right.

    Args:
        action_high: of both actions.
        reward: of this environment; None is -1.
        dict_obs: whether the position is seen as a number, and not as a picture.
    """

    LENGTH = 12

    def __init__(
        self,
        action_high: float = 1.0,
        reward: Callable[[Any], float] | None = None,
        dict_obs: bool = False,
    ) -> None:
        self.image = spaces.Box(0, 255, (40, 40, 3), np.uint8)
        self.dict_obs = dict_obs
        self.observation_space = (
            spaces.Dict({"x": spaces.Box(-1, 1, (1,), np.float32)}) if dict_obs else self.image
        )
        self.action_space: spaces.Box = spaces.Box(-action_high, action_high, (2,), np.float32)
        self.reward = reward
        self.executed: list[Any] = []

    def _obs(self) -> Any:
        if self.dict_obs:
            return {"x": np.array([self.x / 40], np.float32)}
        frame = np.zeros((40, 40, 3), np.uint8)
        x = int(np.clip(self.x, 0, 36))
        frame[18:22, x : x + 4] = 255
        return frame

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin in the left third."""
        super().reset(seed=seed)
        self.x = float(self.np_random.uniform(0, 12))
        self.t = 0
        return self._obs(), {}

    def guide_action(self) -> NDArray[Any]:
        """To the right."""
        action: NDArray[Any] = (
            np.array([self.np_random.uniform(0.5, 0.9), 0.1], np.float32) * self.action_space.high
        )
        return action

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Go there."""
        self.executed.append(np.array(action))
        self.x += 4 * float(action[0] / self.action_space.high[0])
        self.t += 1
        success = self.x > 27
        reward = -1.0 if self.reward is None else self.reward(self)
        info = {"is_success": success, "retrieval": {"env_reward": 5.0}}
        return self._obs(), reward, success, not success and self.t >= self.LENGTH, info


def demonstration(high: float = 1.0) -> Demonstration:
    """The guide's own."""
    env = Reach(high)
    frame, _ = env.reset(seed=0)
    frames, actions, done = [frame], [], False
    while not done:
        actions.append(np.array([0.7, 0.1], np.float32) * high)
        frame, _, done, _, _ = env.step(actions[-1])
        frames.append(frame)
    return Demonstration(frames=np.stack(frames), actions=np.stack(actions))


def stacked(n_envs: int = 1, n_stack: int = 2, vec: Any = DummyVecEnv, **kwargs: Any) -> VecEnv:
    """Several, their frames stacked."""
    return VecFrameStack(vec([lambda: Reach(**kwargs) for _ in range(n_envs)]), n_stack)


def toy(
    n_envs: int = 1, replayable: bool = True, env: Callable[..., Any] = Reach, **kwargs: Any
) -> VecEnv:
    """The same, whose open episodes come back after a restart."""

    def one() -> Any:
        return ReplayableEpisode(env(**kwargs)) if replayable else env(**kwargs)

    return VecFrameStack(DummyVecEnv([one] * n_envs), 2)


def new_model(env: VecEnv, policy: str = "CnnPolicy", **changes: Any) -> TD3BC:
    """TD3BC with all that it has, at sizes that take seconds."""
    settings = {
        "demo": demonstration(),
        "buffer_size": 150,
        "learning_starts": 20,
        "batch_size": 8,
        "warmup_steps": 60,
        "guide_again": 0.5,
        "bc_pretrain_steps": 5,
        "bc_schedule": "success",
        "keep_own_successes": True,
        "success_buffer_size": 80,
        "seed": 0,
        "device": "cpu",
    }
    return TD3BC(policy, env, **{**settings, **changes})


def live(
    folder: Path,
    env: VecEnv,
    every: int,
    also: Callable[[int], Sequence[BaseCallback]] = lambda done: (),
    **changes: Any,
) -> dict[str, Any]:
    """One life of a process, to step 200 or its end: the learner's state then.

    Args:
        folder: of checkpoints; goes on from the newest.
        env: to learn in.
        every: steps between checkpoints.
        also: given the steps already done, callbacks.
        **changes: of the model.
    """
    model = new_model(env, **changes)
    checkpoints = CheckpointCallback(folder, steps=every)
    done = checkpoints.restore(model)
    anew = not checkpoints.restored
    try:
        model.learn(STEPS - done, [checkpoints, *also(done)], reset_num_timesteps=anew)
        return learner_state(model)
    finally:
        checkpoints.close()


def flat(tree: Any, at: str = "") -> Iterator[tuple[str, NDArray[Any]]]:
    """Each value of a learner's state, and where it is; times aside."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from flat(value, f"{at}/{key}")
    elif isinstance(tree, list | tuple):
        for i, value in enumerate(tree):
            yield from flat(value, f"{at}/{i}")
    elif not at.endswith("/t"):  # Monitor's seconds
        yield at, np.asarray(getattr(tree, "rows", tree))


def digest(state: dict[str, Any]) -> str:
    """SHA-256 of a learner's state, to the bit."""
    found = hashlib.sha256()
    for at, array in sorted(flat(state), key=lambda pair: pair[0]):
        found.update(f"{at} {array.dtype} {array.tolist()!r}".encode())
    return found.hexdigest()
