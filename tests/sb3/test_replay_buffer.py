"""FrameReplayBuffer against SB3's own buffers, which store every stack twice."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer

from regil_sb3.replay_buffer import FrameReplayBuffer

SIZE = 8


def spaces_for(n_stack, channels=3):
    image = spaces.Box(0, 255, (channels * n_stack, SIZE, SIZE), np.uint8)
    return image, spaces.Box(-1, 1, (2,), np.float32)


class Stream:
    """Random episodes of several environments, stacked as VecFrameStack stacks."""

    def __init__(self, n_envs, n_stack, seed):
        self.rng = np.random.default_rng(seed)
        self.n_envs, self.n_stack = n_envs, n_stack
        self.stacks = [self.first() for _ in range(n_envs)]

    def frame(self):
        return self.rng.integers(0, 256, (3, SIZE, SIZE), dtype=np.uint8)

    def first(self):
        return np.concatenate(
            [np.zeros((3 * (self.n_stack - 1), SIZE, SIZE), np.uint8), self.frame()]
        )

    def step(self):
        obs = np.stack(self.stacks)
        following = [np.concatenate([s[3:], self.frame()]) for s in self.stacks]
        done = self.rng.random(self.n_envs) < 0.2
        timeout = done & (self.rng.random(self.n_envs) < 0.5)
        infos = [{"TimeLimit.truncated": bool(t)} for t in timeout]
        action = self.rng.uniform(-1, 1, (self.n_envs, 2)).astype(np.float32)
        reward = self.rng.normal(size=self.n_envs).astype(np.float32)
        self.stacks = [self.first() if d else f for d, f in zip(done, following, strict=True)]
        return obs, np.stack(following), action, reward, done, infos


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("n_stack", [1, 2, 3])
@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("steps", [7, 31, 32, 100])
def test_samples_equal_those_of_sb3(n_envs, n_stack, n_steps, steps):
    image, action = spaces_for(n_stack)
    kwargs = {"device": "cpu", "n_envs": n_envs, "n_steps": n_steps, "gamma": 0.9}
    ours = FrameReplayBuffer(32 * n_envs, image, action, n_stack=n_stack, **kwargs)
    theirs = NStepReplayBuffer(32 * n_envs, image, action, **kwargs)
    stream = Stream(n_envs, n_stack, seed=steps)
    for _ in range(steps):
        transition = stream.step()
        ours.add(*transition)
        theirs.add(*transition)
    for seed in range(5):
        np.random.seed(seed)
        a = ours.sample(64)
        np.random.seed(seed)
        b = theirs.sample(64)
        for name in ("observations", "next_observations", "actions", "dones"):
            assert np.array_equal(getattr(a, name), getattr(b, name)), name
        np.testing.assert_allclose(a.rewards, b.rewards, rtol=1e-6)
        np.testing.assert_allclose(a.discounts, b.discounts, rtol=1e-6)


@pytest.mark.parametrize(("n_stack", "share"), [(2, 0.26), (3, 0.18)])
def test_memory_is_a_fraction_of_sb3s(n_stack, share):
    image = spaces.Box(0, 255, (3 * n_stack, 84, 84), np.uint8)
    action = spaces.Box(-1, 1, (4,), np.float32)
    ours = FrameReplayBuffer(500, image, action, "cpu", n_stack=n_stack, n_steps=3)
    theirs = NStepReplayBuffer(500, image, action, "cpu", n_steps=3)
    assert ours.nbytes <= share * (theirs.observations.nbytes + theirs.next_observations.nbytes)


def test_state_goes_round_with_open_episodes():
    image, action = spaces_for(2)
    kwargs = {"device": "cpu", "n_envs": 2, "n_stack": 2, "n_steps": 3}
    ours, again = (FrameReplayBuffer(40, image, action, **kwargs) for _ in range(2))
    stream = Stream(2, 2, seed=0)
    for _ in range(50):
        ours.add(*stream.step())
    again.load_state({k: v.copy() for k, v in ours.state().items()})
    for buffer in (ours, again):  # what is open can be closed in both
        buffer.close_episodes()
    np.random.seed(0)
    a = ours.sample(64)
    np.random.seed(0)
    b = again.sample(64)
    assert all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
    fresh = Stream(2, 2, seed=1)  # a new episode is accepted after it
    again.add(*fresh.step())


def test_refuses_what_is_no_stack():
    image, action = spaces_for(2)
    buffer = FrameReplayBuffer(40, image, action, "cpu", n_stack=2)
    stream = Stream(1, 2, seed=0)
    obs, *rest = stream.step()
    with pytest.raises(ValueError, match="VecFrameStack"):
        buffer.add(np.full_like(obs, 7), *rest)


def test_says_how_large_it_may_be():
    image = spaces.Box(0, 255, (6, 84, 84), np.uint8)
    action = spaces.Box(-1, 1, (4,), np.float32)
    with pytest.raises(MemoryError, match="set buffer_size to at most"):
        FrameReplayBuffer(10**9, image, action, "cpu", n_stack=2)


def test_refuses_frames_that_do_not_divide():
    image = spaces.Box(0, 255, (5, 84, 84), np.uint8)
    with pytest.raises(ValueError, match="do not divide"):
        FrameReplayBuffer(10, image, spaces.Box(-1, 1, (4,), np.float32), "cpu", n_stack=2)
