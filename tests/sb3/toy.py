"""The environment that learns in seconds, with a guide of its own."""

from regil_sb3.bench.toy import Reach, demonstration, stacked

__all__ = ["Reach", "demonstration", "stacked"]
