"""`regil bench buffer-vs-learning`: does a fuller success buffer make a better policy?

Of finished runs alone: what the guide left in the success buffer when its warm-up ended, and how
often the last policy succeeds in unseen episodes. Nothing learns, and nothing is played.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import stats  # type: ignore[import-untyped]

from regil_sb3.bench.machine import describe
from regil_sb3.bench.page import figure, need_parquet, write
from regil_sb3.bench.replay import task_of
from regil_sb3.intervals import wilson
from regil_sb3.report.run_contents import STEPS, RunContents, read_run, successes
from regil_sb3.settings import Settings

__all__ = ["Learned", "Rank", "buffer_after_warmup", "learned", "main", "rank", "table"]

_FEWEST = 3  # runs, of which ranks say anything
_RESAMPLES = 9_999


@dataclass(frozen=True)
class Learned:
    """A finished run.

    Attributes:
        run: its folder.
        task: Meta-World's name, or the environment's id.
        preset: of the run.
        seed: likewise.
        steps: that it made.
        warmup: agent steps in which the guide acted.
        guide: its arguments, as text.
        buffer: transitions in the success buffer when they were over, the demonstration's left out.
        successes: of the last policy.
        episodes: unseen ones.
    """

    run: str
    task: str
    preset: str
    seed: int
    steps: int
    warmup: int
    guide: str
    buffer: int
    successes: int
    episodes: int

    @property
    def success(self) -> float:
        """Rate."""
        return self.successes / self.episodes


class Rank(NamedTuple):
    """Spearman's rank correlation; NaN where one side does not vary or runs are too few.

    Attributes:
        rho: in [-1, 1].
        p: two-sided, of a permutation test (exact where there are few runs).
        n: warm-ups.
    """

    rho: float
    p: float
    n: int


def buffer_after_warmup(run: RunContents, warmup: int) -> int | None:
    """Transitions in the success buffer when the warm-up was over, without the demonstration's.

    Args:
        run: with its log, and its settings or its demonstration.
        warmup: agent steps of it; an episode begun in it is finished in it.

    Returns:
        the first that is logged once it is over; None where that is nowhere.
    """
    demonstrated = run.config.get("demo_actions")
    if demonstrated is None and run.demo is not None and run.demo.actions is not None:
        demonstrated = len(run.demo.actions)  # older runs do not say it
    if demonstrated is None:
        return None
    for row in run.rows:
        # the policy is first evaluated as the warm-up ends; until then only the guide acts
        over = row[STEPS] >= warmup and ("eval/success_rate" in row or not row.get("time/guided"))
        if over and "success_buffer/steps" in row:
            return int(row["success_buffer/steps"]) - int(demonstrated)
    return None


def learned(folders: Sequence[Path | str]) -> tuple[list[Learned], list[str]]:
    """What runs say, and a line for each that says too little.

    Args:
        folders: of runs.

    Raises:
        ValueError: one is no run folder.
    """
    found, left_out = [], []
    for folder in folders:
        run = read_run(folder)
        settings = Settings.load(run.folder / "config.yaml", trust=True)  # nothing of it is run
        outcomes = successes(run.evaluation.get("policy"))
        buffer = buffer_after_warmup(run, settings.warmup_steps)
        if not settings.warmup_steps:
            left_out.append(f"{folder}: no guide acted in it")
        elif settings.hyperparams.get("bc_coef") == 0:
            left_out.append(f"{folder}: it does not learn from the buffer")
        elif not outcomes:
            left_out.append(f"{folder}: its policy is not evaluated (regil evaluate {folder})")
        elif buffer is None:
            left_out.append(f"{folder}: its log does not reach the end of the warm-up")
        else:
            found.append(
                Learned(
                    str(folder),
                    task_of(settings.env),
                    settings.preset,
                    settings.seed,
                    settings.steps,
                    settings.warmup_steps,
                    json.dumps(settings.guide),
                    buffer,
                    sum(outcomes),
                    len(outcomes),
                )
            )
    return found, left_out


def rank(runs: Sequence[Learned]) -> Rank:
    """Rank correlation of buffer and success.

    Runs that had the same warm-up, and differ in what came after it, count as one: their mean.
    """
    warmups: dict[tuple[str, int, int, str, int], list[float]] = {}
    for run in runs:
        same = (run.task, run.seed, run.warmup, run.guide, run.buffer)
        warmups.setdefault(same, []).append(run.success)
    x = [buffer for *_, buffer in warmups]
    y = [float(np.mean(successes)) for successes in warmups.values()]
    if len(warmups) < _FEWEST or len(set(x)) == 1 or len(set(y)) == 1:
        return Rank(np.nan, np.nan, len(warmups))
    tested = stats.permutation_test(
        (x,),
        lambda x: stats.spearmanr(x, y).statistic,
        permutation_type="pairings",
        n_resamples=_RESAMPLES,
        rng=np.random.default_rng(0),
    )
    return Rank(float(tested.statistic), float(tested.pvalue), len(warmups))


def table(runs: Sequence[Learned]) -> list[str]:
    """The table in Markdown: a line a run, the fullest buffer first."""
    head = "| task | preset | seed | steps | warm-up | buffer | success (95 %) | run |"
    lines = [head, "|" + "---|" * 8]
    for run in sorted(runs, key=lambda run: -run.buffer):
        low, high = (bound / 100 for bound in wilson(run.successes, run.episodes))
        success = f"{run.success:.2f} ({low:.2f} to {high:.2f})"
        what = (run.task, run.preset, run.seed, run.steps, run.warmup, run.buffer, success, run.run)
        lines.append(f"| {' | '.join(map(str, what))} |")
    return lines


def _said(what: str, found: Rank) -> str:
    if np.isnan(found.rho):
        return f"{what}: none, of {found.n} warm-ups"
    return f"{what}: {found.rho:+.2f} (p {found.p:.3f}) of {found.n} warm-ups"


def _left_out(lines: Sequence[str]) -> str:
    """Runs that are left out, by why."""
    runs: dict[str, list[str]] = {}
    for line in lines:
        run, _, why = line.partition(": ")
        runs.setdefault(why, []).append(Path(run).name)
    return "".join(f"Left out ({why}): {', '.join(names)}. " for why, names in runs.items())


def _hours(runs: Sequence[Learned]) -> str:
    """What runs took, as far as `regil bench` made them and says it."""
    files = [path for run in runs if (path := Path(run.run) / "took.json").exists()]
    if not files:
        return ""
    seconds = sum(json.loads(path.read_text("utf-8"))["seconds"] for path in files)
    of = "" if len(files) == len(runs) else f" {len(files)} of"
    return f"To make{of} them took {seconds / 3600:.1f} hours, one after the other. "


def _draw(runs: Sequence[Learned], path: Path) -> None:
    with figure(path) as ((axis,),):
        for i, task in enumerate(dict.fromkeys(run.task for run in runs)):
            own = [run for run in runs if run.task == task]
            points = [run.buffer for run in own], [run.success for run in own]
            axis.plot(*points, "o", color=f"C{i}", label=task)
        axis.set_xlabel("transitions in the success buffer after the warm-up")
        axis.set_ylabel("success of the last policy")
        axis.set_ylim(-0.05, 1.05)
        axis.set_xlim(left=0)
        axis.legend(fontsize=8)


def main(runs: Sequence[str] = (), out: str = "bench", dry_run: bool = False) -> None:
    """Read runs, and print the table.

    Args:
        runs: folders that `regil train` or `regil bench` wrote; none: all evaluated ones in `out`.
        out: folder of ``buffer-vs-learning.md``, ``.tex``, ``.parquet`` and ``.png``.
        dry_run: print the runs, and write nothing.

    Raises:
        ValueError: one is no run folder, or none says enough.
        ImportError: pyarrow is not installed.
    """
    name = "buffer-vs-learning"
    folders = list(runs) or [str(e.parent) for e in sorted(Path(out).glob("*/evaluation.json"))]
    if not folders:
        raise ValueError(f"--out {out}: no evaluated run is there; name some with --runs")
    found, left_out = learned(folders)
    if not found:
        raise ValueError(f"none of these runs says enough: {'; '.join(left_out)}")
    if dry_run:
        print("\n".join([*(run.run for run in found), *left_out]))
        print(f"{len(found)} of {len(folders)} runs to read: about 0 hours, nothing is played")
        return
    need_parquet(name)
    tasks = list(dict.fromkeys(run.task for run in found))
    ranks = [_said("of all runs", rank(found))]
    if len(tasks) > 1:
        own = ([run for run in found if run.task == task] for task in tasks)
        ranks += [_said(task, rank(r)) for task, r in zip(tasks, own, strict=True)]
    lines = table(found)
    below = (
        "Buffer: transitions of whole successful episodes when the warm-up was over, the "
        "demonstration left out. Success: last policy, unseen episodes, Wilson's interval. "
        "Spearman's rank correlation of both, runs with the same warm-up counted once: "
        f"{'; '.join(ranks)}. "
        + _left_out(left_out)
        + _hours(found)
        + f"Read by {describe(('numpy', 'scipy', 'regil-sb3'))}"
    )
    folder = Path(out)
    write(folder, name, {"runs": runs} if runs else {}, lines, below, [vars(r) for r in found])
    _draw(found, folder / f"{name}.png")
    print("\n".join([*lines, "", below]))
