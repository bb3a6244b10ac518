"""Spaces of Gymnasium, however nested, as one table of numbers, as Minari records them."""

import math
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from misstep.errors import MisstepError
from misstep.formats.format import FloatArray
from misstep.trajectory import Column


class Table(NamedTuple):
    """The numbers of a space over an episode, a column each, and what is no number."""

    columns: tuple[Column, ...]
    values: FloatArray
    left_out: tuple[str, ...]


def flat(space: spaces.Space[Any], values: Any, name: str) -> Table:
    """Return the numbers of a space over an episode.

    Parameters
    ----------
    space : gymnasium space
    values : nested dicts and tuples of ndarray, shape (b, ...)
        As Minari nests them.
    name : str
        For the columns of a space that is not nested.

    Raises
    ------
    MisstepError
        If there are none, or the values do not fit the space.
    """
    columns: list[Column] = []
    tables: list[FloatArray] = []
    left_out: list[str] = []
    for place, part, leaf in _leaves(space, values, ""):
        title = place or name
        if not isinstance(part, _NUMBERS) or _is_image(part):
            left_out.append(f"{name} {place}".strip())
            continue
        table = _table(leaf, title)
        width = table.shape[1]
        names = [title] if width == 1 and place else [f"{title}_{i}" for i in range(width)]
        columns += [Column(each, "") for each in names]
        tables.append(table)
    if not tables:
        raise MisstepError(f"the {name} space holds no numbers")
    if len({len(table) for table in tables}) > 1:
        raise MisstepError(f"the parts of the {name}s differ in their lengths")
    return Table(tuple(columns), np.concatenate(tables, axis=1), tuple(left_out))


def _table(values: Any, title: str) -> FloatArray:
    try:
        table: FloatArray = np.asarray(values, np.float64)
        return table.reshape(len(table), math.prod(table.shape[1:]))
    except (TypeError, ValueError) as error:
        raise MisstepError(f"{title} does not hold numbers for every step") from error


_NUMBERS = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)


def _is_image(space: spaces.Space[Any]) -> bool:
    return isinstance(space, spaces.Box) and len(space.shape) > 1 and space.dtype == np.uint8


def _leaves(
    space: spaces.Space[Any], values: Any, place: str
) -> Iterator[tuple[str, spaces.Space[Any], Any]]:
    parts: Iterable[tuple[Any, spaces.Space[Any]]]
    if isinstance(space, spaces.Dict):
        parts = space.spaces.items()
    elif isinstance(space, spaces.Tuple):
        parts = enumerate(space.spaces)
    else:
        yield place, space, values
        return
    for key, part in parts:
        try:
            deeper = values[key]
        except (KeyError, IndexError, TypeError) as error:
            raise MisstepError(f"{place or 'what is recorded'} has no part {key!r}") from error
        yield from _leaves(part, deeper, f"{place}_{key}".strip("_"))
