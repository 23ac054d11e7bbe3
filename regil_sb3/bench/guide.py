"""`regil bench guide` and `regil bench success-buffer`: how often does the guide succeed?

Plain and corrected replay at the same unseen goals, undisturbed or with changed light, noise, a
turned camera, a distractor or an undeclared mirror sign; and what each leaves in a success buffer.
Nothing learns. The same arguments give the same tables on one machine, seconds apart.
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

import regil_sb3  # registers the environments  # noqa: F401
from regil_sb3.bench.rewards import TASKS
from regil_sb3.bench.timing import Timed
from regil_sb3.envs import METAWORLD_TASKS
from regil_sb3.recording import EVALUATION_SEEDS, record_expert
from regil_sb3.settings import make_settings, presets

__all__ = ["DISTURBANCES", "Collected", "Guided", "guide", "main", "success_buffer", "table"]

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
    """Replay plainly and corrected at the same goals; the correction calibrates first.

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
            demo = record_expert(_env_id(task), seed, _env_kwargs(task))
            for disturbance in disturbances:
                yield _guided(task, seed, demo, disturbance, episodes)


def _arguments() -> dict[str, Any]:
    """The guide of the default preset."""
    entry = presets()["default"]["env_wrapper"][0]
    return dict(entry["regil_wrappers.RetrievalGuideWrapper"])


def _env_id(task: str) -> str:
    return task if "/" in task else f"regil/metaworld-{task}-v0"


def _env_kwargs(task: str) -> dict[str, Any]:
    """As `regil train` makes it: LIBERO's time limits depend on the task."""
    return make_settings(_env_id(task)).env_kwargs


def _make(task: str, disturbance: str) -> gym.Env[Any, Any]:
    env = gym.make(_env_id(task), **_env_kwargs(task))
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
    reference.close()

    plain = RetrievalGuideWrapper(_make(task, disturbance), demo)
    failed_or_not = [_play(plain, goal) for goal in goals]
    plain.close()

    timed = Timed(_make(task, disturbance))
    own = {**_arguments(), "disturbance": 0.0}
    if disturbance == "mirror-auto":
        own["mirror"] = "auto"
    env = RetrievalGuideWrapper(timed, demo, **own)
    steps = _calibrate(env, int(demo.metadata["seed"]) + 1)
    timed.seconds, start = 0.0, time.perf_counter()
    corrected, errors = [], []
    for goal in goals:
        corrected.append(_play(env, goal))
        believed = [shift * env.unwrapped.metadata["regil"]["step_cm"] for shift in _believed(env)]
        for shift, moved in zip(believed, _targets(env) - home, strict=False):
            errors.append(float(np.linalg.norm((shift - 100 * moved)[:2])))
    seconds = time.perf_counter() - start - timed.seconds
    said = (env.calibration() or {}).get("why", "")
    env.close()
    return Guided(
        task, seed, disturbance, failed_or_not, corrected, errors, seconds / n, steps, said
    )


def _targets(env: gym.Env[Any, Any]) -> npt.NDArray[np.float64]:
    """(n, 3) m: where what the task is about stands, from the simulator."""
    places: npt.NDArray[np.float64] = env.unwrapped.targets()  # type: ignore[attr-defined]
    return places


def _believed(env: RetrievalGuideWrapper[Any, Any]) -> list[npt.NDArray[np.float64]]:
    """[(3,), (3,)] action units: how far the first and the second are believed to have moved."""
    shifts = (env.target_shift, env.place_shift)
    return [shift for shift in shifts if shift is not None]


def _play(env: RetrievalGuideWrapper[Any, Any], seed: int) -> bool:
    env.reset(seed=seed)
    return _follow(env)[0]


def _follow(env: RetrievalGuideWrapper[Any, Any]) -> tuple[bool, int]:
    """Follow the guide to the episode's end: whether it succeeded, and agent steps."""
    steps, over, info = 0, False, {"is_success": False}
    while not over:
        *_, terminated, truncated, info = env.step(env.guide_action())
        over = terminated or truncated
        steps += 1
    return bool(info["is_success"]), steps


def _calibrate(env: RetrievalGuideWrapper[Any, Any], seed: int) -> int:
    """Agent steps of the episodes that calibration took."""
    steps = 0
    for episode in range(10):
        env.reset(seed=seed + episode)
        if env.calibration() is not None:
            break
        steps += _follow(env)[1]
    return steps


@dataclass(frozen=True)
class Collected:
    """What a guide leaves in a success buffer.

    Attributes:
        task: Meta-World's name, or the id of an environment.
        seed: of demonstration and episodes.
        steps: agent steps guided, calibration included.
        plain: transitions of successful episodes, plain replay.
        corrected: the same with correction.
    """

    task: str
    seed: int
    steps: int
    plain: int
    corrected: int


