"""Attributes of an HDF5 file that may come from anybody: single numbers, and texts of fixed length.

The HDF5 library crashes on damaged texts of variable length, so none is written or read.
"""

import json
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import h5py

from misstep.errors import MisstepError, reason_of

_LONGEST_TEXT = 64000  # bytes: HDF5 has room for 64 KiB, what describes it included

# What h5py raises when a file is damaged, depending on where.
_DAMAGE = (
    OSError,
    KeyError,
    RuntimeError,
    ValueError,
    TypeError,
    OverflowError,
    MemoryError,
    zlib.error,
)


@contextmanager
def damage(what: str) -> Iterator[None]:
    """Tell what h5py raises over a damaged file as one line."""
    try:
        yield
    except MisstepError:
        raise
    except _DAMAGE as error:
        reason = reason_of(error)
        raise MisstepError(f"{what} is damaged ({reason})") from error


def set_attribute(owner: h5py.Group, name: str, value: Any) -> None:
    """Write a number, a truth value or a text.

    Raises
    ------
    MisstepError
        If a text is too long for an attribute.
    """
    if not isinstance(value, str):
        owner.attrs[name] = value
        return
    text = value.encode()
    if len(text) > _LONGEST_TEXT:
        raise MisstepError(
            f"attribute {name} would take up {len(text)} bytes: at most {_LONGEST_TEXT} fit"
        )
    owner.attrs.create(name, text, dtype=h5py.string_dtype("utf-8", max(1, len(text))))


def has_attribute(owner: h5py.Group, name: str) -> bool:
    """Say whether there is an attribute `name`."""
    with damage(f"attribute {name}"):
        return name in owner.attrs


def attribute(owner: h5py.Group, name: str, kind: type | tuple[type, ...]) -> Any:
    """Return a single int, float, bool or str, whichever of these `kind` is.

    Raises
    ------
    MisstepError
        If it is missing, damaged or of another kind.
    """
    if not has_attribute(owner, name):
        raise MisstepError(f"attribute {name} is missing")
    with damage(f"attribute {name}"):
        identifier = owner.attrs.get_id(name)
        if identifier.shape != () or not _is_plain(identifier.get_type()):
            raise MisstepError(f"attribute {name} is not a single number or text of fixed length")
        plain = owner.attrs[name].item()
        if isinstance(plain, bytes):
            plain = plain.decode()
    if not isinstance(plain, kind) or (isinstance(plain, bool) and kind is not bool):
        raise MisstepError(f"attribute {name} is {plain!r}: that is of the wrong type")
    return plain


def json_attribute(owner: h5py.Group, name: str) -> Any:
    """Return what an attribute says in JSON.

    Raises
    ------
    MisstepError
        If it is missing, damaged or no JSON.
    """
    text = attribute(owner, name, str)
    with damage(f"attribute {name}"):  # nested too deeply is a RuntimeError
        return json.loads(text)


def _is_plain(kind: h5py.h5t.TypeID) -> bool:
    if isinstance(kind, h5py.h5t.TypeStringID):
        return not kind.is_variable_str() and kind.get_size() <= _LONGEST_TEXT
    return isinstance(kind, h5py.h5t.TypeIntegerID | h5py.h5t.TypeFloatID | h5py.h5t.TypeEnumID)
