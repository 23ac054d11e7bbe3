"""The way that a demonstration's hand goes.

* ``Path`` - its places, and which of them belong to what is taken up and which to where it is
  brought
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
from numpy.typing import NDArray

__all__ = ["Path"]

Floats = NDArray[np.float64]

_RAMP = 0.15  # of the path: the share in which a correction grows to its full size
_CHANGE = (10, 12)  # steps after the gripper closes: the correction starts to change; changes over
_SOONER = (0.3, 0.4)  # of the steps left then: the most that these may be


class Path:
    """The places that a demonstration goes through, as its actions command them.

    Args:
        deltas: (T, 3) action units, of each step.
        gripper: (T,) the gripper's actions, positive to close; None without one.

    Attributes:
        places: (T, 3) action units from where the hand starts.
        grasp: the step in which an open gripper closes; None where none does.
    """

    def __init__(self, deltas: Floats, gripper: NDArray[np.float32] | None) -> None:
        self.places: Floats = np.cumsum(deltas, axis=0)
        self._last_delta = deltas[-1]
        self._gripper = gripper
        closing = np.zeros(len(deltas), bool) if gripper is None else gripper > 0
        events = np.flatnonzero(closing[1:] & ~closing[:-1])
        self.grasp = int(events[0]) + 1 if len(events) else None

    def __len__(self) -> int:
        return len(self.places)

    def gripper_moves(self, start: int, end: int) -> bool:
        """Whether the gripper's action changes between two steps, both included."""
        return self._gripper is not None and bool(np.ptp(self._gripper[start : end + 1]))

    def corrected(self, i: int, taken: Floats, brought: Floats | None) -> Floats:
        """(3,) action units: the place of step i, which may be beyond the last one.

        Args:
            i: the step.
            taken: (3,) action units, how far what the hand goes to first has moved.
            brought: (3,) how far where it brings that has, to which the correction changes over
                after a grasp; None: it does not.
        """
        shift = taken
        if brought is not None and self.grasp is not None:
            left = len(self) - self.grasp
            start, over = (min(c, s * left) for c, s in zip(_CHANGE, _SOONER, strict=True))
            share = float(np.clip((i - self.grasp - start) / over, 0, 1))
            shift = (1 - share) * taken + share * brought
        n = len(self)
        place = self.places[min(i, n - 1)] + max(0, i - n + 1) * self._last_delta
        return cast("Floats", place + min(1.0, (i + 1) / (_RAMP * n)) * shift)

    def split(self) -> Sequence[Floats]:
        """The places up to where something has been taken up, and those after; (., 3) each.

        Raises:
            ValueError: where nothing is.
        """
        if self.grasp is None:
            raise ValueError("nothing is taken up on this path: its gripper does not close")
        middle = min(self.grasp + _CHANGE[0], len(self) - 1)
        return self.places[:middle], self.places[middle:]
