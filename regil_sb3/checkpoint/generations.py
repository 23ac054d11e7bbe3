"""Generations of a checkpoint on disk: the newest is whole, or the one before it is there.

A folder holds ``000001``, ``000002`` ... and ``blocks``. A generation is written beside the others,
waited for, and renamed in one step. Large arrays are cut into blocks, files named by the SHA-256 of
their content and shared between generations: what has not changed is not written again. It is read
again, though, every few saves, and written anew from memory where the disk no longer has it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from regil_sb3 import __version__
from regil_sb3.checkpoint.snapshot import Array, Ring, put_together, take_apart
from regil_sb3.files import sync_folder, write_durably

__all__ = ["Generations"]

VERSION = 1
BLOCK = 4 << 20  # bytes, at most
SMALL = 64 << 10  # bytes: smaller arrays of a generation are in one file together
TRUSTED = 4  # saves, at most, that may reuse a block before it is read again
_DAMAGE = (
    ValueError,
    OSError,
    LookupError,
    TypeError,
    AttributeError,
    RecursionError,
    OverflowError,
    SyntaxError,  # of NumPy, from a damaged name of a type
)


class OtherVersionError(ValueError):
    """A generation is whole, and in a format that is not known here."""


class Generations:
    """Saves trees of values (`regil_sb3.checkpoint.snapshot`), and loads the newest that is whole.

    Args:
        folder: made when the first is saved.
        keep: how many generations stay, the newest included.
        max_bytes: what all may take on disk; the oldest go, but never the newest. None: anything.

    Raises:
        ValueError: an argument is out of range.
    """

    def __init__(self, folder: Path, keep: int = 2, max_bytes: int | None = None) -> None:
        if keep < 1 or (max_bytes is not None and max_bytes < 1):
            raise ValueError(f"keep={keep}, max_bytes={max_bytes}: both must be at least 1")
        self.folder, self.keep, self.max_bytes = folder, keep, max_bytes
        self._blocks = folder / "blocks"
        # blocks that this process has written or read, and how many saves have relied on it since
        self._sound: dict[str, int] = {}
        self._there: dict[str, int] = {}  # bytes of the blocks that the disk had before a save
        self.written_by = __version__  # of what was loaded
        self._rings: dict[str, tuple[int, list[list[Any]]]] = {}

    @property
    def numbers(self) -> list[int]:
        """Of the generations that there are, in the order in which they were saved."""
        if not self.folder.is_dir():
            return []
        return sorted(int(p.name) for p in self.folder.iterdir() if p.name.isdecimal())

    # -- saving ----------------------------------------------------------------------------------

    def save(self, tree: Any) -> Path:
        """Save the next generation.

        Returns:
            its folder.

        Raises:
            OSError: it could not be written; the others are as they were.
            ValueError: something in it cannot be held.
        """
        try:
            target = self._save(tree)
        except OSError:
            with contextlib.suppress(OSError):  # room, where the disk is full
                self._remove_unneeded(self.numbers)
            raise
        try:
            self._prune()
        except OSError as error:
            warnings.warn(
                f"{target} is saved, but older ones could not be removed ({error})", stacklevel=2
            )
        return target

    def _save(self, tree: Any) -> Path:
        self._blocks.mkdir(parents=True, exist_ok=True)
        self._there = {file.name: file.stat().st_size for file in os.scandir(self._blocks)}
        new = self.folder / ".new"
        shutil.rmtree(new, ignore_errors=True)
        new.mkdir()
        small = bytearray()
        rings: dict[str, tuple[int, list[list[Any]]]] = {}

        def keep(array: Array, ring: Ring | None, at: str) -> Any:
            if array.nbytes < SMALL:
                small.extend(array.tobytes())
                return [len(small) - array.nbytes, len(small)]
            known = self._unchanged(ring, self._rings.get(at), array)
            blocks = [
                self._keep_block(part, known.get(i)) for i, part in enumerate(_parts(array, ring))
            ]
            if ring is not None:
                rings[at] = (ring.written, blocks)
            return {"blocks": blocks}

        content = take_apart(tree, keep)
        sync_folder(self._blocks)
        values = {
            "version": VERSION,
            "regil": __version__,
            "small": _sha256(memoryview(small)),
            "tree": content,
        }
        body = json.dumps(values, separators=(",", ":")).encode()
        write_durably(new / "small.bin", memoryview(small))
        signed = _sha256(memoryview(body)).encode() + b"\n" + body
        write_durably(new / "state.json", memoryview(signed))
        sync_folder(new)
        taken = [int(p.stem) for p in self.folder.iterdir() if p.stem.isdecimal()]
        target = self.folder / f"{max(taken, default=0) + 1:06}"
        os.rename(new, target)
        sync_folder(self.folder)
        self._rings = rings
        return target

    def _keep_block(self, part: memoryview, known: list[Any] | None) -> list[Any]:
        """Its name and length; written where the disk does not have it, or no longer as it was."""
        name = known[0] if known else _sha256(part)
        if name in self._sound and self._there.get(name) == len(part):
            self._sound[name] += 1
            if self._sound[name] < TRUSTED:
                return [name, len(part)]
            try:
                self._block(name, len(part))
                return [name, len(part)]
            except (OSError, ValueError) as error:
                warnings.warn(f"{self._blocks / name} is written anew ({error})", stacklevel=2)
        name = _sha256(part)
        beside = self._blocks / ".new"
        write_durably(beside, part)
        os.rename(beside, self._blocks / name)
        self._there[name] = len(part)
        self._sound[name] = int(name[:4], 16) % TRUSTED  # not all are read at the same save
        return [name, len(part)]

    def _unchanged(
        self, ring: Ring | None, before: tuple[int, list[list[Any]]] | None, array: Array
    ) -> dict[int, list[Any]]:
        """Blocks of a ring that no row was written to since the last save, by their place."""
        if ring is None or before is None or not 0 <= ring.written - before[0] < ring.size - 2:
            return {}
        per_block = _rows(array)
        changed = {row % ring.size // per_block for row in range(before[0] - 1, ring.written + 2)}
        whole = len(array) // per_block
        return {i: b for i, b in enumerate(before[1][:whole]) if i not in changed}

    # -- loading ---------------------------------------------------------------------------------

    def load(self) -> Any:
        """The newest generation that is whole; None where none was ever saved.

        Newer ones that are damaged are warned of by name, and set aside as ``<number>.damaged``.

        Raises:
            ValueError: there are some, and none is whole; or another version wrote the newest.
            MemoryError: it would not fit into memory.
        """
        for number in reversed(self.numbers):
            folder = self.folder / f"{number:06}"
            try:
                return self._load(folder)
            except OtherVersionError:
                raise
            except _DAMAGE as error:
                warnings.warn(f"{folder} is damaged ({error}): passed over", stacklevel=2)
                if not isinstance(error, OSError) or isinstance(error, FileNotFoundError):
                    with contextlib.suppress(OSError):  # a folder that is read-only
                        os.rename(folder, folder.with_suffix(".damaged"))
        if self.numbers or any(self.folder.glob("*.damaged")):
            raise ValueError(
                f"no checkpoint in {self.folder} is whole: remove that folder to begin anew"
            )
        return None

    def _load(self, folder: Path) -> Any:
        values = _state(folder)
        if values["version"] != VERSION:
            raise OtherVersionError(
                f"{folder} was written by regil-sb3 {values.get('regil', 'of another version')} in "
                f"format {values['version']}, and regil-sb3 {__version__} reads format {VERSION}: "
                f"go on with that version, or remove {self.folder} to begin anew"
            )
        self.written_by = str(values.get("regil", "0.1.0"))
        small = (folder / "small.bin").read_bytes()
        if _sha256(memoryview(small)) != values["small"]:
            raise ValueError("small.bin is not what was saved")
        blocks = list(_blocks_of(values["tree"]))
        for name, length in blocks:  # before any memory is taken for them
            self._path_of(name, length)
        needed = sum(length for _, length in blocks)
        available = psutil.virtual_memory().available
        if needed > available:
            raise MemoryError(
                f"{folder} needs {needed / 1e9:.1f} GB, but {available / 1e9:.1f} GB are available"
            )

        taken = 0

        def fetch(kept: Any, n_bytes: int) -> bytearray:
            nonlocal taken
            if isinstance(kept, list):
                start, stop = kept
                found = bytearray(small[start:stop])
                length = len(found)
                taken += length
                if taken > len(small):
                    raise ValueError("small.bin is used twice")
            else:
                length = sum(int(length) for _, length in kept["blocks"])
            if length != n_bytes:
                raise ValueError(f"an array of {n_bytes} bytes has {length}")
            if isinstance(kept, dict):
                found, at = bytearray(n_bytes), 0
                for name, length in kept["blocks"]:
                    found[at : at + length] = self._block(name, length)
                    at += length
            return found

        return put_together(values["tree"], fetch)

    def _path_of(self, name: str, length: int) -> Path:
        path = self._blocks / name
        if path.parent != self._blocks or path.stat().st_size != length:
            raise ValueError(f"block {name} is not {length} bytes long")
        return path

    def _block(self, name: str, length: int) -> bytes:
        with self._path_of(name, length).open("rb") as file:
            if hasattr(os, "posix_fadvise"):  # what the disk has, not what memory has of it
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
            content = file.read()
        if _sha256(memoryview(content)) != name:
            raise ValueError(f"block {name} is not what was saved")
        self._sound[name] = 0
        return content

    # -- pruning ---------------------------------------------------------------------------------

    def _prune(self) -> None:
        numbers = self.numbers
        used = {n: self._files_of(self.folder / f"{n:06}") for n in numbers}
        kept = numbers[-self.keep :]
        while (
            self.max_bytes is not None
            and len(kept) > 1
            and sum({k: v for n in kept for k, v in used[n].items()}.values()) > self.max_bytes
        ):
            kept = kept[1:]
        for number in set(numbers) - set(kept):
            old = self.folder / ".old"
            shutil.rmtree(old, ignore_errors=True)
            os.rename(self.folder / f"{number:06}", old)
            shutil.rmtree(old)
        self._remove_unneeded(kept)

    def _remove_unneeded(self, kept: list[int]) -> None:
        """Blocks that none of these generations mentions."""
        used = [self._files_of(self.folder / f"{n:06}") for n in kept]
        if not all(used):  # one cannot be read, now at least: it may need any of them
            return
        needed = {name for files in used for name in files}
        for path in self._blocks.iterdir():
            if path.name not in needed:
                path.unlink()
                self._sound.pop(path.name, None)

    def _files_of(self, folder: Path) -> dict[str, int]:
        """Bytes of all that a generation needs, by name; empty where that cannot be read."""
        try:
            sizes = {name: length for name, length in _blocks_of(_state(folder)["tree"])}
            return sizes | {f"{folder.name}/{p.name}": p.stat().st_size for p in folder.iterdir()}
        except _DAMAGE:
            return {}


def _sha256(content: memoryview) -> str:
    return hashlib.sha256(content).hexdigest()


def _state(folder: Path) -> dict[str, Any]:
    """What a generation's ``state.json`` says, checked."""
    signature, _, body = (folder / "state.json").read_bytes().partition(b"\n")
    if _sha256(memoryview(body)).encode() != signature:
        raise ValueError("state.json is not what was saved")
    values: dict[str, Any] = json.loads(body)
    return values


def _blocks_of(value: Any) -> Iterator[tuple[str, int]]:
    """Names and lengths of the blocks that a JSON value mentions."""
    if isinstance(value, dict):
        for key, part in value.items():
            if key == "blocks":
                yield from ((str(name), int(length)) for name, length in part)
            else:
                yield from _blocks_of(part)
    elif isinstance(value, list):
        for part in value:
            yield from _blocks_of(part)


def _rows(array: Array) -> int:
    """Whole rows in a block of a ring."""
    return max(1, BLOCK // max(1, array.nbytes // len(array)))


def _parts(array: Array, ring: Ring | None) -> Iterator[memoryview]:
    whole = array.reshape(-1).view(np.uint8).data
    size = BLOCK if ring is None else _rows(array) * (array.nbytes // len(array))
    for start in range(0, len(whole), size):
        yield whole[start : start + size]
