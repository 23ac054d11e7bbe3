"""What an encoder is, and what it may return.

* ``Encoder`` - the protocol
* ``check_embedding`` - refuses anything but finite float32 of the right shape
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["Encoder", "check_embedding"]


class Encoder(Protocol):
    """Turns pictures into embeddings.

    An encoder may also have these attributes:

    * ``frame_size`` (int or None): the side of the square picture it would like to be given.
      Environments that can render one are asked for it; otherwise it gets the observation's
      picture.
    * ``cache_key`` (str or None): everything that its output depends on (name, settings, digest of
      the weights). Without it embeddings are not cached.
    * ``slow`` (bool): whether embeddings of a demonstration are worth a file in the user's cache
      folder.
    """

    def encode(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Encode pictures.

        Args:
            frames: (B, H, W, 3) uint8, RGB.

        Returns:
            (B, D) float32.
        """
        ...


def check_embedding(row: Any, which: str) -> None:
    """Refuse anything but (1, D) finite float32.

    Args:
        row: what an encoder returned for one frame.
        which: the frame, as the error names it.

    Raises:
        ValueError: naming the frame.
    """
    if not isinstance(row, np.ndarray) or row.dtype != np.float32 or row.ndim != 2 or len(row) != 1:
        got = f"{row.dtype} {row.shape}" if isinstance(row, np.ndarray) else type(row).__name__
        raise ValueError(f"the encoder gave {got} for {which}: it must be a float32 array (1, D)")
    if not np.isfinite(row).all():
        raise ValueError(f"the encoder gave NaN or infinity for {which}")
