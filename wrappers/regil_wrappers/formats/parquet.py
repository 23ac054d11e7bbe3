"""The door through which parquet and arrow files come in: claims are checked, rows come in batches.

* ``batches`` - the wanted columns, some rows at a time
* ``numbers`` - a column of numbers, or of lists of one length, as an array
* ``json_file`` - a JSON text beside them
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from regil_wrappers.formats.footer import claims
from regil_wrappers.limits import Budget, need

__all__ = ["batches", "json_file", "numbers"]

_MAX_ROWS = 10_000_000
_MAX_SCHEMA = 16 * 1024**2
_MAX_INDEX = 64 * 1024**2
# What one batch may unpack to: a value that a dictionary holds once can stand in every row.
_BATCH_BYTES = 256 * 1024**2


def batches(
    path: Path,
    columns: Sequence[str],
    budget: Budget,
    extra: str,
    optional: Callable[[str], bool] = lambda name: False,
) -> Iterator[Any]:
    """Record batches of a parquet file with these columns.

    Args:
        path: the file.
        columns: names that it must have.
        budget: takes what the file's own index claims for them.
        extra: the extra of regil-wrappers that brings pyarrow.
        optional: whether a column that is not among them is read too.

    Raises:
        ValueError: if a column is missing or too much is claimed; pyarrow's own errors
            (`ValueError`, `OSError`) if it is damaged.
        ImportError: without pyarrow.
    """
    parquet = need("pyarrow.parquet", extra, "reading parquet")
    with (
        path.open("rb") as stream,
        parquet.ParquetFile(
            stream,
            thrift_string_size_limit=_MAX_SCHEMA,
            thrift_container_size_limit=_MAX_SCHEMA // 16,
        ) as file,
    ):
        there = set(file.schema_arrow.names)
        missing = [name for name in columns if name not in there]
        if missing:
            raise ValueError(
                f"{path.name} has no column {missing[0]!r}: it has {sorted(there)[:20]}"
            )
        wanted = [*columns, *sorted(n for n in there if n not in columns and optional(n))]
        index = file.metadata
        if not 0 <= index.num_rows <= _MAX_ROWS:
            raise ValueError(f"{path.name} claims {index.num_rows} rows, more than {_MAX_ROWS}")
        largest = 1
        for column in claims(stream, _MAX_INDEX):
            if column.path[0] in wanted:
                size = max(column.size, 8 * column.values)
                budget.claim(f"{path.name}, column {column.path[0]!r},", size)
                largest = max(largest, size)
        at_once = max(1, min(1024, _BATCH_BYTES // largest))
        for batch in file.iter_batches(at_once, columns=wanted, use_threads=False):
            if batch.nbytes > 4 * _BATCH_BYTES:
                raise ValueError(f"{path.name} unpacks to {batch.nbytes} bytes in {at_once} rows")
            yield batch


def numbers(parts: Sequence[Any], name: str) -> NDArray[Any]:
    """Arrow arrays of numbers, (N,), or of lists that all have K numbers, (N, K).

    Raises:
        ValueError: if they hold anything else.
    """
    return np.concatenate([_numbers(part, name) for part in parts])


def _numbers(part: Any, name: str) -> NDArray[Any]:
    import pyarrow  # type: ignore[import-untyped]

    kinds = pyarrow.types
    if part.null_count:
        raise ValueError(f"column {name!r} has rows without a value")
    n = len(part)
    nested = (kinds.is_list, kinds.is_large_list, kinds.is_fixed_size_list)
    lists = any(kind(part.type) for kind in nested)
    inner = part.flatten() if lists else part
    if not (
        kinds.is_integer(inner.type)
        or kinds.is_floating(inner.type)
        or kinds.is_boolean(inner.type)
    ):
        raise ValueError(f"column {name!r} holds {part.type}: numbers or lists of them are read")
    if inner.null_count:
        raise ValueError(f"column {name!r} has rows without a value")
    values = inner.to_numpy(zero_copy_only=False)
    if not lists:
        return np.asarray(values)
    if kinds.is_fixed_size_list(part.type):
        width = part.type.list_size
    else:
        lengths = np.diff(part.offsets.to_numpy())
        width = int(lengths[0]) if n else 0
        if (lengths != width).any():
            raise ValueError(f"column {name!r} has lists of several lengths")
    if values.size != n * width:
        raise ValueError(f"column {name!r} has lists of several lengths")
    return np.asarray(values.reshape(n, width))


def json_file(path: Path, limit: int) -> Any:
    """What a JSON file says.

    Raises:
        ValueError: if it is missing, larger than `limit` bytes, or no JSON.
    """
    if not path.is_file():
        raise ValueError(f"there is no {path.name} in {path.parent.name!r}")
    if path.stat().st_size > limit:
        raise ValueError(f"{path.name} has {path.stat().st_size} bytes, more than {limit}")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path.name} is no JSON text ({error})") from error
