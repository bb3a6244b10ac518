"""CSV: tables as text, with or without names in the first line, see `misstep.formats.tables`.

Columns are separated by commas, semicolons, tabs or blanks, whichever the first line has; with
semicolons a comma in a number is its decimal point. Lines that begin with ``#`` before the first
row are skipped. Numbers are written with as many digits as bring them back to the last bit.

Rows are parsed by NumPy a megabyte at a time; whatever it stumbles over (an empty cell, a quote, a
text) is gone through again cell by cell, which finds what is wrong and in which line.
"""

import csv
import io
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TextIO

import numpy as np

from misstep.errors import MisstepError
from misstep.formats.format import Episode, FloatArray, Format, ReadOptions
from misstep.formats.guard import prefixed
from misstep.formats.tables.table import (
    EPISODE,
    TIME,
    Keys,
    Rows,
    Table,
    cells_of,
    read_table,
    written_rows,
)
from misstep.storage import atomic_write

_PIECE = 2**20  # bytes that are read at a time, and the most that a line may have
_MOST_COLUMNS = 10_000


def read(path: Path, options: ReadOptions) -> Iterator[Episode]:
    """Read any CSV; see `misstep.formats.format.Format`.

    Raises
    ------
    MisstepError
        Also on the way, with the number of the line: if a row has more or fewer cells than the
        first, a cell is no number, or it is no text in UTF-8.
    """
    if not path.is_file():
        raise MisstepError("it is a folder or a device; name a file")
    try:
        file = open(path, "rb")  # noqa: SIM115
    except OSError as error:
        raise MisstepError(f"{error.strerror}") from error
    with file:
        yield from _read(_Lines(file, options), options)


def _read(lines: "_Lines", options: ReadOptions) -> Iterator[Episode]:
    first = lines.first_line()
    dialect = _Dialect(first)
    cells = dialect.cells(first, lines.number)
    if len(cells) > _MOST_COLUMNS:
        raise MisstepError(f"{len(cells)} columns: at most {_MOST_COLUMNS} are read")
    named = options.named if options.named is not None else not all(map(_is_number, cells))
    if named:
        lines.skip_line()
    else:
        cells = [str(i) for i in range(len(cells))]
    cells = [cell.strip() or str(i) for i, cell in enumerate(cells)]
    reader = _RowReader(lines, dialect, len(cells))
    yield from read_table(Table(cells, named, "line", reader.rows), options)


class _Lines:
    """The lines of a file, a piece at a time, and their numbers."""

    def __init__(self, file: io.BufferedReader, options: ReadOptions) -> None:
        self._file, self._options = file, options
        self._size = os.fstat(file.fileno()).st_size
        self._left = b""  # the start of a line whose end was not read yet
        self._waiting: list[str] = []
        self.number = 1  # of the first line that waits
        self._is_start = True

    def first_line(self) -> str:
        """Return the first line that is neither blank nor a comment; it is still to be read."""
        while self._fill():
            for i, line in enumerate(self._waiting):
                if line.strip() and not line.startswith("#"):
                    self._drop(i)
                    return line
            self._drop(len(self._waiting))
        raise MisstepError("the file is empty")

    def skip_line(self) -> None:
        """Go past the next line."""
        self._drop(1)

    def pieces(self) -> Iterator[tuple[int, list[str]]]:
        """Yield the lines that are left, some at a time, and the number of the first of them."""
        while self._fill():
            number, lines = self.number, self._waiting
            self._drop(len(lines))
            if self._options.report is not None:
                self._options.report(self._file.tell(), self._size)
            yield number, lines

    def _drop(self, count: int) -> None:
        self._waiting = self._waiting[count:]
        self.number += count

    def _fill(self) -> bool:
        """Read a piece if no line waits; False at the end."""
        while not self._waiting:
            try:
                data = self._file.read(_PIECE)
            except OSError as error:
                raise MisstepError(f"{error.strerror}") from error
            if not data and not self._left:
                return False
            whole, newline, rest = (self._left + data).rpartition(b"\n")
            if not data:
                whole, rest = self._left, b""
            elif len(rest) > _PIECE:
                raise MisstepError(
                    f"a line after line {self.number} has more than {_PIECE} bytes: this is no CSV"
                )
            self._left = rest
            if newline or not data:
                self._waiting = self._decode(whole).split("\n")
        return True

    def _decode(self, data: bytes) -> str:
        if self._is_start:
            data, self._is_start = data.removeprefix(b"\xef\xbb\xbf"), False
        try:
            return data.decode().replace("\r\n", "\n").removesuffix("\r")
        except UnicodeDecodeError as error:
            line = self.number + data[: error.start].count(b"\n")
            raise MisstepError(f"line {line} is no text in UTF-8") from error


class _Dialect:
    """How the lines of a file are cut into cells, as its first line shows."""

    def __init__(self, line: str) -> None:
        own = [mark for mark in ",\t" if line.startswith(EPISODE + mark + TIME + mark)]
        self.delimiter = next((mark for mark in (*own, *";,\t") if mark in line), None)

    def cells(self, line: str, number: int) -> list[str]:
        """Return the cells of a line."""
        if self.delimiter is None:
            return line.split()
        try:
            (cells,) = csv.reader([line], delimiter=self.delimiter, strict=True)
        except (csv.Error, ValueError) as error:
            raise MisstepError(f"line {number}: {error or 'quotes do not fit'}") from error
        return [self.plain(cell) for cell in cells]

    def plain(self, text: str) -> str:
        """Return text with decimal points where it has decimal commas."""
        return text.replace(",", ".") if self.delimiter == ";" else text


