"""Several runs as one self-contained HTML page.

* ``write_comparison`` - reads run folders and writes the page
* ``scores``, ``plots`` - what is on it, of runs that have their methods' names
* ``methods`` - which runs differ in their seed or task alone
"""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from regil_sb3.intervals import Interval, improvement, iqm, wilson
from regil_sb3.report.charts import Line, line_chart
from regil_sb3.report.page import card, flat, write_page
from regil_sb3.report.run_contents import RunContents, column, number, read_run, successes

__all__ = ["MOST", "NOTE", "methods", "plots", "scores", "write_comparison"]

_COLOURS = 6  # as many as the page has for methods
_STYLES = ("solid", "dashed", "dotted")  # of lines: a colour comes once in each
MOST = _COLOURS * len(_STYLES)  # methods that can be told apart
_NOT_COMPARED = ("versions.", "defaults.")  # what begins so
_OF_A_SEED = {"env", "seed", "demo_actions"}
_NAMED = 2  # settings in a method's name

NOTE = (
    "Interquartile mean (IQM): the mean of the middle half of all runs' success rates; in "
    "brackets its 95 % stratified bootstrap interval, runs drawn again within each task "
    "(Agarwal et al. 2021; the statistic of rliable, computed with scipy.stats.bootstrap). It "
    "says how much other seeds would change it. A run's own interval is Wilson's, of its "
    "episodes."
)
"""What the figures are."""

Runs = Sequence[RunContents]
Named = Mapping[str, Runs]
"""Runs by the name of their method."""


def write_comparison(runs: Sequence[Path | str], out: Path | str) -> Path:
    """Write one page that compares runs: of methods, over tasks and seeds.

    Runs of one task that differ in nothing but their seed and demonstration are runs of one method.
    Scores are the last policy's success in unseen episodes (``evaluation.json``).

    Args:
        runs: folders that `regil train` wrote, two or more.
        out: the file to write.

    Returns:
        its path.

    Raises:
        ValueError: if one is not a run folder, none has been evaluated, there are more methods than
            lines that can be told apart, or ``out`` is a folder.
    """
    out = Path(out)
    if out.is_dir():
        raise ValueError(f"out '{out}' is a folder: give the name of an HTML file")
    read = [read_run(run) for run in runs]
    missing = [
        f"{run.folder}: {line}"
        for run in read
        for line in run.missing
        if line.startswith(("config.yaml", "progress.csv", "evaluation.json"))
    ]
    evaluated = [run for run in read if _score(run) is not None]
    missing += [f"{run.folder}: its policy is not evaluated" for run in read if _score(run) is None]
    if not evaluated:
        raise ValueError("none of these runs has been evaluated: regil evaluate RUN")
    named = methods(evaluated)
    differ = card("Where they differ", _differences(evaluated))
    tasks = len({run.env for run in evaluated})
    write_page(
        out,
        f"ReGIL: {len(evaluated)} runs, {tasks} {'task' if tasks == 1 else 'tasks'}",
        scores(named),
        plots(named, differ) + card("Runs", _runs(named), "wide"),
        NOTE,
        missing,
    )
    return out


def plots(named: Named, beside: str = "") -> str:
    """HTML: success over steps, how probably each is better than the first, success of each task.

    Args:
        named: evaluated runs, the first method's first.
        beside: HTML to stand below the second of them.

    Raises:
        ValueError: there are more methods than lines that can be told apart.
    """
    if len(named) > MOST:
        raise ValueError(
            f"these are runs of {len(named)} methods ({'; '.join(named)}): compare at most "
            f"{MOST} at once"
        )
    columns = (
        card("Success over steps", _curves(named)),
        card("Is it better?", _improvements(named)) + beside,
    )
    grid = "".join(f'<div class="column">{column}</div>' for column in columns)
    heads = "".join(f"<th>{html.escape(name)}</th>" for name in named)
    by_task = "".join(_task_row(task, named) for task in _tasks(named))
    return f'<div class="grid">{grid}</div>' + card(
        "Success of each task",
        f'<div class="scroll"><table class="figures"><tr><th></th>{heads}</tr>{by_task}'
        "</table></div>",
        "wide",
    )


