"""``misstep demonstrate``: record demonstrations that fail."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from misstep.cli.options import (
    Cost,
    Failure,
    JsonFile,
    Seed,
    Success,
    SystemName,
    SystemParameters,
    parse_parameters,
    system_parameters,
)
from misstep.cli.output import check_new_recording, check_output_file, print_attempts, write_result
from misstep.cli.progress import progress
from misstep.parameters import build_parameters


def demonstrate(
    system: SystemName,
    out: Annotated[Path, typer.Option(metavar="FILE", help="Where the demonstrations go.")],
    by: Annotated[
        str, typer.Option(metavar="KIND", help="A kind of `misstep list demonstrators`.")
    ] = "noisy",
    n: Annotated[int, typer.Option("-n", help="How many failed attempts to record.")] = 4,
    set_: SystemParameters = None,
    with_: Annotated[
        list[str] | None,
        typer.Option(
            "--with", metavar="NAME=VALUE", help="A parameter of the demonstrator; repeatable."
        ),
    ] = None,
    success: Success = None,
    failure: Failure = None,
    cost: Cost = None,
    seed: Seed = 0,
    force: Annotated[bool, typer.Option("--force", help="Replace FILE if it exists.")] = False,
    json: JsonFile = None,
) -> int:
    """Record failed demonstrations of a system."""
    import misstep
    from misstep.formats import format_of

    given: dict[str, Any] = parse_parameters("--with", with_)
    demonstrator = build_parameters(misstep.DEMONSTRATORS[by], f"demonstrator {by}", given)
    judged = system_parameters(set_, success=success, failure=failure, cost=cost)
    driven = misstep.make_system(system, **judged)
    format_of(out)
    check_new_recording(out, "--out", force=force)
    check_output_file(json, "--json")
    with progress("demonstrating"):
        dataset = misstep.demonstrate(driven, by, n, seed, **given)
    misstep.save_dataset(dataset, out)
    parameters = asdict(demonstrator)  # type: ignore[call-overload]
    result = {
        "parameters": {"system": driven.parameters, "demonstrator": parameters},
        "system": system,
        "demonstrator": by,
        "seed": seed,
        "out": str(out),
        "episodes": len(dataset),
        "outcomes": [str(attempt.outcome) for attempt in dataset],
        "failure_times": [attempt.failure_time for attempt in dataset],
        "costs": [attempt.mean_cost for attempt in dataset],
    }
    write_result(json, result)
    print_attempts("episode", dataset)
    print(f"{len(dataset)} failed demonstrations in {out}")
    return 0


COMMANDS = [
    ("demonstrate", demonstrate, "misstep demonstrate cartpole --by weak -n 4 --out D.h5"),
]
