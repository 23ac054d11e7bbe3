"""Scripted experts of the rehearsal robot's tasks, who know where the target stands."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["Expert"]

_DELTA = 0.01  # m that an action of 1 moves the hand
_SPEED = 0.5  # of a full action
_GRASP = 8  # steps that the gripper is given to close
_LIFT = 0.03  # radians of the lid in a step
_LID = (0.12, 0.035)  # m, the knob from the lid's hinge: along it and above it
_HINGE = (-0.07, 0.074)  # m, the hinge from the box's middle: x and z


class Expert:
    """Says what a person would do.

    Args:
        task: "reach", "insert" or "open".
    """

    def __init__(self, task: str) -> None:
        self._way = {"reach": self._reach, "insert": self._insert, "open": self._open}[task]
        self.begin()

    def begin(self) -> None:
        """An episode begins."""
        self._held = 0

    def action(
        self, hand: npt.NDArray[np.float64], truth: dict[str, Any]
    ) -> npt.NDArray[np.float32]:
        """What to do now, (4,) in [-1, 1].

        Args:
            hand: (3,) m.
            truth: what ``Rehearsal.truth`` says.
        """
        place, closed = self._way(hand, truth)
        action = np.clip((place - hand) / _DELTA, -_SPEED, _SPEED)
        return np.append(action, 1.0 if closed else -1.0).astype(np.float32)

    def _above(
        self,
        hand: npt.NDArray[np.float64],
        target: npt.NDArray[np.float64],
        low: float,
        high: float,
        near: float,
    ) -> npt.NDArray[np.float64]:
        """Towards the target's place, and down to it as the hand comes to be above it."""
        off = float(np.hypot(*(hand - target)[:2]))
        return np.array([target[0], target[1], low if off < near else high])

    def _reach(
        self, hand: npt.NDArray[np.float64], truth: dict[str, Any]
    ) -> tuple[npt.NDArray[np.float64], bool]:
        return self._above(hand, truth["target"], 0.0, 0.05, 0.02), True

    def _insert(
        self, hand: npt.NDArray[np.float64], truth: dict[str, Any]
    ) -> tuple[npt.NDArray[np.float64], bool]:
        return self._above(hand, truth["target"], 0.1, 0.175, 0.01), True

    def _open(
        self, hand: npt.NDArray[np.float64], truth: dict[str, Any]
    ) -> tuple[npt.NDArray[np.float64], bool]:
        knob = truth["target"] + _knob(0.0)
        if self._held:
            self._held += 1
            angle = max(self._held - _GRASP, 0) * _LIFT
            # Along the lid's own circle: the arm gives way, so that chasing the knob would push it
            return hand + (_knob(angle + _LIFT) - _knob(angle)) * (angle > 0), True
        if np.linalg.norm(hand - knob) < 0.005:
            self._held = 1
        return self._above(hand, knob, knob[2], 0.16, 0.008), False


def _knob(angle: float) -> npt.NDArray[np.float64]:
    """Where the finger tips hold the knob of a lid that is open by so much, from the box (m)."""
    along, above = _LID
    return np.array(
        [
            _HINGE[0] + along * math.cos(angle) - above * math.sin(angle),
            0.0,
            _HINGE[1] + along * math.sin(angle) + above * math.cos(angle) - 0.006,
        ]
    )
