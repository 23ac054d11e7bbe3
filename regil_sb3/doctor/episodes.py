"""Whether a demonstration guides episodes of an environment as it should.

* ``Played`` - what came of one episode
* ``play`` - plays one
* ``check_replay`` - the demonstration's actions lead where its pictures show, and as fast
* ``check_success`` - the environment says what success is
* ``check_guide`` - how often guided replay succeeds, plain and corrected
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from regil_wrappers import Demonstration
from regil_wrappers.reward_signals import Signal

from regil_sb3.doctor.findings import Finding, listed
from regil_sb3.doctor.pictures import is_idle

__all__ = ["Act", "Played", "check_guide", "check_replay", "check_success", "play"]

Actions = npt.NDArray[np.float32]
Act = Callable[[int], Actions]
"""Number of the step -> action, (A,) float32."""

_RATES = (0.5, 1, 2)  # steps of the environment for one of the demonstration that are tried
_BETTER = 0.5  # of the misfit at one for one: so little must be left at another rate
_ASTRAY = 0.6  # of the way that pictures show: a replay that misses by more goes elsewhere
_SELDOM = 0.5  # guided replay that succeeds less often is warned of


@dataclass
class Played:
    """One episode.

    Attributes:
        success: whether it was solved, as training counts: ``info["is_success"]`` at any step.
        says: whether any info had that key.
        rewards: by name, (steps,) each.
        embeddings: (steps + 1, D) float32, of its pictures.
        seconds: it took, all together.
        film: its pictures, in each size that was kept; empty where none were.
    """

    success: bool = False
    says: bool = False
    rewards: dict[str, list[float]] = field(default_factory=dict)
    embeddings: list[npt.NDArray[np.float32]] = field(default_factory=list)
    seconds: float = 0.0
    film: Sequence[Sequence[npt.NDArray[np.uint8]]] = ()

    @property
    def steps(self) -> int:
        """How many actions were executed."""
        return len(self.embeddings) - 1


def play(
    env: gym.Env[Any, Any],
    seed: int,
    act: Act,
    rewards: dict[str, Signal] | None = None,
    longest: int = 1_000,
) -> Played:
    """Play one episode.

    Args:
        env: with a retrieval wrapper.
        seed: of the episode.
        act: number of the step -> action.
        rewards: by name, of the wrapper's retriever; None: none is asked for.
        longest: steps, where the environment ends it no earlier.
    """
    begun = time.perf_counter()
    env.reset(seed=seed)
    retriever = env.get_wrapper_attr("retriever")
    played = Played(embeddings=[retriever.embedding], rewards={n: [] for n in rewards or ()})
    for signal in (rewards or {}).values():
        signal.begin()
    over = False
    while not over and played.steps < longest:
        *_, terminated, truncated, info = env.step(act(played.steps))
        played.embeddings.append(retriever.embedding)
        for name, signal in (rewards or {}).items():
            played.rewards[name].append(signal.step())
        played.success |= bool(info.get("is_success", False))
        played.says |= "is_success" in info
        over = terminated or truncated
    played.seconds = time.perf_counter() - begun
    if env.has_wrapper_attr("film"):
        played.film = env.get_wrapper_attr("film")
    return played


def check_replay(
    env: gym.Env[Any, Any], demo: Demonstration, embedded: npt.NDArray[np.float32], seed: int
) -> Finding:
    """Whether the demonstration's actions lead where its pictures show, and as fast.

    They are replayed as they are, each for two steps, and every other one: what changes in the
    pictures since the first one is compared with what changes in the demonstration.

    Args:
        env: with a retrieval wrapper that does not register.
        demo: with actions.
        embedded: (N, D) float32, of its frames.
        seed: of the episode in which they are replayed; best the demonstration's own.
    """
    assert demo.actions is not None
    begins = int(np.argmin(is_idle(embedded)))  # before that nothing tells one rate from another
    moving = demo.actions[begins:]
    misfits = {}
    for rate in _RATES:
        actions = moving[::2] if rate < 1 else np.repeat(moving, int(rate), axis=0)
        played = play(env, seed, actions.__getitem__, longest=len(actions))
        there, here = embedded[begins:], np.stack(played.embeddings)
        there, here = (there[::2], here) if rate < 1 else (there, here[:: int(rate)])
        misfits[rate] = _misfit(there, here)
    if math.isinf(misfits[1]):
        line = "the environment ended the replay of its actions before half of them were executed"
        return Finding("frame rate", "warning", f"{line}: is its time limit too short?")
    best = min(misfits, key=lambda rate: misfits[rate])
    return _rate_finding(misfits, best)


def _misfit(there: npt.NDArray[np.float32], here: npt.NDArray[np.float32]) -> float:
    """Share of what changes in one sequence of embeddings that changes otherwise in the other.

    Infinite where less than half of the first has a counterpart.
    """
    n = min(len(there), len(here))
    if n <= len(there) / 2:
        return math.inf
    shown, seen = (x[:n].astype(np.float64) - x[0] for x in (there, here))
    return float(((shown - seen) ** 2).sum() / max((shown**2).sum(), 1e-12))


def _rate_finding(misfits: dict[float, float], best: float) -> Finding:
    left = misfits[1]
    if best != 1 and misfits[best] < _BETTER * left:
        much, slower = ("twice", "half") if best > 1 else ("half", "twice")
        line = (
            f"a step of it shows {much} of what a step of the environment does under its actions "
            f"({misfits[best]:.0%} of the change is missed so, {left:.0%} one for one): it was "
            f"recorded at {slower} the environment's rate; make the environment with {much} the "
            "action repeat, or record it again"
        )
        return Finding("frame rate", "wrong", line)
    if left > _ASTRAY:
        line = (
            f"its actions, replayed, miss {left:.0%} of the change that its pictures show: are "
            "they what was executed, in the environment's own units and from a start like this?"
        )
        return Finding("frame rate", "warning", line)
    line = f"its actions, replayed, lead where its pictures show ({left:.0%} of the change missed)"
    return Finding("frame rate", "ok", line)


def check_success(says: bool) -> list[Finding]:
    """A finding where the environment never says whether it is solved.

    Args:
        says: whether any info of an episode had the key "is_success".
    """
    if says:
        return []
    line = (
        'no info had the key "is_success", which is all that counts as a success: none would be '
        'kept, none evaluated; let step() return info["is_success"], and terminate there'
    )
    return [Finding("success", "wrong", line)]


def check_guide(plain: Sequence[bool], corrected: Sequence[bool] | None, said: str) -> Finding:
    """How often guided replay succeeded.

    Args:
        plain: of episodes in which the demonstrator's own actions guided.
        corrected: of the same ones, corrected for where the target is; None: it does not apply.
        said: why not, or what it said of itself.
    """
    line = f"plain {listed(plain)}"
    if corrected is None:
        line += f", corrected: does not apply ({said})"
    else:
        line += f", corrected {listed(corrected)}" + (f" (it says: {said})" if said else "")
    better = max(float(np.mean(plain)), float(np.mean(corrected or [False])))
    if better == 0:
        line += (
            ": it never succeeded, so it cannot fill a success buffer; see what else is wrong or "
            "warned of here, or try more --episodes"
        )
        return Finding("guided replay", "wrong", line)
    if better < _SELDOM:
        line += ": seldom; a longer warm-up may make up for it, a demonstration elsewhere too"
        return Finding("guided replay", "warning", line)
    return Finding("guided replay", "ok", line)
