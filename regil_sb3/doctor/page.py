"""Findings as one HTML page that needs no other file and no network.

* ``write_page`` - the report's page, with a table of findings, their pictures and the film
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path

from regil_wrappers import Demonstration

from regil_sb3.doctor.findings import Finding
from regil_sb3.report import page
from regil_sb3.report.pictures import data_uri, film_player

__all__ = ["write_page"]

_COLOURS = {"ok": "var(--lambda)", "warning": "var(--guide)", "wrong": "#d1242f"}
_SUMMARY = {
    "ok": "Nothing speaks against training with this demonstration.",
    "warning": "It may work; read the warnings first.",
    "wrong": "It cannot work like this.",
}


def write_page(
    path: Path | str, title: str, findings: Sequence[Finding], demo: Demonstration
) -> None:
    """Write the page.

    Args:
        path: the file; an existing one is replaced at once.
        title: of the page.
        findings: in the order they are shown in.
        demo: whose film is shown.

    Raises:
        ValueError: if the path is a folder.
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"--html '{path}' is a folder: give the name of an HTML file")
    verdicts = {f.verdict for f in findings}
    worst = next((v for v in ("wrong", "warning") if v in verdicts), "ok")
    rows = "".join(map(_row, findings))
    film = f"<h2>Demonstration</h2>{film_player(demo, None, None)}"
    cards = (f"<table>{rows}</table>", film)
    page.write_page(
        path,
        title,
        f'<p style="color:{_COLOURS[worst]}"><b>{_SUMMARY[worst]}</b></p>',
        "".join(f'<section class="card wide">{card}</section>' for card in cards),
        "Made by regil doctor.",
    )


def _row(finding: Finding) -> str:
    pictures = "".join(
        f'<figure style="margin:0"><img class="pixels" width="168" alt="{html.escape(caption)}" '
        f'src="{data_uri(picture, ".png")}"><figcaption class="soft small">{html.escape(caption)}'
        "</figcaption></figure>"
        for caption, picture in finding.pictures
    )
    shown = f'<div class="legend">{pictures}</div>' if pictures else ""
    return (
        f'<tr><td><b style="color:{_COLOURS[finding.verdict]}">{finding.verdict}</b> '
        f"{html.escape(finding.check)}</td><td>{html.escape(finding.line)}{shown}</td></tr>"
    )
