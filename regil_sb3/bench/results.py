"""`regil bench results`: every table that is kept, on one page, and which are not there yet.

Nothing is measured, and nothing is written by hand: a table's command stands above it, and what it
was measured on below it, as the table itself was written.
"""

from __future__ import annotations

from pathlib import Path

from regil_sb3.bench.run_tables import LEARNING
from regil_sb3.files import replacing

__all__ = ["KEPT", "main"]

KEPT = ("sensitivity", "success-buffer", *LEARNING)
"""Tables that write ``NAME.md`` into their folder."""


def main(out: str = "bench", page: str = "docs/results.md") -> None:
    """Write the page.

    Args:
        out: the tables' folder.
        page: the Markdown file.

    Raises:
        ValueError: there is no table in the folder, or no folder for the page.
    """
    found = {name: Path(out) / f"{name}.md" for name in KEPT}
    found = {name: path for name, path in found.items() if path.exists()}
    if not found:
        raise ValueError(f"--out {out}: no table is there; make one: regil bench {KEPT[0]}")
    if not Path(page).absolute().parent.is_dir():
        raise ValueError(f"--page {page}: there is no folder {Path(page).parent}")
    parts = ["# Results", "Written by `regil bench results`, from tables that it keeps."]
    parts += [f"## {name}\n\n{path.read_text('utf-8').rstrip()}" for name, path in found.items()]
    missing = [f"* `regil bench {name}`" for name in KEPT if name not in found]
    if missing:
        parts.append("\n".join(["## Not measured yet", "", *missing]))
    with replacing(Path(page)) as file:
        file.write(("\n\n".join(parts) + "\n").encode())
    print(f"{page}: {', '.join(found)}" + (f"; {len(missing)} not there yet" if missing else ""))
