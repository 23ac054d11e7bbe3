"""Frames in, HTML out: films that a page's script plays, and the picture of an alignment.

- `data_uri`: a picture as text.
- `film_player`: the demonstration beside an episode; with an alignment, the distances between the
  two, the warping path and the reward of the frame that is shown.
- `mosaic`: many short films that play together.

Knows nothing of runs or encoders. The script is in ``report.html``: each ``.player`` holds its
canvases, its slider and, as JSON, its data.
"""

import base64
import html
import json
import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from regil_wrappers import Demonstration

from regil_sb3.report.charts import Line, line_chart
from regil_sb3.report.episode_alignment import AlignedEpisode

__all__ = ["data_uri", "film_player", "mosaic"]

Image = npt.NDArray[np.uint8]
_THUMBS = 8  # frames along each side of the distances
_THUMB, _SIZE = 50, 50 * _THUMBS  # SVG units
_MOSAIC_RATE = 8  # pictures a second


def data_uri(image: Image, suffix: str) -> str:
    """An (H, W, 3) RGB uint8 image as a data URI in the format ``suffix`` (".png" or ".jpg")."""
    done, code = cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    if not done:
        raise ValueError(f"an image of shape {image.shape} cannot be written as {suffix}")
    kind = {".png": "png", ".jpg": "jpeg"}[suffix]
    return f"data:image/{kind};base64,{base64.b64encode(code.tobytes()).decode()}"


def _clip(role: str, name: str, frames: Image) -> dict[str, Any]:
    """All frames in one JPEG, row by row, and what the script needs to find one."""
    count, height, width, _ = frames.shape
    columns = math.ceil(math.sqrt(count))
    lines = math.ceil(count / columns)
    sheet = np.zeros((lines * columns, height, width, 3), np.uint8)
    sheet[:count] = frames
    sheet = sheet.reshape(lines, columns, height, width, 3).swapaxes(1, 2)
    return {
        "role": role,
        "name": name,
        "sprite": data_uri(sheet.reshape(lines * height, columns * width, 3), ".jpg"),
        "columns": columns,
        "length": count,
        "width": width,
        "height": height,
    }


def _figure(clip: dict[str, Any], caption: str) -> str:
    return (
        f'<figure><canvas width="{clip["width"]}" height="{clip["height"]}" role="img" '
        f'aria-label="{html.escape(caption)}"></canvas>'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def _controls(last: int, more: str = "") -> str:
    return (
        '<div class="controls"><button type="button" class="play">Play</button>'
        f'<input type="range" class="time" aria-label="frame" min="0" value="0" max="{last}">'
        f'{more}</div><p class="soft small now"></p>'
    )


def _data(clips: list[dict[str, Any]], **own: Any) -> str:
    # "<" cannot end the script element this way, whatever a file holds.
    text = json.dumps({"clips": clips, **own}).replace("<", "\\u003c")
    return f'<script type="application/json" class="player-data">{text}</script>'


def film_player(
    demo: Demonstration | None, episode: Demonstration | None, alignment: AlignedEpisode | None
) -> str:
    """The demonstration beside the evaluation episode; "" without either.

    With an alignment (which needs both): all that retrieval knew at the frame that is shown.
    """
    named = (("demo", "demonstration", demo), ("episode", "evaluation episode", episode))
    given = [(role, label, film) for role, label, film in named if film is not None]
    if not given:
        return ""
    clips, figures = [], []
    for role, label, film in given:
        clips.append(_clip(role, f"{label}: frame", film.frames))
        caption = label[0].upper() + label[1:]
        if film is episode and "success" in film.metadata:
            caption += " (success)" if film.metadata["success"] else " (failure)"
        figures.append(_figure(clips[-1], caption))
    rates = [film.metadata.get("control_rate") for _, _, film in given]
    rate = next((rate for rate in rates if isinstance(rate, int | float) and rate > 0), 20)
    films = f'<div class="films">{"".join(figures)}</div>'
    last = max(clip["length"] for clip in clips) - 1
    if alignment is None or demo is None or episode is None:
        return f'<div class="player">{films}{_controls(last)}{_data(clips, rate=rate)}</div>'
    follow = (
        '<label class="small"><input type="checkbox" class="follow" checked> '
        "show the matched demonstration frame</label>"
    )
    data = _data(
        clips,
        rate=rate,
        ends=alignment.ends,
        paths=alignment.paths,
        rewards=[round(value, 4) for value in alignment.rewards],
    )
    rewards = [(t + 1.0, value) for t, value in enumerate(alignment.rewards)]
    chart = line_chart(
        [Line(f"reward {alignment.reward}", "policy", rewards)], x_label="frame of the episode"
    )
    return (
        f'<div class="player aligned"><div>{films}{_controls(len(episode) - 1, follow)}{chart}'
        f"</div><div>{_distances(demo, episode, alignment)}</div>{data}</div>"
    )


def mosaic(films: Sequence[tuple[str, Image]]) -> str:
    """Short films, (pictures, H, W, 3) uint8 each, with their captions, that play together."""
    if not films:
        return ""
    clips = [_clip("part", caption, film) for caption, film in films]
    figures = "".join(
        _figure(clip, caption) for clip, (caption, _) in zip(clips, films, strict=True)
    )
    last = max(clip["length"] for clip in clips) - 1
    data = _data(clips, rate=_MOSAIC_RATE, stretch=True)
    return (
        f'<div class="player"><div class="films many">{figures}</div>{_controls(last)}{data}</div>'
    )


def _distances(demo: Demonstration, episode: Demonstration, alignment: AlignedEpisode) -> str:
    """Distances of every episode frame to every demonstration frame, and the matched frames."""
    rows, columns = alignment.distances.shape
    # The root spreads the small distances apart, which are the ones the path chooses between.
    shade = np.sqrt(alignment.distances / max(alignment.distances.max(), 1e-12))
    colors = cv2.applyColorMap((255 * shade).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    picture = data_uri(cv2.cvtColor(colors, cv2.COLOR_BGR2RGB), ".png")
    parts = []
    for film, down in ((demo, False), (episode, True)):
        frames = film.frames
        for i in range(_THUMBS):
            frame = frames[min(int((i + 0.5) * len(frames) / _THUMBS), len(frames) - 1)]
            x, y = (0, _THUMB * (i + 1)) if down else (_THUMB * (i + 1), 0)
            parts.append(
                f'<image x="{x}" y="{y}" width="{_THUMB - 2}" height="{_THUMB - 2}" '
                f'href="{data_uri(frame, ".jpg")}"/>'
            )
    matched = " ".join(
        f"{_THUMB + (j + 0.5) * _SIZE / columns:.1f},{_THUMB + (t + 0.5) * _SIZE / rows:.1f}"
        for t, j in enumerate(alignment.ends)
    )
    parts.append(
        f'<image class="pixels" x="{_THUMB}" y="{_THUMB}" width="{_SIZE}" height="{_SIZE}" '
        f'preserveAspectRatio="none" href="{picture}"/>'
        f'<polyline class="path" points="{matched}"/>'
    )
    return (
        f'<svg class="matrix" viewBox="0 0 {_THUMB + _SIZE} {_THUMB + _SIZE}" role="img" '
        f'data-grid="{_THUMB} {_SIZE} {rows} {columns}" '
        f'aria-label="distances and warping path">{"".join(parts)}</svg>'
        '<p class="soft small">Columns: the demonstration. Rows, downwards: the evaluation '
        "episode. Dark is near. Orange: the demonstration frame that each episode frame is matched "
        "with. White: the warping path of the window that ends with the frame that is shown. "
        "Click to go there.</p>"
    )
