"""Options that several commands share, and how their texts are read."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from misstep.errors import MisstepError
from misstep.parameters import ParameterValue

SystemName = Annotated[
    str, typer.Argument(metavar="SYSTEM", help="A system of `misstep list systems`.")
]
Seed = Annotated[int, typer.Option(help="Same seed, same result.")]
JsonFile = Annotated[
    Path | None,
    typer.Option("--json", metavar="FILE", help="Write the result to this file too, as JSON."),
]

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|[+-]?inf|nan", re.IGNORECASE | re.ASCII)
_WHOLE = re.compile(r"[+-]?\d+", re.ASCII)


def parse_parameters(option: str, texts: Sequence[str] | None) -> dict[str, ParameterValue]:
    """Read the texts of a repeatable option ``name=value``.

    Parameters
    ----------
    option : str
        Its name, for the error message.
    texts : sequence of str or None

    Returns
    -------
    dict
        Whole numbers, numbers, ``true`` and ``false`` as such; anything else as a text.

    Raises
    ------
    MisstepError
        If a text is not ``name=value``, or a name comes twice.
    """
    values: dict[str, ParameterValue] = {}
    for text in texts or ():
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals or not name.isidentifier() or not value:
            raise MisstepError(f"{option} {text!r}: write name=value, such as {option} length=0.5")
        if name in values:
            raise MisstepError(f"{option} {text!r}: {name} is given twice")
        values[name] = _parse_value(value)
    return values


def parse_names(text: str | None) -> tuple[str, ...] | None:
    """Read names separated by commas; None stays None."""
    return None if text is None else tuple(name.strip() for name in text.split(","))


def _parse_value(text: str) -> ParameterValue:
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    if _WHOLE.fullmatch(text):
        return int(text)
    return float(text) if _NUMBER.fullmatch(text) else text
