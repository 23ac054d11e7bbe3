"""Whether a demonstration's pictures and actions are those of an environment, before it acts.

* ``check_recorded`` - camera, render settings, action repeat and rate, as far as they are stated
* ``check_pictures`` - which way up, colours
* ``check_scene`` - its first picture among those of fresh episodes
* ``check_actions`` - their size, limits and scale
* ``check_motion`` - idle frames, and far-apart parts that look alike
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from regil_wrappers import Demonstration
from regil_wrappers.alignment import squared_distances
from regil_wrappers.frames import AS_RECORDED, FrameSource, check_recorded_settings, stated
from regil_wrappers.guide_arguments import fitting_actions
from regil_wrappers.registration import register
from regil_wrappers.rewards import arc_length

from regil_sb3.doctor.findings import Finding, Picture

__all__ = [
    "check_actions",
    "check_motion",
    "check_pictures",
    "check_recorded",
    "check_scene",
    "is_idle",
]

_LABEL = "the demonstration"

# A first picture whose nearest fresh one is farther off than fresh ones are from their nearest
# ("far", as a multiple) may still be of the same scene with the target at another place.
_EXPLAINED = 0.65  # share of the difference that may be left when what moved is moved back
_FAR, _TOO_FAR = 1.5, 2.0  # unexplained, and whatever explains it
_REGISTERED = 4  # of the nearest fresh pictures are registered, at 0.1 s each

_TINY = 0.05  # of what the space allows
_CLIPPED = 0.9  # of the steps
_STILL = 0.1  # of a fast step (90th percentile): a step that shows less moves nothing
_IDLE_START = 5  # frames
_IDLE_INSIDE = 0.2  # of the frames
_GRIPS = 15  # steps from a gripper's command until it holds; robosuite's take 13
_APART = 0.2  # of the demonstration's way
_ALIKE = 0.05  # of the frames
_COMPARED = 2_000  # frames, at most, each with each
_OTHERWISE = 0.5  # of what the space allows: actions that differ by more are others


def check_recorded(env: gym.Env[Any, Any], demo: Demonstration) -> list[Finding]:
    """Whether the demonstration was recorded as the environment says of itself that it is.

    Camera, render settings, action repeat and actions a second; what either does not state passes.
    """
    found = []
    for name in AS_RECORDED:
        one = {**dict.fromkeys(AS_RECORDED), name: demo.metadata[name]}
        try:
            check_recorded_settings(env, one, _LABEL)
        except ValueError as error:
            found.append(Finding(name.replace("_", " "), "wrong", str(error)))
    rate, here = demo.metadata["control_rate"], stated(env.unwrapped.metadata).get("control_rate")
    if rate is not None and here is not None and not np.isclose(rate, here):
        line = f"recorded at {rate:g} actions a second, and the environment takes {here:g}"
        found.append(Finding("frame rate", "wrong", f"{line}: record it at the environment's"))
    return found


def check_pictures(
    env: gym.Env[Any, Any], source: FrameSource, seeds: Sequence[int]
) -> tuple[Finding, list[Picture]]:
    """Whether fresh episodes' first pictures are the right way up, and their colours in order.

    Args:
        env: without retrieval wrappers.
        source: where its pictures come from.
        seeds: of the fresh episodes, one or more.

    Returns:
        the finding, and the first pictures, (H, W, 3) uint8; none where they do not compare.
    """
    firsts: list[Picture] = []
    refused: list[str] = []
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        raw = source.raw(observation)
        try:
            firsts.append(source.another().picture(raw).copy())
        except ValueError as error:
            refused.append(str(error))
            last = np.array(raw)
    if 2 * len(refused) <= len(seeds):
        height, width = firsts[0].shape[:2]
        line = f"{height}x{width}, upright, not mirrored, red is red"
        return Finding("pictures", "ok", line), firsts
    shown = [("demonstration", source.recorded_first)]
    if last.shape == source.recorded_first.shape:
        shown.append(("environment", last))
    colours = "exchanged" in refused[-1]
    cure = "frames[..., ::-1] exchanges colours" if colours else "regil convert --flip turns them"
    line = f"{refused[-1]} ({cure})"
    return Finding("pictures", "wrong", line, shown), []


def check_scene(
    demo: Demonstration,
    recorded_first: Picture,
    firsts: Sequence[Picture],
    embedded: npt.NDArray[np.float32],
    fresh: npt.NDArray[np.float32],
    env_id: str,
) -> list[Finding]:
    """Whether the demonstration begins where the environment's episodes do.

    Args:
        demo: the demonstration.
        recorded_first: its first picture, (H, W, 3) uint8.
        firsts: the same of fresh episodes, two or more.
        embedded: (N, D) float32, of the demonstration's frames.
        fresh: (episodes, D) float32, of the fresh first pictures.
        env_id: the environment's.
    """
    found = []
    recorded = demo.metadata["env_id"]
    if recorded not in (None, env_id):
        line = f"it was recorded in {recorded!r}: is {env_id!r} the same task and scene?"
        found.append(Finding("task", "warning", line))
    to_fresh = np.sqrt(squared_distances(embedded[0], fresh))
    between = np.sqrt(squared_distances(fresh, fresh))
    np.fill_diagonal(between, np.inf)
    steps = _steps(embedded)
    step = float(np.median(steps[steps > 0])) if steps.any() else 0.0
    spread = max(float(between.min(axis=1).max()), step)
    far = float(to_fresh.min()) / max(spread, 1e-9)
    nearest = np.argsort(to_fresh)[:_REGISTERED]
    moved = [register(recorded_first, firsts[i]) for i in nearest]
    left = min(0.0 if m is None else m.ratio for m in moved)
    cameras = [m.camera for m in moved if m is not None and any(m.camera)]
    distance = (
        f"its first picture is {to_fresh.min():.2g} from the nearest of {len(fresh)} fresh ones, "
        f"which are up to {spread:.2g} from their nearest"
    )
    shown = [("demonstration", recorded_first), ("nearest fresh episode", firsts[nearest[0]])]
    elsewhere = [m.changed for m in moved if m is not None and m.another_scene]
    if far > 1 and len(elsewhere) == len(moved):
        line = f"{distance}; {min(elsewhere):.0%} of the pixels differ: another camera or scene"
        found.append(Finding("scene", "wrong", f"{line}, record it with this one", shown))
    elif 2 * len(cameras) > len(moved) and left <= _EXPLAINED:
        x, y = np.median(cameras, axis=0)
        line = (
            f"the camera has moved since: what stands still is shifted by ({x:.1f}, {y:.1f}) "
            "pixels; register=true takes that out, moving the camera back is better"
        )
        found.append(Finding("scene", "warning", line, shown))
    elif far > 1 and (left > _EXPLAINED or far > _TOO_FAR):
        line = (
            f"{distance}; one thing that moved explains {1 - left:.0%} of what differs: another "
            "task, camera or arm pose? Record it in this environment"
        )
        found.append(Finding("scene", "wrong" if far > _FAR else "warning", line, shown))
    else:
        found.append(Finding("scene", "ok", distance, shown))
    return found


def check_actions(demo: Demonstration, space: gym.Space[Any]) -> list[Finding]:
    """Whether the actions can be executed, and are of the size that the environment expects."""
    if demo.actions is None:
        line = (
            "it has none: it can reward, but not guide, and TD3BC cannot clone it: regil train "
            "learns from the reward alone"
        )
        return [Finding("actions", "warning", line)]
    try:
        fitting_actions(space, [demo], demo)
    except ValueError as error:
        return [Finding("actions", "wrong", str(error))]
    assert isinstance(space, gym.spaces.Box)
    found = []
    for key, here in (("action_low", space.low), ("action_high", space.high)):
        said = demo.metadata[key]
        if said is not None and not np.allclose(said, here):
            line = (
                f"recorded where {key} was {_numbers(said)}, and the environment has "
                f"{_numbers(here)}: are they in the same unit?"
            )
            found.append(Finding("actions", "warning", line))
    limit = np.maximum(np.maximum(-space.low, space.high), 1e-9)
    used = np.abs(demo.actions) / limit
    bounded = used[:, np.isfinite(limit)]
    if bounded.size and bounded.max() < _TINY:
        line = (
            f"they use {used.max():.1%} of what the environment takes: another unit? Store them "
            "in the environment's own"
        )
        found.append(Finding("actions", "warning", line))
    held = np.ptp(demo.actions, axis=0) == 0  # a gripper that never moves says nothing
    clipped = (used[:, ~held] > 0.999).mean(axis=0) if not held.all() else np.zeros(1)
    if clipped.min() > _CLIPPED:
        line = (
            f"every dimension is at its limit in over {_CLIPPED:.0%} of the steps: were larger "
            "actions cut off? Store what was executed"
        )
        found.append(Finding("actions", "warning", line))
    if not found:
        line = (
            f"{demo.actions.shape[1]} dimensions, up to {used.max():.0%} of what is taken, "
            f"{float(clipped.max()):.0%} of the steps at a limit"
        )
        found.append(Finding("actions", "ok", line))
    return found


def is_idle(embedded: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """(N - 1,) bool: the steps of a demonstration, embedded (N, D), in which nothing moves."""
    steps = _steps(embedded)
    idle: npt.NDArray[np.bool_] = steps <= _STILL * np.percentile(steps[steps > 0], 90)
    return idle


def _grips(actions: npt.NDArray[np.float32], gripper: int) -> npt.NDArray[np.bool_]:
    """(N - 1,) bool: the steps in which the gripper may still close or open."""
    switched = np.flatnonzero(np.diff(np.sign(actions[:, gripper]))) + 1
    steps = np.arange(len(actions))[:, None] - switched
    return np.asarray(((steps >= 0) & (steps < _GRIPS)).any(axis=1), bool)


def check_motion(
    demo: Demonstration,
    embedded: npt.NDArray[np.float32],
    horizon: int,
    space: gym.Space[Any],
    gripper: int | None = None,
) -> list[Finding]:
    """Idle frames at the start and inside, and moments that look alike but are not near.

    Args:
        demo: the demonstration.
        embedded: (N, D) float32, of its frames.
        horizon: H: so many frames before are compared too, as in retrieval.
        space: of actions.
        gripper: the dimension that moves it: while it closes or opens, waiting is no idleness.
    """
    steps = _steps(embedded)
    if not steps.any():
        line = "its frames are all the same: record one that moves"
        return [Finding("idle frames", "wrong", line)]
    idle = is_idle(embedded)
    start = int(np.argmin(idle))
    end = int(np.argmin(idle[::-1]))
    inside = int(idle.sum()) - start - end
    n = len(embedded)
    where = f"{start} at the start, {inside} inside, {end} at the end, of {n}"
    if gripper is not None and demo.actions is not None and demo.actions.shape[1:] == space.shape:
        within = slice(start, len(idle) - end)
        gripped = int((idle & _grips(demo.actions[: n - 1], gripper))[within].sum())
        inside -= gripped  # it has to wait then
        where += f" ({gripped} of them while the gripper moves)" if gripped else ""
    if start >= _IDLE_START:
        line = (
            f"{where}: nothing moves in the first {start} steps, which teach to stand still: "
            f"cut them off (frames[{start}:], actions[{start}:])"
        )
        motion = Finding("idle frames", "warning", line)
    elif inside > _IDLE_INSIDE * n:
        line = f"{where}: it waits for long; record it again without, or set guide_patience=5"
        motion = Finding("idle frames", "warning", line)
    else:
        motion = Finding("idle frames", "ok", where)
    return [motion, _ambiguous(demo, embedded, horizon, space)]


def _ambiguous(
    demo: Demonstration, embedded: npt.NDArray[np.float32], horizon: int, space: gym.Space[Any]
) -> Finding:
    """Moments whose last frames look like others far along the way."""
    every = -(-len(embedded) // _COMPARED)
    embedded = embedded[::every]
    n = len(embedded)
    way = arc_length(embedded)
    squares = squared_distances(embedded, embedded)
    window = min(horizon + 1, n)
    recent = np.zeros((n - window + 1,) * 2)
    for i in range(window):
        recent += squares[i : n - window + 1 + i, i : n - window + 1 + i]
    apart = np.abs(way[window - 1 :, None] - way[None, window - 1 :]) > _APART
    # Alike: no farther than frames are that follow each other
    steps = _steps(embedded)
    alike: npt.NDArray[np.bool_] = apart & (
        recent <= window * float(np.median(steps[steps > 0])) ** 2
    )
    some = np.asarray(alike.any(axis=1))
    if some.mean() <= _ALIKE:
        line = f"{int(some.sum())} of {len(some)} moments look like one far along the way"
        return Finding("ambiguous frames", "ok", line)
    closest = divmod(int(np.where(alike, recent, np.inf).argmin()), len(recent))
    first, second = sorted(every * (k + window - 1) for k in closest)
    does = "" if demo.actions is None else _does(demo.actions, first, second, space)
    line = (
        f"{int(some.sum())} of {len(some)} moments look like one far along the way, as frames "
        f"{first} and {second} do{does}: reward and guide may take one for the other; a larger "
        "horizon or another encoder or camera may tell them apart"
    )
    shown = [(f"frame {k}", demo.frames[k]) for k in (first, second)]
    return Finding("ambiguous frames", "warning", line, shown)


def _does(actions: npt.NDArray[np.float32], first: int, second: int, space: gym.Space[Any]) -> str:
    if not isinstance(space, gym.spaces.Box) or actions.shape[1:] != space.shape:
        return ""  # another finding says that these do not fit
    a, b = (actions[min(k, len(actions) - 1)] for k in (first, second))
    same = (np.abs(a - b) <= _OTHERWISE * (space.high - space.low) / 2).all()
    return ", with much the same action" if same else ", with different actions"


def _steps(embedded: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """(N - 1,) float64: how far each step goes."""
    pairs = pairwise(embedded)
    return np.sqrt([squared_distances(y, later[None])[0] for y, later in pairs])


def _numbers(values: Any) -> str:
    return "[" + ", ".join(f"{v:g}" for v in values) + "]"
