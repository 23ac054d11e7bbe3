"""How long control steps took, and which came too late."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

__all__ = ["StepTimes"]


class StepTimes:
    """The time between an observation and the action that answers it, step by step.

    Args:
        period: of control, in seconds.

    Attributes:
        answers: seconds from an observation to its action.
        periods: seconds from one observation to the next.
        missed: actions that came after the time of the next observation.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self.answers: list[float] = []
        self.periods: list[float] = []
        self.missed = 0
        self._seen = 0.0

    def begin(self, now: float) -> None:
        """An observation is given that no step led to."""
        self._seen = now

    def arrived(self, now: float, tick: float) -> float:
        """An action has come; returns when the next observation is due."""
        self.answers.append(now - self._seen)
        if now <= tick:
            return tick
        self.missed += 1
        return tick + math.ceil((now - tick) / self._period) * self._period

    def left(self, now: float) -> None:
        """An observation is given."""
        self.periods.append(now - self._seen)
        self._seen = now

    def summary(self) -> dict[str, Any]:
        """Steps, missed deadlines, and milliseconds: median, 99th percentile and most."""
        out: dict[str, Any] = {"steps": len(self.periods), "missed": self.missed}
        for name, values in (("answer_ms", self.answers), ("period_ms", self.periods)):
            if values:
                at = np.percentile(values, [50, 99, 100]) * 1000
                out[name] = dict(zip(("median", "p99", "max"), at.round(2).tolist(), strict=True))
        return out
