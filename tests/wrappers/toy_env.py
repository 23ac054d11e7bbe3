"""A point that has to reach a square, drawn as a picture: the environment that these tests wrap."""

from __future__ import annotations

from typing import Any

import cv2
import gymnasium as gym
import numpy as np
from regil_wrappers import Demonstration


class ToyReach(gym.Env[Any, np.ndarray]):
    """`look` turns the picture as broken cameras do; `frozen` puts the square at one place."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        render_mode: str | None = None,
        obs: str = "pixels",
        size: int = 48,
        camera: str = "above",
        frozen: bool = True,
        look: str = "upright",
        says_settings: bool = True,
    ) -> None:
        self.render_mode = render_mode
        self.size = size
        self.obs = obs
        self.frozen = frozen
        self.look = look
        self.action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        picture = gym.spaces.Box(0, 255, (size, size, 3), np.uint8)
        state = gym.spaces.Box(-np.inf, np.inf, (4,), np.float32)
        spaces: dict[str, gym.Space[Any]] = {
            "pixels": picture,
            "channels_first": gym.spaces.Box(0, 255, (3, size, size), np.uint8),
            "state": state,
            "dict": gym.spaces.Dict({"state": state, "front": picture}),
        }
        self.observation_space = spaces[obs]
        if says_settings:
            self.metadata = self.metadata | {
                "regil": {
                    "camera": camera,
                    "render": {"shadows": False},
                    "image_size": [size, size],
                    "action_repeat": 1,
                    "control_rate": 10,
                }
            }

    def encoder_frame(self, size: int) -> np.ndarray:
        picture = np.empty((size, size, 3), np.uint8)
        half = size // 2
        picture[:half, :half] = (90, 120, 200)
        picture[:half, half:] = (150, 160, 170)
        picture[half:] = (160, 110, 60)
        for centre, radius, colour in (
            (self.goal, 0.09, (220, 30, 30)),
            (self.point, 0.06, (20, 20, 20)),
        ):
            low = tuple(int(v) for v in np.round((centre - radius) * size))
            high = tuple(int(v) for v in np.round((centre + radius) * size))
            cv2.rectangle(picture, low, high, colour, cv2.FILLED)
        turned = {
            "upright": picture,
            "upside down": picture[::-1],
            "mirrored": picture[:, ::-1],
            "turned by 180 degrees": picture[::-1, ::-1],
            "red and blue exchanged": picture[..., ::-1],
        }
        return np.ascontiguousarray(turned[self.look])

    def render(self) -> np.ndarray:
        return self.encoder_frame(self.size)

    def expert_action(self) -> np.ndarray:
        return np.clip((self.goal - self.point) / 0.05, -1, 1).astype(np.float32)

    def _observe(self) -> Any:
        state = np.concatenate([self.point, self.goal]).astype(np.float32)
        picture = self.encoder_frame(self.size)
        return {
            "pixels": picture,
            "channels_first": np.moveaxis(picture, -1, 0).copy(),
            "state": state,
            "dict": {"state": state, "front": picture},
        }[self.obs]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.point = np.array([0.2, 0.2])
        self.goal = np.array([0.8, 0.6])
        if not self.frozen:
            self.goal = self.np_random.uniform(0.1, 0.9, size=2)
        self.steps = 0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> Any:
        self.point = np.clip(self.point + 0.05 * np.asarray(action, np.float64), 0, 1)
        self.steps += 1
        success = bool(np.abs(self.point - self.goal).max() < 0.03)
        info = {"is_success": success}
        return self._observe(), float(success), success, self.steps >= 40, info


gym.register("ToyReach-v0", entry_point="toy_env:ToyReach")


def record(seed: int = 0, encoder_size: int | None = None, **settings: Any) -> Demonstration:
    """One expert episode."""
    env = ToyReach(**settings)
    env.reset(seed=seed)
    pictures, larger, actions, successes = [env.render()], [], [], [False]
    larger.append(env.encoder_frame(encoder_size or 8))
    while not successes[-1]:
        actions.append(env.expert_action())
        successes.append(env.step(actions[-1])[2])
        pictures.append(env.render())
        larger.append(env.encoder_frame(encoder_size or 8))
    regil = env.metadata.get("regil", {})
    return Demonstration(
        np.stack(pictures),
        actions=np.stack(actions),
        encoder_frames=np.stack(larger) if encoder_size else None,
        successes=np.array(successes),
        metadata={
            "env_id": "ToyReach-v0",
            "seed": seed,
            "action_low": [-1, -1],
            "action_high": [1, 1],
            **{k: regil[k] for k in ("camera", "render", "action_repeat") if k in regil},
        },
    )
