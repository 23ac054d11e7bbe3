"""The algorithms that TD3BC is compared with (docs/baselines.md).

* ``BC`` - behaviour cloning of the demonstration alone
* ``BAKU`` - a transformer that clones chunks of its actions
* ``ROT`` - RL on optimal-transport rewards, regularised towards behaviour cloning; with the reward
  "tot" it is TOT
* ``ReverseForwardCurriculum`` - where RFCL's episodes begin
* ``vinn_act`` - no learning: the actions of the nearest frames, weighted by distance
"""

from regil_sb3.baselines.baku import BAKU, BAKUPolicy
from regil_sb3.baselines.bc import BC
from regil_sb3.baselines.offline import Offline
from regil_sb3.baselines.rfcl import ReverseForwardCurriculum
from regil_sb3.baselines.rot import ROT
from regil_sb3.baselines.vinn import locally_weighted, vinn_act

__all__ = [
    "BAKU",
    "BC",
    "ROT",
    "BAKUPolicy",
    "Offline",
    "ReverseForwardCurriculum",
    "locally_weighted",
    "vinn_act",
]
