"""`regil bench guide`: how often does the guide succeed?

Plain replay, plain replay on pictures that are moved back, and corrected replay at the same unseen
goals, undisturbed or with changed light, noise, a turned camera, a distractor or an undeclared
mirror sign. Nothing learns. The same arguments give the same tables on one machine, seconds apart.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import gymnasium as gym
import numpy as np
import numpy.typing as npt
from regil_wrappers import Demonstration, RetrievalGuideWrapper
from regil_wrappers.frames import stated

from regil_sb3.bench.replay import (
    TASKS,
    check,
    demonstration,
    env_id,
    env_kwargs,
    follow,
    guides,
    play,
)
from regil_sb3.bench.timing import Timed
from regil_sb3.envs import EVALUATION_SEEDS

__all__ = ["DISTURBANCES", "Guided", "guide", "main", "table"]

Frame = npt.NDArray[np.uint8]
Change = Callable[[Frame, np.random.Generator], Frame]

_TURN = 3.0  # px of 84 by which the disturbed camera is turned, along both axes of the picture
_NOISE = 8.0  # std, of 255
_DISTRACTOR = 10  # px, its side


def _brighter(frame: Frame, _: np.random.Generator) -> Frame:
    brighter: Frame = (frame * 1.2).clip(0, 255).astype(np.uint8)
    return brighter


def _darker(frame: Frame, _: np.random.Generator) -> Frame:
    darker: Frame = (frame * 0.8).astype(np.uint8)
    return darker


def _noisy(frame: Frame, rng: np.random.Generator) -> Frame:
    noisy: Frame = (frame + rng.normal(0, _NOISE, frame.shape)).clip(0, 255).astype(np.uint8)
    return noisy


DISTURBANCES = ("none", "brighter", "darker", "noise", "camera", "distractor", "mirror-auto")
"""Brightness +20 % and -20 %, pixel noise, a camera turned by 3 pixels along both axes, a square of
random blots somewhere in the picture, and `mirror="auto"` in place of the declared sign."""
_CHANGES: dict[str, Change] = {"brighter": _brighter, "darker": _darker, "noise": _noisy}


class _Disturbed(gym.ObservationWrapper[Frame, npt.NDArray[np.float32], Frame]):
    """Changes pictures; the same way in each episode of a seed."""

    def __init__(self, env: gym.Env[Any, Any], name: str) -> None:
        super().__init__(env)
        self._name = name
        self._rng = np.random.default_rng(0)
        self._square: Frame = np.zeros((0, 0, 3), np.uint8)
        self._place = (0, 0)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        blots = self._rng.integers(0, 255, (3, 3, 3)).astype(np.uint8)
        self._square = np.asarray(cv2.resize(blots, (_DISTRACTOR, _DISTRACTOR)), np.uint8)
        height, width = self.env.observation_space.shape[:2]  # type: ignore[index]
        y, x = self._rng.integers(0, (height - _DISTRACTOR, width - _DISTRACTOR))
        self._place = (int(y), int(x))
        return super().reset(seed=seed, options=options)

    def observation(self, observation: Frame) -> Frame:
        if self._name in _CHANGES:
            return _CHANGES[self._name](observation, self._rng)
        y, x = self._place
        changed: Frame = observation.copy()
        changed[y : y + _DISTRACTOR, x : x + _DISTRACTOR] = self._square
        return changed


@dataclass(frozen=True)
class Guided:
    """One task, one demonstration, one disturbance.

    Attributes:
        task: Meta-World's name, or the id of an environment.
        seed: the demonstration's.
        disturbance: of `DISTURBANCES`.
        plain: whether plain replay succeeded, goal by goal.
        moved_back: whether it did on pictures that were moved back, at the same goals.
        corrected: whether corrected replay did, at the same goals.
        errors_cm: how far the believed place of the target is from the true one, in the table's
            plane, and that of where it is brought, where the task moves it too; only of episodes in
            which a correction was tried.
        seconds: spent in the guide (encoder, retrieval and registration too), an episode.
        calibration_steps: that calibration took, before these episodes.
        said: what the guide said of itself, where it gave up correcting.
    """

    task: str
    seed: int
    disturbance: str
    plain: list[bool]
    moved_back: list[bool]
    corrected: list[bool]
    errors_cm: list[float] = field(default_factory=list)
    seconds: float = 0.0
    calibration_steps: int = 0
    said: str = ""


def guide(
    tasks: Sequence[str] = TASKS,
    episodes: int = 20,
    seeds: Sequence[int] = (0, 1),
    disturbances: Sequence[str] = ("none",),
) -> Iterator[Guided]:
    """Replay with each guide at the same goals; the correction calibrates first.

    Args:
        tasks: Meta-World's names, or ids of environments with a scripted expert.
        episodes: goals, the first of those that evaluations use.
        seeds: first seeds tried for the demonstrations; each gives one.
        disturbances: of `DISTURBANCES`.

    Yields:
        one result for each task, seed and disturbance.
    """
    for task in tasks:
        for seed in seeds:
            demo = demonstration(task, seed)
            for disturbance in disturbances:
                yield _guided(task, seed, demo, disturbance, episodes)


def _make(task: str, disturbance: str) -> gym.Env[Any, Any]:
    env = gym.make(env_id(task), **env_kwargs(task))
    if disturbance == "camera":
        _turn_camera(env.unwrapped)
    elif disturbance in _CHANGES or disturbance == "distractor":
        env = _Disturbed(env, disturbance)
    return env


def _turn_camera(env: Any) -> None:
    """Turn it about its own axes, so that what stands still shifts by `_TURN` pixels."""
    import mujoco  # type: ignore[import-untyped]

    model = env._sim.model
    focal = 84 / 2 / np.tan(np.deg2rad(model.cam_fovy[env._camera]) / 2)
    angle = np.arctan(_TURN / focal)
    quat = model.cam_quat[env._camera]
    for axis in (np.array([1.0, 0, 0]), np.array([0, 1.0, 0])):
        turn, turned = np.zeros(4), np.zeros(4)
        mujoco.mju_axisAngle2Quat(turn, axis, angle)
        mujoco.mju_mulQuat(turned, quat, turn)
        quat[:] = turned


def _guided(task: str, seed: int, demo: Demonstration, disturbance: str, n: int) -> Guided:
    goals = range(EVALUATION_SEEDS, EVALUATION_SEEDS + n)
    reference = _make(task, "none")
    reference.reset(seed=int(demo.metadata["seed"]))
    home = _targets(reference)
    step_cm = stated(reference.unwrapped.metadata).get("step_cm")
    reference.close()

    known = guides()
    replayed = []
    for name in ("plain", "moved back"):
        plain = RetrievalGuideWrapper(_make(task, disturbance), demo, **known[name])
        replayed.append([play(plain, goal) for goal in goals])
        plain.close()

    timed = Timed(_make(task, disturbance))
    own = {**known["corrected"], "disturbance": 0.0}
    if disturbance == "mirror-auto":
        own["mirror"] = "auto"
    env = RetrievalGuideWrapper(timed, demo, **own)
    steps = _calibrate(env, int(demo.metadata["seed"]) + 1)
    timed.seconds, start = 0.0, time.perf_counter()
    corrected, errors = [], []
    for goal in goals:
        corrected.append(play(env, goal))
        if home is None or step_cm is None:
            continue
        believed = [shift * step_cm for shift in _believed(env)]
        for shift, moved in zip(believed, _targets(env) - home, strict=False):
            errors.append(float(np.linalg.norm((shift - 100 * moved)[:2])))
    seconds = time.perf_counter() - start - timed.seconds
    said = (env.calibration() or {}).get("why", "")
    env.close()
    return Guided(
        task,
        seed,
        disturbance,
        replayed[0],
        replayed[1],
        corrected,
        errors,
        seconds / n,
        steps,
        said,
    )


def _targets(env: gym.Env[Any, Any]) -> Any:
    """(n, 3) m: where what the task is about stands, from the simulator; None: it does not say."""
    return env.unwrapped.targets() if hasattr(env.unwrapped, "targets") else None


def _believed(env: RetrievalGuideWrapper[Any, Any]) -> list[npt.NDArray[np.float64]]:
    """[(3,), (3,)] action units: how far the first and the second are believed to have moved."""
    shifts = (env.target_shift, env.place_shift)
    return [shift for shift in shifts if shift is not None]


def _calibrate(env: RetrievalGuideWrapper[Any, Any], seed: int) -> int:
    """Agent steps of the episodes that calibration took."""
    steps = 0
    for episode in range(10):
        env.reset(seed=seed + episode)
        if env.calibration() is not None:
            break
        steps += follow(env)[1]
    return steps


def table(results: Sequence[Guided]) -> list[str]:
    """A table in Markdown: one line a result, and means over each disturbance."""
    lines = [
        "| task | demonstration | disturbance | plain | moved back | corrected | "
        "error, median / 90 % (cm) | guide, s an episode | calibration, steps |",
        "|---|---|---|---|---|---|---|---|---|",
        *map(_line, results),
    ]
    for disturbance in dict.fromkeys(r.disturbance for r in results):
        own = [r for r in results if r.disturbance == disturbance]
        errors = [e for r in own for e in r.errors_cm]
        lines.append(
            f"| **mean** | {len(own)} | {disturbance} | {_rates(own)} | "
            f"{_spread(errors)} | {np.mean([r.seconds for r in own]):.2f} | |"
        )
    return lines + [f"{r.task}, {r.seed}, {r.disturbance}: {r.said}" for r in results if r.said]


def _rates(results: Sequence[Guided]) -> str:
    """Plain, moved back and corrected: means over results."""
    sides = ("plain", "moved_back", "corrected")
    means = [np.mean([np.mean(getattr(result, side)) for result in results]) for side in sides]
    return " | ".join(f"{mean:.2f}" for mean in means)


def _line(r: Guided) -> str:
    return (
        f"| {r.task} | {r.seed} | {r.disturbance} | {_rates([r])} | {_spread(r.errors_cm)} | "
        f"{r.seconds:.2f} | {r.calibration_steps} |"
    )


def _spread(errors: Sequence[float]) -> str:
    if not errors:
        return "-"
    return f"{np.median(errors):.1f} / {np.percentile(errors, 90):.1f}"


def main(
    tasks: Sequence[str] = TASKS,
    episodes: int = 20,
    seeds: Sequence[int] = (0, 1),
    disturbances: Sequence[str] = ("none",),
) -> None:
    """Measure and print, line by line.

    Args:
        tasks: as for `guide`.
        episodes: likewise.
        seeds: likewise.
        disturbances: likewise.

    Raises:
        ValueError: if an option cannot be measured.
    """
    check(tasks, seeds, episodes=episodes)
    for name in disturbances:
        if name not in DISTURBANCES:
            raise ValueError(f"--disturbances {name}: choose from {', '.join(DISTURBANCES)}")
    if "camera" in disturbances and any("/" in task for task in tasks):
        raise ValueError("--disturbances camera: only Meta-World's cameras can be turned")
    results = []
    for result in guide(tasks, episodes, seeds, disturbances):
        results.append(result)
        print(_line(result), flush=True)
    print("\n" + "\n".join(table(results)))
