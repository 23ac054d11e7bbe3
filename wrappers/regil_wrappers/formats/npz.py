"""npz: NumPy's own archive, read without pickle.

``frames``, ``actions``, ``observations`` (or ``observations.KEY`` for each), ``encoder_frames``,
``successes`` and ``metadata`` (a JSON text) as in `Demonstration`. Everything is kept.
"""

from __future__ import annotations

import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from regil_wrappers.demonstration import Demonstration
from regil_wrappers.formats.changes import Pictures
from regil_wrappers.limits import MAX_TEXT, Budget

__all__ = ["array_of", "read", "write"]

_MOST_HEADER = 10_000  # bytes; NumPy refuses longer ones, once it has read them
_PREFIX = "observations."


def read(
    path: Path, pictures: Pictures, camera: str = "frames", actions_key: str = "actions"
) -> dict[str, Any]:
    """Read an archive, its own or one of another program.

    Args:
        path: the file.
        pictures: takes the frames.
        camera: name of the array (N, H, W, 3) uint8.
        actions_key: name of the array (T, A); there may be none.

    Raises:
        ValueError: if a member is missing, no array of numbers, or claims too much.
    """
    budget = Budget(path.stat().st_size)
    with zipfile.ZipFile(path) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist()]
        if len(set(names)) != len(names):
            raise ValueError("the archive holds one name twice")
        if camera not in names:
            raise ValueError(
                f"the archive has no array {camera!r}: choose camera= from {names[:20]}"
            )

        def array(name: str) -> NDArray[Any] | None:
            return array_of(archive, name, budget) if name in names else None

        frames = array(camera)
        assert frames is not None
        if frames.ndim != 4:
            raise ValueError(f"{camera!r} is {frames.dtype} {frames.shape}: no pictures")
        pictures.add_all(frames)
        observations: Any = array("observations")
        several = [name for name in names if name.startswith(_PREFIX)]
        if several:
            observations = {name.removeprefix(_PREFIX): array(name) for name in several}
        text = array("metadata")
        if text is not None and (text.dtype.kind != "U" or text.ndim):
            raise ValueError("'metadata' is no JSON text")
        successes = array("successes")
        return {
            "actions": array(actions_key),
            "observations": observations,
            "encoder_frames": array("encoder_frames"),
            "successes": successes,
            "metadata": {} if text is None else json.loads(str(text)),
        }


def array_of(archive: zipfile.ZipFile, name: str, budget: Budget) -> NDArray[Any]:
    """One member, once its header claims what the archive says it has, and no objects.

    Raises:
        ValueError: if it is none, or damaged; and others of `regil_wrappers.formats.DAMAGED`.
    """
    info = archive.getinfo(f"{name}.npy")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(
            f"{name!r} is packed in a way that is not read: use numpy.savez_compressed"
        )
    with archive.open(info) as file:
        start = file.read(12)
        length = int.from_bytes(start[8:12] if start[6:7] == b"\x02" else start[8:10], "little")
        if length > _MOST_HEADER:  # NumPy would read it all first
            raise ValueError(f"{name!r} has a header of {length} bytes, more than {_MOST_HEADER}")
        file.seek(0)
        version = npy.read_magic(file)
        header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}.get(version)
        if header is None:
            raise ValueError(f"{name!r} has .npy version {version}")
        shape, fortran, dtype = header(file)
        kinds = "U" if name == "metadata" else "biuf"
        if dtype.kind not in kinds or any(n < 0 for n in shape):
            raise ValueError(f"{name!r} is {dtype} {shape}: only numbers are read, no objects")
        claimed = math.prod(shape) * dtype.itemsize
        budget.claim(repr(name), claimed)
        if kinds == "U" and claimed > 4 * MAX_TEXT:
            raise ValueError(f"'metadata' claims {claimed} bytes, more than {4 * MAX_TEXT}")
        if claimed > info.file_size:
            raise ValueError(f"{name!r} claims {claimed} bytes but holds {info.file_size}")
        content = file.read(claimed)
    if len(content) != claimed:
        raise ValueError(f"{name!r} is cut short")
    array = np.frombuffer(content, dtype=dtype)
    return array.reshape(shape, order="F" if fortran else "C").astype(
        dtype.newbyteorder("="), order="C"
    )


def write(demo: Demonstration, path: Path) -> None:
    """Write everything, compressed."""
    arrays: dict[str, Any] = {
        "frames": demo.frames,
        "actions": demo.actions,
        "encoder_frames": demo.encoder_frames,
        "successes": demo.successes,
        "metadata": np.array(json.dumps(demo.metadata)),
    }
    if isinstance(demo.observations, dict):
        arrays |= {_PREFIX + name: value for name, value in demo.observations.items()}
    else:
        arrays["observations"] = demo.observations
    with path.open("wb") as file:  # to a path it would append ".npz"
        np.savez_compressed(file, **{k: v for k, v in arrays.items() if v is not None})