def _tasks(named: Named) -> list[str]:
    return sorted({run.env for runs in named.values() for run in runs})


def methods(runs: Runs) -> dict[str, list[RunContents]]:
    """Runs by method, named by the settings in which methods differ within a task.

    What differs between tasks alone, such as a task's own preset, names nothing.
    """
    settings = [_settings(run) for run in runs]
    differ = _differing(runs, settings)
    # One setting tells most comparisons apart: a preset rather than all that it sets
    enough = [key for key in differ if _tells_as_much([key], differ, settings)]
    keys = sorted(enough, key=lambda k: ("." in k, len(k)))[:1] or differ
    grouped: dict[tuple[str, ...], list[RunContents]] = {}
    for run, own in zip(runs, settings, strict=True):
        grouped.setdefault(tuple(str(own.get(key)) for key in keys), []).append(run)
    named: dict[str, list[RunContents]] = {}
    for values, group in grouped.items():
        pairs = [f"{k.rpartition('.')[2]}={v}" for k, v in zip(keys, values, strict=True)]
        name = ", ".join(pairs[:_NAMED]) + (", ..." if len(pairs) > _NAMED else "")
        name = name or "runs"
        if name in named:
            name += f" ({len(named) + 1})"
        named[name] = group
    return named


def _settings(run: RunContents) -> dict[str, Any]:
    own = {
        key: value
        for key, value in flat(run.config)
        if not (key in _OF_A_SEED or key.startswith(_NOT_COMPARED) or key.endswith(".demo"))
    }
    if own.get("preset") == run.env:  # a task's own section of the default
        own["preset"] = "default"
    return own


def _differing(runs: Runs, settings: Sequence[dict[str, Any]]) -> list[str]:
    keys: dict[str, None] = {}
    for task in dict.fromkeys(run.env for run in runs):
        here = [own for run, own in zip(runs, settings, strict=True) if run.env == task]
        for key in dict.fromkeys(key for own in here for key in own):
            if len({str(own.get(key)) for own in here}) > 1:
                keys[key] = None
    return list(keys)


def _tells_as_much(
    some: Sequence[str], every: Sequence[str], settings: Sequence[dict[str, Any]]
) -> bool:
    parts = [{tuple(str(own.get(k)) for k in keys) for own in settings} for keys in (some, every)]
    return len(parts[0]) == len(parts[1])


def _score(run: RunContents) -> float | None:
    outcomes = successes(run.evaluation.get("policy"))
    return sum(outcomes) / len(outcomes) if outcomes else None


def _scores(runs: Runs, tasks: Sequence[str]) -> list[list[float]]:
    by_task: dict[str, list[float]] = {task: [] for task in tasks}
    for run in runs:
        score = _score(run)
        if run.env in by_task and score is not None:
            by_task[run.env].append(score)
    return [scores for scores in by_task.values() if scores]


