"""Which column of a table is what, and where one episode ends: what CSV and Parquet share."""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, groupby
from operator import itemgetter

import numpy as np

from misstep.errors import MisstepError
from misstep.formats.annotation import Annotation, read_annotation
from misstep.formats.blocks import aligned
from misstep.formats.format import Block, Ending, Episode, FloatArray, Header, ReadOptions
from misstep.formats.guard import check_same_kind, prefixed
from misstep.trajectory import Column, Provenance

EPISODE, TIME, COST, ANNOTATION = "episode", "time [s]", "cost", "misstep"
_ACTION, _OBSERVATION = "action:", "observation:"
_TIMES = ("time", "t", "timestamp")  # names that say by themselves that they are times
_CELL = re.compile(r"(.*\S) \[([^\[\]]*)\]")
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}

UNKNOWN = Provenance("", {}, "", None, "")


@dataclass(frozen=True, eq=False)
class Rows:
    """Some consecutive rows of a table.

    Parameters
    ----------
    values : ndarray, shape (b, k)
        The columns asked for; NaN where a cell is empty.
    texts : sequence of b str, or None
        The cells of the column of texts, empty where they are; None if all are.
    first : int
        Where the first of the rows is in the file, as `Table.place` counts.
    """

    values: FloatArray
    texts: Sequence[str] | None
    first: int


@dataclass(frozen=True, eq=False)
class Table:
    """A table that can be read once, from the top.

    Parameters
    ----------
    cells : sequence of str
        What the table calls its columns.
    named : bool
        False: the columns have no names but their positions.
    place : str
        What its rows are called: ``"line"``.
    rows : callable
        ``rows(numbers, key, text) -> iterator of Rows`` of the columns at the positions `numbers`;
        after them, unless it is None, that at the position `key`, where texts stand for numbers
        too, see `Keys`; `text` is the position of the column of texts, or None.
    """

    cells: Sequence[str]
    named: bool
    place: str
    rows: Callable[[Sequence[int], int | None, int | None], Iterator[Rows]]


class Keys:
    """Numbers for what episodes are called: the number itself, or one for each text."""

    def __init__(self) -> None:
        self._numbers: dict[str, float] = {}

    def number(self, text: str) -> float:
        """Return the number of a cell; NaN if it is empty."""
        if not text:
            return np.nan
        try:
            return float(text)
        except ValueError:
            return self._numbers.setdefault(text, 2.0**52 + len(self._numbers))


# Reading


def read_table(table: Table, options: ReadOptions) -> Iterator[Episode]:
    """Yield the episodes of a table.

    Raises
    ------
    MisstepError
        Also on the way: if a column that is asked for is not there, nothing says when the rows
        were recorded, or an episode goes on after another one has begun.
    """
    roles = _Roles.of(table, options)
    pieces = _split(table, roles)
    is_empty = True
    for _, group in groupby(pieces, key=itemgetter(0)):
        is_empty = False
        episode = _TableEpisode(table, roles, options, (piece for _, piece in group))
        yield Episode(episode.header, episode.blocks(), episode.ending, episode.where)
    if is_empty:
        raise MisstepError("there are no rows")


