"""Episodes under way, brought back in another process by doing again what was done in them.

* ``ReplayableEpisode`` - a wrapper that remembers how its environment's open episode came about

An environment whose episodes follow from its generator and the actions needs nothing more: no state
of its simulator. Whether it is such a one is seen when the replay ends where the episode stood.
"""

from __future__ import annotations

from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.core import ActType, ObsType

__all__ = ["ReplayableEpisode"]


class ReplayableEpisode(
    gym.Wrapper[ObsType, ActType, ObsType, ActType], gym.utils.RecordConstructorArgs
):
    """Remembers the actions of the open episode, and the generator's state before it.

    Belongs outside all other wrappers of one environment, but for SB3's `Monitor`. Of a retrieval
    guide it keeps `RetrievalGuideWrapper.lasting_state` from before the episode, too.

    Example:
        >>> import gymnasium as gym
        >>> from regil_sb3.checkpoint import ReplayableEpisode
        >>> env, later = (ReplayableEpisode(gym.make("ToyReach-v0")) for _ in range(2))
        >>> _, _ = env.reset(seed=7)
        >>> _ = env.step(env.action_space.high)
        >>> state = env.episode_state()
        >>> later.go_back(state)
        >>> _, _ = later.reset(seed=state["begin"]["seed"])
        >>> _ = [later.step(action) for action in state["actions"]]
        >>> later.how_it_differs(state)
        ''

    Args:
        env: the environment.
    """

    def __init__(self, env: gym.Env[ObsType, ActType]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        self._begin: dict[str, Any] | None = None
        self._actions: list[Any] = []
        self._rewards: list[float] = []
        self._seen: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ObsType, dict[str, Any]]:
        """Begin an episode."""
        self._begin = {"seed": seed, "options": options, **self._between()}
        self._actions, self._rewards = [], []
        self._seen, info = self.env.reset(seed=seed, options=options)
        return self._seen, info

    def step(self, action: ActType) -> tuple[ObsType, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step, and remember it."""
        self._actions.append(np.array(action))
        self._seen, reward, terminated, truncated, info = self.env.step(action)
        self._rewards.append(float(reward))
        return self._seen, reward, terminated, truncated, info

    def episode_state(self) -> dict[str, Any]:
        """How the open episode came about, as numbers, text and arrays.

        Raises:
            ValueError: before the first reset.
        """
        if self._begin is None:
            raise ValueError("no episode has begun: call reset() first")
        return {
            "begin": self._begin,
            "actions": np.array(self._actions),
            "rewards": np.array(self._rewards),
            "seen": self._seen,
            "now": self._between(),
        }

    def go_back(self, state: dict[str, Any]) -> None:
        """Take over what there was before an episode, in a new environment of the same kind.

        Args:
            state: what `episode_state` gave.
        """
        before = state["begin"]
        self.unwrapped.np_random.bit_generator.state = before["generator"]
        if self.env.has_wrapper_attr("set_lasting_state"):
            self.env.get_wrapper_attr("set_lasting_state")(before["lasting"])

    def how_it_differs(self, state: dict[str, Any]) -> str:
        """Compare the open episode with the one that it is to be, and take over its generator.

        Args:
            state: what `episode_state` gave.

        Returns:
            nothing where it stands as that one stood; else how it differs.
        """
        self.unwrapped.np_random.bit_generator.state = state["now"]["generator"]
        for i, (now, before) in enumerate(zip(self._rewards, state["rewards"], strict=False)):
            if now != before:
                return f"its step {i + 1} returned {now}, and {before} the first time"
        if len(self._rewards) < len(state["rewards"]):
            return f"it ended after {len(self._rewards)} steps"
        if not _equal(self._seen, state["seen"]):
            return "what is seen is not what was seen the first time"
        if not _equal(self._between()["lasting"], state["now"]["lasting"]):
            return "its guide is not as it was the first time"
        return ""

    def _between(self) -> dict[str, Any]:
        lasting = None
        if self.env.has_wrapper_attr("lasting_state"):
            lasting = self.env.get_wrapper_attr("lasting_state")()
        return {"generator": self.unwrapped.np_random.bit_generator.state, "lasting": lasting}


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_equal(one[k], other[k]) for k in one)
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(_equal, one, other))
    return bool(np.array_equal(one, other))
