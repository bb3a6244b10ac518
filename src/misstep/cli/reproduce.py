"""``misstep reproduce``: the paper's experiments, figures and tables, and a report."""

from pathlib import Path
from typing import Annotated

import typer

from misstep.cli.interruption import resumable
from misstep.cli.options import JsonFile, Seed
from misstep.cli.output import check_output_file, write_result
from misstep.cli.progress import progress


def reproduce(
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Where everything goes.")],
    seeds: Annotated[
        int | None,
        typer.Option(
            help="Repetitions, each with its own demonstrations.",
            show_default="30, or 5 with --quick",
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Only what the paper itself shows.")
    ] = False,
    physics: Annotated[
        str,
        typer.Option(metavar="ENGINE", help="mujoco, or gazebo, which `make gazebo` prepares."),
    ] = "mujoco",
    workers: Annotated[
        int | None,
        typer.Option(help="Processes; the results do not depend on it.", show_default="one a core"),
    ] = None,
    seed: Seed = 0,
    json: JsonFile = None,
) -> int:
    """Reproduce the paper and judge its claims.

    Makes every figure, table and video, and a report.

    If the folder holds the same reproduction, unfinished, that one goes on.
    """
    from misstep.paper import reproduction

    check_output_file(json, "--json")
    with progress("reproducing") as report, resumable(out, reproduction.CONFIG):
        page = reproduction.reproduce(
            out,
            seeds=seeds,
            seed=seed,
            quick=quick,
            physics=physics,
            workers=workers,
            progress=report,
        )
    return _conclude(page, json)


def resume_reproduction(folder: Path, json: Path | None) -> int:
    """Go on with the reproduction in a folder."""
    from misstep.paper import reproduction

    with progress("reproducing") as report, resumable(folder, reproduction.CONFIG):
        page = reproduction.resume(folder, progress=report)
    return _conclude(page, json)


def _conclude(page: Path, json: Path | None) -> int:
    from misstep.storage import read_json

    document = read_json(page.parent / "tables.json")
    names = ("parameters", "tables", "claims")
    write_result(json, {"report": str(page), **{name: document[name] for name in names}})
    print(page)
    return 0


COMMANDS = [("reproduce", reproduce, "misstep reproduce --out paper --seeds 30")]
