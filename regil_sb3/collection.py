"""Who acts in each environment, and what is kept of the episodes under way."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from regil_sb3.success_buffer import Observations

_REWARDS = ("env_reward", "retrieval_reward")
_STATE = ("guided", "warmup", "lengths", "succeeded", "_demonstrates", "_labels")


class Collection:
    """The open episodes of some environments.

    An episode is the guide's or the policy's, to its end; in the warm-up it is the guide's.

    Args:
        n_envs: environments.
        action_shape: (A,) of one action.
        keeps_own: whether the policy's episodes are kept too.

    Attributes:
        guided: (n_envs,) bool: where the guide acts.
        warmup: (n_envs,) bool: where it does because the episode began in the warm-up.
        lengths: (n_envs,) int: steps of each open episode.
        succeeded: (n_envs,) bool: whether it succeeded at any step.
    """

    def __init__(self, n_envs: int, action_shape: tuple[int, ...], keeps_own: bool) -> None:
        self._keeps_own = keeps_own
        self._labels = np.zeros((n_envs, *action_shape), np.float32)
        self.restart(False)

    def restart(self, warmup: bool) -> None:
        """Every environment was reset, whatever it was doing."""
        n_envs = len(self._labels)
        self.guided, self.warmup = np.full((2, n_envs), warmup)
        self.lengths = np.zeros(n_envs, int)
        self.succeeded = np.zeros(n_envs, bool)
        self._demonstrates = np.zeros(n_envs, bool)  # an episode's first step tells
        self._steps: list[list[tuple[Any, npt.NDArray[Any]]]] = [[] for _ in range(n_envs)]
        self._returns = {name: np.zeros(n_envs) for name in _REWARDS}
        for env in range(n_envs):
            self.begin(env, warmup)

    def begin(self, env: int, warmup: bool, guided: bool = False) -> None:
        """The environment's next episode begins, in the warm-up or not."""
        self.warmup[env] = warmup
        self.guided[env] = warmup or guided
        self.lengths[env] = 0
        self.succeeded[env] = self._demonstrates[env] = False
        self._steps[env] = []
        for returns in self._returns.values():
            returns[env] = 0.0

    def note_guide(self, indices: npt.NDArray[Any], actions: npt.NDArray[Any]) -> None:
        """What the guides of these environments say, (n, A) scaled to [-1, 1]: it is what is kept.

        What is executed may be disturbed.
        """
        self._labels[indices] = actions

    def step(
        self, env: int, seen: Any, action: npt.NDArray[Any], reward: float, info: dict[str, Any]
    ) -> None:
        """One step of an environment is done.

        Args:
            env: its index.
            seen: what the policy saw before, of all environments: an array or a dict of such.
            action: (A,) that was executed, scaled.
            reward: of the step.
            info: of the step.
        """
        retrieval = info.get("retrieval", {})
        self._demonstrates[env] = not retrieval.get("calibrating", False)
        guided = self.guided[env]
        if guided or self._keeps_own:
            before = (
                {k: v[env].copy() for k, v in seen.items()}
                if isinstance(seen, dict)
                else np.array(seen[env])
            )
            noted = self._labels[env] if guided else action
            self._steps[env].append((before, noted.copy()))
        late = np.sum(retrieval.get("episode_rewards", 0.0))
        self._returns["env_reward"][env] += retrieval.get("env_reward", reward)
        self._returns["retrieval_reward"][env] += reward + late
        self.lengths[env] += 1

    def calibrating(self, env: int) -> bool:
        """Whether the guide moved to learn how its camera sees, in the environment's episode."""
        return not self._demonstrates[env]

    def returns(self, env: int) -> dict[str, float]:
        """Undiscounted returns of the environment's episode by name."""
        return {name: float(values[env]) for name, values in self._returns.items()}

    def demonstration(self, env: int) -> tuple[Observations, npt.NDArray[np.float32]] | None:
        """What the environment's episode demonstrates: observations (T, ...), actions (T, A).

        None where it did not succeed, was calibrating, or is not kept.
        """
        if self.calibrating(env) or not (self.succeeded[env] and self._steps[env]):
            return None
        return self._kept(env)

    def _kept(self, env: int) -> tuple[Observations, npt.NDArray[np.float32]]:
        seen, actions = zip(*self._steps[env], strict=True)
        observations: Observations = (
            {k: np.stack([o[k] for o in seen]) for k in seen[0]}
            if isinstance(seen[0], dict)
            else np.stack(seen)
        )
        return observations, np.stack(actions)

    def state(self) -> dict[str, Any]:
        """The open episodes as plain arrays."""
        kept = [self._kept(i) if steps else None for i, steps in enumerate(self._steps)]
        return {
            **{name: getattr(self, name) for name in _STATE},
            "returns": self._returns,
            "steps": kept,
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Take over what ``state`` returned."""
        for name in _STATE:
            setattr(self, name, state[name])
        self._returns = state["returns"]
        self._steps = [[] if kept is None else _taken_apart(*kept) for kept in state["steps"]]


def _taken_apart(
    observations: Observations, actions: npt.NDArray[np.float32]
) -> list[tuple[Any, npt.NDArray[Any]]]:
    if isinstance(observations, dict):
        seen: list[Any] = [
            {key: values[i] for key, values in observations.items()} for i in range(len(actions))
        ]
    else:
        seen = list(observations)
    return list(zip(seen, actions, strict=True))
