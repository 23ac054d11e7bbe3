"""Where in the demonstration the agent is: recent frames against a memory of one demonstration.

* ``Alignment`` - the answer for one step
* ``Retriever`` - keeps the recent distances and gives it
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from regil_wrappers.alignment import (
    STEP_PATTERNS,
    StepPattern,
    accumulated_costs,
    best_end,
    nearest,
    squared_distances,
    warping_path,
)
from regil_wrappers.demonstration import Demonstration
from regil_wrappers.encoders import Encoder, check_embedding, embed, fitted, make_encoder

__all__ = ["Alignment", "Retriever"]


@dataclass(frozen=True)
class Alignment:
    """Which segment of the demonstration the recent frames look like. Indices are 0-based frames.

    Attributes:
        start: the demonstration frame that the oldest frame of the window is matched with.
        end: j* of Eq. 2, the demonstration frame that the current frame is matched with.
        cost: D(H+1, j*), summed along the path, in squared units of the embedding; >= 0.
        candidates: the k frames nearest to the current one, ascending.
        q_star: the last of them; end <= q_star.
        window: how many recent frames were aligned: 1 at reset, growing to H + 1.
    """

    start: int
    end: int
    cost: float
    candidates: tuple[int, ...]
    q_star: int
    window: int


class Retriever:
    """Aligns recent frames with one demonstration: candidates, q*, S-DTW (the paper's Section 3.1).

    One new row of distances a step; older rows are kept.

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

    Args:
        demo: the demonstration.
        encoder: a name of `regil_wrappers.encoders.encoder_names()`, or an object with
            ``encode(frames: uint8 (B, H, W, 3)) -> float32 (B, D)``.
        k: how many nearest frames are candidates.
        horizon: H, the frames before the current one that are aligned with it.
        step_pattern: "symmetric" (Eq. 1) or "strap".
        use_encoder_frames: whether memory is ``demo.encoder_frames`` instead of ``demo.frames``.

    Raises:
        ValueError: if the demonstration is shorter than horizon + 1 frames, or an argument is out
            of range.
    """

    def __init__(
        self,
        demo: Demonstration,
        encoder: str | Encoder = "pixels",
        k: int = 5,
        horizon: int = 4,
        step_pattern: StepPattern = "symmetric",
        use_encoder_frames: bool = False,
    ) -> None:
        check_settings(demo, k, horizon, step_pattern)
        frames = demo.encoder_frames if use_encoder_frames else demo.frames
        if frames is None:
            raise ValueError("use_encoder_frames: the demonstration has no encoder_frames")
        encoder = make_encoder(encoder) if isinstance(encoder, str) else encoder
        self.encoder = fitted(encoder, frames)
        self.k = k
        self.horizon = horizon
        self.step_pattern: StepPattern = step_pattern
        self.embeddings = embed(self.encoder, frames)
        self._frame_shape = frames.shape[1:]
        # Equal frames get equal distances to the last bit, whatever order a processor sums in: ties
        # between idle frames must stay ties.
        first: dict[bytes, int] = {}
        self._distinct_of = np.array(
            [first.setdefault(y.tobytes(), len(first)) for y in self.embeddings]
        )
        _, index = np.unique(self._distinct_of, return_index=True)
        self._distinct = np.ascontiguousarray(self.embeddings[index])
        # Rows of distances, newest last; moved back to the top when the buffer is full.
        self._rows = np.empty((64 + horizon, len(frames)))
        self.reset()

    @property
    def picture_size(self) -> tuple[int, int]:
        """(height, width) px of the pictures that `step` takes."""
        return self._frame_shape[0], self._frame_shape[1]

    def reset(self) -> None:
        """Forget the episode: the next frame is its first."""
        self._top = 0
        self._bottom = 0
        self._steps = 0
        self._alignment: Alignment | None = None
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
        if frame.shape != self._frame_shape or frame.dtype != np.uint8:
            raise ValueError(
                f"frame {self._steps} of the episode is {frame.dtype} {frame.shape}: "
                f"the demonstration's are uint8 {self._frame_shape}"
            )
        embedding = self.encoder.encode(frame[None])
        check_embedding(embedding, f"frame {self._steps} of the episode")
        return self.step_embedding(embedding[0])

    def step_embedding(self, embedding: NDArray[np.float32]) -> Alignment:
        """The same for a frame that has been encoded already: (D,) float32, finite."""
        distances = squared_distances(embedding, self._distinct)[self._distinct_of]
        if not np.isfinite(distances.sum()):
            raise ValueError(
                f"frame {self._steps} of the episode has no finite distance to the demonstration"
            )
        candidates = nearest(distances, self.k).tolist()
        self._append(distances)
        self._embedding = embedding
        q_star = candidates[-1]
        self._table = accumulated_costs(
            self._rows[self._top : self._bottom, : q_star + 1], self.step_pattern
        )
        end, cost = best_end(self._table)
        start = warping_path(self._table, end, self.step_pattern)[0][1]
        self._alignment = Alignment(
            start=start,
            end=end,
            cost=cost,
            candidates=tuple(candidates),
            q_star=q_star,
            window=self._bottom - self._top,
        )
        return self._alignment

    def _append(self, distances: NDArray[np.float64]) -> None:
        if self._bottom == len(self._rows):
            kept = self._rows[self._bottom - self.horizon :].copy()
            self._rows[: self.horizon] = kept
            self._top, self._bottom = 0, self.horizon
        elif self._bottom - self._top > self.horizon:
            self._top += 1
        self._rows[self._bottom] = distances
        self._bottom += 1
        self._steps += 1

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
        """(N,) float64: squared distance of the current frame to each of the demonstration.

        Raises:
            ValueError: before the first step of an episode.
        """
        _ = self.alignment
        distances: NDArray[np.float64] = self._rows[self._bottom - 1].copy()
        return distances

    def end_costs(self) -> NDArray[np.float64]:
        """D(H+1, j) / window for every frame j, (N,) float64: the best cost of ending there.

        Unlike `Alignment.cost` it looks beyond q*. Infinite where no path ends.

        Raises:
            ValueError: before the first step of an episode.
        """
        window = self.alignment.window
        table = accumulated_costs(self._rows[self._top : self._bottom], self.step_pattern)
        costs: NDArray[np.float64] = table[-1] / window
        return costs

    def path(self) -> list[tuple[int, int]]:
        """The last step's warping path: (frame of the window, frame of the demonstration), 0-based.

        Raises:
            ValueError: before the first step of an episode.
        """
        end = self.alignment.end
        assert self._table is not None
        return warping_path(self._table, end, self.step_pattern)


def check_settings(
    demo: Demonstration,
    k: int,
    horizon: int,
    step_pattern: str,
    label: str = "the demonstration",
) -> None:
    """Refuse settings that do not fit the demonstration, before any long work.

    Raises:
        ValueError: naming the setting, its value and what would be right.
    """
    for name, value, least in (("k", k, 1), ("horizon", horizon, 0)):
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise ValueError(f"{name}={value!r}: it must be a whole number, at least {least}")
    if step_pattern not in STEP_PATTERNS:
        raise ValueError(f"step_pattern={step_pattern!r}: choose one of {sorted(STEP_PATTERNS)}")
    if len(demo) < horizon + 1:
        raise ValueError(
            f"{label} has {len(demo)} frames, fewer than horizon + 1 = {horizon + 1}: "
            f"choose horizon={len(demo) - 1} or record a longer one"
        )
    if k > len(demo):
        raise ValueError(f"k={k}: {label} has only {len(demo)} frames")
    if step_pattern == "strap" and k < (horizon + 1) // 2 + 1:
        raise ValueError(
            f"k={k}: step_pattern 'strap' with horizon={horizon} needs at least "
            f"k={(horizon + 1) // 2 + 1}, so that a path always exists"
        )
