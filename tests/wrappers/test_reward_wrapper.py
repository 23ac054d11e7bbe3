"""`RetrievalRewardWrapper` with each reward."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import toy_env  # registers ToyReach-v0  # noqa: F401
from regil_wrappers import Demonstration, RetrievalGuideWrapper, RetrievalRewardWrapper, vector
from regil_wrappers.reward_signals import AT_EPISODE_END, AT_EVERY_STEP
from regil_wrappers.rewards import episode_scale, ot_rewards, tot_rewards
from toy_env import ToyReach

ACTIONS = np.random.default_rng(0).uniform(-1, 1, (39, 2)).astype(np.float32)


def episode(env: gym.Env[Any, Any]) -> tuple[list[float], dict[str, Any]]:
    """An episode's rewards and its last info, and no other with rewards of the whole episode."""
    env.reset(seed=0)
    rewards: list[float] = []
    done, info = False, {}
    while not done:
        assert "episode_rewards" not in info.get("retrieval", {})
        action = ACTIONS[len(rewards) % len(ACTIONS)]
        _, reward, terminated, truncated, info = env.step(action)
        rewards.append(float(reward))
        done = terminated or truncated
    return rewards, info["retrieval"]


@pytest.mark.parametrize("reward", AT_EPISODE_END)
def test_rewards_of_the_whole_episode_come_at_its_end(demo: Demonstration, reward: Any) -> None:
    env = RetrievalRewardWrapper(ToyReach(), demo, reward=reward)
    assert env.rewards_at_episode_end
    assert env.reward_scale == len(demo) / 10
    steps, last = episode(env)
    assert steps == [0.0] * 40

    env.reset(seed=0)
    seen = [env.retriever.embedding]
    for action in np.resize(ACTIONS, (40, 2)):
        env.step(action)
        seen.append(env.retriever.embedding)
    function = {"ot": ot_rewards, "tot": tot_rewards}[reward]
    expected = function(np.stack(seen), env.retriever.embeddings)[1:]
    assert last["episode_rewards"].dtype == np.float32
    assert last["episode_rewards"].shape == (40,)
    np.testing.assert_array_equal(last["episode_rewards"], expected.astype(np.float32))
    assert last["episode_scale"] == episode_scale(expected)


def test_weight_and_mode_hold_for_rewards_of_the_whole_episode(demo: Demonstration) -> None:
    class Paid(gym.Wrapper[Any, Any, Any, Any]):
        def step(self, action: Any) -> Any:
            observation, _, *rest = self.env.step(action)
            return observation, 3.0, *rest

    _, plain = episode(RetrievalRewardWrapper(ToyReach(), demo, reward="tot"))
    steps, weighted = episode(
        RetrievalRewardWrapper(Paid(ToyReach()), demo, reward="tot", mode="add", weight=0.5)
    )
    assert steps == [3.0] * 40  # the placeholder is what the environment paid
    assert weighted["env_reward"] == 3
    np.testing.assert_allclose(weighted["episode_rewards"], plain["episode_rewards"] / 2)
    assert weighted["episode_scale"] == plain["episode_scale"]  # else it would undo the weight


@pytest.mark.parametrize("reward", [*AT_EVERY_STEP, *AT_EPISODE_END])
def test_where_the_wrapper_stands_and_what_was_before_make_no_difference(
    demo: Demonstration, reward: Any
) -> None:
    inner, outer, alone = (
        RetrievalGuideWrapper(RetrievalRewardWrapper(ToyReach(), demo, reward=reward), demo),
        RetrievalRewardWrapper(RetrievalGuideWrapper(ToyReach(), demo), demo, reward=reward),
        RetrievalRewardWrapper(ToyReach(), demo, reward=reward),
    )
    alone.reset(seed=5)
    for action in ACTIONS[:7]:  # an episode that is given up
        alone.step(action)
    steps, last = episode(alone)
    for env in (inner, outer, alone):
        again, info = episode(env)
        assert again == steps
        np.testing.assert_array_equal(info.get("episode_rewards"), last.get("episode_rewards"))


@pytest.mark.parametrize("reward", [*AT_EVERY_STEP, *AT_EPISODE_END])
def test_a_specification_remembers_the_reward(demo_path: str, reward: Any) -> None:
    env = RetrievalRewardWrapper(gym.make("ToyReach-v0"), demo_path, reward=reward)
    assert env.spec is not None
    again = gym.make(env.spec)
    assert again.get_wrapper_attr("reward") == reward
    assert env.rewards_at_episode_end == (reward in AT_EPISODE_END)
    assert env.reward_scale > 0


def test_an_unknown_reward_gets_one_line(demo: Demonstration) -> None:
    with pytest.raises(ValueError, match=r"^reward='dtw': choose one of \['sdtw', 'progress'"):
        RetrievalRewardWrapper(ToyReach(), demo, reward="dtw")  # type: ignore[arg-type]


@pytest.mark.parametrize(("inside", "outside"), [("ot", "tot"), ("ot", "sdtw"), ("sdtw", "ot")])
def test_rewards_at_the_end_are_not_stacked(inside: Any, outside: Any, demo: Demonstration) -> None:
    env = RetrievalGuideWrapper(RetrievalRewardWrapper(ToyReach(), demo, reward=inside), demo)
    message = "come at an episode's end and cannot be stacked"
    with pytest.raises(ValueError, match=message):
        RetrievalRewardWrapper(env, demo, reward=outside, mode="add")
    envs: Any = gym.vector.SyncVectorEnv([ToyReach] * 2)
    envs = vector.RetrievalRewardWrapper(envs, demo, reward=inside)
    with pytest.raises(ValueError, match=message):
        vector.RetrievalRewardWrapper(envs, demo, reward=outside, mode="add")


def test_rewards_at_every_step_are_stacked(demo: Demonstration) -> None:
    inside = RetrievalRewardWrapper(ToyReach(), demo, reward="cos")
    env = RetrievalRewardWrapper(inside, demo, reward="sdtw", mode="add", weight=2.0)
    env.reset(seed=0)
    *_, info = env.step(np.zeros(2, np.float32))
    assert info["retrieval"]["cost"] >= 0
