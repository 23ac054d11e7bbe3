"""Minari's datasets, as its version 0.5 stores them: HDF5, arrow or parquet. Read without Minari.

A dataset is a folder ``NAME/data`` with ``metadata.json``, and ``main_data.hdf5`` or a folder for
each episode. An episode has T + 1 observations and T actions. Pictures are the observation itself
or a key of a dict observation; they are raw, or JPEG (``jpeg_encoding``), which loses detail.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py  # type: ignore[import-untyped]
import numpy as np
from numpy.typing import NDArray

from regil_wrappers import hdf5
from regil_wrappers.demonstration import Demonstration
from regil_wrappers.formats.changes import Pictures
from regil_wrappers.formats.parquet import batches, json_file, numbers
from regil_wrappers.formats.pictures import decoded
from regil_wrappers.limits import MAX_BYTES, MAX_TEXT, Budget, need

__all__ = ["CAMERA", "data_folder", "read", "write"]

CAMERA = "image"
"""Key of the pictures where we write them beside other observations."""

# metadata.json spells out the bounds of every pixel, twice.
_MAX_METADATA = 16 * 1024**2
_HDF5 = "main_data.hdf5"
_MAX_LEAVES = 1000


def data_folder(path: Path) -> Path | None:
    """The folder with ``metadata.json``: `path` itself or its ``data``; None if there is none."""
    for folder in (path / "data", path):
        if (folder / "metadata.json").is_file():
            return folder
    return None


def read(
    path: Path,
    pictures: Pictures,
    episode: int = 0,
    camera: str | None = None,
    observations: list[str] | None = None,
) -> dict[str, Any]:
    """Read one episode.

    Args:
        path: the dataset's folder, or ``data`` in it.
        pictures: takes the frames.
        episode: which.
        camera: key of the pictures in a dict observation, nested ones as "outer/inner"; None where
            the observation is the picture, or only one key holds pictures.
        observations: other keys to keep; None keeps all that are numbers or vectors.

    Raises:
        ValueError: if something is missing, damaged or claims too much.
        ImportError: if it needs pyarrow or Pillow, and they are not there.
    """
    folder = data_folder(path)
    if folder is None:
        raise ValueError("there is no metadata.json: name the folder of one Minari dataset")
    about = json_file(folder / "metadata.json", _MAX_METADATA)
    if not isinstance(about, dict):
        raise ValueError("metadata.json must hold a dict")
    storage = about.get("data_format", "hdf5")
    if storage == "hdf5":
        found = _read_hdf5(folder / _HDF5, pictures, episode, camera, observations)
    elif storage in ("arrow", "parquet"):
        found = _read_arrow(
            folder / str(episode), storage, about, pictures, episode, camera, observations
        )
    else:
        raise ValueError(f"data_format is {storage!r}: hdf5, arrow and parquet are read")
    metadata = about.get("regil_metadata", {})
    if not isinstance(metadata, dict):
        raise ValueError("regil_metadata in metadata.json must be a dict")
    return found | {"metadata": metadata | _limits(about)}


def _limits(about: dict[str, Any]) -> dict[str, Any]:
    """``action_low`` and ``action_high``, where the action space is a Box that has limits."""
    text = about.get("action_space")
    if not isinstance(text, str) or len(text) > MAX_TEXT:
        return {}
    space = json.loads(text)
    if not isinstance(space, dict) or space.get("type") != "Box":
        return {}
    found = {f"action_{name}": space.get(name) for name in ("low", "high")}
    usable = all(
        isinstance(v, list) and v and all(type(x) in (int, float) and math.isfinite(x) for x in v)
        for v in found.values()
    )
    return found if usable else {}


# -- HDF5 ------------------------------------------------------------------------------------------


def _read_hdf5(
    path: Path,
    pictures: Pictures,
    episode: int,
    camera: str | None,
    keys: list[str] | None,
) -> dict[str, Any]:
    if not path.is_file():
        raise ValueError(f"there is no {path.name} in {path.parent.name!r}")
    budget = Budget(path.stat().st_size)
    with hdf5.opened(path) as file:
        if not hdf5.has(file, f"episode_{episode}"):
            raise ValueError(f"there is no episode {episode}: it has {len(file)}")
        group = hdf5.member(file, f"episode_{episode}", h5py.Group)
        leaves = dict(_leaves(group, "observations"))
        camera = _camera(camera, [k for k, (_, dataset) in leaves.items() if _is_pictures(dataset)])
        holder, dataset = leaves[camera]
        name = dataset.name.rpartition("/")[2]
        if dataset.ndim == 4:
            pictures.add_all(hdf5.array(holder, name, budget))
        else:
            for content in hdf5.encoded_pictures(holder, name, Budget()):
                pictures.add(decoded(content))
        if keys is None:
            keys = [
                k
                for k, (_, d) in leaves.items()
                if d.ndim in (1, 2) and d.dtype.kind in "biuf" and k != camera
            ]
        missing = [key for key in keys if key not in leaves]
        if missing:
            raise ValueError(f"there is no observation {missing[0]!r}: it has {list(leaves)}")
        kept = {
            _flat(key): hdf5.array(leaves[key][0], key.rpartition("/")[2], budget) for key in keys
        }
        successes = None
        if hdf5.has(group, "infos"):
            infos = hdf5.member(group, "infos", h5py.Group)
            if hdf5.has(infos, "success"):
                successes = hdf5.array(infos, "success", budget)
        actions = hdf5.array(group, "actions", budget)
    return _fields(pictures, actions, kept, successes, episode, camera)


def _leaves(group: h5py.Group, name: str) -> Iterator[tuple[str, tuple[h5py.Group, h5py.Dataset]]]:
    """Datasets below `group`/`name`, by their path below it; "" for the one that is it itself."""
    waiting = [("", group, name)]
    # A group may hold itself.
    for _ in range(_MAX_LEAVES):
        if not waiting:
            return
        path, holder, name = waiting.pop(0)
        found = hdf5.member(holder, name)
        if isinstance(found, h5py.Dataset):
            yield path, (holder, found)
        else:
            waiting += [(f"{path}/{inner}".lstrip("/"), found, inner) for inner in found]
    raise ValueError(f"an observation has over {_MAX_LEAVES} parts")


def _is_pictures(dataset: h5py.Dataset) -> bool:
    if dataset.dtype == np.uint8 and dataset.ndim == 4:
        return bool(dataset.shape[3] == 3)
    return bool(dataset.ndim == 1 and h5py.check_vlen_dtype(dataset.dtype) == np.uint8)


def _camera(camera: str | None, found: list[str]) -> str:
    if camera is None and len(found) == 1:
        return found[0]
    if camera not in found:
        raise ValueError(
            f"camera={camera!r}: choose one of the observations that hold pictures, {found}"
        )
    return camera


def _flat(key: str) -> str:
    return key.replace("/", ".") or "observation"


def _fields(
    pictures: Pictures,
    actions: NDArray[Any],
    observations: dict[str, NDArray[Any]],
    successes: NDArray[Any] | None,
    episode: int,
    camera: str,
) -> dict[str, Any]:
    fits = successes is not None and successes.shape == (len(pictures),) and successes.dtype == bool
    return {
        "actions": actions,
        "observations": observations or None,
        "successes": successes if fits else None,
        "details": {"episode": episode, "camera": camera},
    }


# -- arrow and parquet -----------------------------------------------------------------------------


def _read_arrow(
    folder: Path,
    storage: str,
    about: dict[str, Any],
    pictures: Pictures,
    episode: int,
    camera: str | None,
    keys: list[str] | None,
) -> dict[str, Any]:
    files = sorted(folder.glob(f"[!.]*.{storage}")) if folder.is_dir() else []
    if len(files) != 1:
        raise ValueError(f"there is no episode {episode}, or it is not in one {storage} file")
    budget = Budget()
    wanted = ("observations", "actions")
    found = list(
        batches(files[0], wanted, budget, "minari", "infos".__eq__)
        if storage == "parquet"
        else _arrow_batches(files[0], wanted, budget)
    )
    leaves: dict[str, list[Any]] = {}
    for batch in found:
        for name, part in _struct_leaves(batch.column("observations")):
            leaves.setdefault(name, []).append(part)
    text = about.get("observation_space")
    if not isinstance(text, str):
        raise ValueError("metadata.json has no observation_space")
    space = json.loads(text)
    shapes = {name: _picture_shape(space, name) for name in leaves}
    camera = _camera(camera, [name for name, shape in shapes.items() if shape is not None])
    shape = shapes[camera]
    for part in leaves[camera]:
        if _is_binary(part):
            for value in part:
                pictures.add(decoded(value.as_py() or b""))
        else:
            flat = numbers([part], camera)
            if shape is None or flat.ndim != 2 or flat.shape[1] != math.prod(shape):
                raise ValueError(f"observation {camera!r} does not have the shape {shape}")
            if flat.dtype != np.uint8:
                raise ValueError(f"observation {camera!r} is {flat.dtype}: pictures are uint8")
            pictures.add_all(flat.reshape(-1, *shape))
    if keys is None:
        keys = [name for name in leaves if shapes[name] is None and not _is_binary(leaves[name][0])]
    missing = [key for key in keys if key not in leaves]
    if missing:
        raise ValueError(f"there is no observation {missing[0]!r}: it has {list(leaves)}")
    kept = {_flat(key): numbers(leaves[key], key) for key in keys}
    # The row of the last observation holds padding in place of an action.
    actions = numbers([batch.column("actions") for batch in found], "actions")[:-1]
    successes = None
    infos = [dict(_struct_leaves(b.column("infos"))) for b in found if "infos" in b.schema.names]
    if infos and all("success" in info for info in infos):
        successes = numbers([info["success"] for info in infos], "success")
    return _fields(pictures, actions, kept, successes, episode, camera)


def _arrow_batches(path: Path, columns: tuple[str, ...], budget: Budget) -> Iterator[Any]:
    arrow = need("pyarrow", "minari", "reading arrow")
    ipc = need("pyarrow.ipc", "minari", "reading arrow")
    budget.claim(path.name, path.stat().st_size)
    content = path.read_bytes()
    if content[:8] != b"ARROW1\0\0":
        raise ValueError(f"{path.name} is not an arrow file")
    # The file is a stream of messages behind 8 bytes, and an index that is not needed.
    stream = arrow.BufferReader(arrow.py_buffer(content).slice(8))
    schema = ipc.read_schema(stream)
    missing = [name for name in columns if name not in schema.names]
    if missing:
        raise ValueError(f"{path.name} has no column {missing[0]!r}")
    while (message := _next_message(ipc, stream)) is not None:
        if message.type != "record batch" or _compressed(bytes(message.metadata)):
            raise ValueError(f"{path.name} is compressed or has dictionaries: plain arrow is read")
        batch = ipc.read_record_batch(message, schema)
        batch.validate(full=True)
        budget.claim(path.name, batch.nbytes)
        yield batch


def _next_message(ipc: Any, stream: Any) -> Any:
    try:
        return ipc.read_message(stream)
    except EOFError:
        return None


def _compressed(message: bytes) -> bool:
    """Whether a record batch says that its buffers are: they would claim any size, unchecked.

    The message is a flatbuffer: Message.header (field 2) is a RecordBatch, whose field 3 is the
    compression.
    """

    def number(code: str, at: int) -> int:
        return int(struct.unpack_from(f"<{code}", message, at)[0])

    def field(table: int, index: int) -> int | None:
        """Where a table's field lies; None if it is not there."""
        slots = table - number("i", table)
        at = 4 + 2 * index
        offset = number("H", slots + at) if at + 2 <= number("H", slots) else 0
        return table + offset if offset else None

    header = field(number("I", 0), 2)
    return header is None or field(header + number("I", header), 3) is not None


