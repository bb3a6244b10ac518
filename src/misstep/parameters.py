"""Parameters that explain themselves: a frozen dataclass whose fields carry unit, meaning, range.

One such dataclass is at the same time the documentation, the configuration, the arguments on the
command line and the Python interface of a system, a demonstrator or a learner. What a field may
hold is written once, beside it, and checked whenever an instance is made.
"""

import numbers
import sys
from collections.abc import Mapping
from dataclasses import Field, field, fields, is_dataclass
from typing import Any, NamedTuple, TypeVar, cast, get_type_hints

import numpy as np

from misstep.errors import MisstepError

P = TypeVar("P")

ParameterValue = float | int | bool | str
"""What one parameter can hold; exactly what a file or a command line can hold too."""

LARGEST = sys.float_info.max
"""Number that a double can hold; a whole number of Python's can be larger."""
_KIND_OF = {float: "a number", int: "a whole number", bool: "true or false", str: "a text"}


class ParameterRow(NamedTuple):
    """One line of a table of parameters.

    Attributes
    ----------
    name : str
    default : float, int, bool or str
    unit : str
        Empty where the parameter has none.
    meaning : str
    """

    name: str
    default: ParameterValue
    unit: str
    meaning: str


def parameter(
    default: ParameterValue,
    unit: str,
    meaning: str,
    *,
    above: float | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
) -> Any:
    """Declare one field of a dataclass of parameters.

    Parameters
    ----------
    default : float, int, bool or str
    unit : str
        Unit as printed, ``"kg"``; empty for none.
    meaning : str
        One phrase that completes the name.
    above, at_least, at_most : float, optional
        Range of a number: strictly above, at least, at most.
    """
    return field(
        default=default,
        metadata={
            "unit": unit,
            "meaning": meaning,
            "above": above,
            "at_least": at_least,
            "at_most": at_most,
        },
    )


def other_default(kind: type, name: str, default: ParameterValue) -> Any:
    """Declare a field as the dataclass `kind` does, but with another default."""
    (declared,) = (f for f in fields(kind) if f.name == name)
    return field(default=default, metadata=declared.metadata)


def parameter_table(kind: type) -> list[ParameterRow]:
    """Return the parameters of the dataclass `kind` in the order of their declaration.

    Raises
    ------
    MisstepError
        If it is no dataclass, or a field was not declared by `parameter`.
    """
    if not is_dataclass(kind):
        raise MisstepError(
            f"{kind.__name__} is no dataclass: parameters are the fields of a frozen one, each "
            "declared by misstep.parameters.parameter"
        )
    for f in fields(kind):
        if "meaning" not in f.metadata:
            raise MisstepError(
                f"{kind.__name__}.{f.name} says no unit and meaning: declare it as {f.name} = "
                "parameter(default, unit, meaning)"
            )
    return [
        ParameterRow(
            f.name, cast(ParameterValue, f.default), f.metadata["unit"], f.metadata["meaning"]
        )
        for f in fields(kind)
    ]


def build_parameters(kind: type[P], owner: str, values: Mapping[str, object]) -> P:
    """Make an instance of the dataclass `kind` from named values.

    Raises
    ------
    MisstepError
        If a name is not a parameter of `owner`, or a value is of the wrong type or out of range.
    """
    rows = parameter_table(kind)
    known = {row.name for row in rows}
    for name in values:
        if name not in known:
            listed = ", ".join(row.name + (f" [{row.unit}]" if row.unit else "") for row in rows)
            raise MisstepError(f"{owner} has no parameter {name!r}; it has: {listed or 'none'}")
    return kind(**values)


def check_parameters(parameters: Any, owner: str) -> None:
    """Check every field of a dataclass of parameters; whole numbers given for reals become reals.

    To be called from ``__post_init__``.

    Raises
    ------
    MisstepError
        If a value is of the wrong type, not finite, or out of its range.
    """
    parameter_table(type(parameters))
    # Where a module says `from __future__ import annotations`, a field's own type is a text.
    kinds = get_type_hints(type(parameters))
    for f in fields(parameters):
        value = _of_type(f, kinds[f.name], getattr(parameters, f.name), owner)
        _check_range(f, value, owner)
        object.__setattr__(parameters, f.name, value)


def _of_type(f: Field[Any], wanted: Any, value: Any, owner: str) -> ParameterValue:
    if wanted not in _KIND_OF:
        raise MisstepError(
            f"{owner}: {f.name} is declared as {wanted}: a parameter is a float, int, bool or str"
        )
    if isinstance(value, np.generic):
        value = value.item()
    number = isinstance(value, numbers.Real) and not isinstance(value, bool)
    finite = number and -LARGEST <= value <= LARGEST
    if wanted is float and finite:
        return float(value)
    if wanted is int and finite and value == int(value):
        return int(value)
    if wanted in (bool, str) and isinstance(value, wanted):
        return wanted(value)
    unit = f" in {f.metadata['unit']}" if f.metadata["unit"] else ""
    kind = _KIND_OF[wanted]
    if number and not finite:
        kind = kind.replace("a number", "a finite number")
    raise MisstepError(f"{owner}: {f.name} is {value!r} but must be {kind}{unit}: {_meaning(f)}")


def _check_range(f: Field[Any], value: ParameterValue, owner: str) -> None:
    if isinstance(value, bool | str):
        return
    above, least, most = (f.metadata[key] for key in ("above", "at_least", "at_most"))
    bounds = [
        (above is not None and value <= above, "greater than", above),
        (least is not None and value < least, "at least", least),
        (most is not None and value > most, "at most", most),
    ]
    for violated, relation, bound in bounds:
        if violated:
            unit = f.metadata["unit"]
            raise MisstepError(
                f"{owner}: {f.name} is {f'{value:g} {unit}'.strip()} but must be {relation} "
                f"{f'{bound:g} {unit}'.strip()}: {_meaning(f)}"
            )


def _meaning(f: Field[Any]) -> str:
    return str(f.metadata["meaning"])