def success_buffer(
    tasks: Sequence[str] = TASKS, seeds: Sequence[int] = (0,), steps: int = 5_000
) -> Iterator[Collected]:
    """Count the transitions of whole successful episodes in a guided warm-up.

    Episodes that hold calibration moves count as none, and the demonstration itself is left out.
    The guide is the default preset's, pushed off its way now and then as in training.

    Args:
        tasks: Meta-World's names, or ids of environments with a scripted expert.
        seeds: of demonstration and episodes.
        steps: agent steps of the warm-up.
    """
    for task in tasks:
        for seed in seeds:
            demo = record_expert(_env_id(task), seed, _env_kwargs(task))
            kept = [
                _collect(RetrievalGuideWrapper(_make(task, "none"), demo, **own), seed, steps)
                for own in ({}, _arguments())
            ]
            yield Collected(task, seed, steps, *kept)


def _collect(env: RetrievalGuideWrapper[Any, Any], seed: int, steps: int) -> int:
    kept = length = 0
    env.reset(seed=seed)
    for _ in range(steps):
        *_, terminated, truncated, info = env.step(env.disturbed_action())
        length += 1
        if terminated or truncated:
            if info["is_success"] and not info["retrieval"].get("calibrating", False):
                kept += length
            length = 0
            env.reset()
    env.close()
    return kept


def table(results: Sequence[Guided]) -> list[str]:
    """A table in Markdown: one line a result, and means over each disturbance."""
    lines = [
        "| task | demonstration | disturbance | plain | corrected | error, median / 90 % (cm) | "
        "guide, s an episode | calibration, steps |",
        "|---|---|---|---|---|---|---|---|",
        *map(_line, results),
    ]
    for disturbance in dict.fromkeys(r.disturbance for r in results):
        own = [r for r in results if r.disturbance == disturbance]
        rates = [np.mean([np.mean(x) for x in side]) for side in _sides(own)]
        errors = [e for r in own for e in r.errors_cm]
        lines.append(
            f"| **mean** | {len(own)} | {disturbance} | {rates[0]:.2f} | {rates[1]:.2f} | "
            f"{_spread(errors)} | {np.mean([r.seconds for r in own]):.2f} | |"
        )
    return lines + [f"{r.task}, {r.seed}, {r.disturbance}: {r.said}" for r in results if r.said]


def _sides(results: Sequence[Guided]) -> tuple[list[list[bool]], list[list[bool]]]:
    return [r.plain for r in results], [r.corrected for r in results]


def _line(r: Guided) -> str:
    return (
        f"| {r.task} | {r.seed} | {r.disturbance} | {np.mean(r.plain):.2f} | "
        f"{np.mean(r.corrected):.2f} | {_spread(r.errors_cm)} | {r.seconds:.2f} | "
        f"{r.calibration_steps} |"
    )


def _spread(errors: Sequence[float]) -> str:
    if not errors:
        return "-"
    return f"{np.median(errors):.1f} / {np.percentile(errors, 90):.1f}"


def main(name: str, **options: Any) -> None:
    """Measure and print, line by line.

    Args:
        name: "guide" or "success-buffer".
        **options: of `guide` or `success_buffer`.

    Raises:
        ValueError: if an option is none of the table's, or names what does not exist.
    """
    known = {
        "guide": ("tasks", "episodes", "seeds", "disturbances"),
        "success-buffer": ("tasks", "seeds", "steps"),
    }[name]
    for option in options:
        if option not in known:
            raise ValueError(f"--{option} is no option of the table {name!r}: {', '.join(known)}")
    for value in options.get("tasks", ()):
        if _env_id(value) not in gym.registry:
            known_tasks = ", ".join(METAWORLD_TASKS)
            raise ValueError(f"--tasks {value}: choose from {known_tasks}, or an environment's id")
    for value in options.get("disturbances", ()):
        if value not in DISTURBANCES:
            raise ValueError(f"--disturbances {value}: choose from {', '.join(DISTURBANCES)}")
    if "camera" in options.get("disturbances", ()) and any("/" in t for t in options["tasks"]):
        raise ValueError("--disturbances camera: only Meta-World's cameras can be turned")
    for option in ("episodes", "steps"):
        if options.get(option, 1) < 1:
            raise ValueError(f"--{option} {options[option]}: at least 1 is needed")
    if name == "guide":
        results = []
        for result in guide(**options):
            results.append(result)
            print(_line(result), flush=True)
        print("\n" + "\n".join(table(results)))
        return
    print("| task | seed | steps | plain | corrected |\n|---|---|---|---|---|", flush=True)
    collected = []
    for row in success_buffer(**options):
        collected.append(row)
        print(
            f"| {row.task} | {row.seed} | {row.steps} | {row.plain} | {row.corrected} |", flush=True
        )
    means = [np.mean([getattr(row, side) for row in collected]) for side in ("plain", "corrected")]
    print(f"| **mean** | | | {means[0]:.0f} | {means[1]:.0f} |", flush=True)
