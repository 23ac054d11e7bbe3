"""Learning from the demonstration alone: a step is an update, and the environment is not asked."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import MaybeCallback

from regil_sb3.callbacks import close_callbacks

SelfOffline = TypeVar("SelfOffline", bound="Offline")


class Offline(BaseAlgorithm):
    """An algorithm of SB3's whose ``num_timesteps`` are updates on the demonstration."""

    def update(self) -> float:
        """Make one update.

        Returns:
            Its loss.

        Raises:
            FloatingPointError: the loss is not finite.
        """
        raise NotImplementedError

    def learn(
        self: SelfOffline,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 100,
        tb_log_name: str = "offline",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfOffline:
        """Make ``total_timesteps`` updates, and log the mean loss every ``log_interval``.

        However it ends, callbacks that have a ``close`` are closed.
        """
        given = callback
        try:
            total_timesteps, callback = self._setup_learn(
                total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
            )
            callback.on_training_start(locals(), globals())
            callback.on_rollout_start()
            losses = []
            while self.num_timesteps < total_timesteps:
                losses.append(self.update())
                self.num_timesteps += 1
                self._update_current_progress_remaining(self.num_timesteps, total_timesteps)
                if self.num_timesteps % log_interval == 0:
                    self.logger.record("train/bc_loss", float(np.mean(losses)))
                    self.dump_logs()
                    losses.clear()
                if not callback.on_step():
                    break
            callback.on_training_end()
        finally:
            close_callbacks(given)
        return self

    def dump_logs(self) -> None:
        """Write log data."""
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(step=self.num_timesteps)
