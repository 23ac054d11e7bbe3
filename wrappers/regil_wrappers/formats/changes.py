"""What may be done to a demonstration on its way in: turned, cropped, resized, resampled.

Nothing here happens by itself, and all of it is written down in ``metadata["provenance"]``.

* ``Pictures`` - takes pictures one by one as a file gives them, each changed at once, so that a
  long film of large pictures never lies in memory whole
* ``resample`` - another frame rate
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from regil_wrappers.demonstration import Demonstration
from regil_wrappers.limits import Budget

__all__ = [
    "FLIPS",
    "Flip",
    "Pictures",
    "ResampledActions",
    "Size",
    "check_actions",
    "check_rate",
    "resample",
]

Flip = Literal["rows", "columns", "both"]
Size = int | Sequence[int]
ResampledActions = Literal["refuse", "drop", "sum", "mean", "last"]

FLIPS: dict[str, Any] = {
    "rows": np.s_[::-1],
    "columns": np.s_[:, ::-1],
    "both": np.s_[::-1, ::-1],
}
RESAMPLED_ACTIONS = ("refuse", "drop", "sum", "mean", "last")


class Pictures:
    """Collects a demonstration's pictures: flipped, then cropped, then resized.

    Args:
        budget: what memory the results are counted against.
        flip: "rows" (upside down), "columns" (mirrored), "both" (turned by 180 degrees); None.
        crop: top, left, height, width in pixels of the flipped picture; None keeps all.
        size: height and width in pixels, or one number for both; None keeps it. Area averaging
            where it shrinks, linear where it grows.
        encoder_size: the same for a second, larger copy for encoders; None makes none.

    Raises:
        ValueError: if an argument is none of these; in `add`, if a picture does not fit.
    """

    def __init__(
        self,
        budget: Budget,
        flip: Flip | None = None,
        crop: Sequence[int] | None = None,
        size: Size | None = None,
        encoder_size: Size | None = None,
    ) -> None:
        if flip is not None and flip not in FLIPS:
            raise ValueError(f"flip={flip!r}: choose one of {list(FLIPS)}")
        if crop is not None and not (
            isinstance(crop, (list, tuple))
            and len(crop) == 4
            and all(type(v) is int for v in crop)
            and min(crop[:2]) >= 0
            and min(crop[2:]) >= 1
        ):
            raise ValueError(f"crop={crop!r}: give top, left, height, width in pixels")
        self._budget = budget
        self._flip = flip
        self._crop = None if crop is None else list(crop)
        self._size = _pair("size", size)
        self._encoder_size = _pair("encoder_size", encoder_size)
        self._frames: list[NDArray[np.uint8]] = []
        self._encoder_frames: list[NDArray[np.uint8]] = []
        self._source: tuple[int, ...] | None = None

    @property
    def unchanged(self) -> bool:
        """Whether pictures come out as they went in, once."""
        return not self.provenance

    @property
    def provenance(self) -> list[dict[str, Any]]:
        """What is done to each picture, in this order."""
        done = {
            "flip": self._flip,
            "crop": self._crop,
            "size": self._size,
            "encoder_size": self._encoder_size,
        }
        return [{name: value} for name, value in done.items() if value is not None]

    def add(self, picture: NDArray[np.uint8]) -> None:
        """Take the next picture, (H, W, 3) uint8 RGB, of the size of those before."""
        if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
            raise ValueError(
                f"a picture is {picture.dtype} {picture.shape}: it must be uint8 (H, W, 3)"
            )
        if self._source is None:
            self._source = picture.shape
        if picture.shape != self._source:
            raise ValueError(
                f"picture {len(self._frames)} has {picture.shape[0]}x{picture.shape[1]} pixels "
                f"but the first has {self._source[0]}x{self._source[1]}"
            )
        if self._flip is not None:
            picture = picture[FLIPS[self._flip]]
        if self._crop is not None:
            top, left, height, width = self._crop
            if top + height > picture.shape[0] or left + width > picture.shape[1]:
                raise ValueError(
                    f"crop={self._crop} reaches beyond pictures of "
                    f"{picture.shape[0]}x{picture.shape[1]}"
                )
            picture = picture[top : top + height, left : left + width]
        self._keep(self._frames, picture, self._size)
        if self._encoder_size is not None:
            self._keep(self._encoder_frames, picture, self._encoder_size)

    def add_all(self, pictures: Iterable[NDArray[np.uint8]]) -> None:
        """Take several, one after the other."""
        for picture in pictures:
            self.add(picture)

    def _keep(
        self,
        kept: list[NDArray[np.uint8]],
        picture: NDArray[np.uint8],
        size: list[int] | None,
    ) -> None:
        height, width = picture.shape[:2] if size is None else size
        self._budget.claim(f"picture {len(kept)}", height * width * 3)
        if (height, width) != picture.shape[:2]:
            smaller = height <= picture.shape[0] and width <= picture.shape[1]
            method = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
            picture = np.asarray(
                cv2.resize(np.ascontiguousarray(picture), (width, height), interpolation=method),
                dtype=np.uint8,
            )
        kept.append(picture.copy())

    def __len__(self) -> int:
        """How many there are."""
        return len(self._frames)

    def arrays(self) -> dict[str, Any]:
        """``frames`` and ``encoder_frames`` of a `Demonstration`.

        Raises:
            ValueError: if there is no picture.
        """
        if not self._frames:
            raise ValueError("there is no picture in it")
        larger = np.stack(self._encoder_frames) if self._encoder_frames else None
        return {"frames": np.stack(self._frames), "encoder_frames": larger}


def _pair(name: str, value: Size | None) -> list[int] | None:
    pair = [value, value] if isinstance(value, int) else value
    if pair is None:
        return None
    if (
        not isinstance(pair, (list, tuple))
        or len(pair) != 2
        or not all(type(v) is int and 1 <= v <= 4096 for v in pair)
    ):
        raise ValueError(
            f"{name}={value!r}: give height and width, 1 to 4096 pixels, or one number"
        )
    return list(pair)


def resample(
    demo: Demonstration,
    fps: float,
    actions: ResampledActions = "refuse",
    held: Sequence[int] = (),
) -> Demonstration:
    """A demonstration at another frame rate: at each k / fps the latest frame, and the last frame.

    The outcome is never lost: where the duration is no whole number of steps, the last step is
    shorter. Executed actions belong to the rate they were executed at, so by default a
    demonstration that has actions is refused. With a(u) the action at time u (in steps of the
    source, constant within each) and [u, v] what a new step spans:

    * "drop": no actions; the reward works, a guide does not.
    * "sum": the integral of a over [u, v], for deltas in a controller that is given one action
      where it was given several: the new step goes as far. Its limits are no longer known.
    * "mean": that integral / (v - u), for deltas or velocities that the environment repeats or
      holds longer (a larger ``action_repeat``), and for splitting a step in two.
    * "last": a at the end of [u, v], for absolute targets.

    Args:
        demo: its ``control_rate`` (Hz) or ``frame_times`` (seconds, uneven films) must be known.
        fps: frames a second, and with actions also actions a second; > 0.
        actions: what becomes of them.
        held: dimensions that take "last" whatever `actions` says: a gripper among deltas.

    Returns:
        a new demonstration; ``provenance`` says both rates and what became of the actions. The same
        one if it has that rate already.

    Raises:
        ValueError: if the rate is not known, an argument is out of range, or actions are refused.
    """
    check_rate("fps", fps)
    check_actions(actions)
    n, rate = len(demo), demo.metadata["control_rate"]
    times = demo.metadata.get("frame_times")
    if rate is None and times is None:
        raise ValueError(
            f"fps={fps}: the demonstration does not say its own frame rate: give source_fps="
        )
    if times is None:
        if rate == fps:
            return demo
        times = (np.arange(n) / rate).tolist()
    seconds = np.asarray(times, dtype=np.float64)
    if seconds.shape != (n,) or not np.isfinite(seconds).all() or (np.diff(seconds) <= 0).any():
        raise ValueError(f"frame_times must be {n} rising numbers of seconds")
    duration = seconds[-1] - seconds[0]
    # A last step of less than a thousandth is rounding.
    whole = int(np.ceil(duration * fps - 1e-3))
    if whole > 1_000_000:
        raise ValueError(f"fps={fps}: that makes {whole} frames, more than 1000000")
    moments = seconds[0] + np.minimum(np.arange(whole + 1) / fps, duration)
    picked = np.searchsorted(seconds, moments + 1e-6 / fps, side="right") - 1
    picked[-1] = n - 1

    def rows(values: NDArray[Any] | None) -> NDArray[Any] | None:
        return None if values is None else values[picked]

    metadata = {k: v for k, v in demo.metadata.items() if k != "frame_times"}
    given = demo.actions
    if given is not None and actions == "refuse":
        raise ValueError(
            f"actions were executed at {rate} Hz and are others at {fps} Hz: say actions='drop', "
            "'sum' (deltas, one for several), 'mean' (deltas, repeated) or 'last' (targets)"
        )
    if given is not None and actions == "drop":
        given = None
    if given is not None:
        edges = np.interp(moments, seconds, np.arange(n, dtype=np.float64))
        if len(given) == n:  # the action of the last frame has a step of its own
            edges = np.append(edges, n)
        given = _resampled(given, edges, actions, _dimensions(held, given.shape[1]))
        if actions == "sum":
            metadata |= {"action_low": None, "action_high": None}
    step: dict[str, Any] = {"fps": fps, "from": rate if rate is not None else "frame_times"}
    if demo.actions is not None:
        step |= {"actions": actions, "held": list(held)}
    metadata |= {
        "control_rate": fps,
        "action_repeat": None,
        "provenance": [*demo.metadata["provenance"], step],
    }
    return dataclasses.replace(
        demo,
        frames=demo.frames[picked],
        actions=given,
        observations={k: v[picked] for k, v in demo.observations.items()}
        if isinstance(demo.observations, dict)
        else rows(demo.observations),
        encoder_frames=rows(demo.encoder_frames),
        successes=rows(demo.successes),
        metadata=metadata,
    )


def check_rate(name: str, rate: float) -> None:
    """Refuse what is no number of frames a second.

    Raises:
        ValueError: naming it.
    """
    if isinstance(rate, bool) or not isinstance(rate, (int, float)) or not 0 < rate <= 1000:
        raise ValueError(f"{name}={rate!r}: give frames a second, above 0 and at most 1000")


def check_actions(actions: str) -> None:
    """Refuse what `resample` does not know.

    Raises:
        ValueError: naming it.
    """
    if actions not in RESAMPLED_ACTIONS:
        raise ValueError(f"actions={actions!r}: choose one of {list(RESAMPLED_ACTIONS)}")


def _dimensions(held: Sequence[int], size: int) -> list[int]:
    if not all(type(d) is int and 0 <= d < size for d in held):
        raise ValueError(f"held={list(held)}: give dimensions of the action, 0 to {size - 1}")
    return list(held)


def _resampled(
    actions: NDArray[np.float32], edges: NDArray[np.float64], how: str, held: list[int]
) -> NDArray[np.float32]:
    """(T, A) onto the intervals between edges, in steps of the source."""
    total = np.vstack([np.zeros(actions.shape[1]), np.cumsum(actions, axis=0, dtype=np.float64)])
    steps = np.arange(len(total), dtype=np.float64)
    integral = np.stack([np.interp(edges, steps, column) for column in total.T], axis=1)
    final = np.clip(np.ceil(edges[1:] - 1e-9).astype(int) - 1, 0, len(actions) - 1)
    last: NDArray[np.float32] = actions[final]
    if how == "last":
        return last
    result = np.diff(integral, axis=0)
    if how == "mean":
        # Rounding must not lead beyond the limits of what was averaged.
        result = np.clip(result / np.diff(edges)[:, None], actions.min(axis=0), actions.max(axis=0))
    result[:, held] = last[:, held]
    return result.astype(np.float32)
