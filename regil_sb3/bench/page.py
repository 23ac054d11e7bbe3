"""What tables are asked for, and where they are written.

* ``said`` - ``zoo_configs/tables.yml``
* ``write`` - a table in Markdown and LaTeX: the command above, what it was measured on below
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from regil_sb3.files import replacing

__all__ = ["said", "write"]


def said() -> dict[str, Any]:
    """The settings of tables, and under "paper" the paper's figures, by table."""
    text = (resources.files("regil_sb3.zoo_configs") / "tables.yml").read_text(encoding="utf-8")
    tables: dict[str, Any] = yaml.safe_load(text)
    return tables


def write(
    folder: Path, name: str, options: Mapping[str, Any], table: Sequence[str], below: str
) -> None:
    """Write ``NAME.md`` and ``NAME.tex``.

    Args:
        folder: where.
        name: of the table, as `regil bench` takes it.
        options: of the command that makes it.
        table: lines of Markdown.
        below: what stands below it.
    """
    command = f"    regil bench {name}{_words(options)}"
    for suffix, text in (
        ("md", "\n".join([command, "", *table, "", below, ""])),
        ("tex", _latex(table)),
    ):
        with replacing(folder / f"{name}.{suffix}") as file:
            file.write(text.encode())


def _words(options: Mapping[str, Any]) -> str:
    words = ""
    for option, value in options.items():
        values = value if isinstance(value, list | tuple) else [value]
        words += f" --{option} {' '.join(map(str, values))}"
    return words


def _latex(lines: Sequence[str]) -> str:
    """The same table in LaTeX (booktabs)."""
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    head, body = cells[0], cells[2:]
    rows = [
        " & ".join(row).replace("%", r"\%").replace("_", r"\_") + r" \\" for row in [head, *body]
    ]
    return "\n".join(
        [
            r"\begin{tabular}{l" + "c" * (len(head) - 1) + "}",
            r"\toprule",
            rows[0],
            r"\midrule",
            *rows[1:],
            r"\bottomrule",
            r"\end{tabular}",
            "",
        ]
    )
