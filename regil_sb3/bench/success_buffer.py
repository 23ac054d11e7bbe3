"""`regil bench success-buffer`: what does a guided warm-up leave in the success buffer?

Of each guide that exists, mean and standard deviation over seeds beside the paper's. Nothing
learns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from regil_wrappers import RetrievalGuideWrapper

from regil_sb3.bench.cells import Cell, below, finish, rows
from regil_sb3.bench.page import need_parquet, said, write
from regil_sb3.bench.replay import (
    TASKS,
    check,
    demonstration,
    env_id,
    env_kwargs,
    guides,
    task_of,
)

__all__ = ["Planned", "collected", "main", "planned", "table"]

Planned = dict[tuple[str, str], list[Cell]]
"""By task and guide: a cell for each seed."""

_STEP_S = 0.02


def planned(
    out: str = "bench",
    tasks: Sequence[str] = TASKS,
    seeds: Sequence[int] = (0,),
    steps: int = 5_000,
) -> Planned:
    """What is to be measured.

    Args:
        out: folder in which cells are kept.
        tasks: Meta-World's names, or ids of environments with a scripted expert.
        seeds: of demonstration and episodes.
        steps: agent steps of the warm-up, calibration included.

    Raises:
        ValueError: an option cannot be measured.
    """
    check(tasks, seeds, steps=steps)
    plan: Planned = {(task, guide): [] for task in tasks for guide in guides()}
    for task in tasks:
        for seed in seeds:  # what shares a demonstration is measured in a row
            for name, guide in guides().items():
                asked = {
                    "measured": "success buffer of a guided warm-up, begun at another goal",
                    "env": env_id(task),
                    "env_kwargs": env_kwargs(task),
                    "seed": seed,
                    "steps": steps,
                    "guide": guide,
                }
                measure = partial(collected, task, seed, steps, guide)
                cell = Cell(Path(out) / "cells", asked, measure, steps * _STEP_S)
                plan[task, name].append(cell)
    return plan


def collected(task: str, seed: int, steps: int, guide: Mapping[str, Any]) -> dict[str, int]:
    """Count transitions of whole successful episodes in a guided warm-up.

    Episodes that hold calibration moves count as none, and the demonstration itself is left out.
    The corrected guide is pushed off its way now and then, as in training.

    Args:
        task: of `regil_sb3.bench.replay.env_id`.
        seed: of demonstration and episodes.
        steps: agent steps, calibration included.
        guide: arguments of `RetrievalGuideWrapper`.

    Returns:
        ``transitions``; and ``episodes`` that ended, of which ``successes`` are kept.
    """
    demo = demonstration(task, seed)
    env = RetrievalGuideWrapper(gym.make(env_id(task), **env_kwargs(task)), demo, **guide)
    found = {"transitions": 0, "episodes": 0, "successes": 0}
    length, success = 0, False
    env.reset(seed=seed)  # the goal of the demonstration, which would be replayed
    env.reset()  # as training does
    for _ in range(steps):
        *_, terminated, truncated, info = env.step(env.disturbed_action())
        length += 1
        success |= bool(info.get("is_success", False))
        if terminated or truncated:
            found["episodes"] += 1
            if success and not info["retrieval"].get("calibrating", False):
                found["transitions"] += length
                found["successes"] += 1
            length, success = 0, False
            env.reset()
    env.close()
    return found


def table(plan: Planned) -> list[str]:
    """The table in Markdown: a line a task, a column a guide, and the mean over tasks.

    Mean and standard deviation over seeds (over n - 1; one seed has none) of cells that are kept.
    The paper's are of warm-ups of 5,000 steps, LIBERO's of 20,000; beside others there are none.
    """
    tasks, names = (list(dict.fromkeys(key[i] for key in plan)) for i in range(2))
    (steps,) = {cell.asked["steps"] for cells in plan.values() for cell in cells}
    paper: dict[str, list[float]] = said()["paper"]["success-buffer"].get(steps, {})
    lines = [f"| task | {' | '.join(names)} | paper |", "|" + "---|" * (len(names) + 2)]
    means: dict[str, list[float]] = {name: [] for name in [*names, "paper"]}
    for task in tasks:
        shown = []
        for name in names:
            kept = [cell.found["transitions"] for cell in plan[task, name]]
            means[name].append(float(np.mean(kept)))
            shown.append(_spread(np.mean(kept), np.std(kept, ddof=1) if len(kept) > 1 else None))
        told = paper.get(task_of(env_id(task)))
        if told:
            means["paper"].append(told[0])
        shown.append(_spread(*told) if told else "-")
        lines.append(f"| {task} | {' | '.join(shown)} |")
    last = [
        f"{np.mean(found):.0f}" if len(found) == len(tasks) else "-" for found in means.values()
    ]
    return [*lines, f"| **mean** | {' | '.join(last)} |"]


def _spread(mean: Any, deviation: Any = None) -> str:
    return f"{mean:.0f}" if deviation is None else f"{mean:.0f} ± {deviation:.0f}"


def main(
    out: str = "bench",
    dry_run: bool = False,
    tasks: Sequence[str] = TASKS,
    seeds: Sequence[int] = (0,),
    steps: int = 5_000,
) -> None:
    """Measure what is not kept, and print the table.

    Args:
        out: folder of kept cells, and of ``success-buffer.md``, ``.tex``, ``.parquet``.
        dry_run: print the cells and the predicted hours, and measure none.
        tasks: as for `planned`.
        seeds: likewise.
        steps: likewise.

    Raises:
        ValueError: an option cannot be measured.
        ImportError: pyarrow is not installed.
    """
    plan = planned(out, tasks, seeds, steps)
    cells = [cell for task in tasks for i in range(len(seeds)) for cell in _of(plan, task, i)]
    if dry_run:
        finish(cells, dry_run)
        return
    need_parquet("success-buffer")
    finish(cells)
    lines = table(plan)
    said_below = (
        f"Transitions of whole successful episodes in {steps} guided agent steps, mean and "
        f"standard deviation over {len(seeds)} seeds. {below(cells)}"
    )
    write(
        Path(out),
        "success-buffer",
        {"tasks": tasks, "seeds": seeds, "steps": steps},
        lines,
        said_below,
        rows(cells),
    )
    print("\n".join([*lines, "", said_below]))


def _of(plan: Planned, task: str, seed: int) -> list[Cell]:
    """All guides' of a task, of one of the seeds: they share a demonstration."""
    return [cells[seed] for (of, _), cells in plan.items() if of == task]
