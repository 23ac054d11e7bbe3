"""One HTML page that needs no other file and no network; cards and tables to put on it.

* ``write_page`` - the page, with the styles and the script that plays films
* ``card``
* ``config_table``, ``flat`` - nested settings as one table
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from regil_sb3.files import replacing

__all__ = ["card", "config_table", "flat", "write_page"]


def write_page(
    path: Path, title: str, headline: str, body: str, footer: str, missing: Sequence[str] = ()
) -> None:
    """Write a page; an existing file is replaced at once, missing folders are made.

    Args:
        path: the file.
        title: text.
        headline: HTML under the title.
        body: HTML.
        footer: HTML.
        missing: lines of text about what is not on the page.
    """
    lines = "".join(f"<li>{html.escape(line)}</li>" for line in missing)
    warned = f'<div class="card missing"><b>Missing from this page</b><ul>{lines}</ul></div>'
    page = Template(files("regil_sb3.report").joinpath("page.html").read_text("utf-8")).substitute(
        title=html.escape(title),
        headline=headline,
        missing=warned if missing else "",
        body=body,
        footer=footer,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        file.write(page.encode())


def card(title: str, content: str, kind: str = "") -> str:
    """A titled box of HTML; nothing where there is no content."""
    return f'<section class="card {kind}"><h2>{title}</h2>{content}</section>' if content else ""


def config_table(config: dict[str, Any]) -> str:
    """Nested settings as one flat table, ``outer.inner`` beside its value."""
    rows = []
    for key, value in flat(config):
        rows.append(f"<tr><td>{html.escape(key)}</td><td>{html.escape(str(value))}</td></tr>")
    return f"<table>{''.join(rows)}</table>" if rows else ""


def flat(settings: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Nested settings as pairs of ``outer.inner`` and value."""
    pairs: list[tuple[str, Any]] = []
    for key, value in settings.items():
        if isinstance(value, list) and any(isinstance(item, dict) for item in value):
            value = {str(i): item for i, item in enumerate(value)}
        nested = isinstance(value, dict) and value
        pairs += flat(value, f"{prefix}{key}.") if nested else [(f"{prefix}{key}", value)]
    return pairs
