"""What each reward gives success, failure and standing still.

* ``signals`` - every reward that is known at each step
* ``played_demonstration`` - the demonstration itself as an episode
* ``Worth`` - what one reward gives some episodes
* ``Reward``, ``judged`` - how it ranks successes, failures and standing still
* ``check_reward`` - the same as findings
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from regil_wrappers import Retriever
from regil_wrappers.reward_signals import AT_EVERY_STEP, Signal, make_signal

from regil_sb3.doctor.episodes import Played
from regil_sb3.doctor.findings import Finding, Verdict

__all__ = ["Reward", "Worth", "check_reward", "judged", "played_demonstration", "signals"]

_FREEZES = 0.1  # of the moments: a reward by which freezing pays more often is warned of


def signals(retriever: Retriever) -> dict[str, Signal]:
    """Every reward that is known at each step, of one retriever's frames, by name.

    Raises:
        ValueError: if the demonstration does not move.
    """
    return {name: make_signal(name, retriever) for name in AT_EVERY_STEP}


def played_demonstration(retriever: Retriever) -> Played:
    """The demonstration itself as an episode that succeeds.

    Args:
        retriever: of this one demonstration.
    """
    alone = retriever.another()
    rewards = signals(alone)
    played = Played(success=True, rewards={name: [] for name in rewards})
    for i, embedding in enumerate(retriever.embeddings):
        alone.step_embedding(embedding)
        played.embeddings.append(embedding)
        for name, signal in rewards.items():
            if i == 0:
                signal.begin()
            else:
                played.rewards[name].append(signal.step())
    return played


@dataclass(frozen=True)
class Worth:
    """What one reward gives some episodes.

    Attributes:
        value: their discounted return, mean.
        step: the reward of a step, mean over all of them.
    """

    value: float
    step: float

    def __str__(self) -> str:
        value = f"{self.value:.0f}" if abs(self.value) >= 100 else f"{self.value:.3g}"
        return f"{value} ({self.step:.2g} a step)"


@dataclass(frozen=True)
class Reward:
    """How one reward ranks what was played, as shares in [0, 1] unless said otherwise.

    Attributes:
        name: of the reward.
        success: what successes are worth.
        failure: what failures are worth; None where nothing failed.
        still: what standing still is worth.
        above_still: of pairs of a success and standing still, from whichever starts, in which the
            success's return is higher.
        above_failure: of pairs of a success and a failure in which the success's return is higher;
            NaN where nothing failed.
        order: Spearman's rank correlation of reward and time within successes, mean, in [-1, 1].
        freezing: of moments of successes from which finishing is worth less than freezing: having
            this moment's reward until the episode's time is over.
    """

    name: str
    success: Worth
    failure: Worth | None
    still: Worth
    above_still: float
    above_failure: float
    order: float
    freezing: float

    @property
    def rank(self) -> tuple[float, ...]:
        """The larger, the better to learn from."""
        failure = 1.0 if np.isnan(self.above_failure) else self.above_failure
        return round(self.above_still + failure - self.freezing, 2), self.order


def judged(
    name: str,
    successes: Sequence[Played],
    failures: Sequence[Played],
    still: Sequence[Played],
    gamma: float,
    time_limit: int,
) -> Reward:
    """Rank what was played by one reward's discounted returns.

    Args:
        name: of the reward.
        successes: one or more.
        failures: any number.
        still: one or more.
        gamma: discount factor.
        time_limit: steps that an episode can last.
    """

    def value(rewards: npt.NDArray[np.float64]) -> float:
        return float(rewards @ gamma ** np.arange(len(rewards)))

    good, bad, idle = (
        [value(np.array(p.rewards[name])) for p in group] for group in (successes, failures, still)
    )
    pairs = [g > b for g in good for b in bad]
    orders, freezes = [], []
    for played in successes:
        rewards = np.array(played.rewards[name])
        orders.append(_spearman(rewards))
        for t in range(len(rewards) - 1):
            left = max(time_limit - t - 1, 1)
            freezing = rewards[t] * (gamma ** np.arange(left)).sum()
            freezes.append(value(rewards[t + 1 :]) < freezing)
    return Reward(
        name,
        _worth(name, successes, good),
        _worth(name, failures, bad) if bad else None,
        _worth(name, still, idle),
        float(np.mean([g > i for g in good for i in idle])),
        float(np.mean(pairs)) if pairs else float("nan"),
        float(np.mean(orders)),
        float(np.mean(freezes)) if freezes else 0.0,
    )


def _worth(name: str, played: Sequence[Played], values: Sequence[float]) -> Worth:
    steps = np.concatenate([p.rewards[name] for p in played])
    return Worth(float(np.mean(values)), float(np.mean(steps)))


def _spearman(values: npt.NDArray[np.float64]) -> float:
    """Rank correlation with time; 0 where nothing changes."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    ranks = (np.cumsum(counts) - (counts - 1) / 2)[inverse]
    if len(counts) < 2:
        return 0.0
    return float(np.corrcoef(ranks, np.arange(len(values)))[0, 1])


def check_reward(
    rewards: Sequence[Reward], trained: str, none: str = "no replay failed"
) -> list[Finding]:
    """One line for each reward; the one that the settings name is warned of where it misleads.

    Args:
        rewards: of `judged`.
        trained: the one that the settings name.
        none: what to say of failure where there is none.
    """
    best = max(rewards, key=lambda reward: reward.rank).name
    found = []
    for r in rewards:
        failure = none if r.failure is None else f"failure {r.failure}"
        above = "" if r.failure is None else f", above failure {r.above_failure:.0%}"
        line = (
            f"success is worth {r.success}, {failure}, standing still {r.still}; success above "
            f"standing still {r.above_still:.0%}{above}, order {r.order:+.2f}, "
            f"freezing beats finishing in {r.freezing:.0%} of the moments"
        )
        misleads = r.above_still < 1 or r.freezing > _FREEZES
        used = r.name == trained
        if misleads:
            cure = "none is better here" if best == trained else f"set reward={best}"
            line += f": it misleads; {cure}" if used else ": it would mislead"
        verdict: Verdict = "warning" if misleads and used else "ok"
        found.append(Finding(f"reward {r.name}", verdict, line))
    return found