def _struct_leaves(column: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    import pyarrow  # type: ignore[import-untyped]

    if not pyarrow.types.is_struct(column.type):
        yield path, column
        return
    for i, part in enumerate(column.flatten()):
        yield from _struct_leaves(part, f"{path}/{column.type.field(i).name}".lstrip("/"))


def _is_binary(part: Any) -> bool:
    import pyarrow

    return bool(pyarrow.types.is_binary(part.type) or pyarrow.types.is_large_binary(part.type))


def _picture_shape(space: Any, name: str) -> tuple[int, ...] | None:
    """Shape of the pictures at that path of a serialised space; None if there are none."""
    for key in name.split("/") if name else []:
        inner = space.get("subspaces") if isinstance(space, dict) else None
        if isinstance(inner, list) and key.isdecimal() and int(key) < len(inner):
            space = inner[int(key)]
        elif isinstance(inner, dict):
            space = inner.get(key)
        else:
            return None
    if not isinstance(space, dict) or space.get("dtype") != "uint8":
        return None
    shape = space.get("shape")
    if not isinstance(shape, list) or len(shape) != 3 or not all(type(n) is int for n in shape):
        return None
    height, width, depth = shape
    fits = depth == 3 and height > 0 and width > 0 and height * width * 3 <= MAX_BYTES
    return (height, width, depth) if fits else None


# -- out -------------------------------------------------------------------------------------------


def write(demo: Demonstration, path: Path) -> None:
    """Write a dataset of one episode, HDF5 storage, raw pictures.

    T + 1 frames are needed: of T frames and T actions the last action is left out.
    """
    assert demo.actions is not None
    data = path / "data"
    data.mkdir(parents=True)
    n = len(demo)
    actions = demo.actions[: n - 1]
    t = len(actions)
    images = _box(demo.frames.shape[1:], "uint8", 0, 255)
    space: dict[str, Any] = images
    with hdf5.created(data / _HDF5, track_order=True) as file:
        group = file.create_group("episode_0")
        group.attrs["id"] = 0
        group.attrs["total_steps"] = t
        if demo.metadata["seed"] is not None:
            group.attrs["seed"] = demo.metadata["seed"]
        if demo.observations is None:
            _put(group, "observations", demo.frames)
        else:
            others = demo.observations
            if not isinstance(others, dict):
                others = {"observation": others}
            if CAMERA in others:
                raise ValueError(f"observations have a key {CAMERA!r}, which the frames take here")
            space = {"type": "Dict", "subspaces": {CAMERA: images}}
            _put(group, f"observations/{CAMERA}", demo.frames)
            for key, values in others.items():
                # gymnasium has no space of single booleans
                values = values.astype(np.int8) if values.dtype == bool else values
                _put(group, f"observations/{key}", values)
                space["subspaces"][key] = _box(values.shape[1:], str(values.dtype), None, None)
        _put(group, "actions", actions)
        rewards = np.zeros(t) if demo.successes is None else demo.successes[1:n].astype(np.float64)
        _put(group, "rewards", rewards)
        end = np.arange(t) == t - 1
        solved = demo.successes is not None and bool(demo.successes[-1])
        _put(group, "terminations", end & solved)
        _put(group, "truncations", end & (not solved))
        if demo.successes is not None:
            _put(group, "infos/success", demo.successes)
    low, high = demo.metadata["action_low"], demo.metadata["action_high"]
    about = {
        "total_episodes": 1,
        "total_steps": t,
        "data_format": "hdf5",
        "jpeg_encoding": False,
        "observation_space": json.dumps(space),
        "action_space": json.dumps(_box(actions.shape[1:], "float32", low, high)),
        "dataset_id": f"regil/{path.name}-v0",
        "minari_version": "0.5.4",
        "dataset_size": round((data / _HDF5).stat().st_size / 1e6, 1),
        "regil_metadata": demo.metadata,
    }
    (data / "metadata.json").write_text(json.dumps(about), encoding="utf-8")


def _put(group: h5py.Group, name: str, values: NDArray[Any]) -> None:
    group.create_dataset(name, data=values, compression="gzip", maxshape=(None, *values.shape[1:]))


def _box(shape: tuple[int, ...], dtype: str, low: Any, high: Any) -> dict[str, Any]:
    """A Box as Minari serialises it; None is no limit."""

    def limit(value: Any, unknown: float) -> Any:
        if isinstance(value, list):
            return value
        if value is None and not dtype.startswith("float"):
            edges = np.iinfo(dtype)
            value = int(edges.min if unknown < 0 else edges.max)
        return np.full(shape, unknown if value is None else value).tolist()

    return {
        "type": "Box",
        "dtype": dtype,
        "shape": list(shape),
        "low": limit(low, -math.inf),
        "high": limit(high, math.inf),
    }
