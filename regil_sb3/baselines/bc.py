"""BC: behaviour cloning of the demonstration alone."""

from __future__ import annotations

from regil_sb3.baselines.offline import Offline
from regil_sb3.td3bc import TD3BC


class BC(Offline, TD3BC):
    """The actor of ``TD3BC``, trained by its BC term on the demonstration and nothing else.

    It minimises ``E ||a - pi(o)||^2`` over the demonstration's steps with TD3BC's network,
    augmentation, batch and averaging of weights. Its arguments are TD3BC's; those of the critic, of
    exploration and of the warm-up mean nothing here, so ``warmup_steps=0, buffer_size=1`` is right.

    Paper: Pomerleau, Efficient Training of Artificial Neural Networks for Autonomous Navigation,
    1991, https://doi.org/10.1162/neco.1991.3.1.88

    Example:
        >>> from regil_sb3.baselines import BC
        >>> model = BC("CnnPolicy", env, demo=demo, warmup_steps=0, buffer_size=1)
        >>> model.learn(5_000)  # updates  # doctest: +SKIP
    """

    def update(self) -> float:
        """One update of the actor; see ``Offline.update``."""
        self._update_learning_rate(self.actor.optimizer)
        return self.pretrain_bc(1, before=self.num_timesteps)
