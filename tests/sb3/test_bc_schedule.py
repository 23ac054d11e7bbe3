"""lambda(t): by time, and by the policy's own successes."""

from __future__ import annotations

import pytest

from regil_sb3.bc_schedule import BACK, FEW, BySuccess, by_time


def test_by_time_falls_to_its_floor():
    assert [by_time(t, 100, 0.1) for t in (0, 50, 95, 1_000)] == [1.0, 0.5, 0.1, 0.1]


def test_share_falls_while_the_policy_keeps_up():
    schedule = BySuccess(floor=0.2)
    for _ in range(FEW - 1):
        schedule.episode(True, 0.05)
    assert schedule.share == 1.0  # too few episodes to tell
    for _ in range(4):
        schedule.episode(True, 0.05)
    assert schedule.share == pytest.approx(0.8)
    for _ in range(40):
        schedule.episode(True, 0.05)
    assert schedule.share == 0.2


def test_share_rises_faster_where_it_does_not():
    schedule = BySuccess(floor=0.0)
    for _ in range(FEW + 9):
        schedule.episode(True, 0.05)
    low = schedule.share
    assert low == pytest.approx(0.5)
    schedule.episode(False, 0.05)  # 19 of 20: still near its best
    assert schedule.share == pytest.approx(low - 0.05)
    schedule.episode(False, 0.05)
    schedule.episode(False, 0.05)  # 17 of 20
    assert schedule.share == pytest.approx(low - 0.1 + BACK * 0.05)


def test_a_policy_that_never_succeeds_is_let_go():
    """Behaviour cloning that leads nowhere must not hold the critic back for ever."""
    schedule = BySuccess(floor=0.1)
    for _ in range(100):
        schedule.episode(False, 0.02)
    assert schedule.share == 0.1


def test_behind_its_guide_until_it_succeeds_as_often():
    schedule = BySuccess(floor=0.1)
    assert not schedule.behind_guide  # no guide
    for success in (False, False, True, True):
        schedule.guided_episode(success)
    assert schedule.behind_guide  # not shown yet
    for success in (False, True) * 5:
        schedule.episode(success, 0.0)
    assert not schedule.behind_guide
    schedule.episode(False, 0.0)
    schedule.episode(False, 0.0)
    assert schedule.behind_guide
