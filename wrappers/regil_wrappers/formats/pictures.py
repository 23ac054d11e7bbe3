"""A folder of pictures (PNG or JPEG), one for each frame, in the order of their names.

Numbers in names count as numbers: ``frame2.png`` comes before ``frame10.png``.
"""

from __future__ import annotations

import io
import re
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from regil_wrappers.demonstration import Demonstration
from regil_wrappers.formats.changes import Pictures
from regil_wrappers.limits import MAX_PIXELS, need

__all__ = ["check_pixels", "decoded", "files", "no_bombs", "png", "read", "suffixes", "write"]

suffixes = (".png", ".jpg", ".jpeg")


def read(path: Path, pictures: Pictures) -> dict[str, Any]:
    """Read every picture of a folder; other files, and hidden ones, are left alone.

    Raises:
        ValueError: if there is none, one is damaged, or they differ in size.
    """
    for file in files(path):
        try:
            with file.open("rb") as stream:
                pictures.add(decoded(stream))
        except _DAMAGED as error:
            raise ValueError(f"{file.name}: {error or type(error).__name__}") from error
    return {}


# What Pillow raises on files that are not what they say.
_DAMAGED = (
    OSError,
    ValueError,
    SyntaxError,
    EOFError,
    IndexError,
    KeyError,
    TypeError,
    OverflowError,
    struct.error,
)


def files(path: Path) -> list[Path]:
    """The pictures of a folder, in order."""

    def order(file: Path) -> list[tuple[int, int, str]]:
        parts = re.findall(r"\d+|\D+", file.name.lower())
        return [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in parts]

    found = [f for f in path.iterdir() if f.suffix.lower() in suffixes and f.is_file()]
    return sorted((f for f in found if not f.name.startswith(".")), key=order)


def decoded(file: BinaryIO | bytes) -> NDArray[np.uint8]:
    """One PNG or JPEG as (H, W, 3) uint8 RGB, upright; transparency is dropped.

    Raises:
        ValueError, OSError, SyntaxError, ...: if it is neither, damaged, or claims too many pixels.
    """
    image = need("PIL.Image", "video", "reading pictures")
    ops = need("PIL.ImageOps", "video", "reading pictures")
    # From memory: Pillow reads as many bytes as a PNG's chunk claims, and a file on disk makes room
    # for all of them first
    stream = io.BytesIO(file if isinstance(file, bytes) else _content(file))
    # Pillow reads the header alone here.
    with no_bombs(image), image.open(stream, formats=("PNG", "JPEG")) as picture:
        check_pixels(*picture.size)
        if picture.mode not in ("RGB", "RGBA", "L", "P", "LA"):
            raise ValueError(f"a picture is of mode {picture.mode}: it must be 8-bit RGB or grey")
        upright = picture.convert("RGB")
        ops.exif_transpose(upright, in_place=True)
        return np.asarray(upright)


def _content(file: BinaryIO) -> bytes:
    size = file.seek(0, io.SEEK_END)
    if size > 4 * MAX_PIXELS:
        raise ValueError(
            f"a picture of {size} bytes is none that is read: {4 * MAX_PIXELS} at most"
        )
    file.seek(0)
    return file.read()


@contextmanager
def no_bombs(image: Any) -> Iterator[None]:
    """Make Pillow's own errors and warnings on too many pixels a `ValueError`."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", image.DecompressionBombWarning)
            yield
    except (image.DecompressionBombError, image.DecompressionBombWarning) as error:
        raise ValueError(f"a picture has over {MAX_PIXELS} pixels") from error


def check_pixels(width: int, height: int) -> None:
    """Refuse pictures that claim more than `MAX_PIXELS`.

    Raises:
        ValueError: naming the size.
    """
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise ValueError(f"a picture of {width}x{height} is none, or has over {MAX_PIXELS} pixels")


def png(frames: NDArray[np.uint8]) -> Iterator[bytes]:
    """Each frame as a PNG file."""
    image = need("PIL.Image", "video", "writing pictures")
    for frame in frames:
        stream = io.BytesIO()
        image.fromarray(frame).save(stream, format="PNG")
        yield stream.getvalue()


def write(demo: Demonstration, path: Path) -> None:
    """Write ``000000.png``, ... into a folder; nothing but the frames."""
    path.mkdir(parents=True)
    for i, content in enumerate(png(demo.frames)):
        (path / f"{i:06d}.png").write_bytes(content)
