"""``misstep study``: many runs, one table, one page."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from misstep.cli.interruption import resumable
from misstep.cli.options import JsonFile
from misstep.cli.output import check_output_file, write_result
from misstep.cli.progress import progress
from misstep.cli.table import print_table

if TYPE_CHECKING:
    from misstep.study import Study
    from misstep.study.run import Report
    from misstep.study.table import Quantile, Rate, Summary


def study(
    spec: Annotated[Path, typer.Argument(metavar="SPEC", help="What to run, a TOML file.")],
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Where everything goes.")],
    engine: Annotated[
        str, typer.Option(metavar="NAME", help="Where runs are made: processes or ray.")
    ] = "processes",
    workers: Annotated[
        int | None,
        typer.Option(
            help="Runs at a time; the results do not depend on it.", show_default="one a core"
        ),
    ] = None,
    address: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT", help="A Ray cluster to run on, or auto.", show_default="none"
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="One repetition in 50, two tests, no videos.")
    ] = False,
    json: JsonFile = None,
) -> int:
    """Run a study: systems, demonstrators, learners and seeds.

    Makes a table of all runs, a summary, and a page with learning curves and videos.

    If the folder holds the same study, unfinished, that one goes on. The exit code is 0 if every
    run went through, whether a trial succeeded or not, and 1 if one ended in an error or was lost.
    """
    from misstep.study import load_study

    check_output_file(json, "--json")
    wanted = load_study(spec).quick() if quick else load_study(spec)
    return _run(wanted, out, json, engine=engine, workers=workers, address=address)


def resume_study(folder: Path, json: Path | None) -> int:
    """Go on with the study in a folder, on processes, one a core."""
    from misstep.study.run import held_study

    return _run(held_study(folder), folder, json)


def _run(wanted: "Study", out: Path, json: Path | None, **how: Any) -> int:
    from misstep.study import run_study
    from misstep.study.run import CONFIG

    with progress("studying") as report, resumable(out, CONFIG):
        done = run_study(wanted, out, progress=report, **how)
    return _conclude(done, json)


def _conclude(done: "Report", json: Path | None) -> int:
    """Write and print what came of a study, and return the exit code."""
    result = {
        "report": str(done.page),
        "cells": done.cells,
        "errors": done.errors,
        "lost": done.lost,
        "summary": [row.to_json() for row in done.rows],
    }
    write_result(json, result)
    columns = (
        "case",
        "demonstrator",
        "learner",
        ">runs",
        ">success",
        ">first",
        ">median",
        ">tests",
    )
    print_table(columns, map(_row, done.rows))
    print(done.page)
    failed = done.errors + done.lost
    if failed:
        print(
            f"{done.errors} of {done.cells} runs ended in an error and {done.lost} were lost: "
            f"see {done.page}"
        )
    return 1 if failed else 0


def _row(row: "Summary") -> tuple[str, ...]:
    rates = (_rate(row.success), _rate(row.first_trial))
    return (
        row.case,
        row.demonstrator,
        row.learner,
        str(row.runs),
        *rates,
        _quantile(row.median_trials),
        _rate(row.tests),
    )


def _rate(rate: "Rate") -> str:
    return f"{rate.value:.0%}" if rate.n else "-"


def _quantile(quantile: "Quantile | None") -> str:
    return "-" if quantile is None else str(quantile)


COMMANDS = [("study", study, "misstep study studies/headline.toml --out study --quick")]
