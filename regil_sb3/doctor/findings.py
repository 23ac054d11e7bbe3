"""What an examination found, line by line.

* ``Finding`` - one check, its verdict, one line
* ``table`` - findings for a terminal
* ``status`` - findings for a script
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

__all__ = ["Finding", "Picture", "Verdict", "listed", "status", "table"]

Verdict = Literal["ok", "warning", "wrong"]
Picture = npt.NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Finding:
    """One check.

    Attributes:
        check: its name.
        verdict: "ok"; "warning", it may work all the same; "wrong", it cannot work like this.
        line: what is, and, where it is not ok, what would be right.
        pictures: what shows it: captions and (H, W, 3) uint8 pictures.
    """

    check: str
    verdict: Verdict
    line: str
    pictures: Sequence[tuple[str, Picture]] = ()


def table(findings: Iterable[Finding], width: int = 100) -> str:
    """Three columns: verdict, check, line, wrapped to so many characters."""
    rows = list(findings)
    name = max((len(f.check) for f in rows), default=0)
    indent = " " * (9 + name + 2)
    return "\n".join(
        textwrap.fill(
            f.line,
            max(width, len(indent) + 20),
            initial_indent=f"{f.verdict:<9}{f.check:<{name}}  ",
            subsequent_indent=indent,
            break_on_hyphens=False,
        )
        for f in rows
    )


def status(findings: Iterable[Finding]) -> int:
    """Exit status: 1 where something is wrong, else 0; warnings alone are 0."""
    return int(any(f.verdict == "wrong" for f in findings))


def listed(counts: Sequence[bool]) -> str:
    """How many of how many, in words."""
    return f"{sum(counts)} of {len(counts)}"
