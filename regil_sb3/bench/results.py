"""`regil bench results`: every table that is kept, on one page, and which are not there yet.

Nothing is measured, and nothing is written by hand: a table's command stands above it, and what it
was measured on below it, as the table itself was written. Beside the page stands one of the same
name in HTML, with the tables' pictures; of tables whose rows are training runs it draws success
over steps and how probably a method beats the first, from the run folders.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from pathlib import Path

from regil_sb3.bench.run_tables import LEARNING, planned
from regil_sb3.files import replacing
from regil_sb3.report.comparison import MOST, NOTE, plots, scores
from regil_sb3.report.page import card, write_page
from regil_sb3.report.run_contents import RunContents, read_run

__all__ = ["KEPT", "main"]

KEPT = {
    "sensitivity": "",
    "success-buffer": "",
    **dict.fromkeys(LEARNING, ""),
    "buffer-vs-learning": "",
    "trajectories": " --runs RUN",
    "latency": "",
    "real-time": "",
}
"""Tables that write ``NAME.md`` into their folder, and what their commands cannot do without."""


def main(out: str = "bench", page: str = "docs/results.md") -> None:
    """Write both pages.

    Args:
        out: the tables' folder.
        page: the Markdown file; the other one's name ends in ``.html``.

    Raises:
        ValueError: there is no table in the folder, one is damaged, or the page cannot be there.
    """
    found = {path.stem: path for name in KEPT for path in _written(Path(out), name)}
    if not found:
        raise ValueError(
            f"--out {out}: no table is there; make one: regil bench {next(iter(KEPT))}"
        )
    markdown = Path(page)
    if not markdown.absolute().parent.is_dir():
        raise ValueError(f"--page {page}: there is no folder {markdown.parent}")
    if markdown.suffix != ".md":
        raise ValueError(f"--page {page}: its name must end in .md")
    texts = {name: path.read_text("utf-8").rstrip() for name, path in found.items()}
    for name, text in texts.items():
        if text.count("\n\n") != 2:
            raise ValueError(f"{found[name]} is no table: remove it, and it is made again")
    absent = [name for name in KEPT if name not in found]
    missing = {f"regil bench {name}{KEPT[name]}": "not measured yet" for name in absent}
    for name in (name for name in LEARNING if name in found):
        runs = planned(name, out)
        if todo := [run for run in runs if not run.finished]:
            missing[f"regil bench {name}"] = f"{len(todo)} of its {len(runs)} runs are not there"
    written = (
        f"Written by `regil bench results --out {out}`, from the tables that are kept there, as is "
        f"{markdown.with_suffix('.html').name} beside it (not kept in the repository): with "
        "pictures of tables, success over steps, and how probably a method's run beats another's."
    )
    parts = ["# Results", written]
    parts += [f"## {name}\n\n{text}" for name, text in texts.items()]
    if missing:
        lines = [f"* `{command}`: {why}" for command, why in missing.items()]
        parts.append("\n".join(["## Not measured yet", "", *lines]))
    cards, gone = [], [f"{command}: {why}" for command, why in missing.items()]
    for name, text in texts.items():
        learned = name.startswith(LEARNING)
        drawn, lacking = _learning(Path(out), name) if learned else ("", [])
        cards.append(card(name, _as_html(text) + _picture(Path(out) / f"{name}.png"), "wide"))
        cards.append(drawn)
        gone += lacking
    with replacing(markdown) as file:
        file.write(("\n\n".join(parts) + "\n").encode())
    write_page(markdown.with_suffix(".html"), "ReGIL: results", "", "".join(cards), NOTE, gone)
    print(f"{page}: {', '.join(found)}" + (f"; {len(absent)} not there yet" if absent else ""))


def _written(out: Path, name: str) -> list[Path]:
    """A table's files: of its own steps, then of others (``NAME-STEPS.md``)."""
    others = {path.stem[len(name) + 1 :]: path for path in out.glob(f"{name}-*.md")}
    longer = {int(steps): path for steps, path in others.items() if steps.isdecimal()}
    paths = [out / f"{name}.md", *(longer[steps] for steps in sorted(longer))]
    return [path for path in paths if path.exists()]


def _learning(out: Path, name: str) -> tuple[str, list[str]]:
    """Plots of a table's runs, and a line for each run that is not there any more."""
    from pyarrow import parquet  # type: ignore[import-untyped]

    rows = out / f"{name}.parquet"
    columns = parquet.read_table(rows).to_pydict()
    try:
        of_rows = zip(columns["method"], columns["run"], columns["evaluated"], strict=True)
    except KeyError as error:
        raise ValueError(f"{rows} has no column {error}: its command makes it anew") from None
    named: dict[str, list[RunContents]] = {}
    gone = []
    for method, run, evaluated in dict.fromkeys(of_rows):
        if evaluated != "policy":
            continue  # it learned nothing
        if (out / run / "evaluation.json").exists():
            named.setdefault(method, []).append(read_run(out / run))
        else:
            gone.append(f"{out / run}, a run of {name}, is not there any more")
    return "".join(scores(part) + plots(part) for part in _parts(named)), gone


def _parts(named: dict[str, list[RunContents]]) -> list[dict[str, list[RunContents]]]:
    """What is drawn together: all, or of too many each method and its own changes."""
    if len(named) <= MOST:
        return [named] if named else []
    parts: dict[str, dict[str, list[RunContents]]] = {}
    for method, runs in named.items():
        own = next((first for first in parts if method.startswith(f"{first}_")), method)
        parts.setdefault(own, {})[method] = runs
    return list(parts.values())


def _picture(path: Path) -> str:
    if not path.exists():
        return ""
    code = base64.b64encode(path.read_bytes()).decode()
    return f'<img alt="{html.escape(path.stem)}" src="data:image/png;base64,{code}">'


def _as_html(text: str) -> str:
    """A table as `regil_sb3.bench.page.write` writes it: command, table, and what stands below."""
    command, table, below = text.split("\n\n")
    head, _, *rows = (_cells(line) for line in table.splitlines())
    lines = [f"<tr>{''.join(f'<th>{cell}</th>' for cell in head)}</tr>"]
    lines += [f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows]
    return (
        f"<p><code>{html.escape(command.strip())}</code></p>"
        f'<div class="scroll"><table class="figures">{"".join(lines)}</table></div>'
        f'<p class="soft small">{html.escape(below)}</p>'
    )


def _cells(line: str) -> Sequence[str]:
    return [html.escape(cell.strip().strip("*")) for cell in line.strip("|").split("|")]
