"""``misstep list``: what there is, with every parameter, its default, unit and meaning."""

from collections.abc import Callable
from typing import Annotated, Any

import typer

from misstep.cli.options import JsonFile
from misstep.cli.output import check_output_file, write_result
from misstep.cli.table import print_table
from misstep.errors import MisstepError
from misstep.parameters import ParameterRow, parameter_table


def list_(
    what: Annotated[
        str, typer.Argument(metavar="WHAT", help="systems, learners, demonstrators or formats.")
    ],
    json: JsonFile = None,
) -> int:
    """List what there is, with its parameters."""
    if what not in _CATALOGUES:
        raise MisstepError(f"nothing to list named {what!r}; there are: {', '.join(_CATALOGUES)}")
    check_output_file(json, "--json")
    entries, broken = _CATALOGUES[what]()
    write_result(json, {"parameters": {"what": what}, what: entries, "broken": broken})
    _print(what, entries)
    for reason in broken.values():
        print(reason)
    return 0


def _print(what: str, entries: dict[str, dict[str, Any]]) -> None:
    if what == "formats":
        _print_formats(entries)
        return
    for name, entry in entries.items():
        print(f"{name}: {entry['summary']}")
        if entry.get("parameters"):
            rows = [ParameterRow(**row) for row in entry["parameters"]]
            cells = [(r.name, _default(r), r.unit, r.meaning) for r in rows]
            print_table(("parameter", ">default", "unit", "meaning"), cells)


_Catalogue = tuple[dict[str, dict[str, Any]], dict[str, str]]
"""What there is, and why some of it cannot be used."""


def _systems() -> _Catalogue:
    from misstep.systems import JUDGE_PARAMETERS, SYSTEMS, GymParameters, GymSystem

    loaded, broken = SYSTEMS.loaded()
    kinds = {name: _describe(kind, kind.parameters_type) for name, kind in loaded.items()}
    adapter = _describe(GymSystem, GymParameters)
    adapter["parameters"] += [row._asdict() for row in JUDGE_PARAMETERS]
    return {**kinds, "gym:ID": adapter}, broken


def _learners() -> _Catalogue:
    from misstep import LEARNERS

    loaded, broken = LEARNERS.loaded()
    return {n: {"rung": kind.rung, **_describe(kind, kind)} for n, kind in loaded.items()}, broken


def _demonstrators() -> _Catalogue:
    from misstep import DEMONSTRATORS

    loaded, broken = DEMONSTRATORS.loaded()
    return {name: _describe(kind, kind) for name, kind in loaded.items()}, broken


def _formats() -> _Catalogue:
    from misstep import FORMATS

    loaded, broken = FORMATS.loaded()
    return {
        name: {
            "summary": entry.description,
            "suffixes": list(entry.suffixes),
            "read_suffixes": list(entry.read_suffixes),
            "folder": entry.is_folder,
            "reads": entry.read is not None,
            "writes": entry.write is not None,
            "extra": entry.extra,
        }
        for name, entry in loaded.items()
    }, broken


_CATALOGUES: dict[str, Callable[[], _Catalogue]] = {
    "systems": _systems,
    "learners": _learners,
    "demonstrators": _demonstrators,
    "formats": _formats,
}


def _describe(kind: type, parameters: type) -> dict[str, Any]:
    summary = (kind.__doc__ or "").strip().partition("\n")[0]
    return {"summary": summary, "parameters": [r._asdict() for r in parameter_table(parameters)]}


def _print_formats(entries: dict[str, dict[str, Any]]) -> None:
    cells = [
        (
            name,
            "read, write" if entry["writes"] else "read",
            _places(entry),
            f"misstep[{entry['extra']}]" if entry["extra"] else "-",
            entry["summary"],
        )
        for name, entry in entries.items()
    ]
    print_table(("format", "can", "suffix", "needs", "what it is"), cells)


def _places(entry: dict[str, Any]) -> str:
    """Return the suffixes; in parentheses those that are looked into."""
    others = [f"({suffix})" for suffix in entry["read_suffixes"]]
    places = " ".join([*entry["suffixes"], *others])
    return places or ("any folder" if entry["folder"] else "-")


def _default(row: ParameterRow) -> str:
    return str(row.default).lower() if isinstance(row.default, bool) else str(row.default)


COMMANDS = [("list", list_, "misstep list learners")]
