"""One demonstration: what was seen and what was done. In memory and as one HDF5 file.

The file has the layout of `robomimic <https://robomimic.github.io>`_, with one episode. N frames
and T actions (N = T + 1, or N = T), or no actions (T = N then). In ``data``:

==============================  ==================  ================================================
attribute ``total``             int                 T
attribute ``env_args``          JSON text           ``env_name`` (Gymnasium id), ``type`` (2:
                                                    robomimic's number for Gym), ``env_kwargs``
attribute ``regil_metadata``    JSON text           `Demonstration.metadata`, with
                                                    ``format_version``
==============================  ==================  ================================================

and in ``data/demo_0``:

==============================  ==================  ================================================
attribute ``num_samples``       int                 T
attribute ``observations``      JSON text           names in ``obs`` that belong to
                                                    `Demonstration.observations`: null (none), a
                                                    name (array) or a list of names (dict)
``actions``                     (T, A) float32      executed actions, in the environment's units
``successes``                   (N,) uint8          1 where the task is solved in that frame
``obs/agentview_image``         (T, H, W, 3) uint8  frames 0..T-1, RGB, upright
``obs/encoder_image``           (T, h, w, 3) uint8  the same moments, larger, for encoders
``obs/<name>``                  (T, ...)            observations of a policy without a camera
``final_obs/<name>``            as in ``obs``       the frame after the last action, for each name
                                without T           in ``obs``; only where N = T + 1
==============================  ==================  ================================================

Everything but the images is optional; arrays are gzip-compressed. Other layouts are read and
written by `regil_wrappers.formats`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py  # type: ignore[import-untyped]
import numpy as np
from numpy.typing import NDArray

from regil_wrappers import hdf5
from regil_wrappers.content import (
    FORMAT_VERSION,
    check_actions,
    check_metadata,
    check_pictures,
    check_rows,
)
from regil_wrappers.limits import Budget

__all__ = ["FORMAT_VERSION", "Demonstration", "Outline"]

_FRAMES = "agentview_image"
_ENCODER_FRAMES = "encoder_image"
_OBSERVATION = "observation"


@dataclass(frozen=True, eq=False)
class Outline:
    """What a demonstration is without its pictures and observations.

    Attributes:
        shape: (N, H, W, 3), of the frames.
        encoder_shape: (N, h, w, 3), of the larger pictures; or None.
        actions: (T, A) float32; or None.
        metadata: as of `Demonstration`.
    """

    shape: tuple[int, ...]
    encoder_shape: tuple[int, ...] | None
    actions: NDArray[np.float32] | None
    metadata: dict[str, Any]


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
            ``provenance`` (list of what was done to it since it was recorded, oldest first),
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

        put("frames", check_pictures("frames", self.frames))
        n = len(self.frames)
        put("metadata", check_metadata(self.metadata, list(self.frames.shape[1:3])))
        if self.actions is not None:
            put("actions", check_actions(self.actions, n, self.metadata))
        if isinstance(self.observations, dict):
            for key in self.observations:
                if not isinstance(key, str) or not key or "/" in key or key in _RESERVED:
                    raise ValueError(
                        f"observations have a key {key!r}: use text without '/', and none of "
                        f"{_RESERVED}"
                    )
            put(
                "observations",
                {k: check_rows(f"observations[{k!r}]", v, n) for k, v in self.observations.items()},
            )
        elif self.observations is not None:
            put("observations", check_rows("observations", self.observations, n))
        if self.encoder_frames is not None:
            put("encoder_frames", check_pictures("encoder_frames", self.encoder_frames))
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
            with hdf5.created(temporary) as file:
                self._write(file)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
        _sync_folder(path.parent)

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
        with _opened(path) as (file, budget):
            return cls(**_read(file, budget))

    @property
    def outline(self) -> Outline:
        """What is known of it without its pictures."""
        larger = self.encoder_frames
        return Outline(
            self.frames.shape, None if larger is None else larger.shape, self.actions, self.metadata
        )

    @classmethod
    def load_outline(cls, path: str | os.PathLike[str]) -> Outline:
        """Read all of a file that `save` wrote but its pictures and observations.

        What is read is checked as `load` does.

        Raises:
            FileNotFoundError: if there is none.
            ValueError: as for `load`.
        """
        with _opened(path) as (file, budget):
            return _read_outline(file, budget)


_RESERVED = (_FRAMES, _ENCODER_FRAMES)


def _sync_folder(path: Path) -> None:
    """Make a renamed file survive a power cut."""
    if os.name == "nt":
        return  # Windows cannot open a folder
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def _opened(path: str | os.PathLike[str]) -> Iterator[tuple[h5py.File, Budget]]:
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(
            f"there is no demonstration {str(path)!r}: record one with 'regil record ENV -o {path}'"
        )
    if path.is_dir():
        raise ValueError(f"demo {str(path)!r} is a folder: name the HDF5 file in it")
    try:
        with hdf5.opened(path) as file:
            yield file, Budget(path.stat().st_size)
    except PermissionError:
        raise
    except (ValueError, TypeError, KeyError, OSError, RuntimeError, RecursionError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"demo {str(path)!r}: {reason}") from error


def _groups(file: h5py.File) -> tuple[Any, h5py.Group, h5py.Group, h5py.Group | None]:
    """Metadata, the demonstration, its observations and its last ones."""
    data = hdf5.member(file, "data", h5py.Group) if hdf5.has(file, "data") else file
    if "regil_metadata" not in data.attrs:
        raise ValueError(
            "this HDF5 file is not a ReGIL demonstration (no attribute 'regil_metadata' of 'data'):"
            " 'regil convert' makes one from other formats"
        )
    metadata = hdf5.json_attribute(data, "regil_metadata")
    demo = hdf5.member(data, "demo_0", h5py.Group)
    obs = hdf5.member(demo, "obs", h5py.Group)
    final = hdf5.member(demo, "final_obs", h5py.Group) if hdf5.has(demo, "final_obs") else None
    return metadata, demo, obs, final


def _read_outline(file: h5py.File, budget: Budget) -> Outline:
    metadata, demo, obs, final = _groups(file)

    def shape_of(name: str) -> tuple[int, ...]:
        shape = hdf5.shape(obs, name, budget)
        if len(shape) != 4:
            raise ValueError(f"{name} are of shape {shape}: they must be pictures")
        return (shape[0] + (final is not None), *shape[1:])

    shape = shape_of(_FRAMES)
    metadata = check_metadata(metadata, list(shape[1:3]))
    actions = hdf5.array(demo, "actions", budget) if hdf5.has(demo, "actions") else None
    return Outline(
        shape,
        shape_of(_ENCODER_FRAMES) if hdf5.has(obs, _ENCODER_FRAMES) else None,
        None if actions is None else check_actions(actions, shape[0], metadata),
        metadata,
    )


def _read(file: h5py.File, budget: Budget) -> dict[str, Any]:
    metadata, demo, obs, final = _groups(file)

    def joined(name: str) -> NDArray[Any]:
        first = hdf5.array(obs, name, budget)
        if final is None:
            return first
        last = hdf5.array(final, name, budget)
        if first.ndim == 0 or last.shape != first.shape[1:] or last.dtype != first.dtype:
            raise ValueError(f"final_obs/{name} does not fit obs/{name}")
        return np.concatenate([first, last[None]])

    stored = hdf5.json_attribute(demo, "observations")
    observations: Any = None
    if isinstance(stored, str):
        observations = joined(stored)
    elif isinstance(stored, list):
        if len({str(name) for name in stored}) != len(stored):
            raise ValueError("attribute 'observations' names one thing twice")
        observations = {name: joined(name) for name in stored}
    elif stored is not None:
        raise ValueError("attribute 'observations' must be null, a name or a list of names")
    successes = hdf5.array(demo, "successes", budget) if hdf5.has(demo, "successes") else None
    return {
        "frames": joined(_FRAMES),
        "actions": hdf5.array(demo, "actions", budget) if hdf5.has(demo, "actions") else None,
        "observations": observations,
        "encoder_frames": joined(_ENCODER_FRAMES) if hdf5.has(obs, _ENCODER_FRAMES) else None,
        "successes": None if successes is None else successes.astype(np.bool_),
        "metadata": metadata,
    }
