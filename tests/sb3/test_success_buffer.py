from __future__ import annotations

import numpy as np
import pytest

from regil_sb3.success_buffer import SuccessBuffer, stack_frames


def episode(length, value, n_stack=1):
    frames = (
        np.full((length, 3, 6, 6), value, np.uint8)
        + np.arange(length, dtype=np.uint8)[:, None, None, None]
    )
    return stack_frames(frames, n_stack), np.full((length, 2), value / 100, np.float32)


def test_demonstration_stays_and_the_oldest_goes_first():
    buffer = SuccessBuffer(capacity=25)
    buffer.add(*episode(10, 1), pinned=True)
    for value in (2, 3, 4):
        assert buffer.add(*episode(7, value))
    assert (buffer.episodes, buffer.steps) == (3, 24)
    np.random.seed(0)
    _, actions = buffer.sample(500)
    assert set(np.unique((actions * 100).round().astype(int))) == {1, 3, 4}


def test_episode_longer_than_the_room_is_refused():
    buffer = SuccessBuffer(capacity=12)
    buffer.add(*episode(10, 1), pinned=True)
    assert not buffer.add(*episode(3, 2))
    assert buffer.episodes == 1


@pytest.mark.parametrize("n_stack", [1, 2, 3])
def test_samples_are_the_observations_added(n_stack):
    buffer = SuccessBuffer(100, n_stack)
    added = {}
    for value in (10, 50, 90):
        observations, actions = episode(9, value, n_stack)
        buffer.add(observations, actions)
        for observation, action in zip(observations, actions, strict=True):
            added[observation.tobytes()] = action
    observations, actions = buffer.sample(200)
    assert len({o.tobytes() for o in observations}) == len(added)
    for observation, action in zip(observations, actions, strict=True):
        assert np.array_equal(added[observation.tobytes()], action)


def test_dict_observations():
    buffer = SuccessBuffer(100)
    buffer.add({"a": np.arange(5)[:, None], "b": np.ones((5, 2))}, np.arange(5.0)[:, None])
    observations, actions = buffer.sample(20)
    assert np.array_equal(observations["a"], actions)
    assert observations["b"].shape == (20, 2)


def test_state_goes_round():
    buffer, again = SuccessBuffer(100, 2), SuccessBuffer(100, 2)
    for b in (buffer, again):
        b.add(*episode(10, 1, 2), pinned=True)
    buffer.add(*episode(7, 2, 2))
    again.load_state(buffer.state())
    np.random.seed(1)
    a = buffer.sample(30)
    np.random.seed(1)
    b = again.sample(30)
    assert all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def test_empty_and_impossible():
    with pytest.raises(ValueError, match="empty"):
        SuccessBuffer(10).sample(4)
    with pytest.raises(ValueError, match="success_buffer_size is 0"):
        SuccessBuffer(0)
