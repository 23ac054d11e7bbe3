"""One demonstration or many, from files, folders or memory.

* ``Demonstrations`` - what ``demo=`` takes
* ``demonstrations`` - a sequence of what it names
* ``outlines`` - what is known of each without reading its pictures
* ``labels_of`` - what messages call each of them
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TypeAlias, overload

from regil_wrappers.demonstration import Demonstration, Outline

__all__ = ["Demonstrations", "as_given", "demonstrations", "labels_of", "outlines"]

Demonstrations: TypeAlias = (
    "str | os.PathLike[str] | Demonstration | Sequence[str | os.PathLike[str] | Demonstration]"
)
"""A file, a folder of them, a `Demonstration`, or a list of files or `Demonstration` objects."""

_SUFFIXES = (".hdf5", ".h5")


class _Files(Sequence[Demonstration]):
    """Demonstrations that are read when they are asked for, each time: only the first is kept."""

    def __init__(self, given: Sequence[str | Demonstration]) -> None:
        self._given = given

    def __len__(self) -> int:
        return len(self._given)

    @overload
    def __getitem__(self, index: int) -> Demonstration: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Demonstration]: ...
    def __getitem__(self, index: int | slice) -> Demonstration | Sequence[Demonstration]:
        if isinstance(index, slice):
            return _Files(self._given[index])
        one = self._given[index]
        if isinstance(one, Demonstration):
            return one
        return self._first if index == 0 else Demonstration.load(one)

    @cached_property
    def _first(self) -> Demonstration:
        one = self._given[0]
        return one if isinstance(one, Demonstration) else Demonstration.load(one)

    @cached_property
    def outlines(self) -> list[Outline]:
        rest = [
            one.outline if isinstance(one, Demonstration) else Demonstration.load_outline(one)
            for one in self._given[1:]
        ]
        return [self._first.outline, *rest]


def outlines(demos: Sequence[Demonstration]) -> list[Outline]:
    """What is known of each without its pictures: of files only the first is read whole.

    Raises:
        ValueError: if they are not demonstrations.
    """
    if isinstance(demos, _Files):
        return demos.outlines
    several = isinstance(demos, Sequence) and not isinstance(demos, str)
    for demo in demos if several else [demos]:
        if not isinstance(demo, Demonstration):
            raise ValueError(
                f"demo={demo!r}: give a Demonstration, or a list of several; "
                "Demonstration.load opens a file"
            )
    return [demo.outline for demo in demos]


def as_given(demo: Demonstrations) -> str | Demonstration | list[str | Demonstration]:
    """The same with paths as text, so that a specification can hold them.

    Raises:
        ValueError: if it is none of what ``demo=`` takes.
    """
    if isinstance(demo, Demonstration):
        return demo
    if isinstance(demo, (str, os.PathLike)):
        return os.fspath(demo)
    if not isinstance(demo, Sequence) or not demo:
        raise ValueError(
            f"demo={demo!r}: give a file, a folder of .hdf5 files, a Demonstration, or a list of "
            "files or Demonstrations"
        )
    return [one if isinstance(one, Demonstration) else os.fspath(one) for one in demo]


def demonstrations(
    given: str | Demonstration | list[str | Demonstration],
) -> Sequence[Demonstration]:
    """What `as_given` named, in order; of a folder, the .hdf5 and .h5 files in it by name, but
    for hidden ones (".a.hdf5").

    Files are read when they are asked for, each time: only the first is kept.

    Raises:
        ValueError: if a folder holds no such file.
    """
    return _Files(_listed(given))


def labels_of(given: str | Demonstration | list[str | Demonstration]) -> list[str]:
    """What messages call each demonstration: its file, where it has one."""
    listed = _listed(given)
    if len(listed) == 1 and isinstance(listed[0], Demonstration):
        return ["the demonstration"]
    return [
        f"demo {one!r}" if isinstance(one, str) else f"demonstration {i}"
        for i, one in enumerate(listed)
    ]


def _listed(given: str | Demonstration | list[str | Demonstration]) -> list[str | Demonstration]:
    if isinstance(given, list):
        return given
    if isinstance(given, str) and Path(given).is_dir():
        found = (f for f in Path(given).iterdir() if f.suffix in _SUFFIXES)
        files = sorted(str(f) for f in found if not f.name.startswith("."))
        if not files:
            raise ValueError(f"demo {given!r} is a folder without .hdf5 or .h5 files")
        return list(files)
    return [given]
