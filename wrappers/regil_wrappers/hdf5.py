"""The door of HDF5 files: those that come in are checked before they are read, never executed.

Everything stays in the one file: soft, external and user-defined links, virtual datasets and
external storage are refused. Only deflate, lzf, shuffle and fletcher32 are unpacked, each once.

* ``created`` - a new file
* ``opened`` - the file
* ``has``, ``member`` - an object stored under a name in it
* ``array``, ``shape`` - a numeric dataset, once its claim fits a `Budget`, or only its shape
* ``encoded_pictures`` - a dataset of JPEG or PNG files
* ``json_attribute`` - an attribute that holds a JSON text
"""

from __future__ import annotations

import io
import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from mmap import ACCESS_READ, mmap
from pathlib import Path
from struct import unpack_from
from typing import Any

import h5py  # type: ignore[import-untyped]
import numpy as np
from numpy.typing import NDArray

from regil_wrappers.limits import MAX_BYTES, MAX_PIXELS, MAX_TEXT, Budget

__all__ = [
    "SIGNATURE",
    "array",
    "created",
    "encoded_pictures",
    "has",
    "json_attribute",
    "member",
    "opened",
    "shape",
]

SIGNATURE = b"\x89HDF\r\n\x1a\n"

_DEFLATE, _SHUFFLE, _FLETCHER32, _LZF = 1, 2, 3, 32000
_FILTERS = (_DEFLATE, _SHUFFLE, _FLETCHER32, _LZF)
# A chunk is unpacked whole, however small the dataset: this much is allowed to any.
_FREE_CHUNK = 16 * 1024**2


@contextmanager
def created(path: Path, **options: Any) -> Iterator[h5py.File]:
    """A new HDF5 file, which reaches the disk when all is in it.

    Until then it is in memory: HDF5 may crash the process when it writes to a full disk.

    Args:
        path: the file; an existing one is replaced.
        options: of `h5py.File`.

    Raises:
        OSError: if it cannot be written.
    """
    memory = io.BytesIO()
    with h5py.File(memory, "w", **options) as file:
        yield file
    with path.open("wb") as stream:
        stream.write(memory.getbuffer())
        stream.flush()
        os.fsync(stream.fileno())


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """The HDF5 file, for reading.

    Raises:
        ValueError: if it is none, cut short or damaged.
    """
    with path.open("rb") as stream:
        if stream.read(8) != SIGNATURE:
            raise ValueError("this is not an HDF5 file: record one with 'regil record'")
    _check_heaps(path)
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        if "truncated" in str(error):
            raise ValueError("the file is cut short: copy it again, or record another") from error
        raise ValueError(f"the HDF5 file is damaged ({error})") from error
    with file:
        yield file


def _check_heaps(path: Path) -> None:
    """Refuse global heaps whose parts do not fill them: HDF5 2.0 walks those for ever.

    They hold texts and values of variable length. Larger files than `MAX_BYTES` are not searched.
    """
    size = path.stat().st_size
    if not 16 <= size <= MAX_BYTES:
        return
    with path.open("rb") as stream, mmap(stream.fileno(), 0, access=ACCESS_READ) as content:
        at = 9 if content[8] > 1 else 13
        if content[at : at + 2] != b"\x08\x08":
            raise ValueError("the HDF5 file has addresses of other than 8 bytes, or is damaged")
        start = content.find(b"GCOL\1\0\0\0")
        while start >= 0:
            (length,) = unpack_from("<Q", content, start + 8) if start + 16 <= size else (0,)
            end = start + length
            place = start + 16
            if not place <= end <= size:
                raise ValueError("the HDF5 file is damaged (a heap is larger than the file)")
            while place + 16 <= end:
                index, _, part = unpack_from("<HHxxxxQ", content, place)
                # The free rest counts its own header.
                step = part if index == 0 else 16 + (part + 7) // 8 * 8
                if step < 16 or place + step > end:
                    raise ValueError("the HDF5 file is damaged (a heap's part does not fit)")
                place += step
            start = content.find(b"GCOL\1\0\0\0", start + 8)


def has(group: h5py.Group, name: str) -> bool:
    """Whether something is stored under that name, without following where it leads."""
    return group.get(name, getlink=True) is not None


def member(group: h5py.Group, name: Any, kind: type | None = None) -> Any:
    """An object stored in this very file: links that lead elsewhere are not followed.

    Args:
        group: where it is stored.
        name: without "/".
        kind: `h5py.Group` or `h5py.Dataset`; None takes both.

    Raises:
        ValueError: if there is none, it is a link, or of another kind.
    """
    where = f"{group.name.rstrip('/')}/{name}"
    if not isinstance(name, str) or "/" in name:
        raise ValueError(f"{where!r} is no name of a member")
    link = group.get(name, getlink=True)
    if link is None:
        raise ValueError(f"the HDF5 file has no {where!r}")
    if not isinstance(link, h5py.HardLink):
        raise ValueError(f"{where!r} is a link to somewhere else: links are not followed")
    found = group[name]
    if not isinstance(found, kind or (h5py.Group, h5py.Dataset)):
        raise ValueError(f"{where!r} is not a {kind.__name__.lower() if kind else 'dataset'}")
    return found


