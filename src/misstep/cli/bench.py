"""``misstep bench``: how fast misstep is, beside its peers."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from misstep.cli.options import JsonFile, Seed
from misstep.cli.output import check_output_file, write_result
from misstep.cli.progress import progress
from misstep.cli.table import print_table

if TYPE_CHECKING:
    from misstep.bench.run import Bench


def bench(
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Where everything goes.")],
    quick: Annotated[
        bool, typer.Option("--quick", help="A look in a minute or two, which decides nothing.")
    ] = False,
    with_pomegranate: Annotated[
        bool,
        typer.Option(
            "--with-pomegranate",
            help="Measure pomegranate too: it brings PyTorch, gigabytes to download.",
        ),
    ] = False,
    peers: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="The environment of the other libraries, or where to make it.",
            show_default="in the user's cache",
        ),
    ] = None,
    seed: Seed = 0,
    json: JsonFile = None,
) -> int:
    """Measure misstep beside its peers, in one run.

    Installs the other libraries into an environment of their own, and writes every row, plots on a
    page, and the table of the documentation. Takes a quarter of an hour, which nothing else should
    share. The exit code says that it was measured, not that a target was reached.
    """
    from misstep.bench.run import run_bench

    check_output_file(json, "--json")
    with progress("measuring") as report:
        done = run_bench(
            out,
            quick=quick,
            pomegranate=with_pomegranate,
            peers=peers,
            seed=seed,
            progress=report,
        )
    return _conclude(done, out, json)


def _conclude(done: "Bench", out: Path, json: Path | None) -> int:
    from misstep.bench.tables import tables_of

    document = done.to_json()
    write_result(json, document)
    for reason in done.missing.values():
        print(reason)
    for table in tables_of(document):
        if table.name in ("targets", "scan", "query"):
            print(table.title)
            texts = ("contender", "what")
            names = [name if name in texts else f">{name}" for name in table.columns]
            print_table(names, table.rows)
    print(out / "bench.html")
    return 0


COMMANDS = [("bench", bench, "misstep bench --out bench --quick")]
