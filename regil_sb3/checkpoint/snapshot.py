"""A tree of values, taken apart into JSON and arrays' bytes, and put together again to the bit.

Nothing that is read can run anything: there are dicts, lists, tuples, numbers, text, and arrays and
tensors of numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th

__all__ = ["Ring", "put_together", "take_apart"]

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class Ring:
    """An array whose rows are overwritten one after the other; it reads back as the array.

    Args:
        rows: (n, ...) those filled so far.
        written: rows ever written. The last of them and the one after it may still change.
        size: rows that there are altogether.
    """

    rows: Array
    written: int
    size: int


_KINDS = {np.ndarray: "array", np.generic: "number", th.Tensor: "tensor", Ring: "array"}


def take_apart(tree: Any, keep: Callable[[Array, Ring | None, str], Any], at: str = "") -> Any:
    """What JSON can hold of a tree.

    Args:
        tree: the values.
        keep: is given each array, the ring that it is of, and where in the tree it is; returns a
            JSON value that names it.
        at: where in a larger tree this one is.

    Raises:
        ValueError: something in it is none of the kinds.
    """
    if tree is None or isinstance(tree, bool | int | float | str):
        return tree
    if isinstance(tree, dict):
        return {
            "dict": [
                [take_apart(key, keep), take_apart(value, keep, f"{at}/{key}")]
                for key, value in tree.items()
            ]
        }
    if isinstance(tree, list | tuple):
        parts = [take_apart(value, keep, f"{at}/{i}") for i, value in enumerate(tree)]
        return {"tuple": parts} if isinstance(tree, tuple) else parts
    kind = next((name for of, name in _KINDS.items() if isinstance(tree, of)), None)
    if kind is None:
        raise ValueError(f"{at} is a {type(tree).__name__}, which a checkpoint cannot hold")
    ring = tree if isinstance(tree, Ring) else None
    values = tree.rows if isinstance(tree, Ring) else tree
    array = np.asarray(values.detach().cpu() if isinstance(values, th.Tensor) else values)
    if array.dtype.kind not in "biufc":
        raise ValueError(f"{at} is an array of {array.dtype}, which a checkpoint cannot hold")
    # The layout is kept, because networks compute other last bits from another one
    order = sorted(range(array.ndim), key=lambda axis: -array.strides[axis])
    stored = np.asarray(array.transpose(order), order="C")
    return {kind: [array.dtype.str, list(stored.shape), order, keep(stored, ring, at)]}


def put_together(value: Any, fetch: Callable[[Any, int], bytearray]) -> Any:
    """The tree of which ``take_apart`` made a JSON value.

    Args:
        value: that.
        fetch: is given the name that ``keep`` returned and the number of bytes; returns them.

    Raises:
        ValueError: it is no such value.
    """
    if isinstance(value, list):
        return [put_together(part, fetch) for part in value]
    if not isinstance(value, dict):
        return value
    if len(value) != 1:
        raise ValueError(f"{sorted(value)} is no part of a checkpoint")
    ((kind, content),) = value.items()
    if kind == "dict":
        return {put_together(key, fetch): put_together(part, fetch) for key, part in content}
    if kind == "tuple":
        return tuple(put_together(part, fetch) for part in content)
    if kind not in ("array", "number", "tensor"):
        raise ValueError(f"{kind!r} is no part of a checkpoint")
    name, shape, order, kept = content
    dtype = np.dtype(str(name))
    if dtype.kind not in "biufc" or not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError(f"{name!r} of {shape!r} is no array of numbers")
    stored = np.frombuffer(fetch(kept, math.prod(shape) * dtype.itemsize), dtype).reshape(shape)
    array = stored.transpose(np.argsort(order)) if order else stored
    if kind == "tensor":
        return th.from_numpy(array).clone()
    return array[()] if kind == "number" else array