@dataclass(frozen=True)
class _Roles:
    """Which columns of the table are what, by their positions; None where there is none."""

    observations: tuple[int, ...]
    observation_columns: tuple[Column, ...]
    actions: tuple[int, ...]
    action_columns: tuple[Column, ...]
    time: int | None
    time_unit: str
    cost: int | None
    episode: int | None
    annotation: int | None
    left_out: tuple[str, ...]

    @classmethod
    def of(cls, table: Table, options: ReadOptions) -> "_Roles":
        cells = _Cells(table)
        annotation = cells.position(ANNOTATION)
        time = cells.find(options.time) if options.time else cells.time()
        episode = cells.find(options.episode) if options.episode else cells.position(EPISODE)
        cost = cells.position(COST) if annotation is not None else None
        taken = {i for i in (time, episode, cost, annotation) if i is not None}
        if options.rate is not None and not options.time:
            time = None  # the rate says when rows were recorded, whatever the column holds
        wanted = [*(options.observations or ()), *(options.actions or ())]
        found = cells.find_all(wanted, taken)
        count = len(options.observations or ())
        actions = found[count:] if options.actions else cells.actions()
        free = [i for i in range(len(table.cells)) if i not in taken and i not in actions]
        observations = found[:count] if options.observations else free
        if not observations:
            raise MisstepError("no column is left for the observations")
        named = cells.columns
        special = (time, episode, cost, annotation)
        used = {*observations, *actions, *(i for i in special if i is not None)}
        return cls(
            tuple(observations),
            _renamed([named[i] for i in observations], options.observations),
            tuple(actions),
            _renamed([named[i] for i in actions], options.actions),
            time,
            options.time_unit or ("" if time is None else named[time].unit) or "s",
            cost,
            episode,
            annotation,
            tuple(cell for i, cell in enumerate(table.cells) if i not in used),
        )


def _renamed(columns: Sequence[Column], names: tuple[str, ...] | None) -> tuple[Column, ...]:
    """Return the columns under the names by which they were asked for."""
    if not names:
        return tuple(columns)
    return tuple(replace(c, name=name) for c, name in zip(columns, names, strict=True))


class _Cells:
    """What the columns of a table are called, and by which names they can be found."""

    def __init__(self, table: Table) -> None:
        self._table = table
        self.columns = [_column(cell) for cell in table.cells]
        self._kinds = [_kind(cell) for cell in table.cells]
        seen: dict[tuple[str, str], int] = {}
        for i, column in enumerate(self.columns):
            key = (self._kinds[i], column.name)
            if key in seen:
                raise MisstepError(
                    f"columns {seen[key]} and {i} (from 0) are both named {column.name!r}: "
                    "names have to be unique"
                )
            seen[key] = i

    def position(self, name: str) -> int | None:
        """Return the position of the column that is called just so."""
        return next((i for i, cell in enumerate(self._table.cells) if cell == name), None)

    def time(self) -> int | None:
        """Return the position of the column that says by its name that it is the time."""
        for i, column in enumerate(self.columns):
            free = not self._kinds[i] and column.unit in ("", *SECONDS)
            if free and column.name.lower() in _TIMES:
                return i
        return None

    def actions(self) -> list[int]:
        """Return the positions of the columns that say by their names that they are actions."""
        return [i for i, kind in enumerate(self._kinds) if kind == _ACTION]

    def find(self, name: str) -> int:
        """Return the position of a column by its name, or by its position in digits."""
        ways = (
            [i for i, cell in enumerate(self._table.cells) if cell == name],
            [i for i, c in enumerate(self.columns) if self._kinds[i] + c.name == name],
            [i for i, c in enumerate(self.columns) if c.name == name],
        )
        for found in ways:
            if found:
                return found[0]
        if name.isascii() and name.isdigit() and int(name[:9]) < len(self.columns):
            return int(name[:9])
        raise MisstepError(f"there is no column {name!r}; {self._listing()}")

    def find_all(self, names: Sequence[str], taken: set[int]) -> list[int]:
        """Return the positions of several columns, of a table without names also in order."""
        known = {str(i) for i in range(len(self.columns))}
        if self._table.named or any(name in known for name in names):
            return [self.find(name) for name in names]
        free = [i for i in range(len(self.columns)) if i not in taken]
        if len(names) > len(free):
            raise MisstepError(
                f"{len(names)} columns are wanted but the file has {len(free)}; {self._listing()}"
            )
        return free[: len(names)]

    def _listing(self) -> str:
        if self._table.named:
            return "there are: " + ", ".join(cell or repr(cell) for cell in self._table.cells)
        return (
            f"the file does not name its columns: say which by position, 0 to "
            f"{len(self.columns) - 1}, such as x=0"
        )


def _kind(cell: str) -> str:
    return next((kind for kind in (_ACTION, _OBSERVATION) if cell.startswith(kind)), "")


