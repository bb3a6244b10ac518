"""Where in the messages of a bag a column is: ``/joint_states.position[cart]``, ``/cmd.data``.

A place is a topic, a dot, and a way through the fields of its messages; ``[3]`` picks from an
array by number, ``[cart]`` by the name beside it (``name`` in a ``JointState``). A place that
stops half-way means every number below it: ``/cmd_vel`` the six numbers of a ``Twist``.
"""

import re
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np

from misstep.errors import MisstepError

MOST_COLUMNS = 4096

_NAMES = ("name", "names", "joint_names")
_STEP = re.compile(r"\.(\w+)|\[(\d{1,9})\]|\[([^\[\]]+)\]")
_UNTOLD = {"std_msgs/msg/Header", "builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"}


@dataclass(frozen=True)
class Place:
    """A topic and a way through its messages.

    Parameters
    ----------
    topic : str
    way : tuple of str, int or `Named`
        Names of fields, numbers and names of elements.
    """

    topic: str
    way: "tuple[str | int | Named, ...]"

    def __str__(self) -> str:
        steps = (f".{step}" if isinstance(step, str) else f"[{step}]" for step in self.way)
        return self.topic + "".join(steps)

    def value(self, message: Any) -> float | None:
        """Return the number there; None where this message has none."""
        found = self.found(message)
        is_number = isinstance(found, int | float | np.number | np.bool_)
        return float(found) if is_number else None

    def found(self, message: Any) -> Any:
        """Return whatever is there; None where this message has nothing."""
        parent = None
        for step in self.way:
            if isinstance(step, str):
                parent, message = message, getattr(message, step, None)
            elif isinstance(step, Named):
                names = _names_beside(parent)
                index = names.index(step.name) if step.name in names else -1
                message = _element(message, index)
            else:
                message = _element(message, step)
            if message is None:
                return None
        return message


@dataclass(frozen=True)
class Named:
    """An element of an array, by the name beside it."""

    name: str

    def __str__(self) -> str:
        return self.name


def parse_place(text: str) -> Place:
    """Return the place that a text such as ``/joint_states.position[cart]`` says.

    Raises
    ------
    MisstepError
        If it is not one.
    """
    topic = re.match(r"[\w/~-]+", text)
    at = topic.end() if topic else 0
    way: list[str | int | Named] = []
    while topic and at < len(text) and (step := _STEP.match(text, at)):
        field, number, name = step.groups()
        way.append(field or (int(number) if number else Named(name)))
        at = step.end()
    if topic is None or at < len(text):
        raise MisstepError(
            f"{text!r} is no place in a bag: give /topic.field, such as "
            "/joint_states.position[cart] or /cmd.data"
        )
    return Place(topic[0], tuple(way))


def numbers_below(place: Place, message: Any) -> list[Place]:
    """Return the places of all numbers at or below `place` in a message.

    Raises
    ------
    MisstepError
        If there are more than `MOST_COLUMNS`.
    """
    is_array = bool(place.way) and isinstance(place.way[-1], str)
    parent = Place(place.topic, place.way[:-1]).found(message) if is_array else None
    numbers: list[Place] = []
    _collect(place, parent, place.found(message), numbers)
    return numbers


def _collect(place: Place, parent: Any, here: Any, found: list[Place]) -> None:
    if isinstance(here, int | float | np.number | np.bool_):
        found.append(place)
    elif isinstance(here, np.ndarray | list):
        names = _names_beside(parent)
        by_name = all(names) and len(set(names)) == len(names) == len(here)
        for index, element in enumerate(here):
            if len(found) > MOST_COLUMNS or isinstance(element, str):
                break
            step = Named(names[index]) if by_name and "]" not in names[index] else index
            _collect(Place(place.topic, (*place.way, step)), None, element, found)
    elif is_dataclass(here) and getattr(here, "__msgtype__", "") not in _UNTOLD:
        for field in fields(here):
            deeper = Place(place.topic, (*place.way, field.name))
            _collect(deeper, here, getattr(here, field.name), found)
    if len(found) > MOST_COLUMNS:
        raise MisstepError(
            f"{place.topic} has more than {MOST_COLUMNS} numbers: name those that matter, such as "
            f"{place}[0]"
        )


def _element(values: Any, index: int) -> Any:
    if isinstance(values, np.ndarray | list) and 0 <= index < len(values):
        return values[index]
    return None


def _names_beside(parent: Any) -> list[str]:
    """Return the names that a message gives to the elements of its arrays, in their order."""
    for field in _NAMES:
        names = getattr(parent, field, None)
        if isinstance(names, list) and names and all(isinstance(name, str) for name in names):
            return names
    return []
