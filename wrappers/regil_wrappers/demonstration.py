"""One demonstration: what was seen and what was done. In memory and as one HDF5 file.

The file has the layout of `robomimic <https://robomimic.github.io>`_, with one episode. N frames
and T actions (N = T + 1, or N = T), or no actions (T = N then):

=====================================  ==================  =========================================
name                                   shape, dtype        meaning
=====================================  ==================  =========================================
``data`` attribute ``total``           int                 T
``data`` attribute ``env_args``        JSON text           ``env_name`` (Gymnasium id), ``type`` (2:
                                                           robomimic's number for Gym),
                                                           ``env_kwargs``
``data`` attribute                     JSON text           `Demonstration.metadata`, with
``regil_metadata``                                         ``format_version``
``data/demo_0`` attr. ``num_samples``  int                 T
``data/demo_0`` attr.                  JSON text           names in ``obs`` that belong to
``observations``                                           `Demonstration.observations`: null
(none),
                                                           a name (array) or a list of names (dict)
``data/demo_0/actions``                (T, A) float32      executed actions, in the environment's
units ``data/demo_0/successes``              (N,) uint8          1 where the task is solved in that
frame ``data/demo_0/obs/agentview_image``    (T, H, W, 3) uint8  frames 0..T-1, RGB, upright
``data/demo_0/obs/encoder_image``      (T, h, w, 3) uint8  the same moments, larger, for encoders
``data/demo_0/obs/<name>``             (T, ...)            observations of a policy without a camera
``data/demo_0/final_obs/<name>``       as in ``obs``       the frame after the last action, for each
                                       without T           name in ``obs``; only where N = T + 1
=====================================  ==================  =========================================

Everything but the images is optional; arrays are gzip-compressed.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py  # type: ignore[import-untyped]
import numpy as np
from numpy.typing import NDArray

__all__ = ["FORMAT_VERSION", "Demonstration"]

FORMAT_VERSION = 1

_FRAMES = "agentview_image"
_ENCODER_FRAMES = "encoder_image"
_OBSERVATION = "observation"

# What a file may claim before memory is allocated for it. Deflate cannot shrink by more than about
# 1032.
_MAX_BYTES = 4 * 1024**3
_MAX_COMPRESSION = 1100
_MAX_TEXT = 1_000_000

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
    "format_version": FORMAT_VERSION,
}


@dataclass(frozen=True, eq=False, repr=False)
class Demonstration:
    """One demonstration of a task.

    Example:
        >>> import numpy as np
        >>> frames = np.zeros((11, 84, 84, 3), np.uint8)
        >>> demo = Demonstration(frames, actions=np.zeros((10, 4), np.float32))
        >>> len(demo), demo.metadata["image_size"]
        (11, [84, 84])

    Attributes:
        frames: (T + 1, H, W, 3) uint8, RGB, upright: the frame before each action, and the last
            outcome. T frames are taken too; a guide repeats the last action at the end then.
        actions: (T, A) float32, as executed (clipped), in the environment's own units; or None.
        observations: array or dict of arrays with as many rows as frames: what a policy that does
            not see the frame needs; or None.
        encoder_frames: (as many as frames, h, w, 3) uint8: the same moments as larger pictures, for
            encoders; or None.
        successes: (as many as frames,) bool, whether the task is solved in each; False in the
            first; or None.
        metadata: JSON values. Filled in where missing: ``env_id`` (str), ``camera`` (str),
            ``render`` (dict of render settings), ``image_size`` ([H, W], pixels), ``action_repeat``
            (int), ``control_rate`` (Hz, of actions), ``action_low`` and ``action_high`` (lists of A
            numbers), ``seed``, ``seeds_tried`` (int), ``versions`` (dict of packages),
            ``format_version`` (int). Unknown ones are None, or empty.

    Raises:
        ValueError: if a shape, type or length does not fit, or a value is NaN or out of range.
    """

    frames: NDArray[np.uint8]
    actions: NDArray[np.float32] | None = None
    observations: NDArray[Any] | dict[str, NDArray[Any]] | None = None
    encoder_frames: NDArray[np.uint8] | None = None
    successes: NDArray[np.bool_] | None = None
    metadata: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Validate, and fill in the metadata."""

        def put(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        put("frames", _pictures("frames", self.frames))
        n = len(self.frames)
        put("metadata", _metadata(self.metadata, list(self.frames.shape[1:3])))
        if self.actions is not None:
            put("actions", _actions(self.actions, n, self.metadata))
        if isinstance(self.observations, dict):
            for key in self.observations:
                if not isinstance(key, str) or not key or "/" in key or key in _RESERVED:
                    raise ValueError(
                        f"observations have a key {key!r}: use text without '/', and none of "
                        f"{_RESERVED}"
                    )
            checked = {k: _rows(f"observations[{k!r}]", v, n) for k, v in self.observations.items()}
            put("observations", checked)
        elif self.observations is not None:
            put("observations", _rows("observations", self.observations, n))
        if self.encoder_frames is not None:
            put("encoder_frames", _pictures("encoder_frames", self.encoder_frames))
            if len(self.encoder_frames) != n:
                raise ValueError(
                    f"there are {len(self.encoder_frames)} encoder_frames but {n} frames"
                )
        if self.successes is not None:
            successes = np.asarray(self.successes)
            if successes.dtype != np.bool_ or successes.shape != (n,):
                raise ValueError(
                    f"successes are {successes.dtype} {successes.shape}: "
                    f"they must be bool, one for each of {n} frames"
                )
            if successes[0]:
                raise ValueError("successes[0] is True: the task is solved before it begins")
            put("successes", successes)

    def __repr__(self) -> str:
        actions = "no" if self.actions is None else len(self.actions)
        return f"<Demonstration: {len(self)} frames {self.frames.shape[1:]}, {actions} actions>"

    def __len__(self) -> int:
        """The number of frames."""
        return len(self.frames)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write one HDF5 file (layout: see this module).

        It is written under a temporary name beside `path` and renamed: an interrupted save leaves
        whatever was there.

        Args:
            path: the file; an existing one is replaced, missing folders are made.
        """
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        try:
            with h5py.File(temporary, "w") as file:
                self._write(file)
            _sync(temporary)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
        _sync(path.parent)

    def _write(self, file: h5py.File) -> None:
        n = len(self.frames)
        t = n if self.actions is None else len(self.actions)
        data = file.create_group("data")
        data.attrs["total"] = t
        data.attrs["env_args"] = json.dumps(
            {"env_name": self.metadata["env_id"], "type": 2, "env_kwargs": {}}
        )
        data.attrs["regil_metadata"] = json.dumps(self.metadata)
        demo = data.create_group("demo_0")
        demo.attrs["num_samples"] = t
        arrays: dict[str, NDArray[Any]] = {_FRAMES: self.frames}
        if self.encoder_frames is not None:
            arrays[_ENCODER_FRAMES] = self.encoder_frames
        if isinstance(self.observations, dict):
            demo.attrs["observations"] = json.dumps(list(self.observations))
            arrays.update(self.observations)
        elif self.observations is not None:
            demo.attrs["observations"] = json.dumps(_OBSERVATION)
            arrays[_OBSERVATION] = self.observations
        else:
            demo.attrs["observations"] = json.dumps(None)
        for name, array in arrays.items():
            # A chunk is one picture: reading it does not unpack the others.
            chunks = (1, *array.shape[1:]) if array.ndim == 4 else True
            demo.create_dataset(f"obs/{name}", data=array[:t], compression="gzip", chunks=chunks)
            if n > t:
                # h5py cannot compress a scalar.
                options = {"compression": "gzip"} if array.ndim > 1 else {}
                demo.create_dataset(f"final_obs/{name}", data=array[t], **options)
        if self.actions is not None:
            demo.create_dataset("actions", data=self.actions, compression="gzip")
        if self.successes is not None:
            demo.create_dataset(
                "successes", data=self.successes.astype(np.uint8), compression="gzip"
            )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Demonstration:
        """Read a file that `save` wrote. Everything in it is checked, nothing in it is executed.

        Args:
            path: the file.

        Raises:
            FileNotFoundError: if there is none.
            ValueError: if it is no HDF5 file, cut short, not one of ours, or its content is not
                valid.
        """
        path = Path(path)
        if not path.exists():
            raise FileNotFoundError(
                f"there is no demonstration {str(path)!r}: "
                f"record one with 'regil record ENV -o {path}'"
            )
        if path.is_dir():
            raise ValueError(f"demo {str(path)!r} is a folder: name the HDF5 file in it")
        try:
            with _opened(path) as file:
                return cls(**_read(file, path.stat().st_size))
        except PermissionError:
            raise
        except (ValueError, TypeError, KeyError, OSError, RuntimeError, RecursionError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise ValueError(f"demo {str(path)!r}: {reason}") from error


_RESERVED = (_FRAMES, _ENCODER_FRAMES)


def _pictures(name: str, value: Any) -> NDArray[np.uint8]:
    array = np.asarray(value)
    if array.dtype != np.uint8 or array.ndim != 4 or array.shape[-1] != 3 or array.size == 0:
        raise ValueError(
            f"{name} are {array.dtype} {array.shape}: they must be uint8 (frames, height, width, 3)"
        )
    return np.ascontiguousarray(array)


def _rows(name: str, value: Any, n: int) -> NDArray[Any]:
    array = np.ascontiguousarray(value)
    if array.dtype.kind not in "biuf" or array.ndim == 0 or len(array) != n or array.size == 0:
        raise ValueError(
            f"{name} are {array.dtype} {array.shape}: numbers, one row for each of {n} frames"
        )
    if not np.isfinite(array).all():
        row = int(np.argwhere(~np.isfinite(array))[0][0])
        raise ValueError(f"{name} have NaN or infinity in row {row}")
    return array


def _actions(value: Any, n: int, metadata: dict[str, Any]) -> NDArray[np.float32]:
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


def _metadata(given: Any, size: list[int]) -> dict[str, Any]:
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


def _sync(path: Path) -> None:
    """Make a renamed file survive a power cut."""
    if os.name == "nt" and path.is_dir():
        return  # Windows cannot open a folder
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    with path.open("rb") as stream:
        if stream.read(8) != b"\x89HDF\r\n\x1a\n":
            raise ValueError("this is not an HDF5 file: record one with 'regil record'")
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        if "truncated" in str(error):
            raise ValueError("the file is cut short: copy it again, or record another") from error
        raise ValueError(f"the HDF5 file is damaged ({error})") from error
    with file:
        yield file


def _read(file: h5py.File, file_bytes: int) -> dict[str, Any]:
    data = _member(file, "data", h5py.Group)
    if "regil_metadata" not in data.attrs:
        raise ValueError(
            "this HDF5 file is not a ReGIL demonstration (no attribute 'regil_metadata')"
        )
    metadata = _json(data, "regil_metadata")
    demo = _member(data, "demo_0", h5py.Group)
    obs = _member(demo, "obs", h5py.Group)
    final = _member(demo, "final_obs", h5py.Group) if "final_obs" in demo else None

    def joined(name: str) -> NDArray[Any]:
        first = _array(obs, name, file_bytes)
        if final is None:
            return first
        last = _array(final, name, file_bytes)
        if first.ndim == 0 or last.shape != first.shape[1:] or last.dtype != first.dtype:
            raise ValueError(f"final_obs/{name} does not fit obs/{name}")
        return np.concatenate([first, last[None]])

    stored = _json(demo, "observations")
    observations: Any = None
    if isinstance(stored, str):
        observations = joined(stored)
    elif isinstance(stored, list):
        observations = {name: joined(name) for name in stored}
    elif stored is not None:
        raise ValueError("attribute 'observations' must be null, a name or a list of names")
    successes = _array(demo, "successes", file_bytes) if "successes" in demo else None
    return {
        "frames": joined(_FRAMES),
        "actions": _array(demo, "actions", file_bytes) if "actions" in demo else None,
        "observations": observations,
        "encoder_frames": joined(_ENCODER_FRAMES) if _ENCODER_FRAMES in obs else None,
        "successes": None if successes is None else successes.astype(np.bool_),
        "metadata": metadata,
    }


def _member(group: h5py.Group, name: Any, kind: type) -> Any:
    """An object stored in this very file: links that lead elsewhere are not followed."""
    where = f"{group.name.rstrip('/')}/{name}"
    if not isinstance(name, str) or "/" in name:
        raise ValueError(f"{where!r} is no name of a member")
    link = group.get(name, getlink=True)
    if link is None:
        raise ValueError(f"this HDF5 file is not a ReGIL demonstration (no {where!r})")
    if not isinstance(link, h5py.HardLink):
        raise ValueError(f"{where!r} is a link to somewhere else: links are not followed")
    member = group[name]
    if not isinstance(member, kind):
        raise ValueError(f"{where!r} is not a {kind.__name__.lower()}")
    return member


def _array(group: h5py.Group, name: Any, file_bytes: int) -> NDArray[Any]:
    dataset = _member(group, name, h5py.Dataset)
    if dataset.dtype.kind not in "biuf" or dataset.shape is None:
        raise ValueError(f"{dataset.name!r} does not hold numbers")
    if dataset.is_virtual or dataset.external:
        raise ValueError(f"{dataset.name!r} keeps its values in another file: that is not followed")
    if dataset.compression not in (None, "gzip", "lzf"):
        raise ValueError(f"{dataset.name!r} is compressed with {dataset.compression!r}: use gzip")
    claimed = math.prod(dataset.shape) * dataset.dtype.itemsize
    if claimed > _MAX_BYTES or claimed > _MAX_COMPRESSION * file_bytes:
        raise ValueError(f"{dataset.name!r} claims {claimed} bytes, more than this file can hold")
    try:
        return np.asarray(dataset[()])
    except OSError as error:
        raise ValueError(f"{dataset.name!r} cannot be read, the file is damaged") from error


def _json(group: h5py.Group, name: str) -> Any:
    if name not in group.attrs:
        raise ValueError(f"this HDF5 file is not a ReGIL demonstration (no attribute {name!r})")
    text = group.attrs[name]
    if not isinstance(text, str) or len(text) > _MAX_TEXT:
        raise ValueError(f"attribute {name!r} is not a JSON text")
    return json.loads(text)
