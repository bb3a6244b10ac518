"""``misstep inspect``: what is in a recording, and where each attempt went wrong."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from misstep.cli.options import JsonFile, Seed, parse_names
from misstep.cli.output import check_output_file, formatted, write_result
from misstep.cli.progress import progress
from misstep.cli.table import print_table

if TYPE_CHECKING:
    from misstep.inspection import Inspection


def inspect(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A recording of any format.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="PAGE", help="Write a page with pictures to this file, as HTML."
        ),
    ] = None,
    format: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="A format of `misstep list formats`.",
            show_default="what content and suffix say",
        ),
    ] = None,
    observations: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES", help="Columns of a table that are observations, separated by commas."
        ),
    ] = None,
    actions: Annotated[
        str | None, typer.Option(metavar="NAMES", help="Columns of a table that are actions.")
    ] = None,
    time: Annotated[
        str | None, typer.Option(metavar="NAME", help="Column of a table that is the time.")
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(metavar="HZ", help="Rows a second, where the file does not say."),
    ] = None,
    seed: Seed = 0,
    json: JsonFile = None,
) -> int:
    """Show what is in a recording, and where each attempt went wrong.

    The point of no return is found with a model learned from the recording alone. Where the file
    names its system, the recording is also held against the system's equations.
    """
    from misstep.formats import ReadOptions
    from misstep.inspection import inspect_file

    options = ReadOptions(
        observations=parse_names(observations), actions=parse_names(actions), time=time, rate=rate
    )
    check_output_file(json, "--json", file)
    check_output_file(out, "--out", file)
    with progress("looking into attempts") as report:
        inspection = inspect_file(
            file,
            format=format,
            options=options,
            seed=seed,
            progress=lambda done, total: report(done, total, ""),
        )
    write_result(json, {"seed": seed, **inspection.as_json()})
    _print(inspection)
    if out is not None:
        from misstep.inspection.page import render_inspection
        from misstep.storage import write_text

        with progress("drawing") as report:
            page = render_inspection(inspection, lambda done, total: report(done, total, ""))
        write_text(out, page)
        print(f"page written to {out}")
    return 0


def _print(inspection: "Inspection") -> None:
    _print_episodes(inspection)
    _print_columns(inspection)
    notes = list(dict.fromkeys(note for e in inspection.episodes for note in e.notes))
    for note in notes:
        print(f"inferred or changed: {note}")
    for episode in inspection.episodes:
        for oddity in episode.oddities:
            print(f"episode {episode.number}: {oddity}")
    for line in inspection.equations.lines():
        print(line)
    if inspection.reason:
        print(f"where it went wrong cannot be told: {inspection.reason}")
    for sentence in inspection.sentences:
        print(sentence)


def _print_episodes(inspection: "Inspection") -> None:
    points = [blame.point_of_no_return for blame in inspection.blames]
    points = points or [None] * len(inspection.episodes)
    rows = [
        (
            str(e.number),
            str(e.rows),
            f"{e.duration:.2f}",
            "uneven" if e.rate is None else f"{e.rate:.4g}",
            e.outcome,
            formatted(e.failure_time, ".2f"),
            formatted(point, ".2f"),
            e.demonstrator or "-",
            e.recorded or "-",
        )
        for e, point in zip(inspection.episodes, points, strict=True)
    ]
    print_table(
        (
            "episode",
            ">rows",
            ">duration [s]",
            ">rate [Hz]",
            "outcome",
            ">failed at [s]",
            ">no return after [s]",
            "by",
            "recorded",
        ),
        rows,
    )


def _print_columns(inspection: "Inspection") -> None:
    rows = [
        (
            c.name,
            c.kind,
            c.unit or "-",
            formatted(c.minimum, ".4g"),
            formatted(c.maximum, ".4g"),
            formatted(c.mean, ".4g"),
            formatted(c.deviation, ".4g"),
            str(c.missing),
            formatted(c.at_limit, ".0%"),
        )
        for c in inspection.columns
    ]
    print_table(
        (
            "column",
            "kind",
            "unit",
            ">smallest",
            ">largest",
            ">mean",
            ">deviation",
            ">missing",
            ">at its limit",
        ),
        rows,
    )


COMMANDS = [("inspect", inspect, "misstep inspect D.h5 --out PAGE.html")]
