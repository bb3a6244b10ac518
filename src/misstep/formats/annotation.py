"""What misstep knows of an episode besides its numbers, as one line of JSON.

Formats of other projects have no place for a unit, a failure step or a seed, but they all have
one for a text. An episode that misstep wrote to such a format is read back whole through this
line; without it, a reader makes do with what the format says itself.
"""

import json
import math
from dataclasses import dataclass, replace
from typing import Any

from misstep.errors import MisstepError, reason_of
from misstep.formats.format import Ending, Header
from misstep.trajectory import Column, Outcome, Provenance

_VERSION = 1
_LARGEST = 10_000_000  # characters


@dataclass(frozen=True)
class Annotation:
    """What is said of one episode.

    Parameters
    ----------
    header : Header
    ending : Ending
    has_costs : bool
        Whether costs were recorded; rewards that stand in the file mean nothing otherwise.
    """

    header: Header
    ending: Ending
    has_costs: bool

    @property
    def provenance(self) -> Provenance:
        """Where the episode comes from, with what was found on the way to the file."""
        known = self.header.provenance
        return replace(known, notes=(*known.notes, *self.ending.notes))

    def to_text(self) -> str:
        """Return it as one line of JSON."""
        provenance = self.provenance
        parameters = {name: _to_json(value) for name, value in provenance.parameters.items()}
        return json.dumps(
            {
                "misstep": _VERSION,
                "dt": self.header.dt,
                "observation_columns": _columns_to_json(self.header.observation_columns),
                "action_columns": _columns_to_json(self.header.action_columns),
                "system": provenance.system,
                "parameters": parameters,
                "demonstrator": provenance.demonstrator,
                "seed": provenance.seed,
                "time": provenance.time,
                "notes": list(provenance.notes),
                "outcome": self.ending.outcome.value,
                "failure_step": self.ending.failure_step,
                "has_costs": self.has_costs,
            },
            allow_nan=False,
        )


def read_annotation(text: str) -> Annotation:
    """Return what `Annotation.to_text` wrote.

    Raises
    ------
    MisstepError
        If it is not that, or of a newer misstep.
    """
    if len(text) > _LARGEST:
        raise MisstepError(f"misstep's annotation has {len(text)} characters: that is too long")
    try:
        said = json.loads(text)
        is_newer = said["misstep"] > _VERSION
        if not is_newer:
            return _annotation(said)
    except (ArithmeticError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise MisstepError(f"misstep's annotation is damaged ({reason_of(error)})") from error
    raise MisstepError("misstep's annotation is of a newer misstep: install that")


def _annotation(said: dict[str, Any]) -> Annotation:
    dt, failure_step = said["dt"], said["failure_step"]
    if dt is not None and not (isinstance(dt, float | int) and 0 < dt < math.inf):
        raise ValueError(f"dt is {dt!r}")
    if failure_step is not None and (type(failure_step) is not int or failure_step < 0):
        raise ValueError(f"failure_step is {failure_step!r}")
    for name, kind in (("notes", list), ("parameters", dict)):
        if not isinstance(said[name], kind):
            raise ValueError(f"{name} is {type(said[name]).__name__}, not {kind.__name__}")
    provenance = Provenance(
        system=said["system"],
        parameters={name: _from_json(value) for name, value in said["parameters"].items()},
        demonstrator=said["demonstrator"],
        seed=said["seed"],
        time=said["time"],
        notes=tuple(said["notes"]),
    )
    header = Header(
        None if dt is None else float(dt),
        tuple(Column(name, unit) for name, unit in said["observation_columns"]),
        tuple(Column(name, unit) for name, unit in said["action_columns"]),
        provenance,
    )
    return Annotation(
        header, Ending(Outcome(said["outcome"]), failure_step), bool(said["has_costs"])
    )


def _columns_to_json(columns: tuple[Column, ...]) -> list[list[str]]:
    return [[column.name, column.unit] for column in columns]


def _to_json(value: float | int | bool | str) -> Any:
    """Return a parameter; an infinite one, which JSON lacks, as ``{"float": "inf"}``."""
    if isinstance(value, float) and not math.isfinite(value):
        return {"float": repr(value)}
    return value


def _from_json(value: Any) -> Any:
    return float(value["float"]) if isinstance(value, dict) else value
