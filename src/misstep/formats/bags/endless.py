"""What a bag can say in a few bytes and has no end, refused before anybody follows it.

rosbags trusts a bag in four places. Its data base may compute rows, for ever, instead of holding
them. Its YAML may alias an alias of lists, which an error then quotes in full. The definition of a
message may ask for arrays of arrays, or of nothing. And its parser of IDL takes seconds for a
parenthesis inside another, and has not been seen to end for ten: definitions need none.
"""

import re
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any
from urllib.parse import quote

from misstep.errors import MisstepError

_MOST_PARTS = 10_000  # texts and messages inside of one message, as far as its definition says
_LONGEST_DEFINITION = 2**18  # characters; the longest of ROS itself has 2**15
_FILLING = "structure_needs_at_least_one_member"  # of an empty message; in ROS 1 it is not there

# As rosbags' own parser takes them.
_IDL_TEXT = re.compile(r'"(?:\\"|[^"])*"|/[*]([^*]|[*](?!/))*[*]/|//[^\n]*')
_IDL_ANNOTATION = re.compile(r"@[\w:]+\s*\([^()]*\)")
_IDL_NESTED = re.compile(r"\(|<[^<>;]*<[^<>;]*<[^<>;]*<")


def check_base(file: Path) -> None:
    """Refuse a data base of SQLite that computes what it holds, rather than hold it.

    Raises
    ------
    MisstepError
        If it has a view, a virtual table or a computed column.
    sqlite3.Error
        If it is damaged.
    """
    address = f"file:{quote(str(file.resolve()))}?mode=ro&immutable=1"
    with closing(sqlite3.connect(address, uri=True)) as base:
        computed = base.execute(
            "SELECT name FROM sqlite_master WHERE type = 'view' OR sql LIKE 'CREATE VIRTUAL%' "
            "UNION SELECT t.name FROM sqlite_master AS t, pragma_table_xinfo(t.name) AS c "
            "WHERE t.type = 'table' AND c.hidden"
        ).fetchone()
    if computed is not None:
        raise MisstepError(f"{computed[0]!r} in its data base is computed: only tables are read")


def check_types(types: dict[str, Any]) -> None:
    """Refuse definitions of messages that a few bytes, or none, would make without end.

    Parameters
    ----------
    types : dict
        rosbags' definitions of the fields, by the name of the message.

    Raises
    ------
    MisstepError
        If a message holds itself, an array of empty messages, or very many parts.
    """
    from rosbags.interfaces import Nodetype

    @cache
    def parts(name: str) -> int:
        return sum(of(kind) for _, kind in types[name][1])

    @cache
    def is_empty(name: str) -> bool:
        return all(
            field == _FILLING or (kind[0] == Nodetype.NAME and is_empty(kind[1]))
            for field, kind in types[name][1]
        )

    def of(kind: Any) -> int:
        if kind[0] == Nodetype.BASE:
            return 1
        if kind[0] == Nodetype.NAME:
            return 1 + parts(kind[1])
        (inner, length), is_array = kind[1], kind[0] == Nodetype.ARRAY
        if inner[0] == Nodetype.NAME and is_empty(inner[1]):
            raise MisstepError(f"an array of {inner[1]}, which is empty, says nothing")
        if inner[0] == Nodetype.BASE and inner[1][0] != "string":
            return 1  # NumPy makes it of as many bytes as are there
        return of(inner) * (length if is_array else 1)

    for name in types:
        try:
            count = parts(name)
        except RecursionError as error:
            raise MisstepError(f"messages of {name} hold messages without end") from error
        if count > _MOST_PARTS:
            raise MisstepError(f"a message of {name} has {count} parts: at most {_MOST_PARTS}")


@contextmanager
def endless_texts_refused() -> Iterator[None]:
    """Have rosbags refuse YAML with aliases, and definitions that are long or deeply nested.

    It looks these functions up where they are replaced here.
    """
    from rosbags.highlevel import anyreader
    from rosbags.rosbag2 import metadata, reader

    from_msg, from_idl = anyreader.get_types_from_msg, anyreader.get_types_from_idl
    with (
        replaced(vars(metadata), YAML=_plain_yaml),
        replaced(vars(reader), YAML=_plain_yaml),
        replaced(
            vars(anyreader),
            get_types_from_msg=_bounded(from_msg),
            get_types_from_idl=_bounded(from_idl, _check_idl),
        ),
    ):
        yield


_replacements: dict[tuple[int, str], tuple[int, Any]] = {}
_counting = Lock()


@contextmanager
def replaced(table: dict[str, Any], **values: Any) -> Iterator[None]:
    """Replace entries of a library's table while anybody here needs it: then they are as before.

    Bags may be open side by side, so that the first who comes replaces and the last who goes puts
    back.
    """
    with _counting:
        for name, value in values.items():
            count, before = _replacements.get((id(table), name), (0, table[name]))
            _replacements[id(table), name] = count + 1, before
            if count == 0:
                table[name] = value
    try:
        yield
    finally:
        with _counting:
            for name in values:
                count, before = _replacements.pop((id(table), name))
                if count > 1:
                    _replacements[id(table), name] = count - 1, before
                else:
                    table[name] = before


def _plain_yaml(typ: str) -> Any:
    """Return a parser of YAML without aliases, which nobody writes into a bag."""
    from ruamel.yaml import YAML
    from ruamel.yaml.composer import Composer
    from ruamel.yaml.events import AliasEvent

    class PlainComposer(Composer):
        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.parser.check_event(AliasEvent):
                raise MisstepError("it has YAML with an alias: bags are written without")
            return super().compose_node(parent, index)

    yaml = YAML(typ=typ, pure=True)
    yaml.Composer = PlainComposer
    return yaml


def _bounded(
    parse: Callable[..., Any], check: Callable[[str], None] | None = None
) -> Callable[..., Any]:
    """Return a parser that refuses what is too long, or what a check refuses."""

    def parse_bounded(text: str, *others: Any) -> Any:
        if len(text) > _LONGEST_DEFINITION:
            raise MisstepError(
                f"a definition of messages has {len(text)} characters: at most "
                f"{_LONGEST_DEFINITION} are read"
            )
        if check is not None:
            check(text)
        return parse(text, *others)

    return parse_bounded


def _check_idl(text: str) -> None:
    plain = _IDL_ANNOTATION.sub(" ", _IDL_TEXT.sub(" ", text))
    if _IDL_NESTED.search(plain):
        raise MisstepError(
            "a definition of messages has parentheses, or sequences inside each other: only plain "
            "IDL is read"
        )
