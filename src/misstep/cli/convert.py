"""``misstep convert``: recordings of any kind into a data set, and between formats."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from misstep.cli.options import JsonFile, SystemParameters, parse_parameters
from misstep.cli.output import check_new_recording, check_output_file, write_result
from misstep.cli.progress import progress
from misstep.errors import MisstepError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from misstep.recordings.checking import Beginnings
    from misstep.recordings.pipeline import Plan, Summary
    from misstep.trajectory import Column


def convert(
    paths: Annotated[
        list[Path],
        typer.Argument(metavar="IN... OUT", help="What to read, and last what to write."),
    ],
    columns: Annotated[
        str | None,
        typer.Option(
            metavar="COLUMNS",
            help="Observations, NAME[=SOURCE][:UNIT[:FACTOR[:OFFSET]]] separated by commas: "
            '"x=cart_position:cm,theta=2:deg:-1". SOURCE is a name in the file or a position from '
            "0; without it, the same name, or in a file without names the next column. UNIT is "
            "that of the file; deg, cm, g, ... become rad, m, kg, ...",
            show_default="all",
        ),
    ] = None,
    actions: Annotated[
        str | None,
        typer.Option(
            metavar="COLUMNS", help="Actions, likewise.", show_default="what the file says"
        ),
    ] = None,
    time: Annotated[
        str | None,
        typer.Option(
            metavar="COLUMN[:UNIT]",
            help="Column of times, in s, ms, us or ns.",
            show_default="one named time, t or timestamp",
        ),
    ] = None,
    episode: Annotated[
        str | None,
        typer.Option(
            metavar="COLUMN",
            help="Column that numbers or names the episodes; else a file is one.",
            show_default="one named episode",
        ),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(
            metavar="HZ", help="Rows a second; with --time, of the clock that rows are brought to."
        ),
    ] = None,
    header: Annotated[
        bool | None,
        typer.Option(
            "--header/--no-header",
            help="Whether the first line names the columns.",
            show_default="look",
        ),
    ] = None,
    mapping: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="All of the above from a file of --save-mapping; options win."
        ),
    ] = None,
    save_mapping: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Keep the above as a file.")
    ] = None,
    to_rate: Annotated[
        float | None,
        typer.Option(
            metavar="HZ",
            help="Rate of the result: observations are filtered against aliasing, actions "
            "averaged over each step.",
            show_default="that of the recording",
        ),
    ] = None,
    infer_actions: Annotated[
        str | None,
        typer.Option(
            metavar="HOW",
            help="Where none were recorded: inverse-dynamics of --system, or velocities, or "
            "velocities:NAME,NAME.",
        ),
    ] = None,
    system: Annotated[
        str | None,
        typer.Option(metavar="SYSTEM", help="What was driven, a system of `misstep list systems`."),
    ] = None,
    set_: SystemParameters = None,
    demonstrator: Annotated[
        str | None, typer.Option("--by", metavar="NAME", help="Who acted.")
    ] = None,
    failure: Annotated[
        str | None,
        typer.Option(
            metavar="EXPR",
            help='An attempt fails where this first holds: "abs(theta) > 30deg".',
        ),
    ] = None,
    success: Annotated[
        str | None,
        typer.Option(
            metavar="EXPR", help="An attempt that has not failed succeeds if this holds at its end."
        ),
    ] = None,
    hold: Annotated[
        float, typer.Option(metavar="S", help="Seconds that it must have held by then.")
    ] = 0.0,
    angles: Annotated[
        str | None,
        typer.Option(
            metavar="HOW",
            help="Columns in rad: recorded, wrapped to -pi..pi, or unwrapped.",
            show_default="wrapped with inverse-dynamics, else recorded",
        ),
    ] = None,
    only: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Part of the episodes: a filter key of robomimic."),
    ] = None,
    from_format: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="Format of IN, of `misstep list formats`.", show_default="look"
        ),
    ] = None,
    format_: Annotated[
        str | None,
        typer.Option(
            "--format", metavar="NAME", help="Format of OUT.", show_default="by its suffix"
        ),
    ] = None,
    allow_loss: Annotated[
        bool, typer.Option("--allow-loss", help="Write also what OUT can only hold a part of.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace OUT if it exists.")] = False,
    json: JsonFile = None,
) -> int:
    """Convert recordings, of any size, and fill in what they lack.

    What is inferred or changed is noted in the result, and printed; with --system, also whether
    the recordings obey its equations. Nothing is lost silently, and nothing is left half-written.
    """
    from misstep.formats import format_of, write_episodes
    from misstep.formats.minari import located
    from misstep.recordings.mapping import (
        ColumnMapping,
        load_mapping,
        parse_columns,
    )
    from misstep.recordings.mapping import save_mapping as save
    from misstep.recordings.pipeline import Plan, Summary, losing, planned

    if len(paths) < 2:
        raise MisstepError("name what to read and what to write: misstep convert IN... OUT")
    *sources, out = paths
    base = load_mapping(mapping) if mapping is not None else ColumnMapping()
    said = {
        "observations": parse_columns("--columns", columns),
        "actions": parse_columns("--actions", actions),
        "time": time,
        "episode": episode,
        "rate": rate,
        "named": header,
    }
    given: dict[str, Any] = {key: value for key, value in said.items() if value not in (None, ())}
    chosen = replace(base, **given)
    plan = Plan(
        mapping=chosen,
        to_rate=to_rate,
        infer_actions=infer_actions or "",
        system=system or "",
        parameters=parse_parameters("--set", set_),
        demonstrator=demonstrator or "",
        failure=failure,
        success=success,
        hold=hold,
        angles=angles,  # type: ignore[arg-type]
        only=only,
    )
    target = format_of(out, format_)
    check_output_file(json, "--json", *paths)
    check_output_file(save_mapping, "--save-mapping", *paths)
    if not target.is_folder:
        check_new_recording(out, "OUT", force=force)
    elif Path(located(out)).exists() and not force:
        raise MisstepError(f"{out} exists already: choose another name, or add --force")
    summary, beginnings = Summary(), _beginnings(plan)
    with progress("converting") as report:
        episodes = planned(
            sources,
            plan,
            format=from_format,
            report=lambda done, total: report(done, total, ""),
            beginnings=beginnings,
        )
        episodes = summary.counting(losing(episodes, target, allowed=allow_loss), target)
        write_episodes(out, episodes, format_)
    if save_mapping is not None:
        save(chosen, save_mapping)
    checked = None if beginnings is None else beginnings.check()
    equations = {} if checked is None else checked.as_json()
    write_result(json, {**_result(summary, sources, out), **equations})
    _print(summary, out)
    for line in [] if checked is None else checked.lines():
        print(line)
    return 0


def _beginnings(plan: "Plan") -> "Beginnings | None":
    """Return what the equations of the system are checked on; None where none is named."""
    system = plan.make_system()
    if system is None:
        return None
    from misstep.recordings.checking import Beginnings

    return Beginnings(system)


def _result(summary: "Summary", sources: list[Path], out: Path) -> dict[str, Any]:
    first = summary.first
    return {
        "in": [str(path) for path in sources],
        "out": str(out),
        "episodes": summary.episodes,
        "steps": summary.steps,
        "rates": summary.rates,
        "outcomes": summary.outcomes,
        "observation_columns": _listed(first.observation_columns if first else ()),
        "action_columns": _listed(first.action_columns if first else ()),
        "notes": summary.notes,
        "losses": summary.losses,
    }


def _listed(columns: "Sequence[Column]") -> list[list[str]]:
    return [[column.name, column.unit] for column in columns]


def _print(summary: "Summary", out: Path) -> None:
    rates = {rate for rate in summary.rates if rate is not None}
    at = f" at {rates.pop():.6g} Hz" if len(rates) == 1 and None not in summary.rates else ""
    outcomes = ", ".join(
        f"{summary.outcomes.count(outcome)} {outcome}" for outcome in sorted(set(summary.outcomes))
    )
    plural = "s" if summary.episodes != 1 else ""
    print(f"{summary.episodes} episode{plural}, {summary.steps} steps{at} in {out} ({outcomes})")
    for kind, lines in (("noted", summary.notes), ("lost", summary.losses)):
        for line, count in lines.items():
            often = f" ({count} episodes)" if count > 1 else ""
            print(f"{kind}: {line}{often}")
    if summary.failed_at_start:
        print(
            f"warning: {summary.failed_at_start} of {summary.episodes} attempts fail at their "
            "first observation: if they begin in what --failure describes, as a pole that hangs, "
            'say with --success and --hold what they were to reach: "abs(theta) < 12deg"'
        )


COMMANDS = [
    (
        "convert",
        convert,
        "misstep convert log.csv D.h5 --columns x:m,x_dot:m/s,theta:rad,theta_dot:rad/s "
        "--rate 1000 --to-rate 50 --infer-actions inverse-dynamics --system cartpole "
        "--set cart_mass=10",
    ),
]
