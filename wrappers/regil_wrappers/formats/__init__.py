"""Other people's demonstrations, in and out.

* ``read`` - a file or folder of any known format -> `Demonstration`
* ``write`` - a `Demonstration` -> a file or folder
* ``resample`` - another frame rate
* ``FORMATS`` - what is known
* ``DAMAGED`` - what readers raise

A format is a name, or is seen in the file. What each keeps, and its options: ``docs/formats.md``.
Files are checked before memory is given to them, and nothing in them is executed. Packages that
only some formats need are extras: ``[video]``, ``[lerobot]``, ``[minari]``.
"""

from __future__ import annotations

import inspect
import os
import shutil
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py  # type: ignore[import-untyped]

from regil_wrappers import hdf5
from regil_wrappers.demonstration import Demonstration
from regil_wrappers.formats import lerobot, minari, npz, pictures, robomimic, video
from regil_wrappers.formats.changes import (
    Flip,
    Pictures,
    ResampledActions,
    Size,
    check_actions,
    check_rate,
    resample,
)
from regil_wrappers.limits import Budget

__all__ = ["DAMAGED", "FORMATS", "Format", "detect", "read", "resample", "write"]

Reader = Callable[..., dict[str, Any]]


@dataclass(frozen=True)
class Format:
    """One format.

    Attributes:
        what: one line.
        read: (path, pictures, options) -> fields of a `Demonstration`.
        write: (demo, path, options).
        keeps: the fields that survive `write`, beside the frames.
        suffixes: of its files; none for a folder.
        lasts: whether the frame after the last action is kept.
        exact: whether the frames come back to the bit.
    """

    what: str
    read: Reader
    write: Callable[..., None]
    keeps: frozenset[str]
    suffixes: tuple[str, ...] = ()
    lasts: bool = True
    exact: bool = True


def _read_own(path: Path, taken: Pictures) -> dict[str, Any]:
    demo = Demonstration.load(path)
    taken.add_all(demo.frames)
    return {
        "actions": demo.actions,
        "observations": demo.observations,
        "encoder_frames": demo.encoder_frames,
        "successes": demo.successes,
        "metadata": demo.metadata,
    }


_ALL = frozenset({"actions", "observations", "encoder_frames", "successes", "metadata"})
_NO_LARGER = _ALL - {"encoder_frames"}
_NOTHING: frozenset[str] = frozenset()

FORMATS: dict[str, Format] = {
    "regil": Format("our HDF5", _read_own, Demonstration.save, _ALL, (".hdf5", ".h5")),
    "robomimic": Format(
        "robomimic's HDF5",
        robomimic.read_robomimic,
        robomimic.write_robomimic,
        _ALL,
    ),
    "libero": Format(
        "LIBERO's HDF5",
        robomimic.read_libero,
        robomimic.write_libero,
        frozenset({"actions", "observations", "metadata"}),
        lasts=False,
    ),
    "minari": Format("a folder of Minari's", minari.read, minari.write, _NO_LARGER),
    "lerobot": Format(
        "a folder of LeRobot's, v2 or v3", lerobot.read, lerobot.write, _NO_LARGER, lasts=False
    ),
    "mp4": Format(
        "a film",
        video.read_mp4,
        video.write_mp4,
        _NOTHING,
        (".mp4", ".mov", ".m4v"),
        exact=False,
    ),
    "gif": Format(
        "an animated gif", video.read_gif, video.write_gif, _NOTHING, (".gif",), exact=False
    ),
    "pictures": Format("a folder of PNG or JPEG pictures", pictures.read, pictures.write, _NOTHING),
    "npz": Format("NumPy's archive", npz.read, npz.write, _ALL, (".npz",)),
}
"""What can be read and written, by name."""

# PyAV's and pyarrow's errors derive from ValueError, OSError and others of these; Pillow's from
# OSError and SyntaxError.
DAMAGED = (
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    OSError,
    EOFError,
    SyntaxError,
    RuntimeError,
    ArithmeticError,
    MemoryError,
    struct.error,
    tokenize.TokenError,
    zlib.error,
    zipfile.BadZipFile,
)
"""What readers raise on files that are not what they say."""


