"""``embed`` - the embeddings of a demonstration's frames, cached in the process and in files."""

from __future__ import annotations

import hashlib
import os
import zipfile
from collections import OrderedDict
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from regil_wrappers.encoders.pca import Whitened
from regil_wrappers.encoders.protocol import Encoder, check_embedding

__all__ = ["embed"]

_CACHED_DEMONSTRATIONS = 8
_cache: OrderedDict[str, NDArray[np.float32]] = OrderedDict()


def embed(encoder: Encoder, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Embeddings of a demonstration's frames, from the cache where possible.

    Frames are encoded one at a time, as they will be in an episode: a network's output depends in
    its last bits on the size of the batch, and a frame must have distance 0 to itself.

    Args:
        encoder: cached by its ``cache_key`` together with the frames: in this process, and if it is
            ``slow`` also in the folder ``regil`` of the user's cache (``XDG_CACHE_HOME``,
            ``~/.cache``).
        frames: (N, H, W, 3) uint8.

    Returns:
        (N, D) float32, not to be written to.

    Raises:
        ValueError: if the encoder's output has another shape or type, or is not finite.
    """
    key = getattr(encoder, "cache_key", None)
    if key is None:
        return _embed(encoder, frames)
    digest = hashlib.sha256(f"{key} {frames.shape}".encode())
    digest.update(np.ascontiguousarray(frames).data)
    name = digest.hexdigest()
    if name not in _cache:
        slow = getattr(encoder, "slow", False)
        stored = load_arrays(name, {"embeddings": (len(frames), None)}) if slow else None
        embeddings = _embed(encoder, frames) if stored is None else stored["embeddings"]
        if slow and stored is None:
            store_arrays(name, embeddings=embeddings)
        _cache[name] = embeddings
        if len(_cache) > _CACHED_DEMONSTRATIONS:
            _cache.popitem(last=False)
    _cache.move_to_end(name)
    return _cache[name]


def _embed(encoder: Encoder, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
    if isinstance(encoder, Whitened):
        embeddings = encoder.transform(embed(encoder.encoder, frames))
    else:
        rows = []
        for i in range(len(frames)):
            row = encoder.encode(frames[i : i + 1])
            check_embedding(row, f"frame {i} of the demonstration")
            rows.append(row.copy())  # the encoder may use its array again
        embeddings = np.concatenate(rows)
    embeddings.flags.writeable = False
    return embeddings


def cache_folder() -> Path:
    """The folder ``regil`` of the user's cache: ``XDG_CACHE_HOME``, else ``~/.cache``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "regil"


def load_arrays(
    name: str, shapes: Mapping[str, tuple[int | None, ...]]
) -> dict[str, NDArray[np.float32]] | None:
    """Arrays that `store_arrays` kept, not to be written to; None if there are none, or damaged.

    Args:
        name: what they were stored as.
        shapes: of each array, None where any length will do. Theirs must be finite float32.
    """
    file = cache_folder() / f"{name}.npz"
    try:
        # Opened here: np.load leaves a file open that it cannot read.
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in shapes}
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None  # not there, or not readable: it is only a cache, and is written again
    for key, shape in shapes.items():
        array = arrays[key]
        fits = len(shape) == array.ndim and all(
            want in (None, have) for want, have in zip(shape, array.shape, strict=True)
        )
        if not fits or array.dtype != np.float32 or not np.isfinite(array).all():
            return None
        array.flags.writeable = False
    return arrays


def store_arrays(name: str, **arrays: NDArray[np.float32]) -> None:
    """Keep arrays in a file of the cache folder; where that cannot be written, nothing happens."""
    file = cache_folder() / f"{name}.npz"
    temporary = file.with_name(f".{file.name}.{os.getpid()}.tmp")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as stream:
            np.savez(stream, **cast(dict[str, Any], arrays))
        temporary.replace(file)
    except OSError:  # a full or read-only cache costs time, nothing else
        with suppress(OSError):
            temporary.unlink()
