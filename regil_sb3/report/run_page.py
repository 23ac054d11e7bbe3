"""A run folder as one self-contained HTML page.

- `write_report` reads the files of a run (no environment, no model) and writes the page.

The page loads nothing from anywhere: charts are inline SVG that follow the reader's light or dark
theme, pictures are data URIs, films are sprite sheets played on canvases.
"""

import html
from pathlib import Path
from typing import Any

import numpy as np

from regil_sb3.intervals import wilson
from regil_sb3.report.charts import Line, Point, line_chart
from regil_sb3.report.episode_alignment import align
from regil_sb3.report.guide_view import guide_picture, guide_view
from regil_sb3.report.page import card, config_table, write_page
from regil_sb3.report.pictures import film_player, mosaic
from regil_sb3.report.run_contents import STEPS, Rows, column, number, read_run, successes
from regil_sb3.report.success_films import SuccessFilms

__all__ = ["write_report"]

METHODS = {
    "policy": "Policy",
    "guide": "Guided replay",
    "corrected_guide": "Corrected guide",
    "bc": "BC alone",
}
_EXPECTED = ("policy", "guide", "bc")


def write_report(run: Path | str, out: Path | str | None = None) -> Path:
    """Write a run folder's report: one HTML page that needs no other file and no network.

    Only files are read (`regil_sb3.report.run_contents`). What is not there yet, or cannot be read,
    is listed on the page.

    Args:
        run: The run folder that `regil train` wrote, complete or interrupted.
        out: The file to write; ``report.html`` in the run folder by default.

    Returns:
        The path of the page.

    Raises:
        ValueError: If ``run`` is not a run folder, or ``out`` is a folder.
    """
    run = Path(run)
    found = read_run(run)
    out = run / "report.html" if out is None else Path(out)
    if out.is_dir():
        raise ValueError(f"out '{out}' is a folder: give the name of an HTML file")
    missing, evaluation, rows = found.missing, found.evaluation, found.rows
    demo, episode = found.demo, found.episode

    alignment = None
    if demo is not None and episode is not None:
        try:
            alignment = align(demo, episode, found.config)
        except Exception as error:  # not installed, damaged, whatever: it costs this part alone
            missing.append(f"alignment: {' '.join(str(error).split())}")
    seen = ""
    if found.calibration is not None and demo is not None and episode is not None:
        try:
            view = guide_view(demo, episode.frames[0], found.calibration)
            seen = guide_picture(demo, episode.frames[0], view)
        except Exception as error:
            missing.append(f"calibration.json cannot be used: {' '.join(str(error).split())}")
    results = {name: evaluation[name] for name in METHODS if successes(evaluation.get(name))}
    guided = demo is None or demo.actions is not None
    if evaluation:
        expected = _EXPECTED if guided else _EXPECTED[:1]
        absent = [METHODS[name] for name in expected if name not in results]
        if absent:
            missing.append(f"not evaluated: {', '.join(absent)}")
    if not rows:
        missing.append("no training progress has been logged")

    said = "".join(
        f"<li>step {html.escape(str(w['step']))}: {html.escape(str(w['text']))}</li>"
        for w in found.warnings
    )
    left = [
        card("Warnings", f"<ul>{said}</ul>" if said else "", "missing"),
        card("Success over steps", _success_chart(rows, results, evaluation)),
        card("Episodes", _strips(results, evaluation)),
        card("What the guide sees", seen),
    ]
    right = [
        card("Reward over steps", _reward_chart(rows)),
        card("Success buffer", _buffer_chart(rows)),
    ]
    films = film_player(demo, episode, alignment)
    below = [
        card("An evaluation episode beside the demonstration", films, "wide"),
        card("What the success buffer holds", _kept(found.kept, guided), "wide"),
        card("Configuration", _configuration(found.config), "wide"),
    ]
    columns = "".join(f'<div class="column">{"".join(cards)}</div>' for cards in (left, right))
    write_page(
        out,
        f"ReGIL: {found.env}",
        _headline(results, evaluation),
        f'<div class="grid">{columns}</div>{"".join(below)}',
        "In brackets: the 95 % Wilson interval. BC alone: behaviour cloning of the "
        "demonstration. A step is one agent "
        "transition. TD3BC here is online TD3 with a decaying BC term on a success buffer, not "
        "the offline TD3+BC.",
        missing,
    )
    return out


def _headline(results: dict[str, dict[str, Any]], evaluation: dict[str, Any]) -> str:
    if not results:
        return '<p class="soft">Not evaluated yet: run <code>regil evaluate</code>.</p>'
    cards = []
    for name, result in results.items():
        outcomes = successes(result)
        low, high = wilson(sum(outcomes), len(outcomes))
        cards.append(
            f'<div class="card score" style="--c:var(--{name})"><span>{METHODS[name]}</span>'
            f"<b>{100 * sum(outcomes) / len(outcomes):.0f} %</b>"
            f'<span class="soft small">{sum(outcomes)} of {len(outcomes)}<br>'
            f"({low:.0f} to {high:.0f} %)</span></div>"
        )
    steps, frames = number(evaluation.get("steps")), number(evaluation.get("frames"))
    after = "" if steps is None else f" after {steps:,.0f} steps"
    after += "" if frames is None else f" ({frames:,.0f} frames)"
    scores = f'<div class="scores">{"".join(cards)}</div>'
    return f'<p class="soft">Success in unseen episodes{after}</p>{scores}'


