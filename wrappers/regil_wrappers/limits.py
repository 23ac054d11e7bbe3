"""What a file may claim before memory is given to it, and packages that only some formats need.

* ``MAX_BYTES``, ``MAX_PIXELS``, ``MAX_TEXT`` - the stated limits
* ``Budget`` - adds up what one file claims and refuses before anything is allocated
* ``need`` - imports an optional package, or says in one line which extra brings it
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

__all__ = ["MAX_BYTES", "MAX_PIXELS", "MAX_TEXT", "Budget", "available_bytes", "need"]

MAX_BYTES = 4 * 1024**3
"""Bytes of all arrays of one demonstration together."""
MAX_PIXELS = 4096 * 4096
"""Pixels of one picture."""
MAX_TEXT = 1_000_000
"""Bytes of a JSON text."""

# Deflate cannot shrink by more than about 1032.
_MAX_COMPRESSION = 1100


def available_bytes() -> int | None:
    """Memory that can be had without swapping, in bytes; None where the system does not say."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    sizes = dict(line.split(":", 1) for line in lines)
    return int(sizes["MemAvailable"].split()[0]) * 1024 if "MemAvailable" in sizes else None


class Budget:
    """Adds up what one file claims to hold.

    Args:
        file_bytes: the file's size, if what it holds is stored raw or deflated, so that it cannot
            be more than 1100 times as large; None for pictures and videos, which may be.
    """

    def __init__(self, file_bytes: int | None = None) -> None:
        self._most = None if file_bytes is None else _MAX_COMPRESSION * file_bytes
        self._claimed = 0
        available = available_bytes()
        # Half: pictures are there twice while they are joined.
        self._limit = MAX_BYTES if available is None else min(MAX_BYTES, available // 2)

    def claim(self, what: str, size: int) -> None:
        """Take `size` bytes for `what`.

        Raises:
            ValueError: if the file cannot hold so much, or it is beyond the limit.
        """
        if size < 0 or (self._most is not None and size > self._most):
            raise ValueError(f"{what} claims {size} bytes, more than this file can hold")
        self._claimed += size
        if self._claimed > self._limit:
            raise ValueError(
                f"{what} claims {size} bytes, in all {self._claimed}: more than the "
                f"{self._limit} bytes that may be read here (4 GiB, or half of the free memory)"
            )


def need(module: str, extra: str, purpose: str) -> Any:
    """Import an optional package.

    Args:
        module: its import name.
        extra: the extra of regil-wrappers that brings it.
        purpose: what needs it, for the error.

    Raises:
        ImportError: one line that names the extra.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(
            f"{purpose} needs {module.partition('.')[0]} ({error}): "
            f"pip install 'regil-wrappers[{extra}]'"
        ) from error
