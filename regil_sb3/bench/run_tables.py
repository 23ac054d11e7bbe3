"""`regil bench ablations` and its like: methods that learn, on the same tasks and unseen seeds.

Each run is kept and never made twice; a bench that was stopped goes on (`regil_sb3.bench.runs`).
What is printed is made from the run folders alone: success of the last policy with intervals, the
paper's figures beside it, and the steps to .8 and .95.
"""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from regil_sb3.bench.machine import together
from regil_sb3.bench.page import need_parquet, said, write
from regil_sb3.bench.replay import check, env_id, task_of
from regil_sb3.bench.runs import (
    Run,
    finish_all,
    machines,
    others,
    predicted_hours,
    same_demonstrations,
    seconds_of,
)
from regil_sb3.intervals import Interval, iqm

__all__ = ["LEARNING", "main", "planned", "raw", "table"]

LEVELS = (0.8, 0.95)
_ENOUGH = 5  # runs of a task, for a 95 % interval that is nearly one (docs/interval_coverage.py)


LEARNING = tuple(name for name, table in said().items() if "methods" in table)
"""Tables whose rows are training runs."""


def planned(
    name: str,
    root: Path | str,
    tasks: Sequence[str] | None = None,
    seeds: Sequence[int] | None = None,
    steps: int | None = None,
    episodes: int | None = None,
    methods: Sequence[str] | None = None,
) -> list[Run]:
    """The runs of a table.

    Args:
        name: of the table.
        root: folder of all runs; tables share them.
        tasks: Meta-World's names, in place of the table's own.
        seeds: likewise; each has a demonstration of its own.
        steps: agent steps, likewise.
        episodes: unseen episodes at the end, likewise.
        methods: the table's that are wanted.

    Raises:
        ValueError: there is no such task or method, or nothing would be learned or evaluated: a
            run would end before its warm-up does.
    """
    own = said()[name]
    counts = {"steps": steps, "episodes": episodes}
    check(tasks or (), seeds or (), **{k: n for k, n in counts.items() if n is not None})
    for method in methods or ():
        if method not in own["methods"]:
            raise ValueError(f"--methods {method}: choose from {', '.join(own['methods'])}")
    runs = [
        Run(
            root=str(root),
            env=env_id(task),
            method=method,
            seed=seed,
            steps=steps or own["steps"],
            episodes=episodes or own["episodes"],
            preset=asked.get("preset", ""),
            settings=tuple(asked.get("settings", ())),
            called=asked.get("run", ""),
            paper=asked.get("paper", ""),
            beside=tuple(asked.get("beside", {}).items()),
            demo=str(Path(root) / "demos" / f"{task}-{seed}.hdf5"),
        )
        for task in tasks or own["tasks"]
        for seed in seeds or own["seeds"]
        for method, asked in own["methods"].items()
        if not methods or method in methods
    ]
    for run in {(run.env, run.method): run for run in runs}.values():  # of any seed
        if run.steps <= (warmup := run.settings_now.warmup_steps):
            raise ValueError(
                f"--steps {run.steps} end before {run.method}'s warm-up of {warmup} does: take more"
            )
    return runs


def raw(runs: Sequence[Run]) -> Iterator[dict[str, Any]]:
    """What finished runs found: a row for each run, what acted, and unseen episode.

    Of what is evaluated beside a run's policy, and learns nothing, steps and minutes are NaN.
    """
    for run in runs:
        if not run.finished:
            continue
        evaluation = json.loads((run.folder / "evaluation.json").read_text())
        # what learns from the demonstration alone makes no steps
        steps_to = (lambda *_: np.nan) if evaluation.get("frames") == 0 else _steps_to
        reached = {f"steps to {level}": steps_to(run, level) for level in LEVELS}
        made_on = "; ".join(machines([run]))
        learned = {"minutes": (seconds_of(run) or np.nan) / 60, **reached}
        for method, name in ((run.method, "policy"), *run.beside):
            if name not in evaluation:
                continue  # it was asked for, and the run has none
            for episode, success in enumerate(evaluation[name]["successes"][: run.episodes]):
                yield {
                    "task": task_of(run.env),
                    "method": method,
                    "run": run.folder.name,
                    "machines": made_on,
                    "evaluated": name,
                    "seed": run.seed,
                    "steps": run.steps,
                    "episode": episode,
                    "success": bool(success),
                    "length": int(evaluation[name]["lengths"][episode]),
                    **(learned if name == "policy" else dict.fromkeys(learned, np.nan)),
                }


