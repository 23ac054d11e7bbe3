"""``PixelsEncoder`` - ``"pixels"``, the default: a small picture, no network, no download."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from regil_wrappers.encoders.options import whole_number

__all__ = ["PixelsEncoder"]


class PixelsEncoder:
    """The picture itself, made small: no network, no download, 0.01 ms.

    Each frame is resized to a square by area, divided by 255 and flattened (D = 3 * size * size:
    2352 by default); not normalised.

    Args:
        size: side of the small square in pixels.

    Raises:
        ValueError: if it is no whole number of at least 1.
    """

    frame_size: int | None = None
    slow = False

    def __init__(self, size: int = 28) -> None:
        whole_number("size", size)
        self._size = size
        self.cache_key: str | None = f"pixels-{size}"

    def encode(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Encode (B, H, W, 3) uint8 as (B, D) float32 in [0, 1]."""
        size = (self._size, self._size)
        small = [cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in frames]
        embeddings: NDArray[np.float32] = (
            np.stack(small).reshape(len(frames), -1).astype(np.float32)
        )
        embeddings /= 255
        return embeddings
