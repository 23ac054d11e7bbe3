from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from regil_wrappers import Demonstration, RetrievalGuideWrapper, RetrievalRewardWrapper
from toy_env import ToyReach


def stack(demo: str, frozen: bool = False) -> gym.Env[Any, Any]:
    env = RetrievalGuideWrapper(ToyReach(frozen=frozen), demo)
    return RetrievalRewardWrapper(env, demo)


@pytest.mark.parametrize("vector", [SyncVectorEnv, AsyncVectorEnv])
def test_each_environment_has_its_own_alignment(vector: Any, demo_path: str) -> None:
    """Three environments, long enough for episodes to end, against each of them alone."""
    together = vector([partial(stack, demo_path)] * 3)
    alone = [stack(demo_path) for _ in range(3)]
    rng = np.random.default_rng(0)
    try:
        _, infos = together.reset(seed=[1, 2, 3])
        for n, env in enumerate(alone):
            _, info = env.reset(seed=n + 1)
            assert infos["retrieval"]["cost"][n] == info["retrieval"]["cost"]
        done = [False] * 3
        endings = 0
        for _ in range(90):
            actions = rng.uniform(-1, 1, (3, 2)).astype(np.float32)
            _, rewards, terminated, truncated, infos = together.step(actions)
            for n, env in enumerate(alone):
                if done[n]:  # this step of the vector was the reset
                    _, info = env.reset()
                    reward, ended = 0.0, False
                else:
                    _, reward, a, b, info = env.step(actions[n])
                    ended = a or b
                endings += ended
                done[n] = ended
                assert rewards[n] == reward
                assert (terminated[n] or truncated[n]) == ended
                for key in ("start", "end", "cost"):
                    assert infos["retrieval"][key][n] == info["retrieval"][key]
                np.testing.assert_array_equal(
                    infos["retrieval"]["guide_action"][n], info["retrieval"]["guide_action"]
                )
        assert endings >= 6
    finally:
        together.close()


def test_guided_replay_in_subprocesses(demo: Demonstration, demo_path: str) -> None:
    env = AsyncVectorEnv([partial(stack, demo_path, frozen=True)] * 2)
    try:
        env.reset(seed=0)
        for _ in range(len(demo) - 1):
            actions = np.stack(env.call("guide_action"))
            _, rewards, terminated, _, infos = env.step(actions)
            assert rewards.tolist() == [0, 0]
        assert terminated.all()
        assert infos["is_success"].all()
        assert len(set(env.get_attr("reward_scale"))) == 1
    finally:
        env.close()
