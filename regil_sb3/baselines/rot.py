"""ROT: RL on an optimal-transport reward, held to behaviour cloning where that is better."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import torch as th

from regil_sb3.td3bc import TD3BC, encode


class ROT(TD3BC):
    """Regularized Optimal Transport, on TD3BC's networks.

    The actor is trained by behaviour cloning of the demonstration first (``bc_pretrain_steps``);
    what comes out is kept as ``pi_BC``. Then it maximises, from Section 3 of the paper,

        (1 - lambda) E[Q(o, pi(o))] - alpha lambda E ||a - pi(o)||^2

    over the replay buffer and the demonstration, with soft Q-filtering

        lambda = E[ Q(o, pi_BC(o)) > Q(o, pi(o)) ]

    over the batch of the replay buffer: the share of it where cloning alone would do better. Q is
    what the actor's loss takes (``actor_q``), alpha is ``bc_coef``.

    The reward is the environment's: ``RetrievalRewardWrapper(reward="ot")``, or "tot" for TOT.
    Arguments are ``TD3BC``'s. There is no guide and nothing but the demonstration to clone, so
    ``warmup_steps=0, keep_own_successes=False``; ``bc_schedule``, ``bc_floor`` and ``bc_steps``
    mean nothing here.

    Paper: Haldar, Mathur, Yarats and Pinto, Watch and Match: Supercharging Imitation with
    Regularized Optimal Transport, CoRL 2022, https://arxiv.org/abs/2206.15469
    """

    def _setup_model(self) -> None:
        super()._setup_model()
        self.bc_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.soft_q = 1.0  # lambda of the last batch

    def pretrain_bc(
        self, steps: int, progress: Callable[[int], None] | None = None, before: int = 0
    ) -> float:
        """Train the actor by behaviour cloning, and keep it as ``pi_BC``."""
        loss = super().pretrain_bc(steps, progress, before)
        self.bc_actor.load_state_dict(self.actor.state_dict())
        return loss

    def _before_actor(self, observations: Any, features: th.Tensor) -> None:
        with th.no_grad():
            cloned, own = (
                self._actor_q(features, actor.mu(encode(actor, observations)))
                for actor in (self.bc_actor, self.actor)
            )
            self.soft_q = float((cloned > own).float().mean())

    def bc_coef_now(self) -> float:
        """alpha * lambda."""
        return self.bc_coef * self.soft_q

    def q_coef_now(self) -> float:
        """1 - lambda."""
        return self.q_coef * (1.0 - self.soft_q)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        states, variables = super()._get_torch_save_params()
        return [*states, "bc_actor"], variables
