"""How far, how fast and where a hand may go, and how long a silence may last."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ["Limits", "Patience"]


@dataclass(frozen=True)
class Limits:
    """What holds for every motion, whoever asks for it.

    Args:
        low: least x, y, z of the finger tips (m).
        high: largest x, y, z (m).
        delta: how far an action of 1 moves the hand along an axis (m).
        speed: of the hand at most (m/s).
        lead: how far a place that is asked for may be from where the hand is, along each axis (m):
            an arm that is held back by what it touches pushes no harder than that. A hand that was
            pushed out of the box is brought back at this speed, and until then places that are
            asked for may lie outside, too.

    Raises:
        ValueError: the box is empty, or a number is not positive.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    delta: float = 0.01
    speed: float = 0.4
    lead: float = 0.03

    def __post_init__(self) -> None:
        """Validate."""
        if len(self.low) != 3 or len(self.high) != 3 or not (np.array(self.low) < self.high).all():
            raise ValueError(f"workspace from {self.low} to {self.high}: it holds no room")
        for name in ("delta", "speed", "lead"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} is {getattr(self, name)!r}: it must be positive")

    def next_target(
        self,
        target: npt.NDArray[np.float64],
        wanted: npt.NDArray[np.float64],
        position: npt.NDArray[np.float64],
        seconds: float,
    ) -> npt.NDArray[np.float64]:
        """The nearest to what is wanted that these limits allow.

        Args:
            target: (3,) what was asked for last.
            wanted: (3,) what is asked for now.
            position: (3,) where the hand is.
            seconds: until the next.
        """
        step = np.clip(wanted, self.low, self.high) - target
        length = float(np.linalg.norm(step))
        most = self.speed * seconds
        asked = target + step * min(1.0, most / max(length, 1e-12))
        return np.clip(asked, position - self.lead, position + self.lead)


@dataclass(frozen=True)
class Patience:
    """How long a silence may last before the arm is stopped, in control periods.

    Args:
        picture: age of the newest picture.
        state: age of the arm's newest state.
        step: by how much a step may come too late.
        same: steps with the very same picture while the hand moves more than 5 mm.
    """

    picture: float = 3.0
    state: float = 2.0
    step: float = 2.0
    same: int = 4
