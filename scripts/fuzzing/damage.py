"""Damage to bytes, texts and JSON, drawn with a NumPy generator."""

import json
import math
import re
import struct
from collections.abc import Callable, Sequence
from typing import Any

from numpy.random import Generator

LARGEST_GROWTH = 2**14
"""Bytes that one change may add at most."""

_WHOLE = (0, 1, -1, 2, 127, 128, 255, 256, 2**15, 2**16, 2**31 - 1, 2**31, 2**32 - 1, -(2**31))
_LONG = (*_WHOLE, 2**40, 2**62, 2**63 - 1, -(2**63))
_REAL = (0.0, -0.0, 1.0, -1.0, math.nan, math.inf, -math.inf, 5e-324, 1e308, -1e308, 1e-12, 1e12)
_WORTHY = (
    *(struct.pack("<i", n) for n in _WHOLE if n < 2**31),
    *(struct.pack(">i", n) for n in _WHOLE if n < 2**31),
    *(struct.pack("<q", n) for n in _LONG),
    *(struct.pack(">q", n) for n in _LONG),
    *(struct.pack("<d", x) for x in _REAL),
    *(struct.pack("<h", n) for n in (0, 1, -1, 2**15 - 1)),
    *(bytes([n]) for n in (0, 1, 0x7F, 0x80, 0xFF)),
    b"\xff" * 8,
    b"\x00" * 16,
)

TEXTS = (
    *map(str, (*_LONG, *_REAL)),
    "1e999",
    "-1e-999",
    "9" * 400,
    "9" * 5000,
    "1_000",
    "0x10",
    "1.5",
    "true",
    "null",
    "",
    " ",
    "\t",
    "\n",
    "\r\n",
    ",",
    ";",
    ":",
    "=",
    ".",
    "-",
    "#",
    "'",
    '"',
    '"""',
    "\\",
    "\x00",
    "\x1b[2J",
    "\u202e",
    "\ufeff",
    "é",
    "θ",
    "🦿",
    "[",
    "]",
    "{",
    "}",
    "(",
    ")",
    "[[",
    "(" * 60,
    "[" * 3000,
    '{"a":' * 3000,
    "x" * 3000,
    "../../../../etc/passwd",
    "/etc/passwd",
    "file:///etc/passwd",
    "__class__",
    "{0.__class__}",
    "%s%n",
    "$(id)",
    "import os",
    "!!python/object/apply:os.system",
)
"""What texts are known to stumble over."""

_TOKEN = re.compile(r"\s+|[\w.+-]+|[^\w\s]")


def one_of(rng: Generator, choices: Sequence[Any]) -> Any:
    """Return one of `choices`."""
    return choices[int(rng.integers(len(choices)))]


def a_few(rng: Generator) -> int:
    """Return 1, more seldom 2, 3 ..."""
    return min(int(rng.geometric(0.5)), 8)


# Bytes

_Change = Callable[[Generator, bytearray, Sequence[bytes]], None]


def damaged(rng: Generator, whole: bytes, others: Sequence[bytes] = ()) -> bytes:
    """Return bytes with some damage.

    Parameters
    ----------
    rng : Generator
    whole : bytes
    others : sequence of bytes
        Of which pieces are put in: files of the same kind.
    """
    data = bytearray(whole)
    for _ in range(a_few(rng)):
        one_of(rng, _CHANGES)(rng, data, others)
    return bytes(data)


def _place(rng: Generator, data: bytearray) -> int:
    return int(rng.integers(len(data) + 1))


def _length(rng: Generator, data: bytearray) -> int:
    """Return a length that is short more often than long."""
    most = max(1, min(len(data), LARGEST_GROWTH))
    return max(1, int(most ** rng.random()))


def _flip_bit(rng: Generator, data: bytearray, others: Sequence[bytes]) -> None:
    if data:
        data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))


def _set_byte(rng: Generator, data: bytearray, others: Sequence[bytes]) -> None:
    if data:
        data[int(rng.integers(len(data)))] = int(rng.integers(256))


def _overwrite(rng: Generator, data: bytearray, others: Sequence[bytes]) -> None:
    worthy = one_of(rng, _WORTHY)
    at = _place(rng, data)
    data[at : at + len(worthy)] = worthy