def array(group: h5py.Group, name: Any, budget: Budget, row: int | None = None) -> NDArray[Any]:
    """Read a numeric dataset, or one row of it.

    Raises:
        ValueError: if it holds no numbers, claims too much, is kept in another file or damaged.
    """
    dataset = _numbers(group, name)
    if row is not None and (not dataset.shape or not -dataset.shape[0] <= row < dataset.shape[0]):
        raise ValueError(f"{dataset.name!r} has no row {row}")
    _claim(dataset, dataset.shape if row is None else dataset.shape[1:], budget)
    return _read(dataset, () if row is None else row)


def shape(group: h5py.Group, name: Any, budget: Budget) -> tuple[int, ...]:
    """The shape of a numeric dataset that `array` could read.

    Raises:
        ValueError: as `array`, but for damage to the values themselves.
    """
    dataset = _numbers(group, name)
    _claim(dataset, dataset.shape, budget)
    return tuple(dataset.shape)


def _numbers(group: h5py.Group, name: Any) -> h5py.Dataset:
    dataset = member(group, name, h5py.Dataset)
    if dataset.dtype.kind not in "biuf" or dataset.shape is None:
        raise ValueError(f"{dataset.name!r} does not hold numbers")
    _check_storage(dataset)
    return dataset


def _claim(dataset: h5py.Dataset, shape: tuple[int, ...], budget: Budget) -> None:
    budget.claim(repr(dataset.name), math.prod(shape) * dataset.dtype.itemsize)


def encoded_pictures(group: h5py.Group, name: str, budget: Budget) -> Iterator[bytes]:
    """Each picture file of a dataset that holds them as bytes: (N,) of variable length, or (N, L).

    Raises:
        ValueError: as `array`.
    """
    dataset = member(group, name, h5py.Dataset)
    variable = dataset.shape is not None and h5py.check_vlen_dtype(dataset.dtype) == np.uint8
    # The kind of variable length, in HDF5's own encoding: on one that it does not know it crashes
    known = variable and dataset.id.get_type().encode()[3] == 0
    if not (known and dataset.ndim == 1) and not (dataset.dtype == np.uint8 and dataset.ndim == 2):
        raise ValueError(f"{dataset.name!r} does not hold pictures")
    _check_storage(dataset)
    for i in range(len(dataset)):
        # What a variable length claims is checked against the heap it lies in by HDF5 itself.
        row = _read(dataset, i)
        if row.ndim != 1 or row.dtype != np.uint8 or len(row) > 4 * MAX_PIXELS:
            raise ValueError(f"{dataset.name!r} does not hold a picture in row {i}")
        budget.claim(repr(dataset.name), len(row))
        yield row.tobytes()


def _check_storage(dataset: h5py.Dataset) -> None:
    if dataset.is_virtual or dataset.external:
        raise ValueError(f"{dataset.name!r} keeps its values in another file: that is not followed")
    properties = dataset.id.get_create_plist()
    filters = [properties.get_filter(i)[0] for i in range(properties.get_nfilters())]
    # Packed twice, a small file can claim a thousand times a thousand times its size.
    packed = [code for code in filters if code in (_DEFLATE, _LZF)]
    if len(packed) > 1 or len(set(filters)) != len(filters) or not set(filters) <= set(_FILTERS):
        raise ValueError(
            f"{dataset.name!r} is stored with filters {filters}: use gzip (1) or lzf (32000) alone"
        )
    chunk = math.prod(dataset.chunks or ()) * dataset.dtype.itemsize
    if chunk > max(_FREE_CHUNK, math.prod(dataset.shape) * dataset.dtype.itemsize):
        raise ValueError(f"{dataset.name!r} claims chunks of {chunk} bytes, more than it holds")


def _read(dataset: h5py.Dataset, index: Any) -> NDArray[Any]:
    try:
        return np.asarray(dataset[index])
    except OSError as error:
        raise ValueError(f"{dataset.name!r} cannot be read, the file is damaged") from error


def json_attribute(group: h5py.Group, name: str) -> Any:
    """What an attribute's JSON text says.

    Raises:
        ValueError: if there is no such attribute, or it is no JSON text.
    """
    if name not in group.attrs:
        raise ValueError(f"{group.name!r} has no attribute {name!r}")
    stored = group.attrs.get_id(name)
    if stored.shape != () or h5py.check_string_dtype(stored.dtype) is None:
        raise ValueError(f"attribute {name!r} is not a JSON text")
    text = group.attrs[name]
    if not isinstance(text, str) or len(text) > MAX_TEXT:
        raise ValueError(f"attribute {name!r} is not a JSON text")
    return json.loads(text)
