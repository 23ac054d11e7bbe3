"""lambda(t): how much the behaviour-cloning term weighs as learning goes on.

- ``by_time``: falls with the steps done, as in the paper.
- ``BySuccess``: falls only while the policy's own episodes keep succeeding.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

RECENT = 20  # episodes that tell how the policy fares
FEW = 10  # fewer tell nothing
KEEPS_UP = 0.1  # below its best by no more than this
BACK = 4.0  # times faster up than down


def by_time(step: int, steps: int, floor: float) -> float:
    """max(1 - t / T, floor): the share of ``bc_coef`` after ``step`` of ``steps``."""
    return max(1.0 - step / steps, floor)


class BySuccess:
    """A share of ``bc_coef`` in [floor, 1] that falls while the policy keeps up with its best.

    Where it does not, the share rises again, four times faster: what the critic made worse,
    behaviour cloning puts right before it is let go further.

    Args:
        floor: the least share.
    """

    def __init__(self, floor: float) -> None:
        self.floor = floor
        self.share = 1.0
        self.best = 0.0
        self.recent: deque[bool] = deque(maxlen=RECENT)
        self.guide = [0, 0]  # its successes, its episodes

    def episode(self, success: bool, part: float) -> None:
        """An episode of the policy's own has ended.

        Args:
            success: of the episode.
            part: its length over the steps that the policy acts in altogether; the share falls by
                as much.
        """
        self.recent.append(success)
        if len(self.recent) < FEW:
            return
        rate = float(np.mean(self.recent))
        self.best = max(self.best, rate)
        change = -part if rate >= self.best - KEEPS_UP else BACK * part
        self.share = float(np.clip(self.share + change, self.floor, 1.0))

    def guided_episode(self, success: bool) -> None:
        """An episode in which the guide acted has ended."""
        self.guide[0] += success
        self.guide[1] += 1

    @property
    def behind_guide(self) -> bool:
        """Whether the policy succeeds less often than the guide, or has not shown that it does."""
        successes, episodes = self.guide
        if successes == 0:
            return False
        return len(self.recent) < FEW or bool(np.mean(self.recent) < successes / episodes)

    def state(self) -> dict[str, Any]:
        """Everything that has been seen, as plain values."""
        recent, guide = list(self.recent), list(self.guide)
        return {"share": self.share, "best": self.best, "recent": recent, "guide": guide}

    def load_state(self, state: dict[str, Any]) -> None:
        """Take over what ``state`` returned."""
        self.share, self.best = state["share"], state["best"]
        self.recent = deque(state["recent"], maxlen=RECENT)
        self.guide = list(state["guide"])
