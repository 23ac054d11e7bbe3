"""What a parquet file's own index claims of its columns, without pyarrow.

pyarrow (26) ends the interpreter where its index of a column is damaged, instead of raising. The
index is a Thrift structure in the compact protocol (Apache Thrift's `thrift-compact-protocol.md`,
fields as in Apache Parquet's `parquet.thrift`); all but three of a column's fields are skipped.

* ``claims`` - of each column in each row group
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

__all__ = ["Claim", "claims"]

_DEEPEST = 16  # structures in structures; Parquet's own are 6
_BINARY, _LIST, _SET, _MAP, _STRUCT = 8, 9, 10, 11, 12
_TRUTHS, _INTEGERS = (1, 2), (4, 5, 6)
_WIDTHS = {1: 1, 2: 1, 3: 1, 7: 8}  # bytes of a truth, of a byte, of a double
_ROW_GROUPS, _COLUMNS, _ABOUT = 4, 1, 3
_PATH, _VALUES, _SIZE = 3, 5, 6
_DAMAGED = "the parquet file's index is damaged"


class Claim(NamedTuple):
    """Of a column in a row group.

    Attributes:
        path: in the schema, from the column's name down.
        values: how many.
        size: bytes when unpacked.
    """

    path: tuple[str, ...]
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
    if last[4:] != b"PAR1" or length > end - 8:
        raise ValueError(_DAMAGED)
    if length > limit:
        raise ValueError(f"the parquet file's index has {length} bytes: at most {limit} are read")
    stream.seek(end - 8 - length)
    index = _Compact(stream.read(length))
    try:
        for _ in index.within(_ROW_GROUPS, _LIST):
            for _ in index.items():
                for _ in index.within(_COLUMNS, _LIST):
                    for _ in index.items():
                        for _ in index.within(_ABOUT, _STRUCT):
                            yield index.column()
    except (IndexError, UnicodeDecodeError) as error:
        raise ValueError(_DAMAGED) from error


class _Compact:
    """A place in a text of the compact protocol, and what comes next there."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def fields(self) -> Iterator[tuple[int, int]]:
        """Number and kind of each field of a structure; a truth's value is its kind."""
        number = 0
        while head := self._byte():
            number = number + (head >> 4) if head >> 4 else self._integer()
            yield number, head & 15

    def within(self, wanted: int, kind: int) -> Iterator[None]:
        """Stop at the beginning of one field of a structure, and skip all others."""
        for number, its in self.fields():
            if number != wanted:
                self._skip_field(its)
            elif its != kind:
                raise ValueError(_DAMAGED)
            else:
                yield

    def items(self, kind: int = _STRUCT) -> Iterator[None]:
        """Stop at the beginning of each item of a list."""
        its, count = self._list()
        if count and its != kind:
            raise ValueError(_DAMAGED)
        for _ in range(count):
            yield

    def column(self) -> Claim:
        path: list[str] = []
        numbers = {_VALUES: -1, _SIZE: -1}  # which are no claims where they are missing
        for number, kind in self.fields():
            if number == _PATH and kind == _LIST:
                path = [self._bytes().decode() for _ in self.items(_BINARY)]
            elif number in numbers and kind in _INTEGERS:
                numbers[number] = self._integer()
            else:
                self._skip_field(kind)
        if not path or min(numbers.values()) < 0:
            raise ValueError(_DAMAGED)
        return Claim(tuple(path), numbers[_VALUES], numbers[_SIZE])

    def _skip_field(self, kind: int, depth: int = 0) -> None:
        if kind not in _TRUTHS:
            self._skip(kind, 1, depth)

    def _skip(self, kind: int, count: int, depth: int) -> None:
        """Go on behind so many values of a kind."""
        if depth > _DEEPEST:
            raise ValueError(f"the parquet file's index is over {_DEEPEST} structures deep")
        if kind in _WIDTHS:
            self._go(count * _WIDTHS[kind])
            return
        for _ in range(count):
            if kind in _INTEGERS:
                self._number()
            elif kind == _BINARY:
                self._go(self._number())
            elif kind == _STRUCT:
                for _, its in self.fields():
                    self._skip_field(its, depth + 1)
            elif kind in (_LIST, _SET):
                self._skip(*self._list(), depth + 1)
            elif kind == _MAP:
                pairs = self._number()
                kinds = self._byte() if pairs else 0
                for _ in range(pairs):
                    self._skip(kinds >> 4, 1, depth + 1)
                    self._skip(kinds & 15, 1, depth + 1)
            else:
                raise ValueError(_DAMAGED)

    def _list(self) -> tuple[int, int]:
        head = self._byte()
        return head & 15, head >> 4 if head >> 4 < 15 else self._number()

    def _go(self, count: int) -> None:
        self._at += count
        if self._at > len(self._data):
            raise ValueError(_DAMAGED)

    def _bytes(self) -> bytes:
        count = self._number()
        start = self._at
        self._go(count)
        return self._data[start : self._at]

    def _byte(self) -> int:
        self._at += 1
        return self._data[self._at - 1]

    def _number(self) -> int:
        number = shift = 0
        while (byte := self._byte()) > 127:
            number |= (byte & 127) << shift
            shift += 7
            if shift > 63:
                raise ValueError(_DAMAGED)
        return number | byte << shift

    def _integer(self) -> int:
        number = self._number()
        return (number >> 1) ^ -(number & 1)