def _cut(rng: Generator, data: bytearray, others: Sequence[bytes]) -> None:
    at = _place(rng, data)
    del data[at : at + _length(rng, data)]


def _insert(rng: Generator, data: bytearray, others: Sequence[bytes]) -> None:
    at = _place(rng, data)
    data[at:at] = one_of(rng, _WORTHY) if rng.random() < 0.5 else rng.bytes(_length(rng, data))


def _double(rng: Generator, data: bytearray, others: Sequence[bytes]) -> None:
    at = _place(rng, data)
    piece = data[at : at + _length(rng, data)]
    times = min(int(2 ** rng.integers(1, 6)), LARGEST_GROWTH // max(1, len(piece)))
    data[at:at] = piece * times


def _swap(rng: Generator, data: bytearray, others: Sequence[bytes]) -> None:
    size = _length(rng, data)
    a, b = sorted((_place(rng, data), _place(rng, data)))
    if a + size <= b and b + size <= len(data):
        data[a : a + size], data[b : b + size] = data[b : b + size], data[a : a + size]


def _blank(rng: Generator, data: bytearray, others: Sequence[bytes]) -> None:
    at = _place(rng, data)
    size = min(_length(rng, data), len(data) - at)
    data[at : at + size] = bytes([one_of(rng, (0, 0xFF))]) * size


def _shift_number(rng: Generator, data: bytearray, others: Sequence[bytes]) -> None:
    """Change a number of 1, 2, 4 or 8 bytes a little, or by a factor of two."""
    size = int(2 ** rng.integers(4))
    if len(data) < size:
        return
    at = int(rng.integers(len(data) - size + 1))
    order = one_of(rng, ("little", "big"))
    number = int.from_bytes(data[at : at + size], order)
    number = one_of(rng, (number + 1, number - 1, number * 2, number // 2, ~number))
    data[at : at + size] = (number % 256**size).to_bytes(size, order)


def _cut_off(rng: Generator, data: bytearray, others: Sequence[bytes]) -> None:
    del data[_place(rng, data) :]


def _splice(rng: Generator, data: bytearray, others: Sequence[bytes]) -> None:
    """Put a piece of another file in place of what was there."""
    if not others:
        return
    other = one_of(rng, others)
    start = int(rng.integers(len(other) + 1))
    piece = other[start : start + int(rng.integers(1, LARGEST_GROWTH))]
    at = _place(rng, data)
    data[at : at + (len(piece) if rng.random() < 0.7 else 0)] = piece


_CHANGES: tuple[_Change, ...] = (
    _flip_bit,
    _flip_bit,
    _set_byte,
    _set_byte,
    _overwrite,
    _overwrite,
    _cut,
    _insert,
    _double,
    _swap,
    _blank,
    _shift_number,
    _shift_number,
    _cut_off,
    _splice,
)


# Texts


def damaged_text(rng: Generator, text: str, words: Sequence[str] = ()) -> str:
    """Return a text some of whose tokens or lines are lost, changed, doubled or swapped.

    Parameters
    ----------
    rng : Generator
    text : str
    words : sequence of str
        What means something in such a text.
    """
    by_line = rng.random() < 0.2
    tokens = text.splitlines(keepends=True) if by_line else _TOKEN.findall(text)
    for _ in range(a_few(rng)):
        at = int(rng.integers(len(tokens) + 1))
        what = int(rng.integers(7))
        if what == 0:
            del tokens[at : at + 1]
        elif what == 1:
            piece = tokens[at : at + 3]
            times = LARGEST_GROWTH // max(1, sum(map(len, piece)))
            tokens[at:at] = piece * min(times, int(2 ** rng.integers(6)))
        elif what == 2 and tokens:
            other = int(rng.integers(len(tokens)))
            at = min(at, len(tokens) - 1)
            tokens[at], tokens[other] = tokens[other], tokens[at]
        elif what == 3 and words:
            tokens[at : at + int(rng.integers(2))] = [one_of(rng, words)]
        elif what == 4 and tokens:
            at = min(at, len(tokens) - 1)
            raw = damaged(rng, tokens[at].encode("utf-8", "surrogatepass"))
            tokens[at] = raw.decode("utf-8", "replace")
        else:
            tokens[at : at + int(rng.integers(2))] = [one_of(rng, TEXTS)]
    return "".join(tokens)


# Values that JSON and TOML know


def hostile_value(rng: Generator, depth: int = 0) -> Any:
    """Return a number, text, list or table that is seldom expected."""
    kind = int(rng.integers((8, 7, 7, 5)[min(depth, 3)]))
    if kind == 0:
        return one_of(rng, (*_LONG, 10**30, 10**400))
    if kind == 1:
        return one_of(rng, _REAL)
    if kind == 2:
        return one_of(rng, TEXTS)
    if kind == 3:
        return one_of(rng, (None, True, False))
    if kind == 4:
        return float(rng.normal() * 10.0 ** rng.integers(-20, 20))
    if kind == 5:
        return [hostile_value(rng, depth + 1) for _ in range(int(rng.integers(4)))]
    if kind == 6:
        return {one_of(rng, TEXTS): hostile_value(rng, depth + 1) for _ in range(2)}
    return [hostile_value(rng, depth + 2)] * 30


def damaged_value(rng: Generator, value: Any, words: Sequence[str] = ()) -> Any:
    """Return a JSON value of which one part, somewhere, was changed.

    Parameters
    ----------
    rng : Generator
    value : None, bool, int, float, str, list or dict
        Not changed itself.
    words : sequence of str
        Names that mean something there.
    """
    if isinstance(value, dict) and value and rng.random() < 0.85:
        return _damaged_table(rng, value, words)
    if isinstance(value, list) and value and rng.random() < 0.85:
        return _damaged_list(rng, value, words)
    if isinstance(value, str) and value and rng.random() < 0.5:
        return _damaged_inside(rng, value, words)
    if isinstance(value, int | float) and rng.random() < 0.3:
        return -value if rng.random() < 0.5 else str(value)
    return one_of(rng, words) if words and rng.random() < 0.2 else hostile_value(rng)


def _damaged_inside(rng: Generator, text: str, words: Sequence[str]) -> str:
    """Change a text; one that holds JSON itself, more often inside."""
    if text[0] in "{[" and rng.random() < 0.8:
        try:
            return json.dumps(damaged_value(rng, json.loads(text), words))
        except ValueError:
            pass
    return damaged_text(rng, text, words)


def _damaged_table(rng: Generator, table: dict[str, Any], words: Sequence[str]) -> dict[str, Any]:
    changed = dict(table)
    name = one_of(rng, list(table))
    what = rng.random()
    if what < 0.1:
        del changed[name]
    elif what < 0.2:
        changed[one_of(rng, words or TEXTS)] = changed.pop(name)
    elif what < 0.25:
        changed[one_of(rng, words or TEXTS)] = hostile_value(rng)
    else:
        changed[name] = damaged_value(rng, table[name], words)
    return changed


def _damaged_list(rng: Generator, values: list[Any], words: Sequence[str]) -> list[Any]:
    at = int(rng.integers(len(values)))
    what = rng.random()
    if what < 0.1:
        return values[:at] + values[at + 1 :]
    if what < 0.2:
        return (
            values[: at + 1] * min(int(2 ** rng.integers(1, 6)), 1 + 100 // (at + 1)) + values[at:]
        )
    if what < 0.25:
        return [*values[:at], hostile_value(rng), *values[at:]]
    return [*values[:at], damaged_value(rng, values[at], words), *values[at + 1 :]]


def damaged_json(rng: Generator, text: str, words: Sequence[str] = ()) -> str:
    """Return a text of JSON, or of a line of JSON each, damaged as a value or as a text."""
    if rng.random() < 0.3:
        return damaged_text(rng, text, words)
    lines = text.splitlines() if "\n{" in text else [text]
    at = int(rng.integers(len(lines)))
    try:
        lines[at] = json.dumps(damaged_value(rng, json.loads(lines[at]), words))
    except ValueError:
        return damaged_text(rng, text, words)
    return "\n".join(lines)
