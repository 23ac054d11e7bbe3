"""A demonstration's actions, corrected for where the target is now.

* ``Servo`` - moves the hand a little to learn how the camera sees it, then, in each episode, looks
  at the first picture, finds how far the target stands from where it stood, and replays the
  demonstrated path shifted by that much

It is given pictures and says actions. It assumes a fixed camera, an arm that starts each episode in
about the same pose, translations that are deltas, and one target that moved; or two, where a
gripper takes up the one and brings it to the other.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from regil_wrappers.apart import Apart
from regil_wrappers.calibration import Calibration
from regil_wrappers.declared import check_gripper, checked_dims, checked_plane
from regil_wrappers.path import Path
from regil_wrappers.pinhole import Pinhole, nearest_to_path, solve_displacement
from regil_wrappers.registration import Displacement
from regil_wrappers.ways import Way, Ways

__all__ = ["Servo"]

Picture = NDArray[np.uint8]
Floats = NDArray[np.float64]
Mirror = Literal["auto", 1, -1]

_REACHED = 0.3  # of a full action: a place of the path counts as reached
_AHEAD = 10  # places ahead of the next that may be reached before it
_WORST_RATIO = 0.95  # a registration that explains less is not believed
_KICK_EVERY = 10  # steps of a disturbed episode, on average
_DISTURBED = 0.5  # of a full action: a replay that was disturbed by no more is a replay
_MISFIT = 4.0  # std: a displacement that fits picture and plane worse is not believed
_OFTEN = 3  # episodes in which that happens before it is said


class Servo:
    """Replays a demonstration where the target is now, from pictures alone.

    Call `reset` when an episode begins, then ask `action` and tell what was done with `executed`,
    until `finish`. The first calls of `action` are calibration moves, along whole axes, as many as
    fit into an episode; from then on `reset` is told what has moved since the demonstration began.

    Args:
        size: (height, width) px of the pictures.
        actions: (T, A) float32, the demonstration's.
        low: (A,) least actions.
        high: (A,) largest actions.
        translation_dims: the three dimensions that move the hand, as deltas.
        gripper_dim: the dimension of the gripper, positive to close; None without one.
        plane: (3,) how far targets move along each of these, as standard deviations in action
            units; also the scale of the scene.
        mirror: +1, or -1 where the picture is mirrored against the action axes, or "auto": both are
            tried, and successes decide.
        control_rate: actions a second, for how long moves take to come to rest.
        settle_time: s that a calibration move is given to come to rest.
        rotation_dims: dimensions that turn the hand, as deltas: a place of the path that takes more
            than one step must not turn it more than once.
        start_std: (3,) action units, standard deviations of where the hand starts an episode; None:
            always in one place.
        crowded: whether other things move too, so that only what stands where the demonstration
            grasps and where it ends is looked at.
        disturbance: in every other episode `disturbed` pushes the hand off its way now and then, by
            up to so many action units, so that who learns from `action` sees how to come back; 0:
            never.
        seed: of the choice between ways of replaying, and of disturbances.

    Raises:
        ValueError: if a dimension does not exist, has no finite limits or cannot be a delta.
    """

    def __init__(
        self,
        size: tuple[int, int],
        actions: NDArray[np.float32],
        low: NDArray[np.float32],
        high: NDArray[np.float32],
        translation_dims: Iterable[int] = (0, 1, 2),
        gripper_dim: int | None = 3,
        plane: Iterable[float] = (10.0, 10.0, 0.5),
        mirror: Mirror = "auto",
        control_rate: float | None = None,
        settle_time: float = 0.1,
        rotation_dims: Iterable[int] = (),
        start_std: Iterable[float] | None = None,
        crowded: bool = False,
        disturbance: float = 0.0,
        seed: int | None = None,
    ) -> None:
        self._dims = checked_dims(translation_dims, low, high)
        self._plane = checked_plane(plane)
        check_gripper(gripper_dim, self._dims, low, high)
        if mirror not in ("auto", 1, -1):
            raise ValueError(f"mirror={mirror!r}: choose 'auto', 1 or -1")
        self._size = size
        self._actions = actions
        self._gripper = gripper_dim
        self._disturbance = disturbance
        self._disturbs = False
        self._least, self._most = (x[self._dims].astype(float) for x in (low, high))
        self._full = np.minimum(-self._least, self._most)  # that both directions allow
        deltas = self._clipped(actions[:, self._dims].astype(float))
        self._path = Path(deltas, None if gripper_dim is None else actions[:, gripper_dim])
        self._start_std = None if start_std is None else np.array(list(start_std), float)
        self._crowded = crowded
        self._rotations = list(rotation_dims)
        self._turns: Floats = np.cumsum(actions[:, self._rotations].astype(float), axis=0)
        self._mirrors = (1, -1) if mirror == "auto" else (mirror,)
        self._rng = np.random.default_rng(seed)
        self._low, self._high = low, high
        self._calibration: Calibration | None = Calibration(
            size,
            self._idle(),
            low,
            high,
            self._dims,
            gripper_dim,
            float(self._plane.max()),
            self._mirrors,
            max(2, math.ceil(settle_time * (control_rate or 40.0))),
        )
        self.cameras: dict[int, Pinhole] = {}
        self._ways = Ways((), self.grasp is not None)
        self.why = ""  # why replay is plain, where it is
        self._off_plane = 0
        self._begin_episode()

    # -- what the guide calls --------------------------------------------------------------------

    @property
    def calibrated(self) -> bool:
        """Whether calibration is over, so that `reset` can use a displacement."""
        return self._calibration is None

    @property
    def grasp(self) -> int | None:
        """The step in which the demonstration's open gripper closes; None where none does."""
        return self._path.grasp

    def grasp_to_look_at(self, found: Displacement | None) -> int | None:
        """`grasp`, where `reset` has a use for ``apart`` beside this displacement; else None."""
        elsewhere = found is not None and found.another_scene
        return self.grasp if self.cameras and not elsewhere else None

    @property
    def hand_pixel(self) -> Floats | None:
        """(2,) px, where the hand starts; None where it always starts there, or is not known."""
        if self._start_std is None or not self.cameras:
            return None
        return np.array(next(iter(self.cameras.values())).hand)

    @property
    def near(self) -> tuple[Floats, Floats] | None:
        """(2,) px each, where the demonstration grasps and where it ends; None: look everywhere."""
        if not self._crowded or self.grasp is None or not self.cameras:
            return None
        camera, places = next(iter(self.cameras.values())), self._path.places
        return camera.project(places[self.grasp]), camera.project(places[-1])

    # Of an episode
    target_shift: Floats  # action units: where the target is believed to have gone
    place_shift: Floats  # action units: where what is taken up is to be brought has gone
    _way: Way
    _moving: bool  # calibration moves are under way
    _calibrated_here: bool
    _followed: bool  # whether every action was the guide's
    _at: int  # the place of the path that the hand is on its way to
    _hand: Floats  # (3,) action units from the start
    _turned: Floats  # (rotation dims,) action units, by how much it has been turned
    _kick: Floats  # (3,) action units that the hand is still to be pushed

    def reset(
        self,
        displacement: Displacement | None = None,
        apart: Apart | None = None,
        kind: str | None = None,
        hand: Floats | None = None,
    ) -> None:
        """Begin an episode.

        Args:
            displacement: what `registration.register` found between the demonstration's first
                picture and this episode's; not used before `calibrated`.
            apart: what `apart.register_apart` found, where there is a `grasp`; likewise.
            kind: "corrected", "released" or "plain" in place of a choice between them.
            hand: (2,) px, how far the hand's picture is from where the demonstration's started.
        """
        self.settle()
        self._begin_episode()
        if self._calibration is not None:
            self._moving = True
            self._calibration.begin()
        else:
            self._begin_replay(displacement, apart, kind, hand)

    def disturbed(self) -> NDArray[np.float32] | None:
        """What to execute now where `action` is what to learn; None where they are the same."""
        clean = self.action()
        if clean is None or not np.abs(self._kick).max() > 0:
            return None
        pushed: NDArray[np.float32] = clean.copy()
        pushed[self._dims] = self._clipped(self._kick)
        return pushed

    def _next_kick(self) -> None:
        self._kick = self._kick - self._clipped(self._kick)
        if self._disturbs and not self._kick.any() and self._rng.random() < 1 / _KICK_EVERY:
            way = self._rng.normal(size=3)
            size = self._disturbance * self._rng.uniform(0.5, 1)
            self._kick = size * way / np.linalg.norm(way)

    def reseed(self, seed: int) -> None:
        """Seed the choice between ways of replaying, and disturbances."""
        self._rng = np.random.default_rng(seed)

    @property
    def calibrating(self) -> bool:
        """Whether this episode holds calibration moves: it demonstrates nothing."""
        return self._calibrated_here

    @property
    def kind(self) -> str:
        """What `action` is now: "calibration", "corrected", "released" or "plain"."""
        return "calibration" if self._moving else self._way.kind

    def action(self) -> NDArray[np.float32] | None:
        """What to do now: (A,) float32; None for the demonstration's own, unchanged."""
        if self._moving and self._calibration is not None:
            return self._calibration.action
        if self._way.kind == "plain":
            return None
        action: NDArray[np.float32] = self._actions[min(self._at, len(self._actions) - 1)].copy()
        action[self._dims] = self._clipped(self._target() - self._hand)
        action[self._rotations] = self._turns[min(self._at, len(self._turns) - 1)] - self._turned
        clipped: NDArray[np.float32] = np.clip(action, self._low, self._high)
        return clipped

    def executed(
        self, action: NDArray[np.float32], suggested: NDArray[np.float32], picture: Picture
    ) -> None:
        """What was done, whoever chose it, what the guide had suggested, and what was seen then.

        A replay may be disturbed by noise; calibration moves may not. What is beyond the limits
        counts as clipped to them, and a number that is none as no move, by somebody else.
        """
        full = np.maximum((self._high - self._low) / 2, 1e-9)
        action = np.clip(action, self._low, self._high)
        off = float((np.abs(action - suggested) / full).max())
        action = np.nan_to_num(action)
        self._followed = self._followed and off <= _DISTURBED
        if self._moving and self._calibration is not None:
            self._calibrated_here = True
            if not off <= 1e-3:  # somebody else acts: no calibration in this episode
                self._moving = False
                return
            self._calibration.step(picture)
            self._moving = not self._calibration.over
            return
        if self._way.kind != "plain":
            self._hand = self._hand + np.asarray(action, float)[self._dims]
            self._turned = self._turned + np.asarray(action, float)[self._rotations]
            self._at = self._next_place()
            self._next_kick()

    def _next_place(self) -> int:
        """The place after the one reached: who acts in the guide's stead may cut a corner.

        Nothing is skipped that the gripper does on the way.
        """
        for i in range(self._at, min(self._at + _AHEAD, len(self._path))):
            if self._path.gripper_moves(self._at, i):
                break
            if self._near(i):
                return i + 1
        return self._at + (self._at >= len(self._path) and self._near(self._at))

    def _near(self, i: int) -> bool:
        return bool((np.abs(self._place(i) - self._hand) <= _REACHED * self._full).all())

    def _clipped(self, deltas: Floats) -> Floats:
        """(..., 3) action units: what the environment makes of these translations."""
        return np.clip(deltas, self._least, self._most)

    def finish(self, success: bool) -> None:
        """The episode is over; what came of it counts where the guide chose every action."""
        if self._moving and self._followed and self._calibration is not None:
            self._calibration.end()
        elif self._followed and not self._calibrated_here:
            if success:
                self._way.won += 1
            else:
                self._way.lost += 1
            if not self.why and (verdict := self._ways.verdict()):
                self._say(verdict)
        self._followed = False  # once
        self.settle()

    def settle(self) -> None:
        """Take over what calibration has shown, once all its moves have been made.

        Between episodes: it takes most of a second, in which a robot would not be told what to do.
        """
        if self._calibration is None or not self._calibration.over:
            return
        calibration, self._calibration = self._calibration, None
        calibration.fit()
        self.cameras = calibration.cameras
        self._ways = Ways(self.cameras, self.grasp is not None)
        self._moving, self._way = False, self._ways.plain
        if calibration.why:
            self._say(f"{calibration.why}; the guide replays without correction")

    def state(self) -> dict[str, Any] | None:
        """What calibration found and which ways succeeded, as JSON values; None before that."""
        if not self.calibrated:
            return None
        return {
            "cameras": [camera.as_dict() for camera in self.cameras.values()],
            "ways": self._ways.as_list(),
            "translation_dims": self._dims,
            "gripper_dim": self._gripper,
            "plane": self._plane.tolist(),
            "why": self.why,
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Take over what `state` gave, from a guide with the same demonstration and camera.

        Raises:
            ValueError: if it is not such a state, or from pictures of another size, other
                dimensions or a mirror that was not declared.
        """
        try:
            cameras = [Pinhole.from_dict(values) for values in state["cameras"]]
            ways = Ways.from_list(state["ways"], [camera.mirror for camera in cameras])
            why = str(state["why"])
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"not the state of a calibrated guide: {error}") from error
        height, width = self._size
        if any(camera.size != self._size for camera in cameras):
            raise ValueError(f"the calibration is not from pictures of {height}x{width}")
        for name, own in (("translation_dims", self._dims), ("gripper_dim", self._gripper)):
            if state.get(name, own) != own:  # older ones do not say it
                raise ValueError(
                    f"the calibration is of {name}={state[name]} and this guide has {own}: "
                    "remove it, or declare the same"
                )
        for camera in cameras:
            if camera.mirror not in self._mirrors:
                raise ValueError(
                    f"the calibration is of mirror={camera.mirror} and this guide has "
                    f"{self._mirrors[0]}: remove it, or declare the same"
                )
        self.cameras = {camera.mirror: camera for camera in cameras}
        self._ways, self.why = ways, why
        self._calibration = None
        self._begin_episode()

    def lasting(self) -> dict[str, Any]:
        """All that stays when an episode ends, as numbers, text and arrays."""
        return {
            "generator": self._rng.bit_generator.state,
            "calibration": None if self._calibration is None else self._calibration.lasting(),
            "calibrated": self.state(),
            "off_plane": self._off_plane,
            "disturbs": self._disturbs,
        }

    def set_lasting(self, lasting: dict[str, Any]) -> None:
        """Take over what `lasting` gave; ask nothing before the next `reset`.

        Raises:
            ValueError: as `load_state`, and where this one's calibration has begun.
        """
        if lasting["calibrated"] is not None:
            self.load_state(lasting["calibrated"])
        elif self._calibration is None or self._calibration.lasting()["done"]:
            raise ValueError("a guide that has begun its calibration takes no earlier one")
        else:
            self._calibration.set_lasting(lasting["calibration"])
        self._rng.bit_generator.state = lasting["generator"]
        self._off_plane, self._disturbs = lasting["off_plane"], lasting["disturbs"]

    # -- replaying -------------------------------------------------------------------------------

    def _begin_replay(
        self,
        found: Displacement | None,
        apart: Apart | None,
        kind: str | None,
        hand: Floats | None,
    ) -> None:
        seen = apart if apart is not None and apart.believed(_WORST_RATIO) else None
        # In a crowded scene a place that was not seen to move stands where it stood
        speaks = seen is not None or (self._crowded and apart is not None)
        chosen = self._ways.choose(self._rng, speaks) if kind is None else None
        self._way = chosen or self._ways.best(str(kind))
        # Every other episode goes undisturbed, and tells which way of replaying is best
        self._disturbs = not self._disturbs and self._disturbance > 0
        if self._way.kind == "plain":
            return
        if hand is not None and self._start_std is not None:
            camera = self.cameras[self._way.mirror]
            self._hand, _ = solve_displacement(camera, np.zeros(3), hand, None, self._start_std)
        if found is None:
            return
        if found.another_scene:
            self._way = self._ways.plain
            if not self.why:
                self._say(
                    f"{found.changed:.0%} of the picture differ from the demonstration's: camera "
                    "or scene are others; the guide replays without correction while that lasts"
                )
            return
        if self._crowded and apart is not None:
            if apart.worst > _WORST_RATIO or not self._believes(apart):
                self._way = self._ways.plain
            return
        if self._way.kind == "released" and seen is not None and self._believes(seen):
            return
        shift, misfit = self._solved(found, self._path.places)
        if found.ratio > _WORST_RATIO:
            self._way = self._ways.plain
        elif misfit > _MISFIT:
            self._way = self._ways.plain
            self._off_plane += 1
            if self._off_plane == _OFTEN:
                self._say(
                    f"plane={self._plane.tolist()}: in {_OFTEN} episodes no displacement in this "
                    f"plane explained what was seen to move (off by {misfit:.1f} standard "
                    "deviations); there the guide replays without correction"
                )
        else:
            self.target_shift = shift

    def _believes(self, apart: Apart) -> bool:
        """Take over what moved apart, unless the plane does not explain it."""
        shifts = [np.zeros(3), np.zeros(3)]
        for i, (found, path) in enumerate(
            zip((apart.taken, apart.place), self._path.split(), strict=True)
        ):
            if found is not None:
                shifts[i], misfit = self._solved(found, path)
                if misfit > _MISFIT:
                    return False
        self.target_shift, self.place_shift = shifts
        return True

    def _solved(self, found: Displacement, path: Floats) -> tuple[Floats, float]:
        """The displacement in action units, and by how many standard deviations it is off."""
        camera = self.cameras[self._way.mirror]
        place = nearest_to_path(camera, found.point, path)
        return solve_displacement(camera, place, found.shift, found.growth, self._plane)

    def _say(self, why: str) -> None:
        self.why = why
        warnings.warn(why, stacklevel=2)

    def _begin_episode(self) -> None:
        self._moving = self._calibrated_here = False
        self._followed = True
        self._at = 0
        self._hand = np.zeros(3)
        self._turned = np.zeros(len(self._rotations))
        self._kick = np.zeros(3)
        self._way = self._ways.plain
        self.target_shift, self.place_shift = np.zeros(3), np.zeros(3)

    def _idle(self) -> NDArray[np.float32]:
        """The action that holds still, the gripper as the demonstration begins, or open."""
        action = np.zeros(self._actions.shape[1], np.float32)
        if self._gripper is not None:
            first = self._actions[0, self._gripper]
            action[self._gripper] = first if abs(first) > 0.5 else self._low[self._gripper]
        return action

    @property
    def camera(self) -> Pinhole | None:
        """The camera that this episode's correction believes in; None where replay is plain."""
        return None if self._way.kind == "plain" else self.cameras[self._way.mirror]

    def demonstrated_path(self) -> Floats:
        """(T, 3) action units: the places that the demonstration goes through."""
        return np.array(self._path.places)

    def corrected_path(self) -> Floats:
        """(T, 3) action units: the places that this episode's replay goes through."""
        return np.stack([self._place(i) for i in range(len(self._path))])

    def _target(self) -> Floats:
        return self._place(self._at)

    def _place(self, i: int) -> Floats:
        brought = self.place_shift if self._way.kind == "released" else None
        return self._path.corrected(i, self.target_shift, brought)