def _guided(rows: Rows) -> list[Point]:
    """The stretches of training, (first step, last step), in which the guide acted."""
    stretches: list[Point] = []
    before = 0.0
    for step, guided in column(rows, "time/guided"):
        if guided >= 0.5:
            joined = bool(stretches) and stretches[-1][1] == before
            stretches[-1:] = (
                [(stretches[-1][0], step)] if joined else [*stretches[-1:], (before, step)]
            )
        before = step
    return stretches


def _success_chart(
    rows: Rows, results: dict[str, dict[str, Any]], evaluation: dict[str, Any]
) -> str:
    last = max((row[STEPS] for row in rows), default=0.0)
    steps = number(evaluation.get("steps")) or last
    rate = {name: float(np.mean(successes(result))) for name, result in results.items()}
    lines = [
        Line("training episodes, rolling", "policy", column(rows, "rollout/success_rate")),
        Line("evaluations of the policy", "policy", column(rows, "eval/success_rate"), "dots"),
    ]
    if "policy" in rate:
        lines.append(Line("final, unseen seeds", "final", [(steps, rate["policy"])], "dots"))
    for name in results:
        if name != "policy":
            level = [(0.0, rate[name]), (max(last, steps), rate[name])]
            lines.append(Line(METHODS[name], name, level, "dashed"))
    coefficient = column(rows, "train/bc_coef")
    lines.append(Line("lambda (right axis)", "lambda", coefficient, "dotted", right=True))
    return line_chart(lines, _guided(rows), "guide acts", percent=True)


def _reward_chart(rows: Rows) -> str:
    retrieval = column(rows, "rollout/retrieval_reward")
    env = column(rows, "rollout/env_reward")
    lines = [
        Line("retrieval reward", "policy", retrieval),
        Line("environment's own (right axis)", "guide", env, "dashed", right=True),
    ]
    return line_chart(lines, _guided(rows), "guide acts")


def _buffer_chart(rows: Rows) -> str:
    steps, episodes = (column(rows, f"success_buffer/{name}") for name in ("steps", "episodes"))
    lines = [
        Line("steps", "buffer", steps),
        Line("episodes (right axis)", "guide", episodes, "dashed", right=True),
    ]
    return line_chart(lines, _guided(rows), "guide acts")


def _strips(results: dict[str, dict[str, Any]], evaluation: dict[str, Any]) -> str:
    """One row of squares per method: filled where that unseen seed's episode succeeded."""
    seeds = evaluation.get("seeds")
    seeds = seeds if isinstance(seeds, list) else []
    strips = []
    for name, result in results.items():
        squares = []
        for i, success in enumerate(successes(result)):
            seed = f"seed {seeds[i]}" if i < len(seeds) else f"episode {i}"
            word = "success" if success else "failure"
            kind = ' class="yes"' if success else ""
            squares.append(f'<span{kind} title="{html.escape(f"{seed}: {word}")}"></span>')
        strips.append(
            f'<div class="small">{METHODS[name]}</div><div class="strip" '
            f'style="--c:var(--{name})">{"".join(squares)}</div>'
        )
    if not strips:
        return ""
    note = "One square per unseen seed, the same seeds in each row; filled means success."
    return "".join(strips) + f'<p class="soft small">{note}</p>'


def _configuration(config: dict[str, Any]) -> str:
    """What was said, and folded up below it what was left to the constructors."""
    said = {key: value for key, value in config.items() if key != "defaults"}
    defaults = config_table(config.get("defaults") or {})
    folded = f"<details><summary>Defaults</summary>{defaults}</details>" if defaults else ""
    return config_table(said) + folded


def _kept(kept: SuccessFilms | None, guided: bool) -> str:
    """The success buffer's episodes: their films, how many there are and how long.

    Args:
        kept: what is known of them.
        guided: whether the demonstration is the first.
    """
    if kept is None or not kept.lengths:
        return ""
    lengths = kept.lengths
    note = (
        f"{len(lengths):,} episodes of {min(lengths)} to {max(lengths)} steps, "
        f"{sum(lengths):,} steps in all, {'the demonstration first, then ' * guided}from old to new"
    )
    if len(kept.shown) < len(lengths):
        note += f"; {len(kept.shown)} of them are shown"
    films = [
        ("the demo" if guided and i == 0 else f"no. {i}, {lengths[i]} steps", film)
        for i, film in zip(kept.shown, kept.films, strict=True)
    ]
    return f'<p class="soft small">{note}.</p>{mosaic(films)}'
