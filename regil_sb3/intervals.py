"""How sure a figure is, from few episodes or few runs.

* ``wilson`` - the interval of a success rate of episodes
* ``Interval``, ``iqm`` - the interquartile mean of runs, with a stratified bootstrap
* ``improvement`` - the probability that a run of one method beats one of another
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import stats  # type: ignore[import-untyped]

__all__ = ["Interval", "improvement", "iqm", "wilson"]

Scores = Sequence[Sequence[float]]
"""Of each task, one score for each run."""

_RESAMPLES = 5_000


class Interval(NamedTuple):
    """A value and its 95 % interval; NaN where there is none."""

    value: float
    low: float
    high: float


def wilson(successes: int, episodes: int) -> tuple[float, float]:
    """95 % Wilson score interval of a success rate (Wilson 1927), in percent."""
    z2 = 1.96**2
    rate = successes / episodes
    center = (rate + z2 / (2 * episodes)) / (1 + z2 / episodes)
    half = math.sqrt(z2 * (rate * (1 - rate) / episodes + z2 / (4 * episodes**2)))
    half /= 1 + z2 / episodes
    return 100 * max(0.0, center - half), 100 * min(1.0, center + half)


def iqm(scores: Scores) -> Interval:
    """Interquartile mean of all runs of all tasks, with a stratified bootstrap.

    Agarwal et al. 2021, https://arxiv.org/abs/2108.13264, as their package rliable computes it:
    the mean of the middle half of all scores; runs are drawn again within each task, and the
    interval is the percentiles'. It has none where a task has a single run.

    Args:
        scores: of each task, those of its runs.
    """

    def statistic(*tasks: npt.NDArray[np.float64], axis: int = -1) -> Any:
        return stats.trim_mean(np.concatenate(tasks, axis=axis), 0.25, axis=axis)

    return _bootstrapped(scores, statistic)


def improvement(ours: Scores, theirs: Scores) -> Interval:
    """Probability that a run of ours beats one of theirs, mean over tasks; a tie counts half.

    Args:
        ours: of each task, scores of runs.
        theirs: the same of the same tasks.
    """
    n = len(ours)

    def statistic(*tasks: npt.NDArray[np.float64], axis: int = -1) -> Any:
        wins = []
        for x, y in zip(tasks[:n], tasks[n:], strict=True):
            a, b = (np.moveaxis(v, axis, -1) for v in (x, y))
            pairs = np.sign(a[..., :, None] - b[..., None, :])
            wins.append((pairs.mean(axis=(-2, -1)) + 1) / 2)
        return np.mean(wins, axis=0)

    return _bootstrapped([*ours, *theirs], statistic)


def _bootstrapped(scores: Scores, statistic: Callable[..., Any]) -> Interval:
    arrays = [np.asarray(runs, float) for runs in scores]
    value = float(statistic(*arrays))
    if min(map(len, arrays)) < 2:
        return Interval(value, math.nan, math.nan)
    # Several samples: each is drawn again by itself, which is what stratified means
    found = stats.bootstrap(
        arrays,
        statistic,
        vectorized=True,
        n_resamples=_RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Interval(value, float(found.low), float(found.high))
