"""`regil bench trajectories`: where the hand goes, in demonstration, success buffer and policy.

A run's demonstration, its guided warm-up and its last policy are played again, each path begins at
one point, as in the paper's figure. A path is what the simulator says of the hand (an environment's
``hand_position()``, (3,) m); where it says nothing, the sum of the translations that were executed.
The success buffer itself holds no executed actions: of a guide that is pushed off its way it keeps
what the guide wanted (DART). So its episodes are those of the warm-up, whose guide draws the same
again.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from regil_wrappers import Demonstration
from regil_wrappers.frames import stated
from scipy.spatial.distance import cdist  # type: ignore[import-untyped]
from stable_baselines3.common.vec_env import VecEnv
from tqdm import tqdm

from regil_sb3.bench.buffer_vs_learning import buffer_after_warmup
from regil_sb3.bench.machine import describe
from regil_sb3.bench.page import figure, need_parquet, write
from regil_sb3.bench.replay import check, task_of
from regil_sb3.evaluation import EVALUATION_SEED, evaluate, policy_act
from regil_sb3.guided import executed_actions
from regil_sb3.report.run_contents import RunContents, read_run
from regil_sb3.settings import ALGOS, Settings
from regil_sb3.training import make_env

__all__ = ["SOURCES", "Played", "Trajectory", "main", "played", "table"]

_STEP_S, _LENGTH = 0.015, 100  # seconds of a step, and steps of an episode: for predictions

Points = npt.NDArray[np.float64]

SOURCES = {"success buffer": "#2a9d5c", "policy": "#d1495b", "demonstration": "#1f5fa8"}
"""Whose paths, and their colours (the paper's); what is drawn last lies on top."""


@dataclass(frozen=True)
class Trajectory:
    """The hand's path in an episode.

    Attributes:
        source: of `SOURCES`.
        success: whether the episode succeeded.
        points: (T, D) where the hand is before each of T actions, from where it began.
    """

    source: str
    success: bool
    points: Points


@dataclass(frozen=True)
class Played:
    """All paths of a run.

    Attributes:
        run: its folder.
        task: Meta-World's name, or the environment's id.
        unit: of points: "cm" or "action units".
        simulated: whether the simulator says where the hand is.
        trajectories: the demonstration's one, then the success buffer's, then the policy's.
        kept: transitions that the run's own success buffer held after its warm-up; None where its
            log does not say.
    """

    run: str
    task: str
    unit: str
    simulated: bool
    trajectories: list[Trajectory]
    kept: int | None

    def of(self, source: str) -> list[Trajectory]:
        """Those of one source."""
        return [path for path in self.trajectories if path.source == source]


class _Hands:
    """Follows the hands of some environments, an episode at a time.

    Raises:
        ValueError: the environment says neither where they are nor what moves them.
    """

    def __init__(self, env: VecEnv) -> None:
        facts = stated(env.get_attr("metadata")[0])
        self.env = env
        self.simulated = env.has_attr("hand_position")
        if not self.simulated and "translation_dims" not in facts:
            raise ValueError(
                "its environment says neither where the hand is (hand_position()) nor which parts "
                'of an action move it (metadata["regil"]["translation_dims"])'
            )
        self.dims = list(facts.get("translation_dims", ()))
        self.scale = 100.0 if self.simulated else float(facts.get("step_cm", 1.0))  # hands are in m
        self.unit = "cm" if self.simulated or "step_cm" in facts else "action units"
        self._open: list[list[Any]] = [[] for _ in range(env.num_envs)]

    def before(self, actions: npt.NDArray[Any]) -> None:
        """Note where hands are; (n, A) are to be executed."""
        now = self.env.env_method("hand_position") if self.simulated else actions[:, self.dims]
        for track, place in zip(self._open, now, strict=True):
            track.append(np.array(place, float))

    def end(self, env: int, source: str, success: bool) -> Trajectory:
        """The path of the episode that has ended there."""
        points = np.stack(self._open[env])
        self._open[env] = []
        if not self.simulated:
            points = points.cumsum(axis=0) - points
        return Trajectory(source, success, self.scale * (points - points[0]))


def _demonstration(hands: _Hands, demo: Demonstration) -> Trajectory:
    """Its actions, played where it was recorded."""
    assert demo.actions is not None
    env, success = hands.env, False
    env.seed(int(demo.metadata["seed"]))
    env.reset()
    for action in demo.actions:
        hands.before(action[None])
        _, _, dones, infos = env.step(action[None])
        success |= bool(infos[0].get("is_success", False))
        if dones[0]:
            break
    return hands.end(0, "demonstration", success)


def _warmup(hands: _Hands, seed: int, steps: int) -> Iterator[Trajectory]:
    """A run's guided warm-up; what succeeds without calibrating is what the buffer holds."""
    env = hands.env
    everyone = np.arange(env.num_envs)
    guided, done = np.ones(env.num_envs, bool), 0
    env.seed(seed)
    for _ in range(2):  # as training does: to compare first frames, and to begin
        env.reset()
    succeeded = np.zeros(env.num_envs, bool)
    with tqdm(total=steps, desc="warm-up", unit="step", dynamic_ncols=True) as bar:
        while guided.any():
            actions = executed_actions(env, everyone)
            hands.before(actions)
            _, _, dones, infos = env.step(actions)
            done += env.num_envs
            bar.update(env.num_envs)
            for i, info in enumerate(infos):
                succeeded[i] |= bool(info.get("is_success", False))
                if not dones[i]:
                    continue
                path = hands.end(i, "success buffer", bool(succeeded[i]))
                calibrating = info.get("retrieval", {}).get("calibrating", False)
                if guided[i] and path.success and not calibrating:
                    yield path
                succeeded[i] = False
                guided[i] &= done < steps


def _policy(hands: _Hands, model: Any, episodes: int) -> list[Trajectory]:
    """The last policy's, in the first unseen episodes."""
    act = policy_act(model)
    found: list[Trajectory] = []

    def noted(obs: Any, env: VecEnv, first: bool) -> npt.NDArray[Any]:
        action = act(obs, env, first)
        hands.before(action)
        return action

    with tqdm(total=episodes, desc="policy", unit="episode", dynamic_ncols=True) as bar:

        def ended(result: Any) -> None:
            found.append(hands.end(0, "policy", result.successes[-1]))
            bar.update(1)

        evaluate(noted, hands.env, episodes, EVALUATION_SEED, ended)
    return found


def played(run: RunContents, episodes: int, trust: bool = False) -> Played:
    """Play a run's demonstration, warm-up and policy.

    Args:
        run: of `_checked`.
        episodes: of the policy.
        trust: as in ``regil_sb3.training.evaluate_run``.
    """
    settings = Settings.load(run.folder / "config.yaml", trust)
    demo, demo_file = run.demo, run.folder / "demo.hdf5"
    assert demo is not None
    with closing(make_env(settings, demo_file, n_envs=1)) as env:
        hands = _Hands(env)
        paths = [_demonstration(hands, demo)]
        if settings.warmup_steps:
            with closing(make_env(settings, demo_file)) as guided:
                paths += _warmup(_Hands(guided), settings.seed, settings.warmup_steps)
        model = ALGOS[settings.algo].load(run.folder / "model.zip", trust=trust, buffer_size=1)
        paths += _policy(hands, model, episodes)
    kept = buffer_after_warmup(run, settings.warmup_steps) if settings.warmup_steps else 0
    return Played(str(run.folder), task_of(settings.env), hands.unit, hands.simulated, paths, kept)


def _checked(folder: str, trust: bool) -> RunContents:
    """A run that can be played again.

    Raises:
        ValueError: it cannot, and why.
    """
    run = read_run(folder)
    if not (run.folder / "model.zip").exists():
        raise ValueError(f"--runs {folder}: it has no model.zip yet: train it first")
    if run.demo is None or run.demo.actions is None or "seed" not in run.demo.metadata:
        raise ValueError(
            f"--runs {folder}: its demonstration cannot be played again (demo.hdf5 is missing, or "
            "holds no actions or no seed)"
        )
    settings = Settings.load(run.folder / "config.yaml", trust)
    try:
        with closing(make_env(settings, run.folder / "demo.hdf5", n_envs=1)) as env:
            _Hands(env)
    except ValueError as error:
        raise ValueError(f"--runs {folder}: {error}") from None
    return run


def table(runs: Sequence[Played]) -> list[str]:
    """The table in Markdown: a line for each source of each run; medians over its episodes."""
    lines = [
        "| run | paths of | episodes | successes | steps | length | from the demonstration | "
        "ends apart |",
        "|" + "---|" * 8,
    ]
    for run in runs:
        (demo,) = run.of("demonstration")
        for source in ("demonstration", "success buffer", "policy"):
            paths = run.of(source)
            if not paths:
                lines.append(f"| {run.run} | {source} | 0 | - | - | - | - | - |")
                continue
            lengths = [np.linalg.norm(np.diff(p.points, axis=0), axis=1).sum() for p in paths]
            away = [cdist(p.points, demo.points).min(axis=1).mean() for p in paths]
            ends = np.stack([p.points[-1] for p in paths])
            apart = np.sqrt(((ends - ends.mean(axis=0)) ** 2).sum(axis=1).mean())
            lines.append(
                f"| {run.run} | {source} | {len(paths)} | {sum(p.success for p in paths)} | "
                f"{np.median([len(p.points) for p in paths]):.0f} | {np.median(lengths):.1f} | "
                f"{np.median(away):.1f} | {apart:.1f} |"
            )
    return lines


def _rows(runs: Sequence[Played]) -> Iterator[dict[str, Any]]:
    """A row a point."""
    for run in runs:
        for source in SOURCES:
            for episode, path in enumerate(run.of(source)):
                for step, point in enumerate(path.points):
                    x, y, z = (*point, np.nan, np.nan)[:3]
                    yield {
                        "run": run.run,
                        "source": source,
                        "episode": episode,
                        "step": step,
                        "success": path.success,
                        "x": float(x),
                        "y": float(y),
                        "z": float(z),
                        "unit": run.unit,
                    }


def _draw(runs: Sequence[Played], path: Path) -> None:
    """A row a run: from above, and from the side where there is a third dimension."""
    columns = max(1 + (run.trajectories[0].points.shape[1] > 2) for run in runs)
    with figure(path, len(runs), columns) as axes:
        for run, row in zip(runs, axes, strict=True):
            for axis, (i, j) in zip(row, ((0, 1), (1, 2)), strict=False):
                for source, colour in SOURCES.items():
                    for n, track in enumerate(run.of(source)):
                        axis.plot(
                            track.points[:, i],
                            track.points[:, j],
                            color=colour,
                            linewidth=2.2 if source == "demonstration" else 0.8,
                            linestyle="-" if track.success else ":",
                            label="" if n else source,
                        )
                axis.set_xlabel(f"{'xyz'[i]} ({run.unit})")
                axis.set_ylabel(f"{'xyz'[j]} ({run.unit})")
                axis.set_aspect("equal", adjustable="datalim")
            row[0].set_title(run.task, fontsize=10)
            row[0].legend(fontsize=8)


def _how(run: Played) -> str:
    whence = "where the simulator has it" if run.simulated else "sum of executed translations"
    again = sum(len(path.points) for path in run.of("success buffer"))
    own = "its log does not say" if run.kept is None else f"the run itself had kept {run.kept}"
    return (
        f"{run.run}: {run.task}, hand {whence}, {run.unit}; {again} transitions of successful "
        f"guided episodes in the warm-up played again, {own}."
    )


def main(
    runs: Sequence[str] = (),
    out: str = "bench",
    episodes: int = 10,
    dry_run: bool = False,
    trust: bool = False,
) -> None:
    """Play runs again, and print the table.

    Args:
        runs: folders that `regil train` or `regil bench` wrote.
        out: folder of ``trajectories.md``, ``.tex``, ``.parquet`` (a row a point) and ``.png``.
        episodes: of the policy, the first unseen ones.
        dry_run: print the runs and the predicted hours, and play none.
        trust: whether configs and models may name anything, and so run code (`regil evaluate`).

    Raises:
        ValueError: there is no run, or one cannot be played again.
        ImportError: pyarrow is not installed.
    """
    name = "trajectories"
    if not runs:
        raise ValueError("--runs is missing: name a run that has ended")
    check((), (), episodes=episodes)
    contents = [_checked(run, trust) for run in runs]
    if dry_run:
        warmups = [
            Settings.load(run.folder / "config.yaml", trust).warmup_steps for run in contents
        ]
        hours = _STEP_S * sum(warmup + episodes * _LENGTH for warmup in warmups) / 3600
        print("\n".join(str(run.folder) for run in contents))
        print(f"{len(contents)} runs to play: about {hours:.2f} hours, one after the other")
        return
    need_parquet(name)
    begun = time.perf_counter()
    found = [played(run, episodes, trust) for run in contents]
    minutes = (time.perf_counter() - begun) / 60
    lines = table(found)
    packages = ("gymnasium", "metaworld", "mujoco", "numpy", "torch", "regil-sb3")
    below = (
        "Paths begin at one point. Length, mean distance to the nearest point of the "
        "demonstration's path (both medians over episodes), and root mean square distance of the "
        f"ends from their mean. {' '.join(map(_how, found))} Policy: seeds from {EVALUATION_SEED}. "
        f"{minutes:.1f} minutes; {describe(packages)}"
    )
    folder = Path(out)
    options = {"runs": runs, "episodes": episodes, **({"trust": True} if trust else {})}
    write(folder, name, options, lines, below, list(_rows(found)))
    _draw(found, folder / f"{name}.png")
    print("\n".join([*lines, "", below]))
