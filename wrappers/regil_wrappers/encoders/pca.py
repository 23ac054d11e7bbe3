"""PCA whitening: the equation, and an encoder with such a map after it.

* ``principal_axes`` - mean and axes of features
* ``Whitened`` - an encoder, its features whitened
"""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

from regil_wrappers.encoders.protocol import Encoder

__all__ = ["Whitened", "principal_axes"]

_SLICE = 4096


def principal_axes(
    features: NDArray[np.float32], n: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """PCA whitening: with X = U S V^T centred, N rows, ``axes = V sqrt(N - 1) / S``.

    The features, mapped so, have covariance 1 in the n directions of largest variance, and the
    largest component of each axis is positive. Sums are in float64.

    Args:
        features: (N, D) float32.
        n: how many axes.

    Returns:
        mean (D,) and axes (D, n), float32.

    Raises:
        ValueError: if fewer than n singular values are above 1e-5 of the largest.
    """
    rows, columns = features.shape
    mean = features.mean(axis=0, dtype=np.float64)
    # The smaller of X X^T and X^T X, centred in slices: a patch grid of a long demonstration in
    # float64 would need twice its memory again.
    few = rows <= columns
    slices = [slice(i, i + _SLICE) for i in range(0, columns if few else rows, _SLICE)]
    gram = np.zeros((min(rows, columns),) * 2)
    for part in slices:
        if few:
            centred = features[:, part] - mean[part]
            gram += centred @ centred.T
        else:
            centred = features[part] - mean
            gram += centred.T @ centred
    squares, vectors = np.linalg.eigh(gram)
    squares, vectors = squares[::-1], vectors[:, ::-1]
    rank = int((squares > 1e-10 * squares[0]).sum()) if squares[0] > 0 else 0
    if n > rank:
        raise ValueError(
            f"whiten={n}: the {rows} frames it is fitted on span {rank} directions of the "
            + (f"features: choose whiten={rank} or less" if rank else "features: all are equal")
        )
    axes = vectors[:, :n]
    if few:  # V = X^T U / S
        axes = np.concatenate([(features[:, part] - mean[part]).T @ axes for part in slices])
        axes /= np.sqrt(squares[:n])
    axes = axes * np.sqrt((rows - 1) / squares[:n])
    signs = np.sign(axes[np.abs(axes).argmax(axis=0), np.arange(n)])
    return mean.astype(np.float32), np.ascontiguousarray(axes * signs, dtype=np.float32)


class Whitened:
    """An encoder, and an affine map after it: ``(y - mean) @ axes``.

    Args:
        encoder: gives y, (B, D).
        mean: (D,) float32.
        axes: (D, n) float32.
    """

    slow = False  # the features it starts from are kept already

    def __init__(
        self, encoder: Encoder, mean: NDArray[np.float32], axes: NDArray[np.float32]
    ) -> None:
        self.encoder = encoder
        self.mean = mean
        self.axes = axes
        self.frame_size: int | None = getattr(encoder, "frame_size", None)
        digest = hashlib.sha256(mean.tobytes() + axes.tobytes()).hexdigest()
        base = getattr(encoder, "cache_key", None)
        self.cache_key: str | None = None if base is None else f"{base} whitened {digest}"

    def encode(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Encode (B, H, W, 3) uint8 as (B, n) float32, not normalised."""
        return self.transform(self.encoder.encode(frames))

    def transform(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Whiten (B, D) float32; each row by itself, so that it does not depend on the others."""
        return np.stack([(row - self.mean) @ self.axes for row in features])
