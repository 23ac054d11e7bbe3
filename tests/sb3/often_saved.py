"""`often_saved:Toy/Reach-v0`: the toy environment, in a run that is saved every second."""

import toy_registered  # noqa: F401

from regil_sb3.checkpoint import CheckpointCallback

_, *others = CheckpointCallback.__init__.__defaults__
CheckpointCallback.__init__.__defaults__ = (1.0, *others)