def _look(i: int) -> tuple[str, str]:
    """A method's colour, a variable of the page, and the style of its lines."""
    return f"m{i % _COLOURS}", _STYLES[i // _COLOURS]


def _within(found: Interval) -> str:
    if math.isnan(found.low):
        return "no interval: a task with one run"
    return f"({100 * found.low:.0f} to {100 * found.high:.0f} %)"


def scores(named: Named) -> str:
    """HTML: a box for each method, with the interquartile mean of its runs' success."""
    cards, tasks = [], _tasks(named)
    for i, (name, runs) in enumerate(named.items()):
        colour, style = _look(i)
        found = iqm(_scores(runs, tasks))
        n_tasks = len({run.env for run in runs})
        cards.append(
            f'<div class="card score {style}" style="--c:var(--{colour})">'
            f"<span>{html.escape(name)}</span>"
            f"<b>{100 * found.value:.0f} %</b>"
            f'<span class="soft small">{_within(found)}<br>{len(runs)} '
            f"{'run' if len(runs) == 1 else 'runs'}, {n_tasks} "
            f"{'task' if n_tasks == 1 else 'tasks'}</span></div>"
        )
    return (
        '<p class="soft">Success in unseen episodes, interquartile mean</p>'
        f'<div class="scores">{"".join(cards)}</div>'
    )


def _curves(named: Named) -> str:
    """IQM of the policy's evaluations over steps, where every run of a method has one.

    What learns from the demonstration alone makes no steps, and has no curve.
    """
    lines = []
    for i, (name, runs) in enumerate(named.items()):
        moving = [run for run in runs if run.evaluation.get("frames") != 0]
        logged = [(run.env, column(run.rows, "eval/success_rate")) for run in moving]
        logged = [(env, curve) for env, curve in logged if curve]
        curves = [curve for _, curve in logged]
        if not curves:
            continue
        begins, ends = max(c[0][0] for c in curves), min(c[-1][0] for c in curves)
        steps = sorted({step for curve in curves for step, _ in curve if begins <= step <= ends})
        points, spread = [], []
        for step in steps:
            by_task: dict[str, list[float]] = {}
            for env, curve in logged:
                last = [value for at, value in curve if at <= step][-1]
                by_task.setdefault(env, []).append(last)
            found = iqm(list(by_task.values()))
            points.append((step, found.value))
            if not math.isnan(found.low):
                spread.append((step, found.low, found.high))
        colour, style = _look(i)
        lines.append(Line(name, colour, points, style, spread=spread))
    note = (
        '<p class="soft small">Evaluations while training, on seeds for selection: interquartile '
        "mean and its interval.</p>"
    )
    chart = line_chart(lines, percent=True)
    return chart + note if chart else ""


def _improvements(named: Named) -> str:
    """Each method against the first."""
    (first, theirs), *others = named.items()
    rows = []
    for name, ours in others:
        both = sorted({run.env for run in ours} & {run.env for run in theirs})
        if not both:
            continue
        found = improvement(_scores(ours, both), _scores(theirs, both))
        rows.append(
            f"<tr><td>{html.escape(name)}</td><td>{100 * found.value:.0f} % {_within(found)}"
            "</td></tr>"
        )
    if not rows:
        return ""
    return (
        f'<p class="soft small">Probability that a run beats one of {html.escape(first)} on the '
        f"same task; a tie counts half.</p><table>{''.join(rows)}</table>"
    )


def _differences(runs: Runs) -> str:
    settings = [_settings(run) for run in runs]
    rows = []
    for key in _differing(runs, settings):
        values = dict.fromkeys(str(own.get(key, "-")) for own in settings)
        rows.append(
            f"<tr><td>{html.escape(key)}</td><td>{html.escape(' | '.join(values))}</td></tr>"
        )
    return f"<table>{''.join(rows)}</table>" if rows else ""


def _task_row(task: str, named: Named) -> str:
    cells = []
    for runs in named.values():
        scores = [score for of_task in _scores(runs, [task]) for score in of_task]
        said = "-"
        if scores:
            said = f"{100 * np.mean(scores):.0f} %"
            if len(scores) > 1:
                low, high = 100 * min(scores), 100 * max(scores)
                said += f" ({low:.0f} to {high:.0f}, {len(scores)} runs)"
        cells.append(f"<td>{said}</td>")
    return f"<tr><td>{html.escape(task)}</td>{''.join(cells)}</tr>"


def _runs(named: Named) -> str:
    rows = []
    for i, (name, runs) in enumerate(named.items()):
        colour, style = _look(i)
        for run in sorted(runs, key=lambda run: (run.env, str(run.config.get("seed")))):
            outcomes = successes(run.evaluation.get("policy"))
            low, high = wilson(sum(outcomes), len(outcomes))
            steps = number(run.evaluation.get("steps"))
            cells = [
                run.env,
                f"seed {run.config.get('seed', '?')}",
                "" if steps is None else f"{steps:,.0f} steps",
                f"{sum(outcomes)} of {len(outcomes)} ({low:.0f} to {high:.0f} %)",
                str(run.folder),
            ]
            line = f'<i class="{style}" style="--c:var(--{colour})"></i>'
            rows.append(
                f'<tr><td><span class="legend"><span>{line}{html.escape(name)}</span></span></td>'
                + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells)
                + "</tr>"
            )
    return f'<div class="scroll"><table class="figures">{"".join(rows)}</table></div>'
