from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from regil_wrappers import Alignment, Demonstration, Retriever
from regil_wrappers.reward_signals import AT_EPISODE_END, AT_EVERY_STEP, make_signal
from regil_wrappers.rewards import (
    demonstration_tau,
    episode_scale,
    ot_rewards,
    sdtw_reward,
    tot_rewards,
)


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


def test_one_frame_has_no_scale() -> None:
    one, two = np.zeros((1, 2), np.float32), np.eye(2, dtype=np.float32)
    for embeddings in (one, [two, one]):
        with pytest.raises(ValueError, match=r"has 1 frame, .* at least 2$"):
            demonstration_tau(embeddings)
    assert demonstration_tau(two) == 2


def test_tau_needs_movement() -> None:
    with pytest.raises(ValueError, match="5 frames later"):
        demonstration_tau(np.ones((9, 4), np.float32))


class Given:
    """Stands in for an encoder: the picture's first pixels are the embedding."""

    def encode(self, frames: np.ndarray) -> np.ndarray:
        return frames[:, 0, :, 0].astype(np.float32)


def rewarded(name: str, demo: np.ndarray, episode: np.ndarray) -> list[float]:
    """Every step's reward, of frames given by their embeddings (T, D) uint8."""

    def pictures(embeddings: np.ndarray) -> np.ndarray:
        return np.repeat(embeddings[:, None, :, None], 3, axis=3)

    retriever = Retriever(Demonstration(pictures(demo)), Given(), k=2, horizon=1)
    signal = make_signal(name, retriever)
    for _ in range(2):  # nothing of an episode is left in the next
        retriever.reset()
        retriever.step(pictures(episode)[0])
        signal.begin()
        steps = []
        for picture in pictures(episode)[1:]:
            retriever.step(picture)
            steps.append(signal.step())
    late = signal.end()
    assert (late is None) == (name in AT_EVERY_STEP)
    return steps if late is None else late.tolist()


@st.composite
def runs(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    dims = draw(st.integers(1, 4))
    numbers = st.integers(0, 255)
    demo = draw(arrays(np.uint8, (draw(st.integers(2, 9)), dims), elements=numbers))
    gap = min(5, len(demo) - 1)
    assume((demo[gap:] != demo[:-gap]).any())  # it moves, as `demonstration_tau` sees it
    return demo, draw(arrays(np.uint8, (draw(st.integers(2, 12)), dims), elements=numbers))


@settings(deadline=None, max_examples=50)
@given(runs(), st.data())
@pytest.mark.parametrize("name", AT_EVERY_STEP)
def test_a_step_depends_on_nothing_that_comes_later(
    name: str, run: tuple[np.ndarray, np.ndarray], data: st.DataObject
) -> None:
    demo, episode = run
    cut = data.draw(st.integers(1, len(episode)))
    assert rewarded(name, demo, episode)[: cut - 1] == rewarded(name, demo, episode[:cut])


BOUNDS = {"cos": (-1, 1), "orca": (0, 1), "pwil": (0, 5), "progress": (-1, 0)}


@settings(deadline=None, max_examples=50)
@given(runs())
@pytest.mark.parametrize("name", [*AT_EVERY_STEP, *AT_EPISODE_END])
def test_bounds_and_one_reward_for_each_step(name: str, run: tuple[np.ndarray, np.ndarray]) -> None:
    low, high = BOUNDS.get(name, (-np.inf, 0))
    steps = rewarded(name, *run)
    assert len(steps) == len(run[1]) - 1
    assert all(low - 1e-9 <= reward <= high + 1e-9 for reward in steps)


@settings(deadline=None, max_examples=50)
@given(runs())
def test_an_exact_replay(run: tuple[np.ndarray, np.ndarray]) -> None:
    demo, _ = run
    assume(len(np.unique(demo, axis=0)) == len(demo))
    assert rewarded("sdtw", demo, demo) == [0] * (len(demo) - 1)
    if demo.any(axis=1).all():  # a zero vector has no direction
        np.testing.assert_allclose(rewarded("cos", demo, demo), 1)
    # Beside a frame of its own, each finds no other nearer.
    np.testing.assert_allclose(rewarded("pwil", demo, demo), 5)
    orca = rewarded("orca", demo, demo)
    assert orca[-1] == pytest.approx(1)
    assert max(orca) == orca[-1]


def test_orca_pays_for_order() -> None:
    demo = np.array([[0], [60], [120], [180]], np.uint8)
    forwards = rewarded("orca", demo, demo)[-1]
    skipped = rewarded("orca", demo, demo[[0, 3, 3, 3]])[-1]
    backwards = rewarded("orca", demo, demo[[2, 1, 0, 3]])[-1]
    assert forwards > skipped
    assert forwards > backwards


def test_pwil_has_nothing_left_after_the_demonstration() -> None:
    demo = np.array([[0], [60], [120]], np.uint8)
    steps = rewarded("pwil", demo, demo[[0, 1, 2, 2, 2]])
    assert steps[:2] == [5, 5]
    assert steps[2:] == [0, 0]


def test_the_band_keeps_order() -> None:
    rng = np.random.default_rng(0)
    demo = rng.normal(size=(40, 6)).astype(np.float32)
    forwards, backwards = demo, demo[::-1]
    assert ot_rewards(forwards, demo).sum() == pytest.approx(ot_rewards(backwards, demo).sum())
    assert tot_rewards(forwards, demo).sum() > tot_rewards(backwards, demo).sum() + 0.1


def test_the_first_episode_fixes_the_scale() -> None:
    assert episode_scale(np.array([-1.0, -3.0])) == 2.5
    assert episode_scale(np.zeros(4)) == np.inf


def test_unknown_reward_and_a_demonstration_that_stands_still() -> None:
    still = np.full((8, 2), 7, np.uint8)
    for name in ("progress", "orca", "pwil"):
        with pytest.raises(ValueError, match="record one that moves"):
            rewarded(name, still, still)
    with pytest.raises(ValueError, match=r"^reward='dtw': choose one of \['sdtw', 'progress', "):
        rewarded("dtw", still, still)
