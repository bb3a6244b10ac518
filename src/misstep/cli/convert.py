"""``misstep convert``: recordings of any kind into a data set, and between formats."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from misstep.cli.options import JsonFile, parse_parameters
from misstep.cli.output import check_output_file, write_result
from misstep.cli.progress import progress
from misstep.errors import MisstepError


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
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="A parameter of the system; repeatable."),
    ] = None,
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
        str,
        typer.Option(
            metavar="HOW",
            help="Columns in rad: recorded, wrapped to -pi..pi, or unwrapped.",
        ),
    ] = "recorded",
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

    What is inferred or changed is noted in the result, and printed. Nothing is lost silently, and
    nothing is left half-written.
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
    check_output_file(json, "--json")
    check_output_file(save_mapping, "--save-mapping")
    if Path(located(out)).exists() and not force:
        raise MisstepError(f"{out} exists already: choose another name, or add --force")
    if not target.is_folder:
        check_output_file(out, "OUT")
    summary = Summary()
    with progress("converting") as report:
        episodes = planned(
            sources, plan, format=from_format, report=lambda done, total: report(done, total, "")
        )
        episodes = summary.counting(losing(episodes, target, allowed=allow_loss), target)
        write_episodes(out, episodes, format_)
    if save_mapping is not None:
        save(chosen, save_mapping)
    write_result(json, _result(summary, sources, out))
    _print(summary, out)
    return 0


def _result(summary: Any, sources: list[Path], out: Path) -> dict[str, Any]:
    first = summary.first
    return {
        "in": [str(path) for path in sources],
        "out": str(out),
        "episodes": summary.episodes,
        "steps": summary.steps,
        "rates": summary.rates,
        "outcomes": summary.outcomes,
        "observation_columns": [[c.name, c.unit] for c in first.observation_columns],
        "action_columns": [[c.name, c.unit] for c in first.action_columns],
        "notes": summary.notes,
        "losses": summary.losses,
    }


def _print(summary: Any, out: Path) -> None:
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


COMMANDS = [
    (
        "convert",
        convert,
        "misstep convert log.csv D.h5 --columns x:m,x_dot:m/s,theta:rad,theta_dot:rad/s "
        "--rate 1000 --to-rate 50 --infer-actions inverse-dynamics --system cartpole "
        "--set cart_mass=10",
    ),
]
