"""Which columns of a recording become which: names, units, signs; kept as a file if wanted.

On the command line a column is written ::

    name[=source][:unit[:factor[:offset]]]        theta=2:deg:-1

``name`` is what it is called from now on; ``source`` its name in the file, in double quotes if it
holds one of ``= : ,``, or its position from 0 (where it is left out: the same name, or in a file
without names the next column). The new value is (old value · factor + offset) in ``unit``, and then
brought to the unit without prefixes: deg to rad, cm to m, g to kg. So a dataset is in SI units,
whatever was recorded. A number may be ``pi``: ``theta=2:rad:1:pi`` for an angle from the bottom.

In a file the same is said in TOML ::

    rate = 1000.0                                 # rows a second; or: time = "stamp"
    [[observations]]
    name = "theta"
    source = "2"
    unit = "deg"
    factor = -1.0
    [[actions]]
    name = "force"
    source = "F"
"""

import json
import math
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from misstep.errors import MisstepError
from misstep.formats.format import Block, Episode, FloatArray, Header, ReadOptions
from misstep.parameters import LARGEST
from misstep.storage import write_text
from misstep.trajectory import Column
from misstep.units import UNITS

_ITEM = re.compile(
    r"""\s*(?P<name>[^=:,"]+?)\s*
        (?:=\s*(?:"(?P<quoted>[^"]*)"|(?P<source>[^=:,"]+?))\s*)?
        (?::(?P<unit>[^:,"]*)
        (?::(?P<factor>[^:,"]*)
        (?::(?P<offset>[^:,"]*))?)?)?\s*""",
    re.VERBOSE,
)


@dataclass(frozen=True)
class MappedColumn:
    """One column, where it comes from, and what is done to it.

    Parameters
    ----------
    name : str
        What it is called from now on.
    source : str
        Its name in the file, or its position from 0; empty: the same name.
    unit : str
        Of the values in the file, after factor and offset; empty: what the file says.
    factor, offset : float
        The value becomes value · factor + offset, in `unit`.

    Raises
    ------
    MisstepError
        If the name is empty or a number is not finite, or the factor is zero.
    """

    name: str
    source: str = ""
    unit: str = ""
    factor: float = 1.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        Column(self.name, self.unit)
        for field in ("factor", "offset"):
            value = getattr(self, field)
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise MisstepError(f"column {self.name!r}: {field} is {value!r}, not a number")
            if not abs(value) <= LARGEST or (field == "factor" and value == 0):
                raise MisstepError(
                    f"column {self.name!r}: {field} is {_told(value)}, but must be finite"
                    + (" and not zero" if field == "factor" else "")
                )
        if not isinstance(self.source, str):
            raise MisstepError(f"column {self.name!r}: source is {self.source!r}: write a text")


@dataclass(frozen=True)
class ColumnMapping:
    """All that a user says about the columns of a file.

    Parameters
    ----------
    observations, actions : tuple of MappedColumn
        Empty: those that the file itself says.
    time : str
        Column of times, such as ``"stamp"``; with its unit as ``"stamp:ms"``.
    episode : str
        Column that numbers the episodes.
    rate : float or None, Hz
        Rows a second, where there are no times.
    named : bool or None
        Whether the first row of a table names its columns; None: look.
    """

    observations: tuple[MappedColumn, ...] = ()
    actions: tuple[MappedColumn, ...] = ()
    time: str = ""
    episode: str = ""
    rate: float | None = None
    named: bool | None = None

    def __post_init__(self) -> None:
        if self.named not in (None, True, False):
            raise MisstepError(f"named is {self.named!r}: it is true or false")
        is_number = isinstance(self.rate, int | float) and not isinstance(self.rate, bool)
        if self.rate is not None and not (is_number and 0 < self.rate <= LARGEST):
            raise MisstepError(f"the rate is {_told(self.rate)}: it has to be positive, in Hz")
        for field in ("time", "episode"):
            if not isinstance(getattr(self, field), str):
                raise MisstepError(f"{field} is {getattr(self, field)!r}: name a column")
        for mapped in (self.observations, self.actions):
            names = [column.name for column in mapped]
            for name in names:
                if names.count(name) > 1:
                    raise MisstepError(f"column {name!r} is mapped twice")

    def options(self) -> ReadOptions:
        """Return what a reader has to know of it."""
        time, _, unit = self.time.partition(":")
        return ReadOptions(
            observations=tuple(c.source or c.name for c in self.observations) or None,
            actions=tuple(c.source or c.name for c in self.actions) or None,
            time=time or None,
            time_unit=unit,
            episode=self.episode or None,
            rate=self.rate,
            named=self.named,
        )

    def apply(self, episode: Episode) -> Episode:
        """Return the episode with its columns renamed and converted.

        Raises
        ------
        MisstepError
            If a source is not there, also on the way.
        """
        if not self.observations and not self.actions:
            return episode
        actions = _resolved(self.actions, episode.header, allow_observations=True)
        observations = _resolved(self.observations, episode.header, allow_observations=False)
        if not self.observations:
            used = {part.index for part in actions if part.of_observations}
            kept = enumerate(episode.header.observation_columns)
            observations = [_as_it_is(i, c, True) for i, c in kept if i not in used]
        if not self.actions:
            kept = enumerate(episode.header.action_columns)
            actions = [_as_it_is(i, column, False) for i, column in kept]
        notes = [part.note for part in (*observations, *actions) if part.note]
        notes += _left_out(episode.header, observations, actions)
        provenance = episode.header.provenance
        header = replace(
            episode.header,
            observation_columns=tuple(part.column for part in observations),
            action_columns=tuple(part.column for part in actions),
            provenance=replace(provenance, notes=(*provenance.notes, *notes)),
        )
        return replace(episode, header=header, blocks=_blocks(episode, observations, actions))


