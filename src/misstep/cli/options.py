"""Options that several commands share, and how their texts are read."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from misstep.errors import MisstepError
from misstep.parameters import ParameterValue

if TYPE_CHECKING:
    from misstep.systems import System
    from misstep.trajectory import Dataset

SystemName = Annotated[
    str, typer.Argument(metavar="SYSTEM", help="A system of `misstep list systems`.")
]
SystemParameters = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="A parameter of the system; repeatable."),
]
LearnerParameters = Annotated[
    list[str] | None,
    typer.Option("--with", metavar="NAME=VALUE", help="A parameter of the learner; repeatable."),
]
ServedRun = Annotated[
    Path, typer.Argument(metavar="RUN", help="A run, or with --from a new folder for one.")
]
NewRunFrom = Annotated[
    Path | None,
    typer.Option("--from", metavar="FILE", help="Begin a new run from these demonstrations."),
]
NewRunLearner = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="Of a new run.", show_default="as `misstep learn`"),
]
Success = Annotated[
    str | None,
    typer.Option(
        "--success",
        metavar="EXPR",
        help='What a success is in the end, in place of the system\'s own: "abs(theta) < 12deg"; '
        "held for the last T seconds with --set hold=T.",
        show_default=False,
    ),
]
Failure = Annotated[
    str | None,
    typer.Option(
        "--failure",
        metavar="EXPR",
        help='What is a failure too, and ends an attempt: "abs(theta) > 20deg or abs(x) > 1m".',
        show_default=False,
    ),
]
Cost = Annotated[
    str | None,
    typer.Option(
        "--cost",
        metavar="EXPR",
        help='Cost of a step, in place of the system\'s own: "abs(theta) + 0.1 * x * x".',
        show_default=False,
    ),
]
Seed = Annotated[int, typer.Option(help="Same seed, same result.")]
RunSystem = Annotated[
    str | None,
    typer.Option(
        "--system",
        metavar="NAME",
        help="What the run drives, where that is no simulation: such a system is only built of "
        "what you say yourself.",
        show_default=False,
    ),
]
RunParameters = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="A parameter of that system, or the address of a robot; repeatable.",
        show_default=False,
    ),
]
JsonFile = Annotated[
    Path | None,
    typer.Option("--json", metavar="FILE", help="Write the result to this file too, as JSON."),
]

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|[+-]?inf|nan", re.IGNORECASE | re.ASCII)
# Longer ones are numbers with a fraction: no parameter counts so far.
_WHOLE = re.compile(r"[+-]?\d{1,18}", re.ASCII)


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
    pairs = parse_pairs(option, texts, "length=0.5")
    return {name: _parse_value(value) for name, value in pairs.items()}


def parse_pairs(option: str, texts: Sequence[str] | None, example: str) -> dict[str, str]:
    """Read the texts of a repeatable option ``name=value``, each value as it was written.

    Raises
    ------
    MisstepError
        If a text is not ``name=value``, or a name comes twice; the message gives the `example`.
    """
    pairs: dict[str, str] = {}
    for text in texts or ():
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals or not name.isidentifier() or not value:
            raise MisstepError(f"{option} {text!r}: write name=value, such as {option} {example}")
        if name in pairs:
            raise MisstepError(f"{option} {text!r}: {name} is given twice")
        pairs[name] = value
    return pairs


def system_parameters(
    set_: Sequence[str] | None, **judges: str | None
) -> dict[str, ParameterValue]:
    """Read the texts of ``--set`` and the options that judge, such as ``--success``.

    Raises
    ------
    MisstepError
        As `parse_parameters`; and if a judge is given both ways.
    """
    values = parse_parameters("--set", set_)
    for name, formula in judges.items():
        if formula is None:
            continue
        if name in values:
            raise MisstepError(f"--set {name} and --{name} are both given: choose one")
        values[name] = formula
    return values


def demonstrated_system(
    name: str, demonstrations: "Dataset", given: Mapping[str, ParameterValue]
) -> "System":
    """Build the system that the user names, as demonstrations of it were recorded.

    Parameters
    ----------
    name : str
    demonstrations : Dataset
    given : mapping
        Parameters that the user gives, in place of recorded ones.

    Raises
    ------
    MisstepError
        If the demonstrations disagree on a parameter that is not given, or as `recorded_system`.
    """
    from misstep.systems import make_system, recorded_system

    origins = [attempt.provenance for attempt in demonstrations]
    if any(origin.system != name for origin in origins):
        return make_system(name, **given)
    names = sorted({name for origin in origins for name in origin.parameters} - set(given))
    differing = [n for n in names if len({origin.parameters.get(n) for origin in origins}) > 1]
    if differing:
        raise MisstepError(
            f"the demonstrations were recorded with different values of {', '.join(differing)}: "
            "give each with --set"
        )
    return recorded_system(name, origins[0].parameters, given, typed=True)


def run_system(
    folder: Path,
    name: str | None,
    set_: Sequence[str] | None,
    *,
    instead: bool = False,
) -> "System":
    """Build the system of a run: simulations as its folder says, anything else as the user does.

    Parameters
    ----------
    folder : Path
    name : str or None
        What the user says it drives.
    set_ : sequence of str or None
        Texts of ``--set``.
    instead : bool
        Whether these may differ from what the run was made with.

    Raises
    ------
    MisstepError
        If the folder is no run, the user has to name its system, or as `RunConfig.make_system`.
    """
    from misstep.runs import load_config
    from misstep.systems.gymnasium_adapter import PREFIX
    from misstep.systems.recorded import recorded_system, system_kind

    config, given = load_config(folder), parse_parameters("--set", set_)
    named = name is not None or config.system.startswith(PREFIX)
    if not named and system_kind(config.system).typed_only is None:
        raise MisstepError(
            f"the run {folder} drives {config.system}, which is not built from what a file says, "
            f"since it may open files or connections: name it, --system {config.system}, and with "
            "--set what of its parameters is a text"
        )
    if instead:
        return recorded_system(config.system, config.system_parameters, given, typed=named)
    return config.make_system(given, typed=name or "")


def parse_names(text: str | None) -> tuple[str, ...] | None:
    """Read names separated by commas; None stays None."""
    return None if text is None else tuple(name.strip() for name in text.split(","))


def _parse_value(text: str) -> ParameterValue:
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    if _WHOLE.fullmatch(text):
        return int(text)
    return float(text) if _NUMBER.fullmatch(text) else text
