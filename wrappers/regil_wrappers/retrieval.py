"""Where in a demonstration the agent is: recent frames against a memory of one or several.

* ``Alignment`` - the answer for one step
* ``Retriever`` - keeps the recent distances and gives it
* ``step_together`` - the same for several episodes that go on at once: one call of the encoder
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from regil_wrappers.alignment import (
    STEP_PATTERNS,
    StepPattern,
    accumulated_costs,
    best_end,
    warping_path,
)
from regil_wrappers.demonstration import Demonstration
from regil_wrappers.demonstrations import outlines
from regil_wrappers.encoders import Encoder, check_embedding, make_encoder
from regil_wrappers.latency import Latency
from regil_wrappers.memory import SEARCHES, Memory, Search
from regil_wrappers.window import make_window

__all__ = ["Alignment", "Retriever", "check_settings", "step_together"]


@dataclass(frozen=True)
class Alignment:
    """Which segment of a demonstration the recent frames look like. Indices are 0-based frames.

    Attributes:
        start: the demonstration frame that the oldest frame of the window is matched with.
        end: j* of Eq. 2, the demonstration frame that the current frame is matched with.
        cost: D(H+1, j*), summed along the path, in squared units of the embedding; >= 0.
        candidates: those of the k frames nearest to the current one that are of this demonstration,
            ascending.
        q_star: the last of them, but with step_pattern "strap" at least window // 2, without which
            it might have no path; end <= q_star.
        window: how many recent frames were aligned: 1 at reset, growing to H + 1.
        demonstration: which one of several, 0-based.
    """

    start: int
    end: int
    cost: float
    candidates: tuple[int, ...]
    q_star: int
    window: int
    demonstration: int = 0


class Retriever:
    """Aligns recent frames with a demonstration: candidates, q*, S-DTW (the paper's Section 3.1).

    One new row of distances a step; older rows are kept.

    With several demonstrations the k candidates are the nearest frames of all. The recent frames
    are aligned with each demonstration that has a candidate, up to its own last one; the cheapest
    alignment counts (among equal ones the demonstration of the step before, then the earlier one).

    Example:
        >>> import numpy as np
        >>> from regil_wrappers import Demonstration, Retriever
        >>> frames = np.stack([np.full((32, 32, 3), 20 * i, np.uint8) for i in range(10)])
        >>> retriever = Retriever(Demonstration(frames), k=5, horizon=4)
        >>> alignments = [retriever.step(frame) for frame in frames]
        >>> [alignment.end for alignment in alignments]
        [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]
        >>> retriever.path()
        [(0, 5), (1, 6), (2, 7), (3, 8), (4, 9)]
        >>> backwards = Demonstration(frames[::-1])
        >>> retriever = Retriever([Demonstration(frames), backwards], k=5, horizon=4)
        >>> [retriever.step(frame).demonstration for frame in frames[:4:-1]]
        [0, 1, 1, 1, 1]

    Args:
        demo: the demonstration, or a sequence of several; `Demonstration.load` opens a file.
        encoder: a name of `regil_wrappers.encoders.encoder_names()`, or an object with
            ``encode(frames: uint8 (B, H, W, 3)) -> float32 (B, D)``.
        k: how many nearest frames are candidates.
        horizon: H, the frames before the current one that are aligned with it.
        step_pattern: "symmetric" (Eq. 1) or "strap".
        use_encoder_frames: whether memory is ``demo.encoder_frames`` instead of ``demo.frames``.
        search: how candidates are found: "auto", "exact" or "faiss" (`regil_wrappers.memory`).
        deadline_ms: what a step may take, in milliseconds: the first one that takes longer is
            warned of, all are counted in ``latency.misses``. None: anything.

    Attributes:
        latency: how long steps took (`regil_wrappers.latency.Latency`).
        memory: the embedded demonstrations (`regil_wrappers.memory.Memory`).

    Raises:
        ValueError: if a demonstration is none or shorter than horizon + 1 frames, or an argument is
            out of range.
        ImportError: if Faiss is asked for and not installed.
    """

    def __init__(
        self,
        demo: Demonstration | Sequence[Demonstration],
        encoder: str | Encoder = "pixels",
        k: int = 5,
        horizon: int = 4,
        step_pattern: StepPattern = "symmetric",
        use_encoder_frames: bool = False,
        search: Search = "auto",
        deadline_ms: float | None = None,
    ) -> None:
        demos = [demo] if isinstance(demo, Demonstration) else demo
        lengths = [outline.shape[0] for outline in outlines(demos)]
        labels = None if len(demos) == 1 else [f"demonstration {i}" for i in range(len(demos))]
        check_settings(lengths, k, horizon, step_pattern, labels, search)
        self.latency = Latency(deadline_ms)
        encoder = make_encoder(encoder) if isinstance(encoder, str) else encoder
        self.k = k
        self.horizon = horizon
        self.step_pattern: StepPattern = step_pattern
        self.memory = Memory(demos, encoder, use_encoder_frames, search)
        self.encoder = self.memory.encoder
        self._begin()

    def _begin(self) -> None:
        self._window = make_window(self.memory, self.horizon)
        self.reset()

    def another(self) -> Retriever:
        """One more with the same settings, for an episode that goes on besides: memory is shared.

        Its ``latency`` begins at 0.
        """
        twin = copy.copy(self)
        twin.latency = Latency(self.latency.deadline_ms)
        twin._begin()
        return twin

    @property
    def embeddings(self) -> NDArray[np.float32]:
        """(N, D) float32: of the demonstration's frames; of several, one behind the other."""
        return self.memory.embeddings

    @property
    def picture_size(self) -> tuple[int, int]:
        """(height, width) px of the pictures that `step` takes."""
        return self.memory.frame_shape[0], self.memory.frame_shape[1]

    def reset(self) -> None:
        """Forget the episode: the next frame is its first."""
        self._window.clear()
        self._steps = 0
        self._alignment: Alignment | None = None
        self._near: dict[int, list[int]] = {}
        self._table: NDArray[np.float64] | None = None

    @property
    def alignment(self) -> Alignment:
        """The last step's alignment.

        Raises:
            ValueError: before the first step of an episode.
        """
        if self._alignment is None:
            raise ValueError(
                "there is no alignment before the first frame: call reset() of the environment"
            )
        return self._alignment

    def step(self, frame: NDArray[np.uint8]) -> Alignment:
        """Take the next frame of the episode and align the window that ends with it.

        Args:
            frame: (H, W, 3) uint8 RGB, of the size of the memory's frames.

        Raises:
            ValueError: if the frame has another shape or type, or its embedding is not finite.
        """
        self._check(frame)
        begun = perf_counter()
        embedding = self.encoder.encode(frame[None])
        check_embedding(embedding, f"frame {self._steps} of the episode")
        return self.step_embedding(embedding[0], encode_s=perf_counter() - begun)

    def _check(self, frame: NDArray[np.uint8]) -> None:
        if frame.shape != self.memory.frame_shape or frame.dtype != np.uint8:
            raise ValueError(
                f"frame {self._steps} of the episode is {frame.dtype} {frame.shape}: "
                f"the demonstration's are uint8 {self.memory.frame_shape}"
            )

    def step_embedding(
        self,
        embedding: NDArray[np.float32],
        distances: NDArray[np.float64] | None = None,
        encode_s: float = 0.0,
    ) -> Alignment:
        """The same for a frame that has been encoded already.

        Args:
            embedding: (D,) float32, finite.
            distances: (N,) float64, if they are known (``memory.distances(embedding)``).
            encode_s: how long encoding and distances took, in seconds, for ``latency``.
        """
        begun = perf_counter()
        embedding = embedding.copy()  # the encoder may use its array again
        frames = self._window.take(embedding, self.k, distances)
        if frames is None:
            raise ValueError(
                f"frame {self._steps} of the episode has no finite distance to the demonstration"
            )
        self._near = self.memory.demonstrations_of(frames)
        self._steps += 1
        self._embedding = embedding
        found = perf_counter()
        self._alignment = self._aligned()
        self.latency.add(encode_s, found - begun, perf_counter() - found)
        return self._alignment

    def _aligned(self) -> Alignment:
        window = len(self._window)
        before = None if self._alignment is None else self._alignment.demonstration
        best: tuple[float, bool] | None = None
        for demo, candidates in self._near.items():
            q_star = candidates[-1]
            if self.step_pattern == "strap":  # its paths need so many columns
                q_star = max(q_star, window // 2)
            table = accumulated_costs(self._window.costs(demo, q_star + 1), self.step_pattern)
            end, cost = best_end(table)
            rank = (cost, demo != before)
            if best is None or rank < best:
                best = rank
                chosen = demo, end, cost, q_star
                self._table = table
        demo, end, cost, q_star = chosen
        assert self._table is not None
        start = warping_path(self._table, end, self.step_pattern)[0][1]
        return Alignment(start, end, cost, tuple(self._near[demo]), q_star, window, demo)

    @property
    def embedding(self) -> NDArray[np.float32]:
        """(D,) float32: the current frame's.

        Raises:
            ValueError: before the first step of an episode.
        """
        _ = self.alignment
        return self._embedding

    @property
    def distances(self) -> NDArray[np.float64]:
        """(N,) float64: squared distance of the current frame to each in memory.

        Raises:
            ValueError: before the first step of an episode, and where not all were looked at.
        """
        _ = self.alignment
        distances: NDArray[np.float64] = self._window.last().copy()
        return distances

    @property
    def nearest(self) -> int:
        """The frame nearest to the current one, 0 to N - 1; among equal ones the later.

        Raises:
            ValueError: before the first step of an episode.
        """
        _ = self.alignment
        return self._window.nearest()

    @property
    def near(self) -> tuple[int, ...]:
        """The demonstrations that have a candidate, ascending: the recent frames were aligned with.

        Raises:
            ValueError: before the first step of an episode.
        """
        _ = self.alignment
        return tuple(self._near)

    def end_costs(self, demonstration: int | None = None) -> NDArray[np.float64]:
        """D(H+1, j) / window for every frame j of a demonstration, (N_d,) float64.

        It is the best cost of ending there; unlike `Alignment.cost` it looks beyond q*. Infinite
        where no path ends.

        Args:
            demonstration: which one, of `near`; None: the aligned one.

        Raises:
            ValueError: before the first step of an episode.
        """
        window = self.alignment.window
        demo = self.alignment.demonstration if demonstration is None else demonstration
        costs = self._window.costs(demo, len(self.memory.parts[demo]))
        table = accumulated_costs(costs, self.step_pattern)
        ends: NDArray[np.float64] = table[-1] / window
        return ends

    def path(self) -> list[tuple[int, int]]:
        """The last step's warping path: (frame of the window, frame of the demonstration), 0-based.

        Raises:
            ValueError: before the first step of an episode.
        """
        end = self.alignment.end
        assert self._table is not None
        return warping_path(self._table, end, self.step_pattern)


def step_together(
    retrievers: Sequence[Retriever], frames: Sequence[NDArray[np.uint8]], latency: Latency
) -> None:
    """Step several retrievers that share one memory, with one call of their encoder.

    Distances and alignments are to the bit what each would find from the same embedding.

    Args:
        retrievers: `Retriever.another` of one, and itself.
        frames: the next frame of each one's episode, (H, W, 3) uint8.
        latency: takes the times of the whole.

    Raises:
        ValueError: as for `Retriever.step`.
    """
    if not retrievers:
        return
    for retriever, frame in zip(retrievers, frames, strict=True):
        retriever._check(frame)
    first = retrievers[0]
    begun = perf_counter()
    embeddings = first.encoder.encode(np.stack(frames))
    for retriever, i in zip(retrievers, range(len(embeddings)), strict=True):
        check_embedding(embeddings[i : i + 1], f"frame {retriever._steps} of an episode")
    encoded = perf_counter()
    distances = first.memory.distances(embeddings) if first.memory.exact else [None] * len(frames)
    searched = perf_counter()
    search = alignment = 0.0
    for retriever, embedding, row in zip(retrievers, embeddings, distances, strict=True):
        retriever.step_embedding(embedding, row)
        _, part, rest = retriever.latency.last
        search, alignment = search + part, alignment + rest
    latency.add(encoded - begun, searched - encoded + search, alignment)


def check_settings(
    lengths: Sequence[int],
    k: int,
    horizon: int,
    step_pattern: str,
    labels: Sequence[str] | None = None,
    search: str = "auto",
) -> None:
    """Refuse settings that do not fit the demonstrations, before any long work.

    Args:
        lengths: frames of each demonstration.
        k: as for `Retriever`.
        horizon: as for `Retriever`.
        step_pattern: as for `Retriever`.
        labels: what messages call each demonstration.
        search: as for `Retriever`.

    Raises:
        ValueError: naming the setting, its value and what would be right.
    """
    labels = ["the demonstration"] if labels is None else labels
    for name, value, least in (("k", k, 1), ("horizon", horizon, 0)):
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise ValueError(f"{name}={value!r}: it must be a whole number, at least {least}")
    for name, choice, choices in (
        ("step_pattern", step_pattern, sorted(STEP_PATTERNS)),
        ("search", search, list(SEARCHES)),
    ):
        if choice not in choices:
            raise ValueError(f"{name}={choice!r}: choose one of {choices}")
    if not lengths:
        raise ValueError("there is no demonstration: give at least one")
    for length, label in zip(lengths, labels, strict=True):
        if length < horizon + 1:
            raise ValueError(
                f"{label} has {length} frames, fewer than horizon + 1 = {horizon + 1}: "
                f"choose horizon={length - 1} or record a longer one"
            )
    if k > sum(lengths):
        what = f"{labels[0]} has" if len(lengths) == 1 else f"{len(lengths)} demonstrations have"
        raise ValueError(f"k={k}: {what} only {sum(lengths)} frames")
    if step_pattern == "strap" and k < (horizon + 1) // 2 + 1:
        raise ValueError(
            f"k={k}: step_pattern 'strap' with horizon={horizon} needs at least "
            f"k={(horizon + 1) // 2 + 1}, so that a path always exists"
        )
