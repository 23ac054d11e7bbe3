"""A guided warm-up for algorithms that know nothing of guides.

* ``GuidedWarmup`` - a callback: for the first steps the guide acts in place of the policy
* ``guide_actions`` - what guides say
* ``executed_actions`` - what is to be executed for it
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

__all__ = ["GuidedWarmup", "executed_actions", "guide_actions"]

Array = npt.NDArray[Any]


def guide_actions(env: VecEnv, indices: Array, name: str = "guide_action") -> Array:
    """What the guides of these environments say, (n, A), clipped to the action space.

    Args:
        env: environments with `regil_wrappers.RetrievalGuideWrapper`, or `VecRetrievalGuide`.
        indices: of those that are asked.
        name: the method that is asked: "guide_action" or "disturbed_action".
    """
    assert isinstance(env.action_space, spaces.Box)
    said = np.stack(env.env_method(name, indices=indices.tolist())).astype(env.action_space.dtype)
    return said.clip(env.action_space.low, env.action_space.high, out=said)


def executed_actions(env: VecEnv, indices: Array) -> Array:
    """What is to be executed where the guide acts, (n, A): disturbed, where guides disturb."""
    disturbed = env.has_attr("disturbed_action")
    return guide_actions(env, indices, "disturbed_action" if disturbed else "guide_action")


class GuidedWarmup(BaseCallback):
    """The guide acts for the first steps of SAC, TQC, TD3 or another off-policy algorithm.

    In each environment an episode begun in the warm-up is finished in it. The replay buffer gets
    the action that was really executed, and the algorithm learns meanwhile as it always does, from
    its ``learning_starts`` on. A model saved by then is a model of its own class. `TD3BC` has such
    a warm-up, and does more with it (a success buffer): it needs no callback.

    Example:
        >>> from stable_baselines3 import SAC
        >>> from regil_sb3 import GuidedWarmup
        >>> model = SAC("MlpPolicy", env)  # wrapped in RetrievalGuideWrapper and a reward
        >>> model.learn(10_000, callback=GuidedWarmup(2_000))  # doctest: +SKIP

    In rl_zoo3's YAML: ``callback: [{regil_sb3.GuidedWarmup: {steps: 2000}}]``.

    Args:
        steps: transitions of all environments together, counted as the algorithm counts them: a
            model that is past them goes on without a guide.
        verbose: 1 says when the warm-up is over.

    Raises:
        ValueError: ``steps`` is no whole number of at least 1; from ``learn``: the algorithm is not
            off-policy, or has a warm-up of its own, or the environment has no guide.
    """

    def __init__(self, steps: int, verbose: int = 0) -> None:
        super().__init__(verbose)
        if type(steps) is not int or steps < 1:
            raise ValueError(f"steps is {steps!r}: it must be a whole number of at least 1")
        self.steps = steps
        self._own_class: type[OffPolicyAlgorithm] | None = None

    def _init_callback(self) -> None:
        if not isinstance(self.model, OffPolicyAlgorithm):
            raise ValueError(
                f"{type(self.model).__name__} learns from its own policy's actions alone: a guided "
                "warm-up needs an off-policy algorithm, as SAC, TQC or TD3"
            )
        if hasattr(self.model, "warmup_steps"):
            raise ValueError(
                f"{type(self.model).__name__} has a warm-up of its own: set its warmup_steps"
            )
        if not self.training_env.has_attr("guide_action"):
            raise ValueError(
                "a guided warm-up needs a guide: wrap the environment in "
                "regil_wrappers.RetrievalGuideWrapper"
            )

    def _on_training_start(self) -> None:
        self._give_back()  # of a learning that was interrupted
        self._guided = np.full(self.training_env.num_envs, self.num_timesteps < self.steps)
        if self._guided.any():
            assert isinstance(self.model, OffPolicyAlgorithm)
            self._own_class = own = type(self.model)
            self.model.__class__ = _guided_class(own, self._play)

    def _play(self, action: Array, buffer_action: Array) -> tuple[Array, Array]:
        """Put the guides' actions over the policy's, in the environments that they act in."""
        indices = np.flatnonzero(self._guided)
        action, buffer_action = action.copy(), buffer_action.copy()
        action[indices] = executed_actions(self.training_env, indices)
        buffer_action[indices] = self.model.policy.scale_action(action[indices])
        return action, buffer_action

    def _on_step(self) -> bool:
        if self.num_timesteps >= self.steps:
            self._guided &= ~self.locals["dones"]
            if not self._guided.any():
                self._give_back()
        return True

    def _on_training_end(self) -> None:
        self._give_back()

    def _give_back(self) -> None:
        if self._own_class is not None:
            self.model.__class__ = self._own_class
            self._own_class = None
            if self.verbose:
                print(f"the guide has acted for {self.num_timesteps} steps")


def _guided_class(own: type[Any], play: Any) -> type[Any]:
    """The algorithm's class with another answer to which action comes next.

    A class, and not an attribute of the model: SB3 saves all attributes.
    """

    class Guided(own):  # type: ignore[misc]
        def _sample_action(
            self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
        ) -> tuple[Array, Array]:
            return play(  # type: ignore[no-any-return]
                *super()._sample_action(learning_starts, action_noise, n_envs)
            )

    Guided.__name__, Guided.__qualname__ = own.__name__, own.__qualname__
    return Guided
