"""PCA whitening of an encoder's features, fitted on a demonstration.

* ``Whitening`` - an encoder still to be fitted: ``"<encoder>?whiten=32"``
* ``fitted`` - the encoder to use beside these frames
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from regil_wrappers.encoders.cache import embed, load_arrays, store_arrays
from regil_wrappers.encoders.options import whole_number
from regil_wrappers.encoders.pca import Whitened, principal_axes
from regil_wrappers.encoders.protocol import Encoder

__all__ = ["Whitening", "fitted"]

_FITTED_BYTES = 512 * 1024**2


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

    def fit(self, memories: Iterable[NDArray[np.uint8]]) -> Whitened:
        """Fit on demonstrations' frames, each (N, H, W, 3) uint8; kept in the cache if slow.

        Of features of more than 512 MiB together, those of every second frame are used, every
        fourth, and so on.

        Raises:
            ValueError: if the frames span fewer than n directions.
        """
        features = _thinned(embed(self.encoder, frames) for frames in memories)
        base = getattr(self.encoder, "cache_key", None)
        name = None
        if base is not None and getattr(self.encoder, "slow", False):
            digest = hashlib.sha256(f"{base} whiten={self.n} {features.shape}".encode())
            digest.update(features.data)
            name = f"whitening-{digest.hexdigest()}"
            shapes = {"mean": features.shape[1:], "axes": (features.shape[1], self.n)}
            stored = load_arrays(name, shapes)
            if stored is not None:
                return Whitened(self.encoder, stored["mean"], stored["axes"])
        mean, axes = principal_axes(features, self.n)
        if name is not None:
            store_arrays(name, mean=mean, axes=axes)
        return Whitened(self.encoder, mean, axes)


def _thinned(parts: Iterable[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Rows 0, s, 2 s, ... of all parts together, s the smallest power of two that lets them fit."""
    kept: list[NDArray[np.float32]] = []
    seen = rows = 0
    step = 1
    for part in parts:
        kept.append(_every(step, part, seen))
        seen += len(part)
        rows += len(kept[-1])
        while rows > 1 and rows * part[0].nbytes > _FITTED_BYTES:
            step *= 2
            starts = np.cumsum([0, *map(len, kept)])
            kept = [_every(2, rest, at) for rest, at in zip(kept, starts[:-1], strict=True)]
            rows = sum(map(len, kept))
    return kept[0] if len(kept) == 1 else np.concatenate(kept)


def _every(step: int, part: NDArray[np.float32], start: int) -> NDArray[np.float32]:
    """Those of the rows start, start + 1, ... whose numbers `step` divides."""
    if step == 1:
        return part
    rows: NDArray[np.float32] = part[-start % step :: step].copy()  # a view keeps the whole part
    return rows


def fitted(encoder: Encoder, memories: NDArray[np.uint8] | Iterable[NDArray[np.uint8]]) -> Encoder:
    """The encoder to use beside these demonstrations: itself, or its whitening fitted on them.

    Args:
        encoder: any.
        memories: frames of one demonstration, (N, H, W, 3) uint8, or of each of several; only for
            whitening are they looked at.
    """
    if not isinstance(encoder, Whitening):
        return encoder
    return encoder.fit([memories] if isinstance(memories, np.ndarray) else memories)
