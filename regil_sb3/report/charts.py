"""Numbers in, inline SVG out: line charts with two axes, for pages that load nothing.

- `Line`: one series.
- `line_chart`: series, shaded bands and a legend as HTML.

Knows nothing of runs. Colours are CSS variables of the page, so a chart follows its theme.
"""

import html
import math
from collections.abc import Sequence
from typing import NamedTuple

__all__ = ["Line", "Point", "line_chart"]

Point = tuple[float, float]

# SVG units. Text is sized for a chart that is about 480 CSS pixels wide.
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 480, 290, 52, 52, 12, 44


class Line(NamedTuple):
    """One series of a chart.

    Attributes:
        label: Its text in the legend.
        color: Name of a CSS variable of the page, without the dashes.
        points: (x, y) pairs, finite.
        style: "solid", "dashed", "dotted" or "dots".
        right: Whether it is read on the right axis.
        spread: (x, low, high) of an area around it, finite.
    """

    label: str
    color: str
    points: Sequence[Point]
    style: str = "solid"
    right: bool = False
    spread: Sequence[tuple[float, float, float]] = ()


def _ticks(low: float, high: float, count: int = 5) -> list[float]:
    """About ``count`` round numbers from at or below ``low`` to at or above ``high``."""
    if high <= low:
        high = low + (abs(low) or 1.0)
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= raw * 0.999)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [i * step for i in range(first, last + 1)]


def _format(value: float, percent: bool) -> str:
    if percent:
        return f"{100 * value:.0f} %"
    if abs(value) >= 1000:
        return f"{value / 1000:g}k"
    return f"{value:.3g}"


def line_chart(
    lines: Sequence[Line],
    bands: Sequence[Point] = (),
    band_label: str = "",
    x_label: str = "steps",
    percent: bool = False,
) -> str:
    """Draw series over a common x axis that starts at 0.

    Args:
        lines: The series; those without points are left out.
        bands: (start, end) pairs on the x axis to shade.
        band_label: Their text in the legend.
        x_label: Title of the x axis.
        percent: Whether the left axis is a rate, drawn from 0 to 100 %.

    Returns:
        HTML: an ``svg`` and its legend; "" if no series has points. Its ``data-plot`` says where
        the axes are: left, top, right, bottom and the x value at the right.
    """
    lines = [line for line in lines if line.points]
    if not lines:
        return ""
    right_edge, bottom = _WIDTH - _RIGHT, _HEIGHT - _BOTTOM
    x_high = max(max(x for line in lines for x, _ in line.points), 1.0)

    def across(x: float) -> float:
        return _LEFT + (right_edge - _LEFT) * min(x / x_high, 1.0)

    parts = [
        f'<rect class="band" x="{across(start):.1f}" y="{_TOP}" '
        f'width="{across(end) - across(start):.1f}" height="{bottom - _TOP}"/>'
        for start, end in bands
    ]
    for tick in _ticks(0.0, x_high, 4):
        if tick <= x_high:
            parts.append(
                f'<text x="{across(tick):.1f}" y="{bottom + 18}" text-anchor="middle">'
                f"{_format(tick, False)}</text>"
            )
    middle = (_LEFT + right_edge) / 2
    parts.append(
        f'<text x="{middle}" y="{_HEIGHT - 6}" text-anchor="middle">{html.escape(x_label)}</text>'
    )
    for right in (False, True):
        here = [line for line in lines if line.right is right]
        if not here:
            continue
        values = [y for line in here for _, y in line.points]
        values += [y for line in here for _, *both in line.spread for y in both]
        as_rate = percent and not right
        ticks = (
            [i / 5 for i in range(6)] if as_rate else _ticks(min(*values, 0.0), max(*values, 0.0))
        )
        low, high = ticks[0], ticks[-1]

        def up(y: float, low: float = low, high: float = high) -> float:
            return bottom - (bottom - _TOP) * (y - low) / (high - low)

        for tick in ticks:
            y = up(tick)
            if not right:
                parts.append(
                    f'<line class="axis" x1="{_LEFT}" x2="{right_edge}" y1="{y:.1f}" y2="{y:.1f}"/>'
                )
            edge, anchor = (right_edge + 6, "start") if right else (_LEFT - 6, "end")
            parts.append(
                f'<text x="{edge}" y="{y + 4.5:.1f}" text-anchor="{anchor}">'
                f"{_format(tick, as_rate)}</text>"
            )
        for line in here:
            where = [(across(x), up(y)) for x, y in line.points]
            style = f'style="--c:var(--{line.color})"'
            if line.spread:
                rim = [(x, high) for x, _, high in line.spread]
                rim += [(x, low) for x, low, _ in reversed(line.spread)]
                corners = " ".join(f"{across(x):.1f},{up(y):.1f}" for x, y in rim)
                parts.append(f'<polygon class="spread" {style} points="{corners}"/>')
            if line.style != "dots":
                dots = " ".join(f"{x:.1f},{y:.1f}" for x, y in where)
                parts.append(f'<polyline class="series {line.style}" {style} points="{dots}"/>')
            # A series of one point would leave no ink as a polyline.
            if line.style == "dots" or len(where) == 1:
                for (x, y), (step, value) in zip(where, line.points, strict=True):
                    title = f"{line.label}: {_format(value, as_rate)} at {step:,.0f}"
                    parts.append(
                        f'<circle class="dot" {style} cx="{x:.1f}" cy="{y:.1f}" r="4.5">'
                        f"<title>{html.escape(title)}</title></circle>"
                    )
    entries = [(line.label, line.color, line.style) for line in lines]
    if bands:
        entries.append((band_label, "guided", "area"))
    legend = "".join(
        f'<span><i class="{style}" style="--c:var(--{color})"></i>{html.escape(label)}</span>'
        for label, color, style in entries
    )
    names = html.escape(", ".join(label for label, _, _ in entries), quote=True)
    return (
        f'<svg class="chart" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{names}" '
        f'data-plot="{_LEFT} {_TOP} {right_edge} {bottom} {x_high:g}">'
        f'{"".join(parts)}</svg><div class="legend">{legend}</div>'
    )
