"""What a run folder holds, read without running anything of it.

* ``RunContents`` - what could be read, and lines about what could not
* ``read_run``, and ``read_warnings`` - of one file of it
* ``column``, ``successes`` - values of a log, outcomes of an evaluation
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from regil_wrappers import Demonstration
from regil_wrappers.formats import DAMAGED

from regil_sb3.report.success_films import SuccessFilms, load_films

__all__ = [
    "STEPS",
    "Rows",
    "RunContents",
    "column",
    "number",
    "read_run",
    "read_warnings",
    "successes",
]

STEPS = "time/total_timesteps"
_MARKS = ("config.yaml", "progress.csv", "evaluation.json")
_MOST_VALUES, _DEEPEST = 1_000_000, 50  # in a file
_LEAST = 1e-100  # smaller numbers, and larger than one over it, are not drawn

Rows = list[dict[str, float]]


@dataclass
class RunContents:
    """The files of a run.

    Attributes:
        folder: the run's.
        config: ``config.yaml``; empty where there is none.
        evaluation: ``evaluation.json``; likewise.
        rows: of ``progress.csv``; likewise.
        demo: ``demo.hdf5``.
        episode: ``episode.hdf5``.
        kept: ``success_buffer.npz``.
        calibration: ``calibration.json``.
        warnings: ``warnings.jsonl``, what `regil_sb3.watch` has said.
        missing: a line for each file that is not there, though a run has one, or cannot be read.
    """

    folder: Path
    config: dict[str, Any]
    evaluation: dict[str, Any]
    rows: Rows
    demo: Demonstration | None
    episode: Demonstration | None
    kept: SuccessFilms | None
    calibration: dict[str, Any] | None
    warnings: list[dict[str, Any]] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)

    @property
    def env(self) -> str:
        """The environment's id; where nothing says it, the folder's name."""
        own = self.demo.metadata.get("env_id") if self.demo else None
        return str(self.config.get("env") or own or self.folder.resolve().name)


def read_run(run: Path | str) -> RunContents:
    """Read a run folder, complete or interrupted.

    Raises:
        ValueError: if it is not a run folder.
    """
    run = Path(run)
    if not any((run / name).is_file() for name in _MARKS):
        raise ValueError(
            f"'{run}' is not a run folder: it has none of {', '.join(_MARKS)}: "
            "give the folder that `regil train` wrote"
        )
    missing: list[str] = []

    def read(name: str, reader: Callable[[Path], Any], optional: bool = False) -> Any:
        """None where there is nothing, after noting why."""
        if not (run / name).is_file():
            if not optional:
                missing.append(f"{name} is not there")
            return None
        try:
            return reader(run / name)
        except (*DAMAGED, yaml.YAMLError, csv.Error) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            missing.append(f"{name} cannot be read: {reason}")
            return None

    return RunContents(
        folder=run,
        config=read("config.yaml", _yaml) or {},
        evaluation=read("evaluation.json", _json) or {},
        rows=read("progress.csv", _progress) or [],
        demo=read("demo.hdf5", Demonstration.load),
        episode=read("episode.hdf5", Demonstration.load),
        kept=read("success_buffer.npz", load_films, optional=True),
        calibration=read("calibration.json", _json, optional=True),
        warnings=read("warnings.jsonl", read_warnings, optional=True) or [],
        missing=missing,
    )


def _mapping(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"it holds a {type(value).__name__} where a mapping was expected")
    stack, seen = [(value, 0)], 0
    while stack:  # of aliases one within the other a few lines make any number
        item, depth = stack.pop()
        seen += 1
        if seen > _MOST_VALUES or depth > _DEEPEST:
            raise ValueError("it holds itself, or far more than a run says")
        if isinstance(item, dict | list):
            inside = item.values() if isinstance(item, dict) else item
            stack += [(one, depth + 1) for one in inside]
    return {str(key): item for key, item in value.items()}


def _yaml(path: Path) -> dict[str, Any]:
    config = _mapping(yaml.safe_load(path.read_text("utf-8")))
    if not isinstance(config.get("defaults") or {}, dict):
        raise ValueError("its defaults are no mapping")
    return config


def _json(path: Path) -> dict[str, Any]:
    return _mapping(json.loads(path.read_text("utf-8")))


def _progress(path: Path) -> Rows:
    """Read SB3's CSV log; empty, non-finite and half-written cells are left out."""
    with path.open(newline="", encoding="utf-8") as lines:
        rows = [
            {key: n for key, cell in row.items() if key and (n := number(cell)) is not None}
            for row in csv.DictReader(lines)
        ]
    return [row for row in rows if STEPS in row]


def read_warnings(file: Path) -> list[dict[str, Any]]:
    """The warnings of a run, in the order in which they came; broken lines are left out.

    Args:
        file: that a `Watch` has written.
    """
    found = []
    for line in file.read_text("utf-8", errors="replace").splitlines() if file.is_file() else []:
        try:
            value = json.loads(line)
        except (json.JSONDecodeError, RecursionError):
            continue
        if isinstance(value, dict) and {"step", "kind", "text"} <= value.keys():
            found.append(value)
    return found


def number(value: Any) -> float | None:
    """A finite number of a size that can be drawn, or None."""
    try:
        found = float(value)
    except (TypeError, ValueError):
        return None
    return found if found == 0 or _LEAST <= abs(found) <= 1 / _LEAST else None


def column(rows: Rows, name: str) -> list[tuple[float, float]]:
    """(step, value) of each row that has one."""
    return [(row[STEPS], row[name]) for row in rows if name in row]


def successes(result: Any) -> list[bool]:
    """Per-episode outcomes; for files that hold only a rate, as many as make that rate."""
    if not isinstance(result, dict):
        return []
    if isinstance(result.get("successes"), list):
        return [bool(success) for success in result["successes"]]
    rate, episodes = number(result.get("success")), number(result.get("episodes"))
    if rate is None or episodes is None or not 0 <= episodes <= _MOST_VALUES:
        return []
    return [i < round(rate * episodes) for i in range(int(episodes))]
