"""The sample tables of an mp4 file claim no more than their boxes hold (ISO/IEC 14496-12).

FFmpeg gives memory to what a table claims before it reads it, up to 2 GiB a table. So the boxes are
walked here first; only their headers are read.
"""

from __future__ import annotations

import struct
from typing import BinaryIO

__all__ = ["check_boxes"]

_CONTAINERS = {b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts", b"moof", b"traf", b"mvex"}
# What describes a film's samples holds boxes, too, behind so many bytes
_DESCRIPTION = 8
_VISUAL = 78
_CODED = {b"avc1", b"avc3", b"hvc1", b"hev1", b"av01", b"vp09", b"mp4v", b"jpeg", b"mjpa", b"mjpb"}
# Bytes an entry takes, behind 4 bytes of version and flags and 4 of the number of entries.
_TABLES = {b"stts": 8, b"ctts": 8, b"stsc": 12, b"stco": 4, b"co64": 8, b"stss": 4, b"elst": 12}
# stts and ctts say how many samples each entry stands for.
_RUNS = {b"stts", b"ctts"}

_MAX_BOXES = 10_000
_MAX_SAMPLES = 10_000_000
_MAX_EDITS = 64


def check_boxes(file: BinaryIO) -> None:
    """Refuse a film whose boxes or tables do not fit into it.

    Args:
        file: at any position, which is restored.

    Raises:
        ValueError: naming the box.
    """
    before = file.tell()
    end = file.seek(0, 2)
    waiting = [(0, end)]
    for _ in range(_MAX_BOXES):
        while waiting and waiting[-1][0] + 8 > waiting[-1][1]:
            waiting.pop()
        if not waiting:
            file.seek(before)
            return
        start, limit = waiting.pop()
        kind, content, after = _header(file, start, limit)
        waiting.append((after, limit))
        if kind in _CONTAINERS:
            waiting.append((content, after))
        elif kind == b"stsd":
            waiting.append((content + _DESCRIPTION, after))
        elif kind in _CODED:
            waiting.append((content + _VISUAL, after))
        else:
            _check_table(file, kind, content, after)
    raise ValueError(f"the film has over {_MAX_BOXES} boxes")


def _header(file: BinaryIO, start: int, limit: int) -> tuple[bytes, int, int]:
    """A box's kind, where its content begins and where it ends."""
    file.seek(start)
    size, kind = struct.unpack(">I4s", file.read(8))
    content = start + 8
    if size == 1:
        (size,) = struct.unpack(">Q", file.read(8))
        content += 8
    elif size == 0:
        size = limit - start
    if start + size < content or start + size > limit:
        raise ValueError(f"the film is damaged or cut short: its box {kind!r} has {size} bytes")
    return kind, content, start + size


def _check_table(file: BinaryIO, kind: bytes, content: int, end: int) -> None:
    if kind not in _TABLES and kind not in (b"stsz", b"trun"):
        return
    file.seek(content)
    if end - content < 8 + 4 * (kind == b"stsz"):
        raise ValueError(f"the film is damaged: its box {kind!r} is too short")
    flags, count = struct.unpack(">II", file.read(8))
    width, free = _TABLES.get(kind, 0), 8
    if kind == b"elst" and flags >> 24 == 1:
        width = 20
    elif kind == b"stsz":  # one size for all, then the number of them
        each, (count,) = count, struct.unpack(">I", file.read(4))
        width, free = 0 if each else 4, 12
    elif kind == b"trun":
        width = 4 * sum(bool(flags & bit) for bit in (0x100, 0x200, 0x400, 0x800))
    if (
        count > (_MAX_EDITS if kind == b"elst" else _MAX_SAMPLES)
        or count * width > end - content - free
    ):
        raise ValueError(f"the film is damaged: its box {kind!r} claims {count} entries")
    if kind in _RUNS:
        numbers = struct.unpack(f">{2 * count}I", file.read(8 * count))
        if sum(numbers[::2]) > _MAX_SAMPLES:
            raise ValueError(f"the film's box {kind!r} claims over {_MAX_SAMPLES} samples")
