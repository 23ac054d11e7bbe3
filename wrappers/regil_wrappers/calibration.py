"""Moves that show how the camera sees the hand, and the cameras that explain what was seen.

* ``Calibration`` - says the moves, keeps the pictures, and fits a pinhole to them
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from regil_wrappers.pinhole import Pinhole, fit_pinhole
from regil_wrappers.registration import local_shift

__all__ = ["Calibration"]

Picture = NDArray[np.uint8]
Action = NDArray[np.float32]
Floats = NDArray[np.float64]

_STILL = 0.5  # px at 84 pixels: a pair of pictures that shifted less says nothing
_IN_VAIN = 3  # episodes that end before any moves that belong together were made
_CONTRADICTED = 6.0  # by how much the other mirror sign's fit must cost less (log likelihood)


@dataclass
class _Segment:
    """Moves that belong together: done within one episode, or again."""

    actions: list[Action]
    marks: list[int]  # after how many actions a picture is kept; 0 is before the first
    places: Floats  # (marks, 3): where the hand is then
    pictures: list[Picture] = field(default_factory=list)


class Calibration:
    """Moves the hand along whole axes and the gripper once, as many as fit into an episode.

    Call `begin` in each episode until `over`, then ask `action` and give `step` the picture that
    followed, until the episode ends or `over`. Then `fit`, when the hand need not be told what to
    do for most of a second.

    Args:
        size: (height, width) px of the pictures.
        idle: (A,) the action that holds still, the gripper as the demonstration begins.
        low: (A,) least actions.
        high: (A,) largest actions.
        dims: the three dimensions that move the hand, as deltas.
        gripper: the gripper's dimension; None without one.
        length: action units, the scale of the scene: moves go half as far to both sides.
        mirrors: signs to fit, +1 or -1 or both.
        settle: steps that a move is given to come to rest.
    """

    def __init__(
        self,
        size: tuple[int, int],
        idle: Action,
        low: Action,
        high: Action,
        dims: Sequence[int],
        gripper: int | None,
        length: float,
        mirrors: Sequence[int],
        settle: int,
    ) -> None:
        self._size, self._unit = size, min(size) / 84
        self._idle, self._low, self._high = idle, low, high
        self._dims, self._gripper = dims, gripper
        self._length, self._mirrors, self._settle = length, mirrors, settle
        self._segments = ([] if gripper is None else [self._gripper_moves()]) + [
            self._axis_moves(axis) for axis in range(3)
        ]
        self._done: list[_Segment] = []
        self._at = self._wait = 0
        self._done_here, self._in_vain = False, 0
        self.cameras: dict[int, Pinhole] = {}  # after `fit`
        self.why = ""  # why there are no cameras, where there are none

    @property
    def over(self) -> bool:
        """Whether all moves have been made, or are given up."""
        return not self._segments

    def begin(self) -> None:
        """An episode begins: the moves that the last one did not complete start again."""
        self._segments[0].pictures = []
        self._done_here = False
        self._at, self._wait = 0, self._settle + 2  # the gripper may have to open or close first

    @property
    def action(self) -> Action:
        """The move to make now: (A,) float32."""
        now = self._idle if self._wait else self._segments[0].actions[self._at]
        move: Action = now.copy()
        return move

    def end(self) -> None:
        """An episode is over that made these moves and no others."""
        self._in_vain = 0 if self._done_here else self._in_vain + 1
        if self._in_vain == _IN_VAIN:
            steps = self._settle + 2 + len(self._segments[0].actions)
            self.why = (
                f"calibration: {steps} moves that belong together did not fit into any of "
                f"{_IN_VAIN} episodes: give them more steps, or a smaller plane"
            )
            self._segments = []

    def step(self, picture: Picture) -> None:
        """The move was made, and this was seen, (H, W, 3) uint8."""
        segment = self._segments[0]
        if self._wait:
            self._wait -= 1
        else:
            self._at += 1
        if self._wait == 0 and self._at in segment.marks:
            segment.pictures.append(picture.copy())
        if self._at < len(segment.actions):
            return
        self._done.append(self._segments.pop(0))
        self._at, self._done_here = 0, True
        if self._segments:
            self._segments[0].pictures = [picture.copy()]

    def fit(self) -> None:
        """Find the `cameras`, or say in `why` why there are none."""
        if self.why:
            return
        moves = [segment for segment in self._done if segment.places.any()]
        hand = _moves_most([segment.pictures for segment in moves])
        gripper = [segment for segment in self._done if not segment.places.any()]
        if gripper:
            tool = _tool_pixel(gripper[0].pictures, hand, self._unit)
            hand = hand if tool is None else tool
        before, after, shifts = [], [], []
        for segment, dim in zip(moves, self._dims, strict=True):
            shifted = np.stack([local_shift(a, b, hand) for a, b in pairwise(segment.pictures)])
            seen = np.linalg.norm(shifted, axis=1) > _STILL * self._unit
            if not seen.any():
                self.why = (
                    f"translation_dims={list(self._dims)}: action dimension {dim} does not move "
                    "the hand's picture: it must be a delta that moves it"
                )
                return
            before.append(segment.places[:-1][seen])
            after.append(segment.places[1:][seen])
            shifts.append(shifted[seen])
        fits = {
            mirror: fit_pinhole(
                np.concatenate(before),
                np.concatenate(after),
                np.concatenate(shifts),
                hand,
                self._size,
                mirror,
                self._length,
            )
            for mirror in (1, -1)
        }
        if len(self._mirrors) == 1:
            declared, other = (fits[s * self._mirrors[0]] for s in (1, -1))
            if declared.cost > other.cost + _CONTRADICTED:
                self.why = (
                    f"mirror={declared.mirror}: calibration says {other.mirror} (fits cost "
                    f"{declared.cost:.1f} and {other.cost:.1f}): set that, or 'auto'"
                )
                return
        # The better fit is tried first
        chosen = sorted((fits[mirror] for mirror in self._mirrors), key=lambda fit: fit.cost)
        self.cameras = {camera.mirror: camera for camera in chosen}

    def lasting(self) -> dict[str, Any]:
        """What stays when an episode ends, as numbers and arrays."""
        return {"done": [s.pictures for s in self._done], "in_vain": self._in_vain}

    def set_lasting(self, lasting: dict[str, Any]) -> None:
        """Take over what `lasting` gave, before any move was made."""
        for pictures in lasting["done"]:
            self._done.append(self._segments.pop(0))
            self._done[-1].pictures = list(pictures)
        self._in_vain = lasting["in_vain"]

    def _gripper_moves(self) -> _Segment:
        turned = self._idle.copy()
        i = self._gripper
        turned[i] = self._low[i] + self._high[i] - turned[i]
        actions = [turned] * self._settle + [self._idle] * self._settle
        return _Segment(actions, [0, self._settle, 2 * self._settle], np.zeros((3, 3)))

    def _axis_moves(self, axis: int) -> _Segment:
        """To one side, back, to the other side, back."""
        dim = self._dims[axis]
        limit = float(min(-self._low[dim], self._high[dim]))
        actions: list[Action] = []
        marks, places = [0], [np.zeros(3)]
        for goal in (1.0, 0.0, -1.0, 0.0):
            place = np.zeros(3)
            place[axis] = goal * self._length / 2
            way = place[axis] - places[-1][axis]
            while abs(way) > 1e-9:
                action = self._idle.copy()
                action[dim] = part = float(np.clip(way, -limit, limit))
                actions.append(action)
                way -= part
            actions += [self._idle] * self._settle
            marks.append(len(actions))
            places.append(place)
        return _Segment(actions, marks, np.stack(places))


def _moves_most(pictures: list[list[Picture]]) -> Floats:
    """Centroid (x, y) of the pixels that change most within sequences of pictures."""
    change = sum(
        cv2.GaussianBlur(np.abs(b.astype(np.float32) - a).max(axis=2), (0, 0), 2.0)
        for sequence in pictures
        for a, b in pairwise(sequence)
    )
    assert isinstance(change, np.ndarray)
    _, labels = cv2.connectedComponents((change > 0.6 * change.max()).astype(np.uint8))
    there = labels == labels[np.unravel_index(change.argmax(), change.shape)]
    return _centroid(change * there)


def _tool_pixel(pictures: list[Picture], near: Floats, unit: float) -> Floats | None:
    """Centroid of what changes when only the gripper moves; None where too little does."""
    still, turned, back = (p.astype(np.float32) for p in pictures)
    change = np.abs(turned - still).max(axis=2) + np.abs(back - turned).max(axis=2)
    y, x = np.mgrid[: change.shape[0], : change.shape[1]]
    change = change * (np.hypot(x - near[0], y - near[1]) < 25 * unit)
    much = (change > max(25.0, 0.3 * change.max())) & (change > 0)
    return _centroid(change * much) if much.sum() >= 3 * unit**2 else None


def _centroid(weights: NDArray[Any]) -> Floats:
    y, x = np.mgrid[: weights.shape[0], : weights.shape[1]]
    return np.array([(x * weights).sum(), (y * weights).sum()]) / max(float(weights.sum()), 1e-9)
