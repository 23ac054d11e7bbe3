"""PCA whitening of an encoder's features, fitted on a demonstration.

* ``Whitening`` - an encoder still to be fitted: ``"<encoder>?whiten=32"``
* ``fitted`` - the encoder to use beside these frames
"""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

from regil_wrappers.encoders.cache import embed, load_arrays, store_arrays
from regil_wrappers.encoders.options import whole_number
from regil_wrappers.encoders.pca import Whitened, principal_axes
from regil_wrappers.encoders.protocol import Encoder

__all__ = ["Whitening", "fitted"]


class Whitening:
    """An encoder whose features are whitened, once there is a demonstration to fit that on.

    It is no use by itself: `Retriever` fits it on its memory.

    Args:
        encoder: whose features are whitened.
        n: how many principal axes are kept, D of the embedding.

    Raises:
        ValueError: if n is no whole number of at least 1.
    """

    def __init__(self, encoder: Encoder, n: int) -> None:
        whole_number("whiten", n)
        self.encoder = encoder
        self.n = n
        self.frame_size: int | None = getattr(encoder, "frame_size", None)

    def encode(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Refuse: nothing has been fitted yet.

        Raises:
            ValueError: always.
        """
        raise ValueError(
            f"whiten={self.n} is fitted on a demonstration: give the encoder to a Retriever, or "
            f"call regil_wrappers.encoders.fitted(encoder, frames)"
        )

    def fit(self, *memories: NDArray[np.uint8]) -> Whitened:
        """Fit on demonstrations' frames, each (N, H, W, 3) uint8; kept in the cache if slow.

        Raises:
            ValueError: if the frames span fewer than n directions.
        """
        embeddings = np.concatenate([embed(self.encoder, frames) for frames in memories])
        base = getattr(self.encoder, "cache_key", None)
        name = None
        if base is not None and getattr(self.encoder, "slow", False):
            digest = hashlib.sha256(f"{base} whiten={self.n} {embeddings.shape}".encode())
            digest.update(embeddings.data)
            name = f"whitening-{digest.hexdigest()}"
            shapes = {"mean": embeddings.shape[1:], "axes": (embeddings.shape[1], self.n)}
            stored = load_arrays(name, shapes)
            if stored is not None:
                return Whitened(self.encoder, stored["mean"], stored["axes"])
        mean, axes = principal_axes(embeddings, self.n)
        if name is not None:
            store_arrays(name, mean=mean, axes=axes)
        return Whitened(self.encoder, mean, axes)


def fitted(encoder: Encoder, *memories: NDArray[np.uint8]) -> Encoder:
    """The encoder to use beside these demonstrations: itself, or its whitening fitted on them.

    Args:
        encoder: any.
        memories: frames of each demonstration, (N, H, W, 3) uint8.
    """
    return encoder.fit(*memories) if isinstance(encoder, Whitening) else encoder
