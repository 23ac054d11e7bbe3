"""What a parquet file's own index claims of its columns, without pyarrow.

pyarrow (26) ends the interpreter where its index of a column is damaged, instead of raising. The
index is a Thrift structure in the compact protocol (Apache Thrift's `thrift-compact-protocol.md`,
fields as in Apache Parquet's `parquet.thrift`).

* ``claims`` - of each column in each row group
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any, BinaryIO, NamedTuple

__all__ = ["Claim", "claims"]

_DEEPEST = 16  # structures in structures; Parquet's own are 6
_MOST = 4_000_000  # values: some 40 are said of a column in a row group
_TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _LIST, _SET, _MAP, _STRUCT = 1, 2, 3, 7, 8, 9, 10, 11, 12
_INTEGERS = (4, 5, 6)


class Claim(NamedTuple):
    """Of a column in a row group: its path in the schema, its values, and bytes when unpacked."""

    path: str
    values: int
    size: int


def claims(stream: BinaryIO, limit: int) -> Iterator[Claim]:
    """Read the index at a parquet file's end.

    Args:
        stream: at any position.
        limit: bytes that the index may have.

    Raises:
        ValueError: it is none, damaged, or larger.
    """
    end = stream.seek(0, 2)
    stream.seek(max(0, end - 8))
    last = stream.read(8)
    length = int.from_bytes(last[:4], "little")
    if last[4:] != b"PAR1" or length > min(limit, end - 8):
        raise ValueError(f"the parquet file's index is damaged, or has over {limit} bytes")
    stream.seek(end - 8 - length)
    try:
        index = _Compact(stream.read(length)).structure(0)
        for group in index[4]:
            for column in group[1]:
                about = column[3]
                path = ".".join(part.decode() for part in about[3])
                yield Claim(path, int(about[5]), int(about[6]))
    except (IndexError, KeyError, TypeError, AttributeError, UnicodeDecodeError) as error:
        raise ValueError("the parquet file's index is damaged") from error


class _Compact:
    """Values of the compact protocol, one after the other: structures are dicts by field number."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at, self._left = data, 0, _MOST

    def structure(self, depth: int) -> dict[int, Any]:
        fields: dict[int, Any] = {}
        number = 0
        while head := self._byte():
            kind = head & 15
            number = number + (head >> 4) if head >> 4 else self._integer()
            if kind in (_TRUE, _FALSE):
                fields[number] = kind == _TRUE
            else:
                fields[number] = self._value(kind, depth)
        return fields

    def _value(self, kind: int, depth: int) -> Any:
        self._left -= 1
        if depth > _DEEPEST or not self._left:
            raise ValueError(f"the parquet file's index is too deep, or has over {_MOST} values")
        if kind in _INTEGERS:
            return self._integer()
        if kind == _BINARY:
            return self._bytes(self._number())
        if kind in (_TRUE, _FALSE, _BYTE):
            return self._byte()
        if kind == _DOUBLE:
            return struct.unpack("<d", self._bytes(8))[0]
        if kind == _STRUCT:
            return self.structure(depth + 1)
        if kind in (_LIST, _SET):
            head = self._byte()
            count = head >> 4 if head >> 4 < 15 else self._number()
            return [self._value(head & 15, depth + 1) for _ in range(count)]
        if kind == _MAP:
            count = self._number()
            kinds = self._byte() if count else 0
            return [
                (self._value(kinds >> 4, depth + 1), self._value(kinds & 15, depth + 1))
                for _ in range(count)
            ]
        raise ValueError("the parquet file's index is damaged")

    def _byte(self) -> int:
        self._at += 1
        return self._data[self._at - 1]

    def _bytes(self, count: int) -> bytes:
        if count > len(self._data) - self._at:
            raise ValueError("the parquet file's index is damaged")
        self._at += count
        return self._data[self._at - count : self._at]

    def _number(self) -> int:
        number = shift = 0
        while True:
            byte = self._byte()
            number |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return number
            if shift > 63:
                raise ValueError("the parquet file's index is damaged")

    def _integer(self) -> int:
        number = self._number()
        return (number >> 1) ^ -(number & 1)
