"""`regil bench ranking`: does a reward put a success above a failure and above standing still?

For the paper's seven Meta-World tasks, one demonstration each, and goals where replaying it blindly
fails: an episode of the scripted expert, the failed replay, and standing still, each until the
environment ends it. Nothing learns.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from regil_wrappers import Demonstration, Retriever
from regil_wrappers.registration import moved_back, register
from regil_wrappers.reward_signals import AT_EPISODE_END, make_signal

import regil_sb3  # registers the environments  # noqa: F401
from regil_sb3.bench.replay import TASKS
from regil_sb3.recording import EVALUATION_SEEDS, record_expert

__all__ = ["EPISODES", "REWARDS", "Return", "draw", "main", "ranking", "table"]

REWARDS = (
    ("sdtw", False),
    ("sdtw", True),
    ("progress", False),
    ("progress", True),
    ("cos", False),
    ("orca", False),
    ("pwil", False),
    ("ot", False),
    ("tot", False),
)
"""(reward, whether pictures are registered)."""
EPISODES = ("success", "failed replay", "standing still")

Frames = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Return:
    """What one reward gives one episode.

    Attributes:
        task: of `TASKS`.
        goal: seed of the episode.
        reward: its name, "registered" behind it where pictures are.
        episode: of `EPISODES`.
        total: undiscounted sum of the rewards, unscaled.
        mean: what length does not change: the mean reward of a step; for "ot" and "tot", whose
            rewards hold a step's share of the whole, the sum.
    """

    task: str
    goal: int
    reward: str
    episode: str
    total: float
    mean: float


def ranking(tasks: Sequence[str] = TASKS, goals: int = 3) -> list[Return]:
    """Play and reward all episodes.

    Args:
        tasks: Meta-World's names.
        goals: how many goals of each, the first seeds at which the expert succeeds and the replay
            fails.
    """
    results = []
    for task in tasks:
        env_id = f"regil/metaworld-{task}-v0"
        demo = record_expert(env_id)
        for goal, episodes in _episodes(env_id, demo, goals):
            for name, registered in REWARDS:
                retriever = Retriever(demo)
                label = f"{name} registered" if registered else name
                reference = demo.frames[0] if registered else None
                for episode, frames in zip(EPISODES, episodes, strict=True):
                    rewards = episode_rewards(name, retriever, frames, reference)
                    total = float(rewards.sum())
                    mean = total if name in AT_EPISODE_END else total / len(rewards)
                    results.append(Return(task, goal, label, episode, total, mean))
    return results


def _episodes(
    env_id: str, demo: Demonstration, goals: int
) -> Iterator[tuple[int, tuple[Frames, Frames, Frames]]]:
    assert demo.actions is not None
    actions, idle = demo.actions, np.zeros_like(demo.actions[:1])
    env = gym.make(env_id)
    found = 0
    try:
        for seed in range(int(demo.metadata["seed"]) + 1, EVALUATION_SEEDS):
            success, solved = _play(env, seed, None)
            failure, replayed = _play(env, seed, actions)
            if solved and not replayed:
                yield seed, (success, failure, _play(env, seed, idle)[0])
                found += 1
            if found == goals:
                return
    finally:
        env.close()


def _play(
    env: gym.Env[Any, Any], seed: int, actions: npt.NDArray[np.float32] | None
) -> tuple[Frames, bool]:
    """An episode's frames and whether it succeeded; the last action repeats; None: the expert's."""
    ours: Any = env.unwrapped
    frame, _ = env.reset(seed=seed)
    frames, over, info = [frame], False, {"is_success": False}
    while not over:
        if actions is None:
            action = ours.expert_action()
        else:
            action = actions[min(len(frames) - 1, len(actions) - 1)]
        frame, _, terminated, truncated, info = env.step(action)
        frames.append(frame)
        over = terminated or truncated
    return np.stack(frames), bool(info["is_success"])


def episode_rewards(
    name: str, retriever: Retriever, frames: Frames, reference: Frames | None = None
) -> npt.NDArray[np.float64]:
    """(steps,) float64: the rewards of an episode's frames (steps + 1, H, W, 3).

    With a reference, the demonstration's first frame, they are registered with it.
    """
    if reference is not None:
        moved = register(reference, frames[0])
        frames = np.stack([moved_back(frame, moved) for frame in frames])
    signal = make_signal(name, retriever)
    retriever.reset()
    retriever.step(frames[0])
    signal.begin()
    steps = []
    for frame in frames[1:]:
        retriever.step(frame)
        steps.append(signal.step())
    late = signal.end()
    return np.array(steps) if late is None else late


def table(results: Sequence[Return]) -> list[str]:
    """Lines of two tables in Markdown: who ranks the success first, and the returns behind it."""
    tasks = list(dict.fromkeys(r.task for r in results))
    names = list(dict.fromkeys(r.reward for r in results))
    goals = len({(r.task, r.goal) for r in results})
    lines = [
        f"Goals of {goals} at which the success is above both others, by return (by mean step):",
        "",
        f"| reward | {' | '.join(tasks)} | all |",
        "|---" * (len(tasks) + 2) + "|",
    ]
    for name in names:
        cells, all_by_total, all_by_mean = [], 0, 0
        for task in tasks:
            here = [r for r in results if r.task == task and r.reward == name]
            by_total, by_mean = _first(here, "total"), _first(here, "mean")
            all_by_total, all_by_mean = all_by_total + by_total, all_by_mean + by_mean
            cells.append(f"{by_total} ({by_mean})")
        lines.append(f"| {name} | {' | '.join(cells)} | {all_by_total} ({all_by_mean}) |")
    lines += [
        "",
        "Mean return of success / failed replay / standing still:",
        "",
        f"| reward | {' | '.join(tasks)} |",
        "|---" * (len(tasks) + 1) + "|",
    ]
    for name in names:
        cells = []
        for task in tasks:
            here = [r for r in results if r.task == task and r.reward == name]
            values = [np.mean([r.total for r in here if r.episode == e]) for e in EPISODES]
            cells.append(" / ".join(f"{value:.3g}" for value in values))
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def _first(results: Sequence[Return], by: str) -> int:
    """At how many goals of a task the success is above both others."""
    count = 0
    for goal in {r.goal for r in results}:
        values = {r.episode: getattr(r, by) for r in results if r.goal == goal}
        count += values["success"] > max(values["failed replay"], values["standing still"])
    return count


def draw(results: Sequence[Return], path: Path) -> None:
    """Draw the mean reward of a step, one panel for each reward, as a picture file."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    tasks = list(dict.fromkeys(r.task for r in results))
    names = list(dict.fromkeys(r.reward for r in results))
    figure, axes = plt.subplots(3, 3, figsize=(11, 8), sharex=True, layout="constrained")
    for axis, name in zip(axes.flat, names, strict=False):
        for k, (episode, colour) in enumerate(zip(EPISODES, _COLOURS, strict=True)):
            heights = [
                np.mean([r.mean for r in results if (r.task, r.reward, r.episode) == key])
                for key in ((task, name, episode) for task in tasks)
            ]
            axis.bar(
                np.arange(len(tasks)) + (k - 1) / 4, heights, 1 / 4, label=episode, color=colour
            )
        axis.set_title(name, fontsize=10)
        axis.axhline(0, color="0.3", linewidth=0.6)
        axis.set_xticks(range(len(tasks)), tasks, rotation=60, ha="right", fontsize=8)
        axis.tick_params(axis="y", labelsize=8)
    axes[0, 0].legend(fontsize=8)
    figure.supylabel("mean reward of a step (ot, tot: sum of the episode)", fontsize=9)
    figure.savefig(path, dpi=100)
    plt.close(figure)


_COLOURS = ("#2a9d5c", "#d1495b", "#9aa0a6")


def main(path: Path = Path("ranking.png")) -> list[Return]:
    """Print the tables and draw the picture.

    Args:
        path: file of the picture.
    """
    results = ranking()
    print("\n".join(table(results)))
    draw(results, path)
    print(f"\npicture: {path}")
    return results
