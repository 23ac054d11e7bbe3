"""How long an environment takes, where it is one part of what is measured."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym

__all__ = ["Timed"]


class Timed(gym.Wrapper[Any, Any, Any, Any]):
    """Adds up the seconds that the environment inside takes."""

    seconds = 0.0

    def reset(self, **kwargs: Any) -> Any:
        """Reset, and count."""
        return self._timed(lambda: self.env.reset(**kwargs))

    def step(self, action: Any) -> Any:
        """Step, and count."""
        return self._timed(lambda: self.env.step(action))

    def _timed(self, call: Callable[[], Any]) -> Any:
        start = time.perf_counter()
        try:
            return call()
        finally:
            self.seconds += time.perf_counter() - start
