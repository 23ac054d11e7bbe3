"""Crash-safe checkpoints, from which training goes on as if it had never stopped.

* ``callback`` - saves now and then, and when the process is told to end
* ``learner_state`` - all that decides how learning goes on, and back again
* ``snapshot``, ``generations`` - JSON and arrays in folders; the newest whole one counts
* ``open_episode`` - an environment's episode, played again after a restart
"""

from regil_sb3.checkpoint.callback import CheckpointCallback, Preempted
from regil_sb3.checkpoint.open_episode import ReplayableEpisode

__all__ = ["CheckpointCallback", "Preempted", "ReplayableEpisode"]
