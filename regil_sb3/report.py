"""A run folder as one self-contained HTML page.

- `write_report` reads the files of a run (no environment, no model) and writes the page.

The page loads nothing from anywhere: charts are inline SVG that follow the reader's light or dark
theme, pictures are data URIs, the video is a sprite sheet played on two canvases.
"""

import csv
import html
import json
import math
from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import yaml
from regil_wrappers import Demonstration, Retriever
from regil_wrappers.alignment import squared_distances
from regil_wrappers.encoders import embed, runs_code

from regil_sb3.charts import Line, Point, line_chart
from regil_sb3.files import replacing
from regil_sb3.guide_view import guide_picture, guide_view
from regil_sb3.pictures import AlignedEpisode, alignment_picture, film_player

__all__ = ["write_report"]

METHODS = {
    "policy": "Policy",
    "guide": "Guided replay",
    "corrected_guide": "Corrected guide",
    "bc": "BC alone",
}
_EXPECTED = ("policy", "guide", "bc")
_MARKS = ("config.yaml", "progress.csv", "evaluation.json")
_STEPS = "time/total_timesteps"
Rows = list[dict[str, float]]


def write_report(run: Path | str, out: Path | str | None = None) -> Path:
    """Write a run folder's report: one HTML page that needs no other file and no network.

    Only files are read: ``config.yaml``, ``progress.csv``, ``evaluation.json``, ``demo.hdf5`` and
    ``episode.hdf5``. What is not there yet, or cannot be read, is listed on the page.

    Args:
        run: The run folder that `regil train` wrote, complete or interrupted.
        out: The file to write; ``report.html`` in the run folder by default.

    Returns:
        The path of the page.

    Raises:
        ValueError: If ``run`` is not a run folder, or ``out`` is a folder.
    """
    run = Path(run)
    if not any((run / name).is_file() for name in _MARKS):
        raise ValueError(
            f"'{run}' is not a run folder: it has none of {', '.join(_MARKS)}: "
            "give the folder that `regil train` wrote"
        )
    out = run / "report.html" if out is None else Path(out)
    if out.is_dir():
        raise ValueError(f"out '{out}' is a folder: give the name of an HTML file")

    missing: list[str] = []
    config: dict[str, Any] = _read(run / "config.yaml", _yaml, missing) or {}
    evaluation: dict[str, Any] = _read(run / "evaluation.json", _json, missing) or {}
    rows: Rows = _read(run / "progress.csv", _progress, missing) or []
    demo: Demonstration | None = _read(run / "demo.hdf5", Demonstration.load, missing)
    episode: Demonstration | None = _read(run / "episode.hdf5", Demonstration.load, missing)

    alignment = None
    if demo is not None and episode is not None:
        try:
            alignment = _align(demo, episode, config)
        except (ImportError, OSError, ValueError) as error:  # an encoder that is not installed here
            missing.append(f"alignment: {error}")
    seen = ""
    if (run / "calibration.json").is_file() and demo is not None and episode is not None:
        try:
            calibration: dict[str, Any] = _json(run / "calibration.json")
            view = guide_view(demo, episode.frames[0], calibration)
            seen = guide_picture(demo, episode.frames[0], view)
        except (OSError, ValueError, KeyError) as error:
            missing.append(f"calibration.json cannot be used: {' '.join(str(error).split())}")
    results = {name: evaluation[name] for name in METHODS if _successes(evaluation.get(name))}
    if evaluation:
        absent = [METHODS[name] for name in _EXPECTED if name not in results]
        if absent:
            missing.append(f"not evaluated: {', '.join(absent)}")
    if not rows:
        missing.append("no training progress has been logged")

    left = [
        _card("Success over steps", _success_chart(rows, results, evaluation)),
        _card("Reward over steps", _reward_chart(rows), "later"),
        _card("Success buffer", _buffer_chart(rows), "later"),
    ]
    right = [
        _card("Demonstration and evaluation episode", film_player(demo, episode, alignment)),
        _card("Episodes", _strips(results, evaluation)),
        _card("What the guide sees", seen),
        _card("Alignment", alignment_picture(demo, episode, alignment)),
    ]
    columns = "".join(f'<div class="column">{"".join(cards)}</div>' for cards in (left, right))
    env = config.get("env") or (demo.metadata.get("env_id") if demo else None) or run.resolve().name
    page = Template(files("regil_sb3").joinpath("report.html").read_text("utf-8")).substitute(
        title=html.escape(f"ReGIL: {env}"),
        headline=_headline(results, evaluation),
        missing=_missing_list(missing),
        body=f'<div class="grid">{columns}</div>' + _card("Configuration", _table(config), "wide"),
        footer="In brackets: the 95 % Wilson interval. BC alone: behaviour cloning of the "
        "demonstration. A step is one agent "
        "transition. TD3BC here is online TD3 with a decaying BC term on a success buffer, not "
        "the offline TD3+BC.",
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    with replacing(out) as file:
        file.write(page.encode())
    return out


# Reading: every reader returns a value or raises; `_read` turns what goes wrong into a line.


def _read(path: Path, reader: Callable[[Path], Any], missing: list[str]) -> Any:
    """Return ``reader(path)``, or None after noting in ``missing`` why there is nothing."""
    if not path.is_file():
        missing.append(f"{path.name} is not there")
        return None
    try:
        return reader(path)
    except (ValueError, OSError, yaml.YAMLError, csv.Error) as error:
        missing.append(f"{path.name} cannot be read: {' '.join(str(error).split())}")
        return None


def _mapping(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"it holds a {type(value).__name__} where a mapping was expected")
    return {str(key): item for key, item in value.items()}


def _yaml(path: Path) -> dict[str, Any]:
    return _mapping(yaml.safe_load(path.read_text("utf-8")))


def _json(path: Path) -> dict[str, Any]:
    return _mapping(json.loads(path.read_text("utf-8")))


def _progress(path: Path) -> Rows:
    """Read SB3's CSV log; empty, non-finite and half-written cells are left out."""
    with path.open(newline="", encoding="utf-8") as lines:
        rows = [
            {key: n for key, cell in row.items() if key and (n := _number(cell)) is not None}
            for row in csv.DictReader(lines)
        ]
    return [row for row in rows if _STEPS in row]


def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def _successes(result: Any) -> list[bool]:
    """Per-episode outcomes; for files that hold only a rate, as many as make that rate."""
    if not isinstance(result, dict):
        return []
    if isinstance(result.get("successes"), list):
        return [bool(success) for success in result["successes"]]
    rate, episodes = _number(result.get("success")), _number(result.get("episodes"))
    if rate is None or episodes is None:
        return []
    return [i < round(rate * episodes) for i in range(int(episodes))]


def _align(demo: Demonstration, episode: Demonstration, config: dict[str, Any]) -> AlignedEpisode:
    """Walk the retriever through the episode's frames, with the run's own settings."""
    settings = {key: config[key] for key in ("encoder", "k", "horizon") if key in config}
    if runs_code(str(settings.get("encoder", "pixels"))):
        # The folder may be someone else's, and a report promises to run nothing of it.
        raise ValueError(
            f"encoder {settings['encoder']!r} names code to run, and a report runs none"
        )
    retriever = Retriever(demo, **settings)
    frames = episode.frames
    if getattr(retriever.encoder, "frame_size", None) and demo.encoder_frames is not None:
        if episode.encoder_frames is None:
            raise ValueError("episode.hdf5 has no encoder_frames, which this encoder reads")
        retriever = Retriever(demo, **settings, use_encoder_frames=True)
        frames = episode.encoder_frames
    embeddings = embed(retriever.encoder, frames)
    ends, paths = [], []
    for t, embedding in enumerate(embeddings):
        alignment = retriever.step_embedding(embedding)
        ends.append(alignment.end)
        if t % max(1, len(frames) // 12) == 0:
            first = t - alignment.window + 1
            paths.append([(first + row, j) for row, j in retriever.path()])
    distances = np.stack([squared_distances(row, retriever.embeddings) for row in embeddings])
    return AlignedEpisode(distances, ends, paths)


# Drawing: values in, markup out. Everything read from a file passes `html.escape`.


def _card(title: str, content: str, kind: str = "") -> str:
    return f'<section class="card {kind}"><h2>{title}</h2>{content}</section>' if content else ""


def _missing_list(missing: Sequence[str]) -> str:
    if not missing:
        return ""
    items = "".join(f"<li>{html.escape(line)}</li>" for line in missing)
    return f'<div class="card missing"><b>Missing from this run</b><ul>{items}</ul></div>'


def _wilson(successes: int, episodes: int) -> tuple[float, float]:
    """95 % Wilson score interval of a success rate (Wilson 1927), in percent."""
    z2 = 1.96**2
    rate = successes / episodes
    center = (rate + z2 / (2 * episodes)) / (1 + z2 / episodes)
    half = math.sqrt(z2 * (rate * (1 - rate) / episodes + z2 / (4 * episodes**2)))
    half /= 1 + z2 / episodes
    return 100 * max(0.0, center - half), 100 * min(1.0, center + half)


def _headline(results: dict[str, dict[str, Any]], evaluation: dict[str, Any]) -> str:
    if not results:
        return '<p class="soft">Not evaluated yet: run <code>regil evaluate</code>.</p>'
    cards = []
    for name, result in results.items():
        outcomes = _successes(result)
        low, high = _wilson(sum(outcomes), len(outcomes))
        cards.append(
            f'<div class="card score" style="--c:var(--{name})"><span>{METHODS[name]}</span>'
            f"<b>{100 * sum(outcomes) / len(outcomes):.0f} %</b>"
            f'<span class="soft small">{sum(outcomes)} of {len(outcomes)}<br>'
            f"({low:.0f} to {high:.0f} %)</span></div>"
        )
    steps, frames = _number(evaluation.get("steps")), _number(evaluation.get("frames"))
    after = "" if steps is None else f" after {steps:,.0f} steps"
    after += "" if frames is None else f" ({frames:,.0f} frames)"
    scores = f'<div class="scores">{"".join(cards)}</div>'
    return f'<p class="soft">Success in unseen episodes{after}</p>{scores}'


def _column(rows: Rows, name: str) -> list[Point]:
    return [(row[_STEPS], row[name]) for row in rows if name in row]


def _guided(rows: Rows) -> list[Point]:
    """The stretches of training, (first step, last step), in which the guide acted."""
    stretches: list[Point] = []
    before = 0.0
    for step, guided in _column(rows, "time/guided"):
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
    last = max((row[_STEPS] for row in rows), default=0.0)
    steps = _number(evaluation.get("steps")) or last
    rate = {name: float(np.mean(_successes(result))) for name, result in results.items()}
    lines = [
        Line("training episodes, rolling", "policy", _column(rows, "rollout/success_rate")),
        Line("evaluations of the policy", "policy", _column(rows, "eval/success_rate"), "dots"),
    ]
    if "policy" in rate:
        lines.append(Line("final, unseen seeds", "final", [(steps, rate["policy"])], "dots"))
    for name in results:
        if name != "policy":
            level = [(0.0, rate[name]), (max(last, steps), rate[name])]
            lines.append(Line(METHODS[name], name, level, "dashed"))
    coefficient = _column(rows, "train/bc_coef")
    lines.append(Line("lambda (right axis)", "lambda", coefficient, "dotted", right=True))
    return line_chart(lines, _guided(rows), "guide acts", percent=True)


def _reward_chart(rows: Rows) -> str:
    retrieval = _column(rows, "rollout/retrieval_reward")
    env = _column(rows, "rollout/env_reward")
    lines = [
        Line("retrieval reward", "policy", retrieval),
        Line("environment's own (right axis)", "guide", env, "dashed", right=True),
    ]
    return line_chart(lines, _guided(rows), "guide acts")


def _buffer_chart(rows: Rows) -> str:
    steps, episodes = (_column(rows, f"success_buffer/{name}") for name in ("steps", "episodes"))
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
        for i, success in enumerate(_successes(result)):
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


def _table(config: dict[str, Any]) -> str:
    """Nested settings as one flat table, ``outer.inner`` beside its value."""
    rows = []
    for key, value in _flat(config):
        rows.append(f"<tr><td>{html.escape(key)}</td><td>{html.escape(str(value))}</td></tr>")
    return f"<table>{''.join(rows)}</table>" if rows else ""


def _flat(settings: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    pairs: list[tuple[str, Any]] = []
    for key, value in settings.items():
        if isinstance(value, list) and any(isinstance(item, dict) for item in value):
            value = {str(i): item for i, item in enumerate(value)}
        nested = isinstance(value, dict) and value
        pairs += _flat(value, f"{prefix}{key}.") if nested else [(f"{prefix}{key}", value)]
    return pairs
