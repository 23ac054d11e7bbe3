"""A hand in space and a square that it has to touch, seen by a camera: what correction is for."""

from __future__ import annotations

from typing import Any

import cv2
import gymnasium as gym
import numpy as np
from regil_wrappers import Demonstration

SIZE = 84
FOCAL = 88.0  # px
EYE, LOOK_AT = np.array([0.0, -58.0, 40.0]), np.array([0.0, 4.0, -6.0])
HOME = np.array([2.0, 4.0, -22.0])  # where the square stands in the demonstration
GOAL = np.array([-9.0, 12.0, -6.0])  # of "carry", where it does not move, and "bring"
SPREAD = 9.0  # how far the square moves along each axis of the table
NEAR = 1.2


def _textured(side: int, seed: int) -> np.ndarray:
    small = np.random.default_rng(seed).uniform(20, 235, (side // 4, side // 4, 3))
    return cv2.resize(small.astype(np.float32), (side, side), interpolation=cv2.INTER_CUBIC)


_TABLE = cv2.resize(_textured(96, 9)[:12, :12], (SIZE + 40, SIZE + 40)) * 0.4 + 80
_FIXED = _textured(24, 7)
_SQUARE, _HAND, _PLACE = _textured(16, 3), _textured(20, 4), _textured(20, 11)
_FINGERS = {False: np.full((8, 8, 3), 250, np.float32), True: np.full((8, 8, 3), 5, np.float32)}


def project(place: Any, distance: float = 1.0) -> tuple[np.ndarray, float]:
    """Pixel (x, y) and depth of a place, written again and apart from `regil_wrappers.pinhole`."""
    eye = LOOK_AT + distance * (EYE - LOOK_AT)
    ahead = (LOOK_AT - EYE) / np.linalg.norm(LOOK_AT - EYE)
    right = np.array([1.0, 0.0, 0.0])
    down = np.cross(ahead, right)
    seen = np.stack([right, down, ahead]) @ (np.asarray(place) - eye)
    return (SIZE - 1) / 2 + FOCAL * seen[:2] / seen[2], float(seen[2])


def _draw(
    picture: np.ndarray, thing: np.ndarray, place: Any, side: float, pan: Any, distance: float
) -> np.ndarray:
    (x, y), depth = project(place, distance)
    scale = FOCAL * side / depth / len(thing)
    half = scale * (len(thing) - 1) / 2
    matrix = np.array([[scale, 0, x + pan[0] - half], [0, scale, y + pan[1] - half]])
    size = picture.shape[1::-1]
    alpha = cv2.warpAffine(np.ones(thing.shape[:2], np.float32), matrix, size)[..., None]
    pixels = cv2.warpAffine(thing, matrix, size, borderMode=cv2.BORDER_REPLICATE)
    return picture * (1 - alpha) + alpha * pixels


class ToyCamera(gym.Env[Any, np.ndarray]):
    """Actions are deltas (dx right, dy away, dz up, gripper); the square moves on the table.

    Tasks: "touch" the square, "carry" it to a goal, or "bring" it to one that is seen and moves.

    `decoy`: only the picture of the square moves, what has to be touched does not. `dead`: a
    dimension that does nothing. `absolute`: actions are places. `look`: "mirrored" left to right.
    `pan`: px by which the camera is turned. `distance`: of the camera, 1 where it
    usually stands. `axes`: how far the square moves along each. `start`: how far from its place the
    hand starts, along each axis; declared where `declares` is.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        task: str = "touch",
        frozen: bool = False,
        render_mode: str | None = None,
        obs: str = "pixels",
        decoy: bool = False,
        dead: int | None = None,
        absolute: bool = False,
        look: str = "upright",
        pan: tuple[float, float] = (0, 0),
        light: float = 1.0,
        distance: float = 1.0,
        axes: tuple[float, float, float] = (SPREAD, SPREAD, 0.0),
        start: float = 0.0,
        declares: bool = True,
        max_steps: int = 70,
    ) -> None:
        self.task, self.frozen, self.render_mode, self.obs = task, frozen, render_mode, obs
        self.decoy, self.dead, self.absolute, self.look = decoy, dead, absolute, look
        self.pan, self.light, self.axes, self.max_steps = pan, light, np.array(axes), max_steps
        self.distance, self.start = distance, start
        self.action_space = gym.spaces.Box(-1, 1, (4,), np.float32)
        picture = gym.spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)
        state = gym.spaces.Box(-np.inf, np.inf, (6,), np.float32)
        self.observation_space = {
            "pixels": picture,
            "state": state,
            "dict": gym.spaces.Dict({"state": state, "front": picture}),
        }[obs]
        if declares:
            said = {
                "control_rate": 20,
                "translation_dims": [0, 1, 2],
                "gripper_dim": 3,
                "plane": [8.0, 8.0, 0.5],
                "mirror": 1,
            }
            if start:
                said["start_std"] = [start] * 3
            self.metadata = {**self.metadata, "regil": said}

    def render(self) -> np.ndarray:
        x, y = 20 - np.asarray(self.pan, float)
        picture = cv2.warpAffine(_TABLE, np.array([[1, 0, -x], [0, 1, -y]]), (SIZE, SIZE))
        picture = _draw(picture, _FIXED, (-20, 30, -22), 8, self.pan, self.distance)
        if self.task == "bring":
            picture = _draw(picture, _PLACE, self.goal, 9, self.pan, self.distance)
        picture = _draw(picture, _SQUARE, self.square, 9, self.pan, self.distance)
        picture = _draw(picture, _HAND, self.hand + np.array([0, 0, 3]), 7, self.pan, self.distance)
        picture = _draw(picture, _FINGERS[self.closed], self.hand, 4, self.pan, self.distance)
        seen = (picture * self.light).round().clip(0, 255).astype(np.uint8)
        return np.ascontiguousarray(seen[:, ::-1]) if self.look == "mirrored" else seen

    def _observe(self) -> Any:
        if self.obs == "pixels":
            return self.render()
        state = np.concatenate([self.hand, self.square]).astype(np.float32)
        return state if self.obs == "state" else {"state": state, "front": self.render()}

    def expert_action(self) -> np.ndarray:
        to = self.square - self.hand
        if self.task != "touch" and (np.abs(to).max() < 0.2 or self.held):
            return np.array([*np.clip(self.goal - self.hand, -0.8, 0.8) * self.held, 1], np.float32)
        return np.array([*np.clip(to, -0.8, 0.8), -1], np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.hand = self.start * self.np_random.normal(size=3) if self.start else np.zeros(3)
        self.square = HOME.copy()
        if not self.frozen:
            self.square += self.axes * self.np_random.uniform(-1, 1, 3)
        self.goal = GOAL.copy()
        if self.task == "bring" and not self.frozen:
            self.goal += self.axes * self.np_random.uniform(-1, 1, 3)
        self.closed = self.held = False
        self.steps = 0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> Any:
        delta = np.clip(np.asarray(action[:3], np.float64), -1, 1)
        if self.dead is not None:
            delta[self.dead] = 0
        self.hand = 10 * delta if self.absolute else self.hand + delta
        self.closed = bool(action[3] > 0)
        wanted = HOME if self.decoy else self.square
        self.held = self.closed and (self.held or bool(np.abs(self.hand - wanted).max() < NEAR))
        if self.task != "touch":
            if self.held:
                self.square = self.hand.copy()
            success = bool(self.held and np.abs(self.hand - self.goal).max() < NEAR)
        else:
            success = bool(np.abs(self.hand - wanted).max() < NEAR)
        self.steps += 1
        info = {"is_success": success}
        return self._observe(), float(success), success, self.steps >= self.max_steps, info


gym.register("ToyCamera-v0", entry_point="toy_camera:ToyCamera")


def record(**settings: Any) -> Demonstration:
    """One expert episode with the square at home."""
    env = ToyCamera(frozen=True, **settings)
    env.reset(seed=0)
    pictures, actions, over = [env.render()], [], False
    while not over:
        actions.append(env.expert_action())
        over = env.step(actions[-1])[2]
        pictures.append(env.render())
        assert len(actions) < 200
    return Demonstration(
        np.stack(pictures),
        actions=np.stack(actions),
        metadata={"env_id": "ToyCamera-v0", "action_low": [-1] * 4, "action_high": [1] * 4},
    )