def _column(cell: str) -> Column:
    text = cell[len(_kind(cell)) :]
    match = _CELL.fullmatch(text)
    with prefixed("the names of the columns"):
        return Column(*match.groups()) if match else Column(text, "")


def _split(table: Table, roles: _Roles) -> Iterator[tuple[int, Rows]]:
    """Yield the rows in pieces of one episode each, with the episode's number from 0."""
    numeric = [*roles.observations, *roles.actions]
    numeric += [i for i in (roles.time, roles.cost) if i is not None]
    if roles.episode is None:
        for rows in table.rows(numeric, None, roles.annotation):
            yield 0, rows
        return
    number, last = -1, np.nan
    seen: set[float] = set()
    for rows in table.rows(numeric, roles.episode, roles.annotation):
        keys = rows.values[:, -1]
        starts = np.flatnonzero(np.diff(keys, prepend=np.nan) != 0).tolist()
        for start, end in zip(starts, [*starts[1:], len(keys)], strict=True):
            key = float(keys[start])
            if np.isnan(key):
                raise MisstepError(
                    f"{table.place} {rows.first + start}: the column of episodes is empty"
                )
            if key != last:
                if key in seen:
                    raise MisstepError(
                        f"{table.place} {rows.first + start}: the episode goes on after another "
                        "one has begun: the rows of an episode have to follow each other"
                    )
                seen.add(key)
                number, last = number + 1, key
            texts = None if rows.texts is None else rows.texts[start:end]
            yield number, Rows(rows.values[start:end, :-1], texts, rows.first + start)


class _TableEpisode:
    """One episode of a table as it is read."""

    def __init__(
        self, table: Table, roles: _Roles, options: ReadOptions, pieces: Iterator[Rows]
    ) -> None:
        first = next(pieces)
        self._pieces = chain([first], pieces)
        self._place, self._first, self._roles = table.place, first.first, roles
        annotation = self._annotation(first, 0)
        provenance, dt = UNKNOWN, None
        if annotation is not None:
            provenance, dt = annotation.header.provenance, annotation.header.dt
        self._notes_before = len(provenance.notes)
        if roles.left_out:
            note = f"columns left out: {', '.join(roles.left_out)}"
            provenance = replace(provenance, notes=(*provenance.notes, note))
        if options.time:
            dt = None
        elif options.rate is not None:
            dt = 1.0 / options.rate
        if dt is None and roles.time is None:
            raise MisstepError(
                "nothing says when the rows were recorded: give --rate in Hz, or name the column "
                "of times with --time"
            )
        self.header = Header(dt, roles.observation_columns, roles.action_columns, provenance)
        self._last: Annotation | None = None
        self._dropped = False

    def where(self, row: int) -> str:
        """Say where a row is."""
        return f"{self._place} {self._first + row}"

    def blocks(self) -> Iterator[Block]:
        """Yield the rows; the action of the last one leads to no observation and is left out."""
        n, m = len(self._roles.observations), len(self._roles.actions)
        kept = np.empty((0, m + 1))
        has_costs: bool | None = None
        for piece in self._pieces:
            values = piece.values
            if has_costs is None:
                has_costs = self._roles.cost is not None and not np.isnan(values[0, -1])
            done = values[:, n : n + m]
            costs = values[:, -1:] if has_costs else np.full((len(values), 1), np.nan)
            both = np.concatenate([kept, np.concatenate([done, costs], axis=1)])
            kept = both[-1:]
            yield Block(
                np.ascontiguousarray(values[:, :n]),
                both[:-1, :m],
                both[:-1, m] if has_costs else None,
                self._times(values),
            )
            self._last = self._annotation(piece, -1)
        self._dropped = bool(m) and not np.isnan(kept[:, :m]).all()

    def ending(self) -> Ending:
        """Return what the last row says of the episode."""
        ending = Ending()
        notes: list[str] = []
        if self._last is not None:
            notes += self._last.header.provenance.notes[self._notes_before :]
            ending = self._last.ending
        if self._dropped:
            notes.append("actions: that of the last row left out, it leads to no observation")
        return replace(ending, notes=tuple(notes))

    def _times(self, values: FloatArray) -> FloatArray | None:
        if self.header.dt is not None:
            return None
        if self._roles.time_unit not in SECONDS:
            raise MisstepError(
                f"times are in {self._roles.time_unit!r}; there are: {', '.join(SECONDS)}"
            )
        position = len(self._roles.observations) + len(self._roles.actions)
        return values[:, position] * SECONDS[self._roles.time_unit]

    def _annotation(self, rows: Rows, index: int) -> Annotation | None:
        text = rows.texts[index] if rows.texts else ""
        if not text:
            return None
        row = rows.first + (index if index >= 0 else len(rows.values) + index)
        with prefixed(f"{self._place} {row}"):
            return read_annotation(text)


