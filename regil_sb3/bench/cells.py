"""What tables are measured from: cells, each kept in a file and never measured twice.

* ``Cell`` - what is asked, and how it is found
* ``finish`` - measures those that are not kept, or says which they are
* ``predicted_hours``, ``below`` - how long that takes; what is to be said below a table
* ``rows`` - what a table is made from

A cell's file is named by all that decides what is found: what was asked, and the versions of
simulators and of this project. Another commit alone measures nothing again: the file says which it
was, and so does the line below a table.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from tqdm import tqdm

from regil_sb3.bench.machine import SIMULATORS, describe, together
from regil_sb3.files import replacing

__all__ = ["Cell", "below", "finish", "kind_of", "predicted_hours", "rows"]

_OF_KIND = {"libero": ("hf-libero", "robosuite"), "robosuite": ("robosuite",)}
_DECIDE = ("gymnasium", "mujoco", "regil-sb3", "regil-wrappers")
_SAID = ("gymnasium", *SIMULATORS, "numpy", "timm", "torch", "regil-sb3")


@dataclass(frozen=True)
class Cell:
    """One measurement.

    Attributes:
        folder: where it is kept.
        asked: JSON values that decide what is found; ``seed`` is the demonstration's.
        measure: finds it, JSON values by name.
        expected: seconds that it takes, roughly; only the ratio to others' counts in the end.
    """

    folder: Path
    asked: Mapping[str, Any]
    measure: Callable[[], Mapping[str, Any]]
    expected: float

    @cached_property
    def path(self) -> Path:
        """Its file: two cells with the same are the same cell."""
        versions = _versions(str(self.asked.get("env")))
        decides = json.dumps({**self.asked, "versions": versions}, sort_keys=True)
        return self.folder / f"{hashlib.sha256(decides.encode()).hexdigest()[:20]}.json"

    @property
    def kept(self) -> dict[str, Any] | None:
        """``asked``, ``found``, ``seconds`` and ``machine``; None before it is measured.

        Raises:
            ValueError: its file cannot be read.
        """
        if not self.path.exists():
            return None
        try:
            kept: dict[str, Any] = json.loads(self.path.read_text("utf-8"))
            if kept.keys() == {"asked", "found", "seconds", "machine"}:
                return kept
        except (ValueError, AttributeError):
            pass
        raise ValueError(f"{self.path} holds no cell of a table: remove it, and it is made again")

    @property
    def found(self) -> dict[str, Any]:
        """What was found.

        Raises:
            ValueError: it is not measured yet.
        """
        if (kept := self.kept) is None:
            raise ValueError(f"{self.path} is not measured yet")
        found: dict[str, Any] = kept["found"]
        return found


def kind_of(env: str) -> str:
    """What an environment's id begins with: "metaworld", "libero", "robosuite", "rehearsal", ..."""
    return env.removeprefix("regil/").partition("-")[0]


def _versions(env: str) -> dict[str, str]:
    """Of the packages that decide what is found in an environment."""
    found = {}
    for name in (*_DECIDE, *_OF_KIND.get(kind_of(env), ("metaworld",))):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _unique(cells: Sequence[Cell]) -> list[Cell]:
    return list({cell.path: cell for cell in cells}.values())


def predicted_hours(cells: Sequence[Cell]) -> float:
    """Hours that those not kept will take, by what the kept ones took."""
    cells = _unique(cells)
    told = [(kept["seconds"], cell.expected) for cell in cells if (kept := cell.kept)]
    ratio = sum(s for s, _ in told) / sum(e for _, e in told) if told else 1.0
    return ratio * sum(cell.expected for cell in cells if not cell.kept) / 3600


def finish(cells: Sequence[Cell], dry_run: bool = False) -> bool:
    """Measure what is not kept.

    Args:
        cells: of a table; those that are the same are measured once.
        dry_run: print what would be measured, and for how long, instead.

    Returns:
        whether all is kept now.

    Raises:
        ValueError: a kept file cannot be read.
    """
    cells = _unique(cells)
    missing = [cell for cell in cells if cell.kept is None]
    if dry_run:
        for cell in cells:
            print(f"{cell.path}: {'to measure' if cell in missing else 'kept'}, {dict(cell.asked)}")
        print(
            f"{len(missing)} of {len(cells)} cells to measure: about "
            f"{predicted_hours(cells):.2f} hours"
        )
        return not missing
    machine = describe(_SAID) if missing else ""
    shape = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}"
    total = sum(cell.expected for cell in missing)
    with tqdm(total=total, bar_format=shape, dynamic_ncols=True, disable=not missing) as bar:
        for done, cell in enumerate(missing):
            bar.set_description_str(f"{done} of {len(missing)} cells")
            if cell.kept is not None:  # by another bench, meanwhile
                bar.update(cell.expected)
                continue
            begun = time.perf_counter()
            kept = {
                "asked": dict(cell.asked),
                "found": dict(cell.measure()),
                "seconds": time.perf_counter() - begun,
                "machine": machine,
            }
            cell.folder.mkdir(parents=True, exist_ok=True)
            with replacing(cell.path) as file:
                file.write(json.dumps(kept, indent=1).encode())
            bar.update(cell.expected)
    return True


def below(cells: Sequence[Cell]) -> str:
    """Seeds, seconds, machines, versions and commits of kept cells, as one line."""
    kept = [kept for cell in _unique(cells) if (kept := cell.kept)]
    seeds = sorted({one["asked"]["seed"] for one in kept})
    minutes = sum(one["seconds"] for one in kept) / 60
    machines = together(one["machine"] for one in kept)
    return (
        f"Demonstrations of seeds {', '.join(map(str, seeds))}; {len(kept)} cells, {minutes:.1f} "
        f"minutes one after the other; {machines}"
    )


def rows(cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """A row of each kept cell: what was asked and found, by name, seconds and machine.

    What has names of its own is JSON text: the guide's arguments differ from cell to cell.
    """
    kept = [kept for cell in _unique(cells) if (kept := cell.kept)]
    found = [
        {**one["asked"], **one["found"], "seconds": one["seconds"], "machine": one["machine"]}
        for one in kept
    ]
    return [
        {name: json.dumps(v) if isinstance(v, dict) else v for name, v in row.items()}
        for row in found
    ]
