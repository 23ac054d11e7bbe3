"""What tables are asked for, and where they are written.

* ``said`` - ``zoo_configs/tables.yml``
* ``write`` - a table in Markdown and LaTeX, the command above, what it was measured on below; and
  as parquet what it was made from
* ``figure`` - a picture beside it
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from typing import Any

import yaml
from regil_wrappers.limits import need

from regil_sb3.files import replacing

__all__ = ["figure", "need_parquet", "said", "write"]


def said() -> dict[str, Any]:
    """The settings of tables, and under "paper" the paper's figures, by table."""
    text = (resources.files("regil_sb3.zoo_configs") / "tables.yml").read_text(encoding="utf-8")
    tables: dict[str, Any] = yaml.safe_load(text)
    return tables


def write(
    folder: Path,
    name: str,
    options: Mapping[str, Any],
    table: Sequence[str],
    below: str,
    rows: Sequence[Mapping[str, Any]],
    called: str = "",
) -> None:
    """Write ``NAME.md``, ``NAME.tex`` and ``NAME.parquet``.

    Args:
        folder: where.
        name: of the table, as `regil bench` takes it.
        options: of the command that makes it.
        table: lines of Markdown.
        below: what stands below it.
        rows: what it was made from, of equal keys.
        called: the files' name; "": ``name``.

    Raises:
        ImportError: pyarrow is not installed.
    """
    import pyarrow as pa  # type: ignore[import-untyped]
    from pyarrow import parquet

    called = called or name
    command = f"    regil bench {name}{_words(options)}"
    folder.mkdir(parents=True, exist_ok=True)
    for suffix, text in (
        ("md", "\n".join([command, "", *table, "", below, ""])),
        ("tex", _latex(table)),
    ):
        with replacing(folder / f"{called}.{suffix}") as file:
            file.write(text.encode())
    with replacing(folder / f"{called}.parquet") as file:
        parquet.write_table(pa.Table.from_pylist(list(rows)), file)


def need_parquet(table: str) -> None:
    """Refuse to begin a table whose rows could not be written.

    Raises:
        ImportError: pyarrow is not installed.
    """
    need("pyarrow.parquet", "lerobot", f"regil bench {table}")


@contextmanager
def figure(path: Path, rows: int = 1, columns: int = 1) -> Iterator[Any]:
    """Panels to draw on, (rows, columns) of Matplotlib's axes, then saved as a PNG file."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    size = (4.6 * columns, 3.6 * rows)
    drawn, axes = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
    try:
        yield axes
        with replacing(path) as file:
            drawn.savefig(file, format="png", dpi=110)
    finally:
        plt.close(drawn)


def _words(options: Mapping[str, Any]) -> str:
    words = ""
    for option, value in options.items():
        words += f" --{option.replace('_', '-')}"
        values = value if isinstance(value, list | tuple) else [value]
        words += "".join(f" {one}" for one in values if one is not True)
    return words


def _latex(lines: Sequence[str]) -> str:
    """The same table in LaTeX (booktabs)."""
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    head, body = cells[0], cells[2:]
    rows = [" & ".join(map(_latex_cell, row)) + r" \\" for row in [head, *body]]
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


def _latex_cell(cell: str) -> str:
    cell = cell.replace("%", r"\%").replace("_", r"\_").replace("±", r"$\pm$")
    return re.sub(r"\*\*(.+?)\*\*", r"\\textbf{\1}", cell)
