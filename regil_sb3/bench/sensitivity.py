"""`regil bench sensitivity`: how much does plain guided replay depend on H, k and the encoder?

One of them is varied at a time, the others are as in the preset ``plain``. The paper's figures
stand beside ours; that they are of plain replay, too, is inferred.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import gymnasium as gym
from regil_wrappers import RetrievalGuideWrapper
from regil_wrappers.encoders import make_encoder
from regil_wrappers.encoders.weights import MissingWeightsError

from regil_sb3.bench.cells import Cell, below, finish, rows
from regil_sb3.bench.page import need_parquet, said, write
from regil_sb3.bench.replay import (
    TASKS,
    benchmark,
    check,
    demonstration,
    env_id,
    env_kwargs,
    guides,
    play,
    task_of,
)
from regil_sb3.envs import EVALUATION_SEEDS
from regil_sb3.intervals import wilson

__all__ = ["Planned", "main", "planned", "successes", "table"]

Planned: TypeAlias = dict[tuple[str, Any], list[Cell] | str]
"""By what is varied, and its value: what it is measured from, or why it cannot be."""

_EPISODE_S, _NETWORK_S = 1.5, 6.0  # seconds an episode, with pixels and with a network


def planned(
    out: str = "bench",
    tasks: Sequence[str] = TASKS,
    seeds: Sequence[int] = (0, 1),
    episodes: int = 50,
    encoders: Sequence[str] | None = None,
    each_task: bool = False,
) -> Planned:
    """What is to be measured.

    Goals are the first of those that evaluations use, as many of each task, one more of the first
    tasks where they do not divide; a task's demonstrations take turns.

    Args:
        out: folder in which cells are kept.
        tasks: Meta-World's names, or ids of environments with a scripted expert.
        seeds: first seeds tried for the demonstrations; each gives one of each task.
        episodes: of each line of the table, all tasks together.
        encoders: names of encoders; None: those of ``zoo_configs/tables.yml``.
        each_task: whether there are so many of each task instead.

    Raises:
        ValueError: an option cannot be measured.
    """
    check(tasks, seeds, episodes=episodes)
    if episodes < len(tasks) and not each_task:
        raise ValueError(f"--episodes {episodes}: at least {len(tasks)}, one a task, are needed")
    plain = guides()["plain"]
    values: dict[str, Sequence[Any]] = dict(said()["sensitivity"])
    values["encoder"] = encoders or values["encoder"]
    keys, missing = _encoders({plain["encoder"], *values["encoder"]})
    total = episodes * len(tasks) if each_task else episodes
    shares = [total // len(tasks) + (i < total % len(tasks)) for i in range(len(tasks))]
    plan: Planned = {}
    for varied, choices in values.items():
        for value in choices:
            guide = {**plain, varied: value}
            if guide["encoder"] in missing:
                plan[varied, value] = missing[guide["encoder"]]
                continue
            plan[varied, value] = [
                _cell(Path(out) / "cells", task, seed, goals, guide, keys[guide["encoder"]])
                for task, share in zip(tasks, shares, strict=True)
                for i, seed in enumerate(seeds)
                if (goals := [EVALUATION_SEEDS + goal for goal in range(i, share, len(seeds))])
            ]
    return plan


def _encoders(names: set[str]) -> tuple[dict[str, str | None], dict[str, str]]:
    """What decides the embeddings of those that are here, and why the others are not."""
    keys, missing = {}, {}
    for name in sorted(names):
        try:
            keys[name] = getattr(make_encoder(name), "cache_key", None)
        except (ImportError, MissingWeightsError) as error:
            missing[name] = str(error)
        except ValueError as error:
            raise ValueError(f"--encoders: {error}") from None
    return keys, missing


def _cell(
    folder: Path,
    task: str,
    seed: int,
    goals: Sequence[int],
    guide: Mapping[str, Any],
    encoder: str | None,
) -> Cell:
    network = getattr(make_encoder(guide["encoder"]), "frame_size", None) is not None
    asked = {
        "measured": "successes of guided replay",
        "env": env_id(task),
        "env_kwargs": env_kwargs(task),
        "seed": seed,
        "goals": goals,
        "guide": guide,
        "encoder": encoder,
    }
    return Cell(
        folder,
        asked,
        partial(successes, task, seed, goals, guide),
        len(goals) * (_NETWORK_S if network else _EPISODE_S),
    )


def successes(
    task: str, seed: int, goals: Sequence[int], guide: Mapping[str, Any]
) -> dict[str, list[bool]]:
    """Follow a guide to some goals.

    Args:
        task: of `regil_sb3.bench.replay.env_id`.
        seed: the demonstration's.
        goals: seeds of episodes.
        guide: arguments of `RetrievalGuideWrapper`.
    """
    demo = demonstration(task, seed, guide["encoder"])
    env = RetrievalGuideWrapper(gym.make(env_id(task), **env_kwargs(task)), demo, **guide)
    try:
        return {"successes": [play(env, goal) for goal in goals]}
    finally:
        env.close()


def table(plan: Planned, each_task: bool = False) -> list[str]:
    """The table in Markdown: a line a value; its cells are kept, but for those that cannot be.

    The paper's figures are of Meta-World and of LIBERO; beside tasks of both there are none.

    Args:
        plan: of `planned`.
        each_task: whether each task has a column of its own, too.
    """
    defaults = guides()["plain"]
    measured = [cells for cells in plan.values() if not isinstance(cells, str)]
    tasks = list(dict.fromkeys(task_of(c.asked["env"]) for cells in measured for c in cells))
    paper = said()["paper"]["sensitivity"].get(benchmark(tasks), {})
    columns = ["varied", "value", "success (95 %)", "episodes", "paper", *(tasks * each_task)]
    lines = [f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
    for (varied, value), cells in plan.items():
        shown = f"{value} (default)" if defaults[varied] == value else str(value)
        by_task: dict[str, list[bool]] = {task: [] for task in tasks}
        if isinstance(cells, str):
            ours = [cells.partition(" (")[0], "-"]  # the rest is for who wants to get it
        else:
            for cell in cells:
                by_task[task_of(cell.asked["env"])] += cell.found["successes"]
            outcomes = [outcome for own in by_task.values() for outcome in own]
            ours = [_rate(outcomes), str(len(outcomes))]
        theirs = paper.get(varied, {}).get(value, "-")
        rates = [_rate(own) for own in by_task.values()] * each_task
        lines.append(f"| {' | '.join([varied, shown, *ours, str(theirs), *rates])} |")
    return lines


def _rate(outcomes: Sequence[bool]) -> str:
    if not outcomes:
        return "-"
    low, high = (bound / 100 for bound in wilson(sum(outcomes), len(outcomes)))
    return f"{sum(outcomes) / len(outcomes):.2f} ({low:.2f} to {high:.2f})"


def main(
    out: str = "bench",
    dry_run: bool = False,
    tasks: Sequence[str] = TASKS,
    seeds: Sequence[int] = (0, 1),
    episodes: int = 50,
    encoders: Sequence[str] | None = None,
    each_task: bool = False,
) -> None:
    """Measure what is not kept, and print the table.

    Args:
        out: folder of kept cells, and of ``sensitivity.md``, ``.tex`` and ``.parquet``.
        dry_run: print the cells and the predicted hours, and measure none.
        tasks: as for `planned`.
        seeds: likewise.
        episodes: likewise.
        encoders: likewise.
        each_task: likewise.

    Raises:
        ValueError: an option cannot be measured.
        ImportError: pyarrow is not installed.
    """
    plan = planned(out, tasks, seeds, episodes, encoders, each_task)
    cells = [cell for found in plan.values() if not isinstance(found, str) for cell in found]
    # what shares a demonstration is measured in a row
    cells.sort(key=lambda c: (c.asked["env"], c.asked["seed"], c.asked["guide"]["encoder"]))
    if dry_run:
        finish(cells, dry_run)
        for (varied, value), why in plan.items():
            if isinstance(why, str):
                print(f"{varied} {value}: {why}")
        return
    need_parquet("sensitivity")
    finish(cells)
    lines = table(plan, each_task)
    defaults = ", ".join(f"{name} {guides()['plain'][name]}" for name in said()["sensitivity"])
    spread = (
        f"Plain guided replay; one parameter varied about {defaults}; {episodes} unseen goals a "
        f"{'task and line' if each_task else 'line, spread evenly'} over {', '.join(tasks)}; "
        f"Wilson's interval. {below(cells)}"
    )
    options: dict[str, Any] = {"tasks": tasks, "seeds": seeds, "episodes": episodes}
    options |= {"encoders": encoders} if encoders else {}
    options |= {"each_task": True} if each_task else {}
    write(Path(out), "sensitivity", options, lines, spread, rows(cells))
    print("\n".join([*lines, "", spread]))