def _told(value: object) -> str:
    """Return a value as a message has it."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return repr(value)
    return "too large" if isinstance(value, int) and abs(value) > LARGEST else f"{value:g}"


# Applying


@dataclass(frozen=True)
class _Part:
    """A column to be made: from which one, with which factor and offset."""

    column: Column
    index: int
    of_observations: bool
    factor: float
    offset: float
    note: str


def _as_it_is(index: int, column: Column, of_observations: bool) -> _Part:
    return _Part(column, index, of_observations, 1.0, 0.0, "")


def _left_out(
    header: Header, observations: Sequence[_Part], actions: Sequence[_Part]
) -> Iterator[str]:
    """Yield a note on the columns that go nowhere, if there are any."""
    used = {(part.of_observations, part.index) for part in (*observations, *actions)}
    names = [c.name for i, c in enumerate(header.observation_columns) if (True, i) not in used]
    names += [c.name for i, c in enumerate(header.action_columns) if (False, i) not in used]
    if names:
        yield f"columns left out: {', '.join(names)}"


def _resolved(
    mapped: Sequence[MappedColumn], header: Header, *, allow_observations: bool
) -> list[_Part]:
    """Find the columns of the file; `allow_observations`: actions may come from observations."""
    own = header.action_columns if allow_observations else header.observation_columns
    return [_part(column, own, header.observation_columns, allow_observations) for column in mapped]


def _part(
    mapped: MappedColumn,
    own: tuple[Column, ...],
    observations: tuple[Column, ...],
    is_action: bool,
) -> _Part:
    source = mapped.source or mapped.name
    index, of_observations = _index(source, own), not is_action
    if index is None and is_action:
        index, of_observations = _index(source, observations), True
        own = observations if index is not None else own
    if index is None:
        listed = ", ".join(column.name for column in (own or observations))
        raise MisstepError(
            f"there is no column {source!r} for {mapped.name!r}; there are: {listed}"
        )
    unit = mapped.unit or own[index].unit
    si, size = UNITS.get(unit, (unit, 1.0))
    changes = [f"{unit} to {si}"] if si != unit else []
    changes += [f"times {mapped.factor:g}"] if mapped.factor != 1.0 else []
    changes += [f"plus {mapped.offset:g} {unit}".rstrip()] if mapped.offset != 0.0 else []
    note = f"{mapped.name}: {', '.join(changes)}" if changes else ""
    return _Part(
        Column(mapped.name, si),
        index,
        of_observations,
        mapped.factor * size,
        mapped.offset * size,
        note,
    )


def _index(source: str, columns: tuple[Column, ...]) -> int | None:
    names = [column.name for column in columns]
    if source in names:
        return names.index(source)
    is_position = source.isascii() and source.isdigit() and int(source[:9]) < len(columns)
    return int(source[:9]) if is_position else None


def _blocks(
    episode: Episode, observations: Sequence[_Part], actions: Sequence[_Part]
) -> Iterator[Block]:
    if not any(part.of_observations for part in actions):
        for block in episode.blocks:
            made = _values(block.observations, observations)
            yield replace(block, observations=made, actions=_values(block.actions, actions))
        return
    if not all(part.of_observations for part in actions):
        raise MisstepError(
            "some actions come from observations and some from actions: name the columns of one "
            "kind only"
        )
    kept = np.empty((0, len(actions)))
    for block in episode.blocks:
        made = _values(block.observations, observations)
        # The last row of an action that was recorded beside the observations leads nowhere.
        rows = np.concatenate([kept, _values(block.observations, actions)])
        kept = rows[-1:]
        yield replace(block, observations=made, actions=rows[:-1])


def _values(table: FloatArray, parts: Sequence[_Part]) -> FloatArray:
    values = table[:, [part.index for part in parts]]
    with np.errstate(over="ignore"):  # what becomes infinite is refused before it is written
        for i, part in enumerate(parts):
            if part.factor != 1.0:
                values[:, i] *= part.factor
            if part.offset != 0.0:
                values[:, i] += part.offset
    return values


# Texts and files


def parse_columns(option: str, text: str | None) -> tuple[MappedColumn, ...]:
    """Read the text of ``--columns`` or ``--actions``; None: nothing.

    Raises
    ------
    MisstepError
        If it is not as the module says.
    """
    if text is None:
        return ()
    return tuple(_parse_item(option, item) for item in _items(text))


def _items(text: str) -> list[str]:
    """Split at the commas that have an even number of quotes after them: outside of quotes."""
    return re.split(r',(?=(?:[^"]*"[^"]*")*[^"]*$)', text)


def _parse_item(option: str, item: str) -> MappedColumn:
    match = _ITEM.fullmatch(item)
    if match is None:
        raise MisstepError(
            f"{option} {item.strip()!r}: write name=source:unit:factor:offset, such as "
            f"{option} theta=2:deg:-1"
        )
    found = match.groupdict()
    source = found["quoted"] if found["quoted"] is not None else found["source"]
    return MappedColumn(
        found["name"],
        source or "",
        (found["unit"] or "").strip(),
        _number(option, item, found["factor"], 1.0),
        _number(option, item, found["offset"], 0.0),
    )


def _number(option: str, item: str, text: str | None, default: float) -> float:
    if text is None or not text.strip():
        return default
    if text.strip().removeprefix("-") == "pi":
        return -math.pi if text.strip().startswith("-") else math.pi
    try:
        return float(text)
    except ValueError as error:
        raise MisstepError(f"{option} {item.strip()!r}: {text!r} is no number") from error


def load_mapping(path: Path) -> ColumnMapping:
    """Read a mapping that `save_mapping` or a person wrote.

    Raises
    ------
    MisstepError
        If there is no such file, it is no TOML, or says something that a mapping does not have.
    """
    try:
        said = tomllib.loads(path.read_text(encoding="utf-8"))
        return _from_toml(said)
    except OSError as error:
        raise MisstepError(f"cannot read {path}: {error.strerror}") from error
    except MisstepError as error:
        raise MisstepError(f"cannot read {path}: {error}") from error
    except (ValueError, RecursionError) as error:  # also of a number with too many digits
        raise MisstepError(f"cannot read {path}: it is no TOML ({error})") from error


def save_mapping(mapping: ColumnMapping, path: Path) -> None:
    """Write a mapping as TOML.

    Raises
    ------
    MisstepError
        If the file cannot be written.
    """
    write_text(path, "\n".join(_toml_lines(mapping)) + "\n")


def _from_toml(said: Mapping[str, Any]) -> ColumnMapping:
    known = [field.name for field in fields(ColumnMapping)]
    _check_names(said, known, "a mapping")
    return ColumnMapping(
        _columns_from_toml(said.get("observations", [])),
        _columns_from_toml(said.get("actions", [])),
        said.get("time", ""),
        said.get("episode", ""),
        said.get("rate"),
        said.get("named"),
    )


def _columns_from_toml(tables: object) -> tuple[MappedColumn, ...]:
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise MisstepError("columns are listed as [[observations]] and [[actions]]")
    for table in tables:
        _check_names(table, [field.name for field in fields(MappedColumn)], "a column")
        if "name" not in table:
            raise MisstepError("a column has no name")
    return tuple(MappedColumn(**table) for table in tables)


def _check_names(said: Mapping[str, Any], known: Sequence[str], what: str) -> None:
    for name in said:
        if name not in known:
            raise MisstepError(f"{what} has no {name!r}; it has: {', '.join(known)}")


def _toml_lines(mapping: ColumnMapping) -> Iterator[str]:
    for name in ("time", "episode", "rate", "named"):
        value = getattr(mapping, name)
        if value not in ("", None):
            yield f"{name} = {json.dumps(value, ensure_ascii=False)}"
    for kind in ("observations", "actions"):
        for column in getattr(mapping, kind):
            yield ""
            yield f"[[{kind}]]"
            for field in fields(MappedColumn):
                value = getattr(column, field.name)
                if value != field.default:
                    yield f"{field.name} = {json.dumps(value, ensure_ascii=False)}"
