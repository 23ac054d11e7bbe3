"""What a demonstration may hold: each part is checked, and brought into one form.

* ``check_pictures``, ``check_rows``, ``check_actions`` - arrays
* ``check_metadata`` - JSON values, filled in where missing
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["FORMAT_VERSION", "check_actions", "check_metadata", "check_pictures", "check_rows"]

FORMAT_VERSION = 1

_METADATA_DEFAULTS: dict[str, Any] = {
    "env_id": None,
    "camera": None,
    "render": {},
    "image_size": None,
    "action_repeat": None,
    "control_rate": None,
    "action_low": None,
    "action_high": None,
    "seed": None,
    "seeds_tried": None,
    "versions": {},
    "provenance": [],
    "format_version": FORMAT_VERSION,
}


def check_pictures(name: str, value: Any) -> NDArray[np.uint8]:
    """Pictures, (N, H, W, 3) uint8.

    Args:
        name: what errors call them.
        value: what was given.

    Raises:
        ValueError: if it is of another type or shape.
    """
    array = np.asarray(value)
    if array.dtype != np.uint8 or array.ndim != 4 or array.shape[-1] != 3 or array.size == 0:
        raise ValueError(
            f"{name} are {array.dtype} {array.shape}: they must be uint8 (frames, height, width, 3)"
        )
    return np.ascontiguousarray(array)


def check_rows(name: str, value: Any, n: int) -> NDArray[Any]:
    """Finite numbers, one row for each of n frames.

    Raises:
        ValueError: if it is of another type or length, or not finite.
    """
    array = np.ascontiguousarray(value)
    if array.dtype.kind not in "biuf" or array.ndim == 0 or len(array) != n or array.size == 0:
        raise ValueError(
            f"{name} are {array.dtype} {array.shape}: numbers, one row for each of {n} frames"
        )
    if not np.isfinite(array).all():
        row = int(np.argwhere(~np.isfinite(array))[0][0])
        raise ValueError(f"{name} have NaN or infinity in row {row}")
    return array


def check_actions(value: Any, n: int, metadata: dict[str, Any]) -> NDArray[np.float32]:
    """Actions, (T, A) float32, within the limits that the metadata states.

    Args:
        value: what was given.
        n: the number of frames, T + 1 or T.
        metadata: as `check_metadata` returns it.

    Raises:
        ValueError: if they do not fit.
    """
    array = np.asarray(value)
    if array.dtype.kind != "f" or array.ndim != 2 or array.shape[1] == 0:
        raise ValueError(f"actions are {array.dtype} {array.shape}: they must be float32 (T, A)")
    array = np.ascontiguousarray(array, dtype=np.float32)
    if len(array) not in (n - 1, n) or len(array) == 0:
        raise ValueError(
            f"there are {len(array)} actions for {n} frames: there must be {n - 1} (or {n})"
        )
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        raise ValueError(f"actions[{bad[0][0]}] has NaN or infinity in dimension {bad[0][1]}")
    for key, outside in (("action_low", np.less), ("action_high", np.greater)):
        if metadata[key] is None:
            continue
        with np.errstate(over="ignore"):  # beyond float32 is no limit
            limit = np.asarray(metadata[key], dtype=np.float32)
        if limit.shape != array.shape[1:]:
            raise ValueError(f"{key} has {limit.size} numbers but actions have {array.shape[1]}")
        bad = np.argwhere(outside(array, limit))
        if len(bad):
            i, a = bad[0]
            raise ValueError(
                f"actions[{i}] is {array[i, a]:g} in dimension {a}, beyond {key} {limit[a]:g}: "
                f"store the clipped action that was executed"
            )
    return array


def check_metadata(given: Any, size: list[int]) -> dict[str, Any]:
    """Metadata, filled in where missing.

    Args:
        given: a dict of JSON values.
        size: [H, W] of the frames, in pixels.

    Raises:
        ValueError: if a value is of another type, or does not fit the frames.
    """
    if not isinstance(given, dict):
        raise ValueError(f"metadata is {type(given).__name__}: it must be a dict")
    try:
        metadata: dict[str, Any] = json.loads(
            json.dumps(_METADATA_DEFAULTS | given, allow_nan=False)
        )
    except (TypeError, ValueError) as error:
        raise ValueError(f"metadata must hold JSON values only: {error}") from error
    if metadata["image_size"] is None:
        metadata["image_size"] = size
    if metadata["image_size"] != size:
        raise ValueError(f"metadata image_size is {metadata['image_size']} but frames are {size}")
    version = metadata["format_version"]
    if version != FORMAT_VERSION:
        raise ValueError(
            f"format_version is {version!r}, this program reads {FORMAT_VERSION}: "
            f"update regil-wrappers, or record again"
        )
    wanted: dict[str, tuple[type, ...]] = {
        "env_id": (str,),
        "camera": (str,),
        "render": (dict,),
        "action_repeat": (int,),
        "control_rate": (int, float),
        "seed": (int,),
        "seeds_tried": (int,),
        "versions": (dict,),
        "provenance": (list,),
    }
    for key, types in wanted.items():
        if metadata[key] is not None and type(metadata[key]) not in types:
            names = " or ".join(t.__name__ for t in types)
            raise ValueError(f"metadata {key} is {metadata[key]!r}: it must be {names} or None")
    for key in ("action_low", "action_high"):
        value = metadata[key]
        if value is not None and not (
            isinstance(value, list) and value and all(type(v) in (int, float) for v in value)
        ):
            raise ValueError(f"metadata {key} is {value!r}: it must be a list of numbers or None")
    return metadata
