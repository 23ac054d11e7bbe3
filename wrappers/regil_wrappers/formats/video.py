"""Films: mp4 (and mov, as telephones write it) through PyAV, gif through Pillow. Pictures only.

A film says when each of its frames is shown. Where they are evenly spaced, ``control_rate`` is
their rate; where not (a telephone in bad light, a gif that shows an idle frame longer),
``frame_times`` holds the seconds, and `regil_wrappers.formats.resample` makes them even.
"""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from regil_wrappers.demonstration import Demonstration
from regil_wrappers.formats.boxes import check_boxes
from regil_wrappers.formats.changes import Pictures
from regil_wrappers.formats.pictures import check_pixels, no_bombs
from regil_wrappers.limits import MAX_PIXELS, need

__all__ = ["read_gif", "read_mp4", "write_gif", "write_mp4"]

_CODECS = ("h264", "hevc", "av1", "libdav1d", "vp9", "mpeg4", "mjpeg")


def read_mp4(
    path: Path, pictures: Pictures, start: float = 0.0, frames: int | None = None
) -> dict[str, Any]:
    """Read a film: h264, hevc, av1, vp9, mpeg4 or mjpeg. Stored rotations are applied.

    Args:
        path: the file.
        pictures: takes the frames.
        start: seconds to begin at.
        frames: how many to read; None reads to the end.

    Raises:
        ValueError: if there is no film in it, its pictures are too large or too many, or it is
            damaged.
        ImportError: without PyAV.
    """
    av = need("av", "video", "reading mp4")
    times: list[float] = []
    # The format is named, and the file handed over open: a play list under another name must not
    # make FFmpeg open what it lists.
    with path.open("rb") as file:
        check_boxes(file)
        try:
            with av.open(file, format="mp4") as container:
                _decode(container, pictures, start, frames, times)
        except av.error.FFmpegError as error:
            raise ValueError(str(error)) from error
    if frames is not None and len(times) != frames:
        raise ValueError(f"the film has {len(times)} frames from {start:g} s on, not {frames}")
    return {"metadata": _timing(times)}


def _decode(
    container: Any, pictures: Pictures, start: float, frames: int | None, times: list[float]
) -> None:
    if not container.streams.video:
        raise ValueError("there is no film in this file")
    stream = container.streams.video[0]
    context = stream.codec_context
    if context is None or context.codec.name not in _CODECS:
        name = "unknown" if context is None else context.codec.name
        raise ValueError(f"the film is coded with {name!r}: one of {list(_CODECS)} is read")
    check_pixels(context.width, context.height)
    context.options = {"max_pixels": str(MAX_PIXELS)}
    context.thread_count = 1
    if start:
        container.seek(int(start / stream.time_base), stream=stream)
    tolerance = 0.5 / float(stream.average_rate or 1000)
    for frame in container.decode(stream):
        time = float(frame.time if frame.time is not None else len(times) * 2 * tolerance)
        if time < start - tolerance:
            continue
        if frames is not None and len(times) == frames:
            break
        check_pixels(frame.width, frame.height)
        picture = frame.to_ndarray(format="rgb24")
        pictures.add(np.rot90(picture, round(frame.rotation / 90)))
        times.append(time - start)


def read_gif(path: Path, pictures: Pictures) -> dict[str, Any]:
    """Read an animated gif.

    Raises:
        ValueError: if it is too large; or an error of Pillow's if it is damaged.
        ImportError: without Pillow.
    """
    image = need("PIL.Image", "video", "reading gif")
    times, now = [], 0.0
    with no_bombs(image), image.open(path, formats=("GIF",)) as film:
        while True:
            check_pixels(*film.size)
            pictures.add(np.asarray(film.convert("RGB")))
            times.append(now)
            # Without a duration, or with 0, browsers show a frame for 0.1 s.
            now += (film.info.get("duration") or 100) / 1000
            try:
                film.seek(film.tell() + 1)
            except EOFError:
                break
    return {"metadata": _timing(times)}


def _timing(times: list[float]) -> dict[str, Any]:
    """``control_rate`` of evenly spaced frames, else ``frame_times``."""
    seconds = np.array(times)
    if len(seconds) < 2 or (np.diff(seconds) <= 0).any():
        return {}
    step = (seconds[-1] - seconds[0]) / (len(seconds) - 1)
    even = seconds[0] + step * np.arange(len(seconds))
    if np.abs(seconds - even).max() > step / 4:
        return {"frame_times": np.round(seconds - seconds[0], 6).tolist()}
    rate = round(1 / step, 3)
    return {"control_rate": int(rate) if rate == int(rate) else rate}


def _rate(demo: Demonstration) -> float:
    rate = demo.metadata["control_rate"]
    if rate is None or not 0 < rate <= 1000:
        raise ValueError(
            f"a film needs frames a second, and control_rate is {rate}: give source_fps="
        )
    return float(rate)


def write_mp4(demo: Demonstration, path: Path) -> None:
    """Write H.264 for any player. It loses colour detail, and nothing but the frames is kept.

    Raises:
        ValueError: if the demonstration does not say its frame rate.
        ImportError: without PyAV.
    """
    rate = Fraction(_rate(demo)).limit_denominator(1000)
    av = need("av", "video", "writing mp4")
    height, width = demo.frames.shape[1:3]
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=rate, options={"crf": "12"})
        stream.width, stream.height = width, height
        # Halved colour resolution needs even sizes.
        stream.pix_fmt = "yuv420p" if height % 2 == width % 2 == 0 else "yuv444p"
        for picture in demo.frames:
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def write_gif(demo: Demonstration, path: Path) -> None:
    """Write an animated gif: 256 colours a frame, times in 1/100 s, nothing but the frames.

    Raises:
        ValueError: if the demonstration does not say its frame rate.
        ImportError: without Pillow.
    """
    rate = _rate(demo)
    image = need("PIL.Image", "video", "writing gif")
    first, *others = [image.fromarray(frame).quantize(256, dither=0) for frame in demo.frames]
    edges = np.round(np.arange(len(demo) + 1) * 100 / rate) * 10
    first.save(
        path,
        format="GIF",
        save_all=True,
        append_images=others,
        duration=np.diff(edges).astype(int).tolist(),
        loop=0,
        optimize=False,
    )