def read(
    path: str | os.PathLike[str],
    format: str | None = None,
    *,
    flip: Flip | None = None,
    crop: Sequence[int] | None = None,
    size: Size | None = None,
    encoder_size: Size | None = None,
    source_fps: float | None = None,
    fps: float | None = None,
    actions: ResampledActions = "refuse",
    held: Sequence[int] = (),
    **options: Any,
) -> Demonstration:
    """Read a demonstration.

    Pictures are flipped, cropped and resized, in this order, as they are read; then the frame rate
    is changed. ``metadata["provenance"]`` records the file and each change.

    Example:
        >>> import numpy as np
        >>> from regil_wrappers import Demonstration, formats
        >>> frames = np.zeros((7, 48, 64, 3), np.uint8)
        >>> formats.write(Demonstration(frames, np.ones((6, 2), np.float32)), "reach.npz")
        ()
        >>> demo = formats.read("reach.npz", size=32, source_fps=30, fps=15, actions="sum")
        >>> demo, demo.actions[0].tolist()
        (<Demonstration: 4 frames (32, 32, 3), 3 actions>, [2.0, 2.0])
        >>> demo.metadata["provenance"][1:3]
        [{'size': [32, 32]}, {'source_fps': 30}]

    Args:
        path: a file or a folder.
        format: a name in `FORMATS`; None looks at the file.
        flip: "rows" (upside down), "columns" (mirrored) or "both": puts right what was stored
            turned. Actions are not turned with it.
        crop: top, left, height, width in pixels, of the flipped picture.
        size: height and width in pixels, or one number for both.
        encoder_size: the same, for a second, larger copy that encoders take.
        source_fps: frames a second of the source, where it does not say or is wrong.
        fps: frames a second to resample to (`resample`).
        actions: what becomes of actions then; "drop" leaves them out at any rate.
        held: dimensions of the action that take "last" then.
        options: of the format: ``episode``, ``camera``, ``observations``, ...

    Raises:
        FileNotFoundError: if there is nothing.
        ValueError: one line: the format is unknown, the file damaged, something missing, too large
            or out of range.
        ImportError: one line that names the extra to install.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no {str(path)!r} to read a demonstration from")
    name = detect(path) if format is None else format
    known = _format(name)
    _check_options(name, known.read, options)
    for rate_name, rate in (("source_fps", source_fps), ("fps", fps)):
        if rate is not None:
            check_rate(rate_name, rate)
    check_actions(actions)
    if fps is None and actions not in ("refuse", "drop"):
        raise ValueError(f"actions={actions!r} says what fps= makes of them: give both")
    taken = Pictures(Budget(), flip, crop, size, encoder_size)
    try:
        fields = known.read(path, taken, **options)
        return _finished(fields, taken, path, name, source_fps, fps, actions, held)
    except PermissionError:
        raise
    except DAMAGED as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        start = "" if reason.startswith("demo ") else f"demo {str(path)!r} ({name}): "
        raise ValueError(start + reason) from error


def _finished(
    fields: dict[str, Any],
    taken: Pictures,
    path: Path,
    name: str,
    source_fps: float | None,
    fps: float | None,
    actions: ResampledActions,
    held: Sequence[int],
) -> Demonstration:
    larger = fields.pop("encoder_frames", None)
    if larger is not None and not taken.unchanged:
        raise ValueError(
            "it has encoder_frames, which flip, crop and size do not reach: convert from the source"
        )
    details = fields.pop("details", {})
    metadata = dict(fields.pop("metadata", {}), image_size=None)
    history = metadata.get("provenance", [])
    if not isinstance(history, list):
        raise ValueError(f"metadata provenance is {history!r:.50}: it must be a list")
    if name != "regil":
        history = [*history, {"read": name, "file": path.name, **details}]
    history = [*history, *taken.provenance]
    if source_fps is not None:
        history = [*history, {"source_fps": source_fps}]
        metadata["control_rate"] = source_fps
        metadata.pop("frame_times", None)
    if actions == "drop" and fields.get("actions") is not None:
        fields["actions"] = None
        history = [*history, {"actions": "drop"}]
    metadata["provenance"] = history
    pictures_taken = taken.arrays()
    if larger is not None:
        pictures_taken["encoder_frames"] = larger
    demo = Demonstration(**pictures_taken, **fields, metadata=metadata)
    return demo if fps is None else resample(demo, fps, actions, held)


def write(
    demo: Demonstration, path: str | os.PathLike[str], format: str | None = None, **options: Any
) -> tuple[str, ...]:
    """Write a demonstration.

    It is written under a temporary name and renamed: an interrupted one leaves nothing.

    Args:
        demo: the demonstration.
        path: a file, which is replaced, or a folder, which must not exist.
        format: a name in `FORMATS`; None goes by the suffix.
        options: of the format.

    Returns:
        what the format could not keep, e.g. ``("actions",)``.

    Raises:
        ValueError: if the format is unknown, or needs what the demonstration lacks.
        FileExistsError: if the folder exists.
        ImportError: one line that names the extra to install.
    """
    path = Path(path)
    if format is None:
        found = [n for n, f in FORMATS.items() if path.suffix.lower() in f.suffixes]
        if not found:
            raise ValueError(f"{str(path)!r} names no format: say format=, one of {list(FORMATS)}")
        format = found[0]
    known = _format(format)
    _check_options(format, known.write, options)
    needs_actions = "actions" in known.keeps and format not in ("regil", "npz")
    if needs_actions and demo.actions is None:
        raise ValueError(
            f"the demonstration has no actions, which {format} needs: "
            "write regil, npz, pictures or a film"
        )
    if path.exists() and (path.is_dir() or not _is_file(format)):
        raise FileExistsError(f"{str(path)!r} exists already: name a new one")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        known.write(demo, temporary, **options)
        os.replace(temporary, path)
    finally:
        if temporary.is_dir():
            shutil.rmtree(temporary)
        else:
            temporary.unlink(missing_ok=True)
    return _lost(demo, format)


def _is_file(name: str) -> bool:
    return bool(FORMATS[name].suffixes) or name in ("robomimic", "libero")


def _lost(demo: Demonstration, name: str) -> tuple[str, ...]:
    known = FORMATS[name]
    fields = ("actions", "observations", "encoder_frames", "successes")
    lost = [f for f in fields if getattr(demo, f) is not None and f not in known.keeps]
    t = len(demo) if demo.actions is None else len(demo.actions)
    if not known.lasts and t < len(demo):
        lost.append("the last frame")
    if name == "minari" and t == len(demo):
        lost.append("the last action")
    if not known.exact:
        lost.append("exact colours")
    return tuple(lost)


def _format(name: str) -> Format:
    if name not in FORMATS:
        raise ValueError(f"format={name!r}: choose one of {list(FORMATS)}")
    return FORMATS[name]


def _check_options(name: str, function: Callable[..., Any], options: dict[str, Any]) -> None:
    taken = list(inspect.signature(function).parameters)[2:]
    for option in options:
        if option not in taken:
            raise ValueError(f"{option}={options[option]!r}: {name} takes {taken or 'no options'}")
    episode = options.get("episode", 0)
    if type(episode) is not int or episode < 0:
        raise ValueError(f"episode={episode!r}: give a number from 0 on")


def detect(path: str | os.PathLike[str]) -> str:
    """The format of a file or folder, by what it holds.

    Returns:
        a name in `FORMATS`.

    Raises:
        ValueError: one line with all of them, if it is none.
    """
    path = Path(path)
    if path.is_dir():
        if (path / "meta" / "info.json").is_file():
            return "lerobot"
        if minari.data_folder(path) is not None:
            return "minari"
        if pictures.files(path):
            return "pictures"
    else:
        with path.open("rb") as file:
            start = file.read(12)
        if start[:8] == hdf5.SIGNATURE:
            return _detect_hdf5(path)
        if start[:4] == b"PK\x03\x04":
            return "npz"
        if start[:4] == b"GIF8":
            return "gif"
        if start[4:8] == b"ftyp":
            return "mp4"
    known = "; ".join(f"{name} ({known.what})" for name, known in FORMATS.items())
    raise ValueError(f"{str(path)!r} is of no format that is known: {known}")


def _detect_hdf5(path: Path) -> str:
    """Which of the layouts with ``data/demo_N`` it has; Minari's file alone is half a dataset."""
    try:
        with hdf5.opened(path) as file:
            if hdf5.has(file, "episode_0"):
                raise ValueError("this is the inside of a Minari dataset: name its folder")
            data = hdf5.member(file, "data", h5py.Group)
            for name in data:
                demo = hdf5.member(data, name, h5py.Group)
                if hdf5.has(hdf5.member(demo, "obs", h5py.Group), robomimic.LIBERO_CAMERA):
                    return "libero"
                break
            return "regil" if "regil_metadata" in data.attrs else "robomimic"
    except (ValueError, OSError, RuntimeError, TypeError, KeyError) as error:
        raise ValueError(f"demo {str(path)!r}: {str(error).splitlines()[0]}") from error
