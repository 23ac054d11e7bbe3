"""The retrieval wrappers inside Stable-Baselines3's vector environments, and its checker."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import toy_env
from regil_wrappers import Demonstration, RetrievalGuideWrapper, RetrievalRewardWrapper
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecFrameStack,
    VecTransposeImage,
)


def stack(demo: str) -> gym.Env[Any, Any]:
    env = RetrievalGuideWrapper(toy_env.ToyReach(), demo)
    return Monitor(RetrievalRewardWrapper(env, demo))


@pytest.mark.parametrize("vector", [DummyVecEnv, SubprocVecEnv])
def test_guided_replay_with_frames_stacked_outside(
    vector: Any, demo: Demonstration, demo_path: str
) -> None:
    env = VecFrameStack(VecTransposeImage(vector([partial(stack, demo_path)] * 2)), 2)
    try:
        env.reset()
        assert demo.actions is not None
        for episode in range(2):  # the environments reset themselves in between
            for t in range(len(demo.actions)):
                actions = np.stack(env.env_method("guide_action"))
                np.testing.assert_array_equal(actions, demo.actions[[t, t]])
                observation, rewards, done, infos = env.step(actions)
                assert observation.shape == (2, 6, 48, 48)
                assert rewards.tolist() == [0, 0], (episode, t)
                for info in infos:
                    assert info["retrieval"]["end"] == t + 1
            assert done.all()
            assert all(info["is_success"] for info in infos)
            assert all(info["retrieval"]["env_reward"] == 1 for info in infos)
            assert all(info["episode"]["r"] == 0 for info in infos)
        assert len(set(env.get_attr("reward_scale"))) == 1
    finally:
        env.close()


@pytest.mark.parametrize("wrapper", [RetrievalGuideWrapper, RetrievalRewardWrapper])
def test_sb3s_checker(wrapper: Any, demo_path: str) -> None:
    check_env(wrapper(toy_env.ToyReach(frozen=False), demo_path), skip_render_check=True)