# Writing


def cells_of(header: Header) -> list[str]:
    """Return what the columns of a table are called that holds episodes like this one.

    Raises
    ------
    MisstepError
        If a column's name could not be told from its unit.
    """
    observations = [_cell(column) for column in header.observation_columns]
    special = {EPISODE, COST, ANNOTATION, *_TIMES}
    observations = [
        _OBSERVATION + cell if _kind(cell) or column.name.lower() in special else cell
        for cell, column in zip(observations, header.observation_columns, strict=True)
    ]
    actions = [_ACTION + _cell(column) for column in header.action_columns]
    return [EPISODE, TIME, *observations, *actions, COST, ANNOTATION]


def _cell(column: Column) -> str:
    # With its brackets even where there is no unit, if the name would look as if it had one.
    plain = not column.unit and not column.name.endswith("]")
    cell = column.name if plain else f"{column.name} [{column.unit}]"
    match = _CELL.fullmatch(cell)
    if (match and Column(*match.groups()) != column) or (not match and not plain):
        raise MisstepError(
            f"column {column.name!r} in {column.unit!r} could not be told apart in a table: "
            "rename it with --columns"
        )
    return cell


def written_rows(episodes: Iterable[Episode]) -> Iterator[tuple[Header, Rows]]:
    """Yield the rows of the table that holds the episodes, and the header of the first of them.

    `Rows.values` has a column for each of `cells_of` but the last.

    Raises
    ------
    MisstepError
        If an episode has other columns or another dt than the first, or there is none.
    """
    first: Header | None = None
    at = 0
    for number, episode in enumerate(episodes):
        first = first or episode.header
        check_same_kind(number, episode.header, first)
        for rows in _episode_rows(number, episode, at):
            at += len(rows.values)
            yield first, rows
    if first is None:
        raise MisstepError("there is no episode to write")


def _episode_rows(number: int, episode: Episode, at: int) -> Iterator[Rows]:
    header = episode.header
    opening = Annotation(header, Ending(), has_costs=False).to_text()
    row, has_costs = 0, False
    blocks = aligned(episode.blocks, has_actions=bool(header.action_columns))
    for block, is_last in _with_last(blocks):
        count = len(block.observations)
        has_costs = has_costs or block.costs is not None
        values = np.full(
            (count, 3 + block.observations.shape[1] + len(header.action_columns)), np.nan
        )
        values[:, 0] = number
        values[:, 1] = _times(block, header, row)
        n = 2 + len(header.observation_columns)
        values[:, 2:n] = block.observations
        values[: len(block.actions), n:-1] = block.actions
        if block.costs is not None:
            values[: len(block.costs), -1] = block.costs
        texts = [""] * count
        if row == 0:
            texts[0] = opening
        if is_last:
            texts[-1] = Annotation(header, episode.ending(), has_costs).to_text()
        yield Rows(values, texts, at + row)
        row += count


def _with_last(blocks: Iterator[Block]) -> Iterator[tuple[Block, bool]]:
    """Yield each block, and whether it is the last: then the ending is known."""
    block = next(blocks, None)
    while block is not None:
        following = next(blocks, None)
        yield block, following is None
        block = following


def _times(block: Block, header: Header, row: int) -> FloatArray:
    if block.times is not None:
        return block.times
    return np.arange(row, row + len(block.observations)) * np.float64(header.dt or 0.0)
