"""RFCL: where episodes begin, from the demonstration's end backwards, then wherever it is hard."""

from __future__ import annotations

from collections import deque
from os import PathLike
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.core import ActType, ObsType
from regil_wrappers import Demonstration

__all__ = ["ReverseForwardCurriculum"]

_SOLVED, _UNSOLVED, _BETWEEN = 1.0, 2.0, 3.0  # how much an initial state is worth trying


class ReverseForwardCurriculum(
    gym.Wrapper[ObsType, ActType, ObsType, ActType], gym.utils.RecordConstructorArgs
):
    """Chooses where episodes begin, as Reverse Forward Curriculum Learning does.

    *Reverse.* An episode begins in the demonstration, at step ``begin`` or a little later (a
    geometric variable with mean ``spread``). Where the last ``recent`` episodes succeeded that
    began at that very step, it moves ``stride`` steps towards the demonstration's own beginning.

    *Forward.* Once that beginning is mastered, too, episodes begin at one of ``starts`` initial
    states of the environment, each a seed. One that was solved in some of its last ``recent``
    episodes is taken three times as often as one solved in all of them, and one never solved twice.

    A state of the demonstration is reached by playing its actions from its own seed, inside
    `reset`: such steps are nobody's, as states that a simulator is set to. Whether they lead
    there is not compared: it must be a demonstration of this very environment. The reward is 1 at
    success, else 0. Only
    ``reset(seed=None)`` is chosen for; with a seed the episode is as it was asked for, which is how
    a policy is evaluated.

    Source: Tao, Shukla, Chan and Su, Reverse Forward Curriculum Learning for Extreme Sample and
    Demonstration Efficiency in Reinforcement Learning, ICLR 2024, https://arxiv.org/abs/2405.03379

    Args:
        env: whose episodes follow from a seed and the actions; ``info["is_success"]`` says success.
        demo: a demonstration of this environment, with actions and the seed in its metadata.
        stride: steps.
        recent: episodes.
        spread: steps.
        starts: initial states.

    Raises:
        ValueError: a number is out of range, or the demonstration lacks its actions or its seed;
            from `reset`: if an episode ends before its actions do.
    """

    def __init__(
        self,
        env: gym.Env[ObsType, ActType],
        demo: Demonstration | str | PathLike[str],
        stride: int = 4,
        recent: int = 3,
        spread: float = 1.0,
        starts: int = 200,
    ) -> None:
        if min(stride, recent, starts) < 1 or spread < 0:
            raise ValueError(
                f"stride={stride}, recent={recent}, starts={starts} must be at least 1, and "
                f"spread={spread} at least 0"
            )
        gym.utils.RecordConstructorArgs.__init__(
            self, demo=demo, stride=stride, recent=recent, spread=spread, starts=starts
        )
        gym.Wrapper.__init__(self, env)
        demo = demo if isinstance(demo, Demonstration) else Demonstration.load(demo)
        if demo.actions is None or demo.metadata.get("seed") is None:
            raise ValueError(
                "a reverse curriculum begins within the demonstration: it needs its actions and "
                "metadata['seed'], as `regil record` writes them"
            )
        self.actions, self.seed = demo.actions, int(demo.metadata["seed"])
        self.stride, self.recent, self.spread, self.starts = stride, recent, spread, starts
        self.begin = max(0, len(self.actions) - stride)
        self.reverse = True
        self._rng = np.random.default_rng(self.seed)
        self._here: deque[bool] = deque(maxlen=recent)  # episodes that began at `begin`
        self._solved: dict[int, deque[bool]] = {}
        self._counts: Any = None  # what the open episode is counted for
        self._success = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ObsType, dict[str, Any]]:
        """Begin an episode: the one asked for by ``seed``, or the curriculum's next."""
        self._success = False
        if seed is not None:
            self._counts = None
            self._rng = np.random.default_rng(seed)
            return self.env.reset(seed=seed, options=options)
        if not self.reverse:
            self._counts = int(self._rng.choice(self.starts, p=self._preferred()))
            return self.env.reset(seed=self._counts, options=options)
        late = int(self._rng.geometric(1 / (1 + self.spread))) - 1
        first = min(self.begin + late, max(self.begin, len(self.actions) - 1))
        self._counts = "begin" if first == self.begin else None
        obs, info = self.env.reset(seed=self.seed, options=options)
        for step, action in enumerate(self.actions[:first]):
            obs, _, terminated, truncated, info = self.env.step(action)
            if terminated or truncated:
                raise ValueError(
                    f"played here, the demonstration ends at its step {step + 1} of "
                    f"{len(self.actions)}: record it in this environment, with these settings"
                )
        return obs, info

    def step(self, action: ActType) -> tuple[ObsType, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step, and count the episode when it ends."""
        obs, _, terminated, truncated, info = self.env.step(action)
        before, self._success = self._success, self._success or bool(info.get("is_success", False))
        if terminated or truncated:
            self._count()
        return obs, float(self._success > before), terminated, truncated, info

    def _count(self) -> None:
        if self._counts == "begin":
            self._here.append(self._success)
            if len(self._here) == self.recent and all(self._here):
                self.reverse = self.begin > 0
                self.begin = max(0, self.begin - self.stride)
                self._here.clear()
        elif self._counts is not None:
            self._solved.setdefault(self._counts, deque(maxlen=self.recent)).append(self._success)
        self._counts = None

    def _preferred(self) -> list[float]:
        worth = np.full(self.starts, _UNSOLVED)
        for start, solved in self._solved.items():
            if any(solved):
                worth[start] = _SOLVED if all(solved) else _BETWEEN
        return [float(share) for share in worth / worth.sum()]

    def lasting_state(self) -> dict[str, Any]:
        """What goes on over episodes, as numbers, text and lists."""
        inner = self.env
        return {
            "begin": self.begin,
            "reverse": self.reverse,
            "here": list(self._here),
            "solved": [[start, list(solved)] for start, solved in self._solved.items()],
            "rng": self._rng.bit_generator.state,
            "inner": inner.get_wrapper_attr("lasting_state")()
            if inner.has_wrapper_attr("lasting_state")
            else None,
        }

    def set_lasting_state(self, state: dict[str, Any]) -> None:
        """Take over what `lasting_state` gave, between episodes."""
        self.begin, self.reverse = int(state["begin"]), bool(state["reverse"])
        self._here = deque(map(bool, state["here"]), maxlen=self.recent)
        self._solved = {
            int(start): deque(map(bool, solved), maxlen=self.recent)
            for start, solved in state["solved"]
        }
        self._rng.bit_generator.state = state["rng"]
        if state["inner"] is not None:
            self.env.get_wrapper_attr("set_lasting_state")(state["inner"])
