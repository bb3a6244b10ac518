"""``misstep learn`` and ``misstep resume``: trial after trial, until one succeeds."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from misstep.cli.interruption import resumable
from misstep.cli.options import (
    Cost,
    Failure,
    JsonFile,
    LearnerParameters,
    RunParameters,
    RunSystem,
    Seed,
    Success,
    SystemName,
    demonstrated_system,
    parse_names,
    parse_parameters,
    run_system,
    system_parameters,
)
from misstep.cli.output import check_output_file, print_attempts, write_result
from misstep.cli.progress import Report, progress

if TYPE_CHECKING:
    from misstep import Run

# The configurations of `misstep.paper.reproduction` and `misstep.study.run`, slow to import.
_REPRODUCTION, _STUDY = "reproduce.json", "study.json"


def learn(
    system: SystemName,
    demonstrations: Annotated[
        Path,
        typer.Option("--from", metavar="FILE", help="Failed demonstrations to start from."),
    ],
    learner: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="A learner of `misstep list learners`.",
            show_default="the highest rung whose feedback is there",
        ),
    ] = None,
    state: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help="Observation columns that the policy may depend on, separated by commas.",
            show_default="all",
        ),
    ] = None,
    max_trials: Annotated[int, typer.Option(help="Trials to make at the most.")] = 20,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Where the run is kept, trial by trial.",
            show_default="runs/SYSTEM-LEARNER-SEED",
        ),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="A parameter of the system, in place of the one that the demonstrations of this "
            "system were recorded with; repeatable.",
        ),
    ] = None,
    with_: LearnerParameters = None,
    success: Success = None,
    failure: Failure = None,
    cost: Cost = None,
    keep_going: Annotated[
        bool, typer.Option("--keep-going", help="Make all trials, whatever comes of them.")
    ] = False,
    seed: Seed = 0,
    json: JsonFile = None,
) -> int:
    """Learn by trial from failed demonstrations.

    The exit code is 0 if a trial succeeded, or with --keep-going if all were made, and 1 otherwise.
    """
    import misstep
    from misstep.learners import Task, default_learner
    from misstep.runs import CONFIG
    from misstep.storage import as_file_name

    given = system_parameters(set_, success=success, failure=failure, cost=cost)
    parameters = parse_parameters("--with", with_)
    if learner is not None:
        misstep.LEARNERS[learner]  # an unknown name is told before anything is read
    shown = misstep.load_dataset(demonstrations)
    driven = demonstrated_system(system, shown, given)
    if learner is None:
        task = Task.of(driven, parse_names(state))
        learner, why = default_learner(task, shown)
        print(f"learner {learner} ({why})")
    name = as_file_name(f"{system}-{learner}-{seed}")  # gym:space/Robot-v1
    folder = Path("runs") / name if out is None else out
    check_output_file(json, "--json", demonstrations)
    with progress("trial") as report, resumable(folder, CONFIG):
        report(0, max_trials, "")
        run = misstep.learn(
            driven,
            shown,
            learner,
            state=parse_names(state),
            max_trials=max_trials,
            seed=seed,
            stop_on_success=not keep_going,
            out=folder,
            on_trial=_reporter(report),
            **parameters,
        )
    return _conclude(run, json)


def resume(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER", help="Of `misstep learn`, `misstep reproduce` or `misstep study`."
        ),
    ],
    system: RunSystem = None,
    set_: RunParameters = None,
    json: JsonFile = None,
) -> int:
    """Go on after a crash or a Ctrl-C.

    The result is that of an uninterrupted command, and so is the exit code.
    """
    import misstep
    from misstep.runs import CONFIG

    check_output_file(json, "--json")
    if (folder / _REPRODUCTION).exists():
        from misstep.cli.reproduce import resume_reproduction

        return resume_reproduction(folder, json)
    if (folder / _STUDY).exists():
        from misstep.cli.study import resume_study

        return resume_study(folder, json)
    driven = run_system(folder, system, set_)
    run = misstep.load_run(folder, system=driven)
    with progress("trial") as report, resumable(folder, CONFIG):
        report(len(run.trials), run.config.max_trials, "")
        misstep.resume(run, system=driven, on_trial=_reporter(report))
    return _conclude(run, json)


def _reporter(report: Report) -> Callable[["Run"], None]:
    def on_trial(run: "Run") -> None:
        trial, cost = run.trials[-1], run.trials[-1].mean_cost
        detail = f"{trial.outcome} after {trial.duration:.2f} s, mean cost {cost:.4g}"
        report(len(run.trials), run.config.max_trials, detail)

    return on_trial


def _conclude(run: "Run", json: Path | None) -> int:
    """Write and print what came of a run, and return the exit code."""
    write_result(json, _result(run))
    print_attempts("trial", run.trials)
    print(f"run kept in {run.folder}")
    made = f"{len(run.trials)} trial{'s' if len(run.trials) != 1 else ''}"
    if run.succeeded:
        print(f"first success in trial {run.trials_to_success} of {made}")
    else:
        print(f"no success in {made}")
    return 0 if run.succeeded or not run.config.stop_on_success else 1


def _result(run: "Run") -> dict[str, Any]:
    config, learner = run.config, run.config.make_learner()
    return {
        "parameters": {
            "system": dict(config.system_parameters),
            "learner": asdict(learner),  # type: ignore[call-overload]
        },
        "learner": config.learner,
        "rung": learner.rung,
        "system": config.system,
        "state": list(config.state),
        "seed": config.seed,
        "max_trials": config.max_trials,
        "stop_on_success": config.stop_on_success,
        "run": str(run.folder),
        "trials": len(run.trials),
        "trials_to_success": run.trials_to_success,
        "seconds_of_interaction": sum(trial.duration for trial in run.trials),
        "computing_seconds": sum(run.computing_seconds),
        "outcomes": [str(trial.outcome) for trial in run.trials],
        "failure_times": [trial.failure_time for trial in run.trials],
        "costs": [trial.mean_cost for trial in run.trials],
    }


COMMANDS = [
    (
        "learn",
        learn,
        "misstep learn cartpole --from D.h5 --learner donut --state theta,theta_dot --out RUN",
    ),
    ("resume", resume, "misstep resume RUN"),
]
