"""``Preprocessing`` - what is done to a frame before a network sees it. No torch here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from regil_wrappers.encoders.options import fraction, one_of, whole_number

__all__ = ["Preprocessing"]


@dataclass(frozen=True)
class Preprocessing:
    """Crop, resize, colour order, and the numbers to standardise by.

    Args:
        size: side (px) of the square that the network sees; None leaves frames as they are.
        crop: None makes the whole picture a square, whatever its shape. A number keeps the central
            square whose side is that share of the shorter side (CLIP: 1, R3M: 224/256).
        mean: of each channel, for values in [0, 1], in the order the network sees.
        std: of each channel.
        order: of the channels that the network sees.

    Raises:
        ValueError: if one of them is out of range.
    """

    size: int | None
    crop: float | None = None
    mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    std: tuple[float, ...] = (1.0, 1.0, 1.0)
    order: Literal["rgb", "bgr"] = "rgb"

    def __post_init__(self) -> None:
        if self.size is not None:
            whole_number("size", self.size)
        if self.crop is not None:
            fraction("crop", self.crop)
        one_of("order", self.order, ("rgb", "bgr"))
        for name in ("mean", "std"):
            object.__setattr__(self, name, _three_numbers(name, getattr(self, name)))
        if min(self.std) <= 0:
            raise ValueError(f"std={self.std}: it must be above 0")

    @property
    def frame_size(self) -> int | None:
        """Side (px) of the picture to render, so that none is enlarged; None where any will do."""
        return None if self.size is None else round(self.size / (self.crop or 1))

    def pictures(self, frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Crop, resize and order channels; standardising is left to the network's device.

        Args:
            frames: (B, H, W, 3) uint8 RGB.

        Returns:
            (B, size, size, 3) uint8: by area where pictures shrink, cubic where they grow.
        """
        if self.crop is not None:
            height, width = frames.shape[1:3]
            side = max(1, round(self.crop * min(height, width)))
            top, left = (height - side) // 2, (width - side) // 2
            frames = frames[:, top : top + side, left : left + side]
        if self.size is not None and frames.shape[1:3] != (self.size, self.size):
            shrinks = min(frames.shape[1:3]) >= self.size
            how = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
            square = (self.size, self.size)
            frames = np.stack([cv2.resize(frame, square, interpolation=how) for frame in frames])
        if self.order == "bgr":
            frames = frames[..., ::-1]
        return np.ascontiguousarray(frames)


def _three_numbers(name: str, value: Any) -> tuple[float, ...]:
    values = tuple(value) if isinstance(value, (tuple, list)) else (value,) * 3
    numbers = all(isinstance(x, (int, float)) and not isinstance(x, bool) for x in values)
    if len(values) != 3 or not numbers:
        raise ValueError(f"{name}={value!r}: give one number, or three with commas between them")
    return tuple(float(x) for x in values)
