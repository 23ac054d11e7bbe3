from __future__ import annotations

import math

import numpy as np
import pytest
from regil_wrappers import Alignment
from regil_wrappers.rewards import demonstration_tau, sdtw_reward


def test_sdtw_reward_divides_by_the_window_or_the_horizon() -> None:
    alignment = Alignment(start=0, end=1, cost=6.0, candidates=(0, 1), q_star=1, window=2)
    assert sdtw_reward(alignment) == -3
    assert sdtw_reward(alignment, horizon=4) == -6 / 5


def test_a_replay_gives_zero_not_minus_zero() -> None:
    reward = sdtw_reward(Alignment(0, 0, 0.0, (0,), 0, 1))
    assert math.copysign(1, reward) == 1


def test_tau_by_hand() -> None:
    # At 0, 1, 2, ..., then still: d_i = 25 while moving and smaller where the gap reaches the end.
    y = np.array([[0], [1], [2], [3], [4], [5], [5], [5]], np.float32)
    d = np.array([25, 16, 9])
    assert demonstration_tau(y) == pytest.approx((d**2).sum() / d.sum())
    assert demonstration_tau(y[:3]) == 4  # the gap is at most N - 1


def test_tau_needs_movement() -> None:
    with pytest.raises(ValueError, match="5 frames later"):
        demonstration_tau(np.ones((9, 4), np.float32))
