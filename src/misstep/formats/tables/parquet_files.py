"""Parquet: tables in columns, see `misstep.formats.tables`; through pyarrow."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from misstep.errors import MisstepError, reason_of
from misstep.formats.format import BLOCK_ROWS, Episode, FloatArray, Format, ReadOptions
from misstep.formats.guard import prefixed
from misstep.formats.libraries import needed, parquet_writer
from misstep.formats.tables.table import (
    ANNOTATION,
    EPISODE,
    SECONDS,
    Keys,
    Rows,
    Table,
    cells_of,
    read_table,
    written_rows,
)
from misstep.storage import atomic_write

_GROUP_ROWS = 2**16  # of a row group


def _arrow() -> Any:
    needed("pyarrow.parquet", "Parquet", "parquet")
    return needed("pyarrow", "Parquet", "parquet")


def read(path: Path, options: ReadOptions) -> Iterator[Episode]:
    """Read any Parquet file of numbers; see `misstep.formats.format.Format`.

    Raises
    ------
    MisstepError
        Also on the way: if the file is damaged, or a column that is needed holds no numbers.
    """
    arrow = _arrow()
    if not path.is_file():
        raise MisstepError("it is a folder or a device; name a file")
    with _damage(arrow):
        file = _opened(arrow, path)
        reader = _RowReader(arrow, file, options)
    with file:
        yield from read_table(Table(reader.cells, True, "row", reader.rows), options)


@contextmanager
def _damage(arrow: Any) -> Iterator[None]:
    """Tell what pyarrow raises over a damaged file as one line."""
    try:
        yield
    except (arrow.ArrowException, OSError, UnicodeDecodeError, MemoryError) as error:
        raise MisstepError(f"it is damaged ({reason_of(error)})") from error


def _opened(arrow: Any, path: Path) -> Any:
    """Open a file so that a text that stands in many rows is in memory once."""
    with arrow.parquet.ParquetFile(path, pre_buffer=False) as file:
        schema = file.schema_arrow
    texts = [field.name for field in schema if _is_text(arrow, field.type)]
    return arrow.parquet.ParquetFile(path, pre_buffer=False, read_dictionary=texts)


def _is_text(arrow: Any, kind: Any) -> bool:
    types = arrow.types
    if types.is_dictionary(kind):
        kind = kind.value_type
    return bool(types.is_string(kind) or types.is_large_string(kind))


class _RowReader:
    """Turns batches of a Parquet file into rows of numbers."""

    def __init__(self, arrow: Any, file: Any, options: ReadOptions) -> None:
        self._arrow, self._file, self._options = arrow, file, options
        self._keys = Keys()
        self.cells: list[str] = list(file.schema_arrow.names)

    def rows(self, numbers: Sequence[int], key: int | None, text: int | None) -> Iterator[Rows]:
        """Yield rows of some columns, see `misstep.formats.tables.table.Table`."""
        # Here, since most of it happens while somebody goes through the rows of an episode.
        with _damage(self._arrow):
            wanted = {self.cells[i] for i in (*numbers, key, text) if i is not None}
            row, total = 0, self._file.metadata.num_rows
            batches = self._file.iter_batches(
                batch_size=BLOCK_ROWS, columns=sorted(wanted), use_threads=False
            )
            for batch in batches:
                if not batch.num_rows:
                    continue
                values = [self._numbers(batch, self.cells[i]) for i in numbers]
                if key is not None:
                    values.append(self._key_numbers(batch, self.cells[key]))
                texts = None if text is None else self._texts(batch, self.cells[text])
                yield Rows(np.column_stack(values), texts, row)
                row += batch.num_rows
                if self._options.report is not None:
                    self._options.report(row, total)

    def _numbers(self, batch: Any, name: str) -> FloatArray:
        column, types = batch.column(name), self._arrow.types
        kind = column.type
        if types.is_timestamp(kind) or types.is_duration(kind):
            return self._float64(column.cast("int64")) * SECONDS[kind.unit]
        if types.is_floating(kind) or types.is_integer(kind) or types.is_boolean(kind):
            return self._float64(column)
        held = kind.value_type if types.is_dictionary(kind) else kind
        raise MisstepError(f"column {name!r} holds {held}: numbers are needed")

    def _key_numbers(self, batch: Any, name: str) -> FloatArray:
        if not _is_text(self._arrow, batch.column(name).type):
            return self._numbers(batch, name)
        words, places = self._words(batch, name)
        numbers: dict[int, float] = {}
        for place in places:
            if place not in numbers:
                numbers[place] = self._keys.number(words[place])
        return np.array([numbers[place] for place in places])

    def _texts(self, batch: Any, name: str) -> list[str]:
        words, places = self._words(batch, name)
        return [words[place] for place in places]

    def _words(self, batch: Any, name: str) -> tuple[list[str], list[int]]:
        """Return the texts that there are, and which of them stands in each row."""
        column = batch.column(name)
        if not _is_text(self._arrow, column.type):
            raise MisstepError(f"column {name!r} holds {column.type}: not texts")
        if not self._arrow.types.is_dictionary(column.type):
            column = column.dictionary_encode()
        words = [*(text or "" for text in column.dictionary.to_pylist()), ""]
        places = column.indices.fill_null(len(words) - 1).to_pylist()
        if not all(0 <= place < len(words) for place in places):
            raise MisstepError(f"column {name!r} is damaged: a row has a text that is not there")
        return words, places

    def _float64(self, column: Any) -> FloatArray:
        plain = column.cast("float64", safe=False)
        return np.array(plain.to_numpy(zero_copy_only=False), dtype=np.float64)


def write(path: Path, episodes: Iterable[Episode]) -> None:
    """Write episodes to `path` in a single step, in place of what was there.

    Raises
    ------
    MisstepError
        If the episodes differ in their columns or dt, there is none, or the file cannot be
        written.
    """
    arrow = _arrow()

    def fill(temporary: Path) -> None:
        writer = None
        try:
            for header, rows in _grouped(written_rows(episodes)):
                if writer is None:
                    schema = _schema(arrow, cells_of(header))
                    writer = parquet_writer(temporary, schema)
                writer.write_table(_table(arrow, schema, rows))
        finally:
            if writer is not None:
                writer.close()

    with prefixed(f"cannot write {path}"):
        atomic_write(path, fill)


def _grouped(pieces: Iterable[tuple[Any, Rows]]) -> Iterator[tuple[Any, Rows]]:
    """Join rows until they make a row group."""
    waiting: list[Rows] = []
    header = None
    for header, rows in pieces:
        waiting.append(rows)
        if sum(len(r.values) for r in waiting) >= _GROUP_ROWS:
            yield header, _joined(waiting)
            waiting = []
    if waiting:
        yield header, _joined(waiting)


def _joined(pieces: list[Rows]) -> Rows:
    texts = [text for rows in pieces for text in rows.texts or [""] * len(rows.values)]
    return Rows(np.concatenate([rows.values for rows in pieces]), texts, pieces[0].first)


def _schema(arrow: Any, cells: Sequence[str]) -> Any:
    kinds = {EPISODE: arrow.int64(), ANNOTATION: arrow.string()}
    return arrow.schema([(cell, kinds.get(cell, arrow.float64())) for cell in cells])


def _table(arrow: Any, schema: Any, rows: Rows) -> Any:
    empty = np.isnan(rows.values)
    arrays = [arrow.array(rows.values[:, 0].astype(np.int64))]
    arrays += [
        arrow.array(rows.values[:, i], mask=empty[:, i]) for i in range(1, rows.values.shape[1])
    ]
    arrays.append(arrow.array([text or None for text in rows.texts or ()], arrow.string()))
    return arrow.Table.from_arrays(arrays, schema=schema)


FORMAT = Format(
    description="Parquet, a row for each observation; loses nothing",
    suffixes=(".parquet",),
    read=read,
    write=write,
    extra="parquet",
)
