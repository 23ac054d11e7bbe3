"""Frames in, HTML out: a film player and the picture of an alignment, as data URIs.

- `AlignedEpisode`: what the retriever saw in an episode.
- `data_uri`: a picture as text.
- `film_player`: the demonstration beside an episode, for the page's script to play.
- `alignment_picture`: distances between the two and the aligned path, as inline SVG.

Knows nothing of runs or encoders.
"""

import base64
import json
import math
from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from regil_wrappers import Demonstration

__all__ = ["AlignedEpisode", "alignment_picture", "data_uri", "film_player"]

Image = npt.NDArray[np.uint8]
_THUMBS = 8  # frames along each side of the alignment picture


class AlignedEpisode(NamedTuple):
    """The evaluation episode seen by the retriever, frame by frame."""

    distances: npt.NDArray[np.float64]  # (episode frames, demonstration frames), >= 0
    ends: list[int]  # the demonstration frame each episode frame is aligned with
    paths: list[list[tuple[int, int]]]  # a few windows' paths: (episode frame, demonstration frame)


def data_uri(image: Image, suffix: str) -> str:
    """An (H, W, 3) RGB uint8 image as a data URI in the format ``suffix`` (".png" or ".jpg")."""
    done, code = cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    if not done:
        raise ValueError(f"an image of shape {image.shape} cannot be written as {suffix}")
    kind = {".png": "png", ".jpg": "jpeg"}[suffix]
    return f"data:image/{kind};base64,{base64.b64encode(code.tobytes()).decode()}"


def _sprite(frames: Image) -> tuple[str, int]:
    """All frames in one JPEG, row by row, and how many there are in a row."""
    count, height, width, _ = frames.shape
    columns = math.ceil(math.sqrt(count))
    lines = math.ceil(count / columns)
    sheet = np.zeros((lines * columns, height, width, 3), np.uint8)
    sheet[:count] = frames
    sheet = sheet.reshape(lines, columns, height, width, 3).swapaxes(1, 2)
    return data_uri(sheet.reshape(lines * height, columns * width, 3), ".jpg"), columns


def film_player(
    demo: Demonstration | None, episode: Demonstration | None, alignment: AlignedEpisode | None
) -> str:
    """The demonstration beside the evaluation episode: canvases, controls and their data."""
    named = (("film-demo", "demonstration", demo), ("film-episode", "evaluation episode", episode))
    given = [(name, label, film) for name, label, film in named if film is not None]
    if not given:
        return ""
    clips, figures = [], []
    for name, label, film in given:
        height, width = film.frames.shape[1:3]
        sprite, columns = _sprite(film.frames)
        clips.append(
            {
                "id": name,
                "name": f"{label}: frame",
                "sprite": sprite,
                "columns": columns,
                "length": len(film.frames),
                "width": width,
                "height": height,
            }
        )
        caption = label[0].upper() + label[1:]
        if film is episode and "success" in film.metadata:
            caption += " (success)" if film.metadata["success"] else " (failure)"
        figures.append(
            f'<figure><canvas id="{name}" width="{width}" height="{height}"></canvas>'
            f"<figcaption>{caption}</figcaption></figure>"
        )
    rates = [film.metadata.get("control_rate") for _, _, film in given]
    rate = next((rate for rate in rates if isinstance(rate, int | float) and rate > 0), 20)
    data = {"clips": clips, "rate": rate, "ends": alignment.ends if alignment else []}
    # "<" cannot end the script element this way, whatever a file holds.
    text = json.dumps(data).replace("<", "\\u003c")
    follow = (
        '<label class="small"><input type="checkbox" id="film-follow"> '
        "show the aligned demonstration frame</label>"
    )
    return (
        f'<div class="films">{"".join(figures)}</div>'
        '<div class="controls"><button type="button" id="film-play">Play</button>'
        f'<input type="range" id="film-time" aria-label="frame" min="0" value="0" '
        f'max="{max(clip["length"] for clip in clips) - 1}">{follow if alignment else ""}</div>'
        '<p class="soft small" id="film-label"></p>'
        f'<script type="application/json" id="film-data">{text}</script>'
    )


def alignment_picture(
    demo: Demonstration | None, episode: Demonstration | None, alignment: AlignedEpisode | None
) -> str:
    """Distances of every episode frame to every demonstration frame, and the aligned path."""
    if demo is None or episode is None or alignment is None:
        return ""
    rows, columns = alignment.distances.shape
    # The root spreads the small distances apart, which are the ones the path chooses between.
    shade = np.sqrt(alignment.distances / max(alignment.distances.max(), 1e-12))
    colors = cv2.applyColorMap((255 * shade).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    picture = data_uri(cv2.cvtColor(colors, cv2.COLOR_BGR2RGB), ".png")
    thumb, size = 50, 50 * _THUMBS
    parts = []
    for film, down in ((demo, False), (episode, True)):
        frames = film.frames
        for i in range(_THUMBS):
            frame = frames[min(int((i + 0.5) * len(frames) / _THUMBS), len(frames) - 1)]
            x, y = (0, thumb * (i + 1)) if down else (thumb * (i + 1), 0)
            parts.append(
                f'<image x="{x}" y="{y}" width="{thumb - 2}" height="{thumb - 2}" '
                f'href="{data_uri(frame, ".jpg")}"/>'
            )

    def points(path: Iterable[tuple[int, int]]) -> str:
        return " ".join(
            f"{thumb + (j + 0.5) * size / columns:.1f},{thumb + (t + 0.5) * size / rows:.1f}"
            for t, j in path
        )

    parts.append(
        f'<image class="pixels" x="{thumb}" y="{thumb}" width="{size}" height="{size}" '
        f'preserveAspectRatio="none" href="{picture}"/>'
    )
    parts += [f'<polyline class="window" points="{points(path)}"/>' for path in alignment.paths]
    parts.append(f'<polyline class="path" points="{points(enumerate(alignment.ends))}"/>')
    return (
        f'<svg class="matrix" viewBox="0 0 {thumb + size} {thumb + size}" role="img" '
        f'aria-label="cost matrix with the aligned path">{"".join(parts)}</svg>'
        '<p class="soft small">Columns: the demonstration. Rows, downwards: the evaluation '
        "episode. Dark is near. Orange: the demonstration frame each episode frame is aligned "
        "with; white: the paths of some windows.</p>"
    )
