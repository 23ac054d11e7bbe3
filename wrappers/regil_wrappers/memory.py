"""The frames of one or several demonstrations, embedded and searched.

* ``Memory`` - embeddings, and which of their frames are nearest to a new one
* ``Search`` - the ways to find them

Frames of several demonstrations are numbered through, one demonstration behind the other.
"""

from __future__ import annotations

import hashlib
import math
import warnings
from collections.abc import Iterator, Sequence
from functools import cached_property
from importlib.util import find_spec
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from regil_wrappers.alignment import squared_distances
from regil_wrappers.demonstration import Demonstration
from regil_wrappers.demonstrations import outlines
from regil_wrappers.encoders import Encoder, embed, fitted
from regil_wrappers.limits import need

__all__ = ["SEARCHES", "Memory", "Search"]

Search = Literal["auto", "exact", "faiss"]
SEARCHES = ("auto", "exact", "faiss")

EXACT_FRAMES = 20_000
"""Up to so many frames "auto" searches exactly."""
_PROBED = 16  # cells that a search looks into, of sqrt(frames)
_TRAINED = 64  # frames that a cell's centre is found from


class Memory:
    """Embeddings of demonstrations' frames.

    Pictures are read one demonstration after the other, once, and twice to fit whitening.

    Args:
        demos: the demonstrations.
        encoder: turns their frames into embeddings, one at a time; whitening is fitted on the
            frames of all.
        use_encoder_frames: whether memory is ``encoder_frames`` instead of ``frames``.
        search: "exact" compares with every frame. "faiss" looks into the 16 of sqrt(frames) cells
            of a `Faiss <https://faiss.ai>`_ inverted file whose centres are nearest, and may miss a
            neighbour. "auto" is "faiss" for several demonstrations of more than 20,000 frames
            together.

    Attributes:
        encoder: as given, or its whitening fitted.
        embeddings: (N, D) float32, of all frames, not to be written to.
        parts: of each demonstration, (N_d, D) float32, views of the same.
        starts: (demonstrations + 1,) int: the number of each one's first frame, and N.
        frame_shape: (H, W, 3) of the pictures.
        exact: whether every frame is looked at.

    Raises:
        ValueError: if the demonstrations' frames do not fit each other.
        ImportError: if Faiss is asked for and not installed.
    """

    def __init__(
        self,
        demos: Sequence[Demonstration],
        encoder: Encoder,
        use_encoder_frames: bool = False,
        search: Search = "auto",
    ) -> None:
        shapes = []
        for i, outline in enumerate(outlines(demos)):
            shape = outline.encoder_shape if use_encoder_frames else outline.shape
            which = "the demonstration" if len(demos) == 1 else f"demonstration {i}"
            if shape is None:
                raise ValueError(f"use_encoder_frames: {which} has no encoder_frames")
            shapes.append(shape)
            if shape[1:] != shapes[0][1:]:
                raise ValueError(
                    f"{which} has frames {shape[1:]} but the first one {shapes[0][1:]}: "
                    "give demonstrations of one size"
                )
        self.frame_shape = shapes[0][1:]
        self.starts = np.concatenate([[0], np.cumsum([shape[0] for shape in shapes])])

        def pictures() -> Iterator[NDArray[np.uint8]]:  # of one demonstration at a time
            for demo in demos:
                yield cast(
                    "NDArray[np.uint8]", demo.encoder_frames if use_encoder_frames else demo.frames
                )

        self.encoder = fitted(encoder, pictures())
        for i, frames in enumerate(pictures()):
            part = embed(self.encoder, frames)
            if i == 0:  # one alone is not copied
                size = (self.starts[-1], part.shape[1])
                self.embeddings = part if len(demos) == 1 else np.empty(size, np.float32)
            if len(demos) > 1:
                self.embeddings[self.starts[i] : self.starts[i + 1]] = part
        self.embeddings.flags.writeable = False
        self.parts = [
            self.embeddings[a:b] for a, b in zip(self.starts, self.starts[1:], strict=False)
        ]
        # Equal frames get equal distances to the last bit, whatever order a processor sums in: ties
        # between idle frames must stay ties.
        first: dict[bytes, int] = {}
        self._distinct_of = np.array(
            [first.setdefault(_digest(y), len(first)) for y in self.embeddings]
        )
        if len(first) == len(self.embeddings):
            self._distinct = np.ascontiguousarray(self.embeddings)
        else:
            _, index = np.unique(self._distinct_of, return_index=True)
            self._distinct = np.ascontiguousarray(self.embeddings[index])
        if search == "auto":
            large = len(demos) > 1 and len(self.embeddings) > EXACT_FRAMES
            search = "faiss" if large and find_spec("faiss") is not None else "exact"
            if large and search == "exact":
                warnings.warn(
                    f"{len(self.embeddings)} frames of {len(demos)} demonstrations are compared "
                    "with one by one: pip install 'regil-wrappers[faiss]' makes that faster, "
                    "search='exact' silent",
                    stacklevel=2,
                )
        self.exact = search == "exact"
        self._index = None if self.exact else _inverted_file(self._distinct)

    def __len__(self) -> int:
        """The number of frames."""
        return len(self.embeddings)

    def distances(self, x: NDArray[np.float32]) -> NDArray[np.float64]:
        """Squared distances of embeddings to every frame: (D,) to (N,), or (B, D) to (B, N)."""
        distances: NDArray[np.float64] = squared_distances(x, self._distinct)[
            ..., self._distinct_of
        ]
        return distances

    def distances_within(self, x: NDArray[np.float32], demo: int) -> NDArray[np.float64]:
        """The same to the frames of one demonstration, (N_d,)."""
        numbers, inverse = self._numbers[demo]
        return squared_distances(x, self._distinct[numbers])[inverse]

    @cached_property
    def _numbers(self) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
        """Which of the distinct frames each demonstration consists of."""
        parts = np.split(self._distinct_of, self.starts[1:-1])
        numbers = [np.unique(part, return_inverse=True) for part in parts]
        return [(which, inverse.reshape(-1)) for which, inverse in numbers]

    def nearest(
        self, x: NDArray[np.float32], k: int
    ) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """The k nearest frames as far as Faiss finds them, ascending, and their distances.

        Among equal ones the later.

        Args:
            x: (D,) float32.
            k: how many; fewer may be found.
        """
        assert self._index is not None
        found = self._index.search(x[None], k)[1][0]
        found = found[found >= 0]
        apart = squared_distances(x, self._distinct[found])
        order, starts = self._frames_of
        frames = [order[starts[i] : starts[i + 1]][-k:] for i in found]
        distances = np.repeat(apart, [len(f) for f in frames])
        joined = np.concatenate(frames)
        latest = np.lexsort((-joined, distances))[:k]
        ascending = latest[np.argsort(joined[latest])]
        return joined[ascending], distances[ascending]

    @cached_property
    def _frames_of(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Frames in the order of their distinct numbers, and where each number's begin."""
        order = np.argsort(self._distinct_of, kind="stable")
        counts = np.bincount(self._distinct_of)
        return order, np.concatenate([[0], np.cumsum(counts)])

    def demonstrations_of(self, frames: NDArray[np.intp]) -> dict[int, list[int]]:
        """Ascending frames by the demonstration they belong to, numbered within it."""
        if len(self.parts) == 1:
            return {0: frames.tolist()}
        by: dict[int, list[int]] = {}
        of = np.searchsorted(self.starts, frames, side="right") - 1
        for demo, frame in zip(of.tolist(), (frames - self.starts[of]).tolist(), strict=True):
            by.setdefault(demo, []).append(frame)
        return by


def _digest(row: NDArray[np.float32]) -> bytes:
    return hashlib.blake2b(row.tobytes(), digest_size=16).digest()


def _inverted_file(vectors: NDArray[np.float32]) -> Any:
    faiss = need("faiss", "faiss", "search='faiss'")
    cells = max(1, min(math.isqrt(len(vectors)), len(vectors) // 39))  # Faiss wants 39 for each
    quantizer = faiss.IndexFlatL2(vectors.shape[1])
    index = faiss.IndexIVFFlat(quantizer, vectors.shape[1], cells)
    index.cp.max_points_per_centroid = _TRAINED
    index.cp.niter = 10
    index.train(vectors)
    index.add(vectors)
    index.nprobe = _PROBED
    return index