class _RowReader:
    """Turns lines into rows of numbers."""

    def __init__(self, lines: _Lines, dialect: _Dialect, n_columns: int) -> None:
        self._lines, self._dialect, self._n_columns = lines, dialect, n_columns
        self._keys = Keys()

    def rows(self, numbers: Sequence[int], key: int | None, text: int | None) -> Iterator[Rows]:
        """Yield rows of some columns, see `misstep.formats.tables.table.Table`."""
        ended_at: int | None = None
        for number, lines in self._lines.pieces():
            filled = len(lines)
            while filled and not lines[filled - 1].strip():
                filled -= 1
            if ended_at is not None and filled:
                raise MisstepError(f"line {ended_at} is empty, but rows follow")
            if filled < len(lines):
                ended_at = ended_at or number + filled
            if filled:
                values = self._fast(lines[:filled], numbers, key, text)
                if values is not None:
                    yield Rows(values, None, number)
                else:
                    yield self._careful(lines[:filled], number, numbers, key, text)

    def _fast(
        self, lines: list[str], numbers: Sequence[int], key: int | None, text: int | None
    ) -> FloatArray | None:
        """Parse lines of nothing but numbers; None if they are not that plain."""
        delimiter = self._dialect.delimiter
        wanted = [*numbers] if key is None else [*numbers, key]
        if delimiter is not None:
            marks = self._n_columns - 1
            if any(line.count(delimiter) != marks or '"' in line for line in lines):
                return None
        if text is not None:  # as misstep writes it: the last column, and nearly always empty
            last = text == self._n_columns - 1 and delimiter is not None
            if not last or not all(line.endswith(str(delimiter)) for line in lines):
                return None
        try:
            values = np.loadtxt(
                map(self._dialect.plain, lines) if delimiter == ";" else lines,
                delimiter=delimiter,
                comments=None,
                # Blanks cannot be counted: reading every column makes sure that all are there.
                usecols=None if delimiter is None else wanted,
                ndmin=2,
            )
        except ValueError:
            return None
        if delimiter is None and values.shape[1] == self._n_columns:
            values = values[:, wanted]
        return values if values.shape == (len(lines), len(wanted)) else None

    def _careful(
        self,
        lines: list[str],
        number: int,
        numbers: Sequence[int],
        key: int | None,
        text: int | None,
    ) -> Rows:
        values = np.empty((len(lines), len(numbers) + (key is not None)))
        texts = []
        for i, line in enumerate(lines):
            cells = self._dialect.cells(line, number + i)
            if len(cells) != self._n_columns:
                raise MisstepError(
                    f"line {number + i} has {len(cells)} cells but the first has "
                    f"{self._n_columns}: every row has to have as many"
                )
            for j, column in enumerate(numbers):
                values[i, j] = self._number(cells[column], number + i, column)
            if key is not None:
                values[i, -1] = self._keys.number(cells[key].strip())
            texts.append("" if text is None else cells[text])
        return Rows(values, texts if any(texts) else None, number)

    def _number(self, cell: str, line: int, column: int) -> float:
        cell = cell.strip()
        if not cell:
            return np.nan
        if not _is_number(cell):
            raise MisstepError(f"line {line}, column {column} (from 0): {cell[:40]!r} is no number")
        return float(cell)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return not cell.strip()
    return "_" not in cell  # Python's own way to write 1_000


# Writing


def write(path: Path, episodes: Iterable[Episode]) -> None:
    """Write episodes to `path` in a single step, in place of what was there.

    Raises
    ------
    MisstepError
        If the episodes differ in their columns or dt, there is none, or the file cannot be
        written.
    """
    delimiter = "\t" if path.suffix.lower() == ".tsv" else ","

    def fill(temporary: Path) -> None:
        with open(temporary, "w", encoding="utf-8", newline="") as file:
            _write(file, episodes, delimiter)

    with prefixed(f"cannot write {path}"):
        atomic_write(path, fill)


def _write(file: TextIO, episodes: Iterable[Episode], delimiter: str) -> None:
    writer = csv.writer(file, delimiter=delimiter, lineterminator="\n")
    for index, (header, rows) in enumerate(written_rows(episodes)):
        if index == 0:
            writer.writerow(cells_of(header))
        values, texts = rows.values, rows.texts or [""] * len(rows.values)
        if not np.isnan(values).any() and not any(texts):
            _write_plain(file, values, delimiter)
            continue
        for row, text in zip(values.tolist(), texts, strict=True):
            cells = ["" if math.isnan(value) else repr(value) for value in row[1:]]
            writer.writerow([str(int(row[0])), *cells, text])


def _write_plain(file: TextIO, values: FloatArray, delimiter: str) -> None:
    """Write rows without empty cells; a third faster than cell by cell."""
    number = str(int(values[0, 0]))
    for row in values[:, 1:].tolist():
        file.write(f"{number}{delimiter}{delimiter.join(map(repr, row))}{delimiter}\n")


FORMAT = Format(
    description="comma-separated values, with or without names; loses nothing",
    suffixes=(".csv", ".tsv"),
    read=read,
    write=write,
)
