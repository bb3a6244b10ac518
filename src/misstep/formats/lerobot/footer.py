"""How many numbers each part of a Parquet file says that it holds, read from its footer.

pyarrow knows too, but where a footer is damaged it aborts the whole process instead of raising, if
it is asked for one column's metadata. So the few numbers are read here: a footer is `FileMetaData`
of parquet.thrift in Thrift's compact protocol, which says the type of everything in it.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

_MAGIC = b"PAR1"
_DEEPEST = 64
# Numbers of fields in parquet.thrift.
_ROW_GROUPS, _COLUMNS, _GROUP_ROWS, _METADATA, _PATH, _NUM_VALUES = 4, 1, 3, 3, 3, 5
_TRUE, _FALSE, _BYTE, _I16, _I32, _I64, _DOUBLE, _BINARY, _LIST, _SET, _MAP, _STRUCT = range(1, 13)


class ColumnPart(NamedTuple):
    """A column in one group of rows."""

    path: str
    """With dots: ``observation.state.list.element``."""
    rows: int
    values: int


def column_parts(path: Path) -> Iterator[ColumnPart]:
    """Yield every column of every group of rows.

    Raises
    ------
    ValueError
        If the footer is damaged.
    """
    try:
        groups = _Reader(_footer(path)).struct()[_ROW_GROUPS]
        for group in groups:
            rows = group[_GROUP_ROWS]
            for column in (chunk[_METADATA] for chunk in group[_COLUMNS]):
                name = ".".join(part.decode() for part in column[_PATH])
                yield ColumnPart(name, int(rows), int(column[_NUM_VALUES]))
    except (AttributeError, IndexError, KeyError, TypeError, struct.error) as error:
        raise ValueError(f"its footer is damaged: {error}") from error


def _footer(path: Path) -> bytes:
    with path.open("rb") as file:
        end = file.seek(0, 2)
        file.seek(max(0, end - 8))
        length, magic = int.from_bytes(file.read(4), "little"), file.read(4)
        if magic != _MAGIC or length > end - 8:
            raise ValueError("it does not end as a Parquet file does")
        file.seek(end - 8 - length)
        return file.read(length)


class _Reader:
    """Reads Thrift's compact protocol: a struct as a dict by the numbers of its fields."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at, self._depth = data, 0, 0

    def struct(self) -> dict[int, Any]:
        self._depth += 1
        if self._depth > _DEEPEST:
            raise ValueError("its footer is nested too deep")
        fields, number = {}, 0
        while (head := self._byte()) != 0:
            step, kind = head >> 4, head & 15
            number = number + step if step else self._integer()
            # A truth value has no more bytes than its type.
            fields[number] = kind == _TRUE if kind in (_TRUE, _FALSE) else self._value(kind)
        self._depth -= 1
        return fields

    def _value(self, kind: int) -> Any:
        if kind in (_TRUE, _FALSE, _BYTE):
            return self._byte()
        if kind in (_I16, _I32, _I64):
            return self._integer()
        if kind == _DOUBLE:
            return struct.unpack("<d", self._bytes(8))[0]
        if kind == _BINARY:
            return self._bytes(self._varint())
        if kind in (_LIST, _SET):
            return self._list()
        if kind == _STRUCT:
            return self.struct()
        raise ValueError(f"its footer has a value of type {kind}")  # nor has parquet.thrift maps

    def _list(self) -> list[Any]:
        head = self._byte()
        size = head >> 4 if head >> 4 != 15 else self._varint()
        if size > len(self._data) - self._at:
            raise ValueError("its footer has a list longer than itself")
        return [self._value(head & 15) for _ in range(size)]

    def _byte(self) -> int:
        value = self._data[self._at]
        self._at += 1
        return value

    def _bytes(self, size: int) -> bytes:
        if size > len(self._data) - self._at:
            raise ValueError("its footer is cut off")
        self._at += size
        return self._data[self._at - size : self._at]

    def _varint(self) -> int:
        value = shift = 0
        while (byte := self._byte()) & 128:
            value |= (byte & 127) << shift
            shift += 7
            if shift > 63:
                raise ValueError("its footer has a number of more than 64 bits")
        return value | byte << shift

    def _integer(self) -> int:
        value = self._varint()
        return (value >> 1) ^ -(value & 1)
