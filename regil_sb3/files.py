"""Files are replaced at once, and never left half written."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedWriter
from pathlib import Path

__all__ = ["replacing", "sync_folder", "write_durably"]


@contextmanager
def replacing(path: Path) -> Iterator[BufferedWriter]:
    """Write beside the old file, then replace it in one step: a failed write loses nothing.

    Several processes, on several machines, may write the same file: the last one's is kept.
    """
    temporary = path.with_name(f".{path.name}.{platform.node()}.{os.getpid()}")
    try:
        with temporary.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_durably(path: Path, content: memoryview) -> None:
    """Write a whole file and wait until the disk has it.

    Args:
        path: of a file that nobody reads yet.
        content: bytes.

    Raises:
        OSError: it cannot be written, or reads back as something else.
    """
    file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
    try:
        rest = content
        while len(rest):
            written = os.write(file, rest)
            if not written:
                raise OSError(f"{path}: nothing was written of {len(rest)} bytes")
            rest = rest[written:]
        os.fsync(file)
    finally:
        os.close(file)
    if path.read_bytes() != content:
        raise OSError(f"{path} reads back otherwise than it was written: is the disk sound?")


def sync_folder(path: Path) -> None:
    """Wait until the disk has the names in a folder."""
    folder = os.open(path, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
