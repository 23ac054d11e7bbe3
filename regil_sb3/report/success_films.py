"""A few pictures of each episode of a success buffer, small enough to be kept with a run.

* ``SuccessFilms`` - what is kept
* ``save_films``, ``load_films`` - as one file
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from regil_wrappers.formats.npz import array_of
from regil_wrappers.limits import Budget

from regil_sb3.files import replacing
from regil_sb3.success_buffer import SuccessBuffer

__all__ = ["SuccessFilms", "load_films", "save_films"]

Film = npt.NDArray[np.uint8]

_EPISODES = 24
_PICTURES = 16  # of each


@dataclass(frozen=True)
class SuccessFilms:
    """Some episodes of a success buffer, the demonstration first.

    Attributes:
        lengths: (E,) steps of every episode that the buffer holds.
        shown: which of them have a film.
        films: (pictures, H, W, 3) uint8 of each of these; evenly picked from its first picture to
            the one before its last action. None where observations are no pictures.
    """

    lengths: list[int]
    shown: list[int]
    films: list[Film]


def save_films(buffer: SuccessBuffer, path: Path) -> None:
    """Keep pictures of some episodes, evenly picked from the oldest to the newest."""
    episodes = buffer.films()
    picked = _evenly(len(episodes), _EPISODES)
    films = {}
    for i in picked:
        film = episodes[i][1]
        if film is not None:
            films[f"film/{i}"] = film[_evenly(len(film), _PICTURES)]
    lengths = np.array([steps for steps, _ in episodes])
    with replacing(path) as file:
        np.savez_compressed(file, lengths=lengths, **films)


def _evenly(n: int, most: int) -> npt.NDArray[np.int_]:
    """At most so many of n, the first and the last among them."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(int))


def load_films(path: Path) -> SuccessFilms:
    """What `save_films` kept.

    Raises:
        ValueError: if it is no such file; and others of `regil_wrappers.formats.DAMAGED`.
    """
    if not zipfile.is_zipfile(path):
        raise ValueError("it is no .npz file")
    budget = Budget(path.stat().st_size)
    with zipfile.ZipFile(path) as archive:
        lengths = [int(n) for n in array_of(archive, "lengths", budget)]
        names = [name.removesuffix(".npy") for name in archive.namelist()]
        shown = sorted(int(name.removeprefix("film/")) for name in names if name != "lengths")
        films = [array_of(archive, f"film/{i}", budget) for i in shown]
    if any(f.dtype != np.uint8 or f.ndim != 4 or f.shape[3] != 3 or not f.size for f in films):
        raise ValueError("a film is not uint8 (pictures, H, W, 3)")
    if any(not 0 <= i < len(lengths) for i in shown):
        raise ValueError("it has a film of an episode that is not there")
    return SuccessFilms(lengths, shown, films)
