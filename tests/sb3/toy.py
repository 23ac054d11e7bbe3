"""An environment that learns in seconds, with a guide of its own."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from regil_wrappers import Demonstration
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack


class Reach(gym.Env):
    """A white dot goes where it is sent; success in the right third. The guide goes right."""

    LENGTH = 12

    def __init__(self, action_high=1.0, reward=None, dict_obs=False):
        self.image = spaces.Box(0, 255, (40, 40, 3), np.uint8)
        self.dict_obs = dict_obs
        self.observation_space = (
            spaces.Dict({"x": spaces.Box(-1, 1, (1,), np.float32)}) if dict_obs else self.image
        )
        self.action_space = spaces.Box(-action_high, action_high, (2,), np.float32)
        self.reward = reward
        self.executed = []

    def _obs(self):
        if self.dict_obs:
            return {"x": np.array([self.x / 40], np.float32)}
        frame = np.zeros((40, 40, 3), np.uint8)
        x = int(np.clip(self.x, 0, 36))
        frame[18:22, x : x + 4] = 255
        return frame

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = float(self.np_random.uniform(0, 12))
        self.t = 0
        return self._obs(), {}

    def guide_action(self):
        return (
            np.array([self.np_random.uniform(0.5, 0.9), 0.1], np.float32) * self.action_space.high
        )

    def step(self, action):
        self.executed.append(np.array(action))
        self.x += 4 * float(action[0] / self.action_space.high[0])
        self.t += 1
        success = self.x > 27
        reward = -1.0 if self.reward is None else self.reward(self)
        info = {"is_success": success, "retrieval": {"env_reward": 5.0}}
        return self._obs(), reward, success, not success and self.t >= self.LENGTH, info


def demonstration(high=1.0):
    env = Reach(high)
    frame, _ = env.reset(seed=0)
    frames, actions, done = [frame], [], False
    while not done:
        actions.append(np.array([0.7, 0.1], np.float32) * high)
        frame, _, done, _, _ = env.step(actions[-1])
        frames.append(frame)
    return Demonstration(frames=np.stack(frames), actions=np.stack(actions))


def stacked(n_envs=1, n_stack=2, vec=DummyVecEnv, **kwargs):
    return VecFrameStack(vec([lambda: Reach(**kwargs) for _ in range(n_envs)]), n_stack)