def _steps_to(run: Run, level: float) -> float:
    """Agent steps at the first evaluation during training that reached it; NaN: none did."""
    with (run.folder / "progress.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            # a budget that ends soon after the warm-up has no evaluation, and no such column
            if (rate := row.get("eval/success_rate")) and float(rate) >= level:
                return float(row["time/total_timesteps"])
    return float("nan")


def table(runs: Sequence[Run]) -> list[str]:
    """The table in Markdown: a line a method, a column a task, and the mean over tasks.

    A cell is the mean over seeds; in brackets the paper's own, after 300,000 frames, or of what
    learns from the demonstration alone, 100,000 updates. The interquartile mean over tasks and
    seeds has a 95 % interval by the stratified bootstrap.
    """
    rows = list(raw(runs))
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    methods = list(dict.fromkeys(row["method"] for row in rows))
    names = {run.method: run.paper or run.method for run in runs}
    paper = said()["paper"]["success"]
    lines = [
        f"| method | {' | '.join(tasks)} | IQM (95 %) | runs | steps to .8 | steps to .95 | "
        "minutes |",
        "|" + "---|" * (len(tasks) + 6),
    ]
    for method in methods:
        own = [row for row in rows if row["method"] == method]
        cells = []
        for task in tasks:
            here = [row["success"] for row in own if row["task"] == task]
            cell = f"{np.mean(here):.3f}" if here else "-"
            told = paper.get(task, {}).get(names.get(method))
            cells.append(cell if told is None else f"{cell} ({told:g})")
        by_run: dict[tuple[str, int], dict[str, Any]] = {
            (row["task"], row["seed"]): row for row in own
        }
        scores = [
            [
                float(np.mean([row["success"] for row in own if (row["task"], row["seed"]) == run]))
                for run in by_run
                if run[0] == task
            ]
            for task in tasks
            if any(run[0] == task for run in by_run)
        ]
        found = iqm(scores)
        reached = [_median(by_run.values(), f"steps to {level}") for level in LEVELS]
        minutes = [row["minutes"] for row in by_run.values() if not np.isnan(row["minutes"])]
        took = f"{np.mean(minutes):.1f}" if minutes else "-"
        cells += [_interval(found), str(len(by_run)), *reached, took]
        lines.append(f"| {method} | " + " | ".join(cells) + " |")
    return lines


def _median(rows: Iterable[dict[str, Any]], column: str) -> str:
    """The median over runs, where those that never got there come last; "-": it is one of those."""
    value = float(np.median([np.nan_to_num(row[column], nan=np.inf) for row in rows]))
    return f"{value:,.0f}" if np.isfinite(value) else "-"


def _in_brackets(runs: Sequence[Run]) -> str:
    """What stands in brackets behind a task's success, where something does."""
    paper = said()["paper"]["success"]
    told = [run for run in runs if (run.paper or run.method) in paper.get(task_of(run.env), {})]
    if not any(run.finished for run in told):
        return ""
    return (
        "In brackets the paper's, after 300,000 frames (LIBERO's 500,000), of BC and BAKU after "
        "100,000 updates. "
    )


def _paper_reached(rows: Sequence[Mapping[str, Any]]) -> str:
    """When the paper's methods reached .95, of those that rows are of."""
    told = ""
    shown = {(row["task"], row["method"]) for row in rows}
    for task, methods in said()["paper"]["frames to 0.95"].items():
        for method, (first, last) in methods.items():
            if (task, method) in shown:
                told += f"The paper's {method} reaches .95 on {task} after {first:,} to {last:,} "
                told += "frames (two an agent step). "
    return told


def _narrow(rows: Sequence[Mapping[str, Any]]) -> str:
    """What a bootstrap's interval of so few runs is worth."""
    runs = {(row["task"], row["method"], row["seed"]) for row in rows}
    counts = Counter((task, method) for task, method, _ in runs)
    methods = {method for _, method in counts}
    fewest = [min(n for (_, of), n in counts.items() if of == method) for method in methods]
    drawn = [n for n in fewest if n > 1]  # of one run there is no interval
    if not drawn or min(drawn) >= _ENOUGH:
        return ""
    return f"Intervals of {min(drawn)} runs a task are too narrow (docs/bench.md). "


def _better(rows: Sequence[Mapping[str, Any]]) -> str:
    """Which lines are above the first one, by task: what is compared with may win."""
    means: dict[str, dict[str, float]] = {}
    for method, task in dict.fromkeys((row["method"], row["task"]) for row in rows):
        own = [row["success"] for row in rows if (row["method"], row["task"]) == (method, task)]
        means.setdefault(method, {})[task] = float(np.mean(own))
    first, *others = means
    above = [
        f"{method} on {task}"
        for method in others
        for task, mean in means[method].items()
        if mean > means[first].get(task, np.inf)
    ]
    return f"Above {first}: {', '.join(above) or 'none'}. "


def _interval(found: Interval) -> str:
    if np.isnan(found.low):
        return f"{found.value:.3f}"
    return f"{found.value:.3f} ({found.low:.3f} to {found.high:.3f})"


def main(
    name: str,
    out: str = "bench",
    dry_run: bool = False,
    workers: int = 1,
    ray: str = "",
    cpus: float = 1,
    gpus: float = 0,
    memory: float = 0,
    **options: Any,
) -> None:
    """Make what is missing of a table, and print it.

    Args:
        name: of the table.
        out: folder of the runs, and of ``NAME.md``, ``NAME.tex`` and ``NAME.parquet``; with other
            steps than the table's own, ``NAME-STEPS.md`` and so on.
        dry_run: print the runs, the predicted hours and the table of those that are finished, and
            make none.
        workers: runs at a time.
        ray: address of a Ray cluster to run on; "local" starts one.
        cpus: that Ray gives to a run.
        gpus: likewise.
        memory: GiB, likewise; 0 asks for none.
        **options: of `planned`.

    Raises:
        ValueError: an option does not fit; or runs failed, which are named.
        ImportError: pyarrow or Ray is not installed.
    """
    if workers < 1:
        raise ValueError(f"--workers {workers}: at least 1 is needed")
    if (cpus, gpus, memory) != (1, 0, 0) and not ray:
        raise ValueError("--cpus, --gpus and --memory are shares of a Ray cluster: give --ray, too")
    runs = planned(name, out, **options)
    if stale := others(runs):
        raise ValueError("; ".join(stale))
    missing = [run for run in runs if not run.finished]
    if dry_run:
        same_demonstrations(runs)
        for run in runs:
            print(f"{run.folder}: {'finished' if run.finished else run.command}")
        at_a_time = "one after the other" if ray else f"{workers} at a time"
        print(
            f"{len(missing)} of {len(runs)} runs to make: about "
            f"{predicted_hours(runs, 1 if ray else workers):.1f} hours, {at_a_time}"
        )
        if len(missing) < len(runs):
            print("\n".join(["", *table(runs)]))
        return
    need_parquet(name)
    failed = finish_all(runs, workers, ray, cpus, gpus, memory)
    rows = list(raw(runs))
    if rows:
        lines = table(runs)
        seeds = ", ".join(map(str, sorted({row["seed"] for row in rows})))
        not_made = [run.folder.name for run in runs if not run.finished]
        hours = sum(seconds_of(run) or 0 for run in runs if run.finished) / 3600
        below = (
            f"{_in_brackets(runs)}{_better(rows)}{_paper_reached(rows)}{_narrow(rows)}"
            + (f"Not made: {', '.join(not_made)}. " if not_made else "")
            + "What was tuned for which method: docs/baselines.md. "
            f"Seeds {seeds}; {hours:.1f} hours, one run after the other; {together(machines(runs))}"
        )
        steps = options.get("steps")
        called = "" if steps in (None, said()[name]["steps"]) else f"{name}-{steps}"
        write(Path(out), name, options, lines, below, rows, called)
        print("\n".join(lines))
    if failed:
        raise ValueError(f"{len(failed)} runs failed: {'; '.join(failed)}")
