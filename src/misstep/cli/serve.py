"""``misstep serve``: the trials of a run are made by a robot; and ``misstep explain``: its log."""

import math
import os
import secrets
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from misstep.cli.interruption import resumable
from misstep.cli.options import (
    Cost,
    Failure,
    JsonFile,
    LearnerParameters,
    NewRunFrom,
    NewRunLearner,
    ServedRun,
    Success,
    demonstrated_system,
    parse_names,
    parse_parameters,
    run_system,
    system_parameters,
)
from misstep.cli.output import check_output_file, print_attempts, write_result
from misstep.errors import MisstepError
from misstep.robot.addresses import TOKEN

if TYPE_CHECKING:
    from misstep import Run, System, Trajectory
    from misstep.parameters import ParameterValue
    from misstep.robot.service import ExplorationService

_KEYS = "space stops, c clears, f marks a failure, g a success, q quits"
_PERSON = "a person"
_LOOK = 0.1  # s, between two looks at whether a key was pressed or the run is finished


def serve(
    folder: ServedRun,
    demonstrations: NewRunFrom = None,
    system: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="The system that describes the robot: of a new run, or of one whose system is no "
            "simulation.",
        ),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="A parameter of it; repeatable."),
    ] = None,
    success: Success = None,
    failure: Failure = None,
    cost: Cost = None,
    learner: NewRunLearner = None,
    with_: LearnerParameters = None,
    state: Annotated[
        str | None,
        typer.Option(metavar="NAMES", help="Of a new run: columns that the policy may depend on."),
    ] = None,
    max_trials: Annotated[int, typer.Option(help="Of a new run.")] = 20,
    seed: Annotated[int, typer.Option(help="Of a new run.")] = 0,
    socket: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Listen here: HOST:PORT or unix:PATH.")
    ] = "127.0.0.1:7106",
    websocket: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT", help="Listen here too, for WebSockets.", show_default="no"
        ),
    ] = None,
    origin: Annotated[
        list[str] | None,
        typer.Option(metavar="URL", help="A web page that may connect; repeatable."),
    ] = None,
    rate_limit: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBERS", help="Largest change of the action in a second, one or one a column."
        ),
    ] = None,
    jerk_limit: Annotated[
        str | None,
        typer.Option(metavar="NUMBERS", help="Largest change of that rate in a second."),
    ] = None,
    safe: Annotated[str, typer.Option(metavar="NUMBERS", help="The safe action.")] = "0",
    range_: Annotated[
        list[str] | None,
        typer.Option(
            "--range",
            metavar="NAME=LOW:HIGH",
            help="States outside cannot be and are refused; repeatable.",
        ),
    ] = None,
    watchdog_ms: Annotated[
        float, typer.Option(help="Without a fresh state for so long: to the safe action.")
    ] = 100.0,
    deadline_ms: Annotated[
        float, typer.Option(help="What a policy takes longer for is not sent; 0: a period.")
    ] = 0.0,
    duration: Annotated[
        float, typer.Option(metavar="S", help="Longest trial; 0: as the system says.")
    ] = 0.0,
    simulated_time: Annotated[
        bool, typer.Option("--simulated-time", help="The states' stamps are the time.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Send the safe action; log what would be sent.")
    ] = False,
    keep_policy: Annotated[
        bool, typer.Option("--keep-policy", help="Drive with the last policy; learn nothing.")
    ] = False,
    json: JsonFile = None,
) -> int:
    """Answer a robot's states with the actions of a run, and learn from trial to trial.

    The exit code is 0 if a trial succeeded, and 1 otherwise.
    """
    from misstep.learning import kept_in
    from misstep.robot.guard import Safety
    from misstep.robot.limits import Limits
    from misstep.robot.service import ExplorationService
    from misstep.runs import CONFIG

    check_output_file(json, "--json")
    safety = Safety(watchdog_ms / 1e3, deadline_ms / 1e3, dry_run)
    judges = {"success": success, "failure": failure, "cost": cost}
    if demonstrations is None:
        given = {"--with": with_, "--learner": learner, "--state": state}
        _refuse(folder, {**given, **{f"--{k}": v for k, v in judges.items()}})
        robot = run_system(folder, system, set_)
        run = _load(folder, robot, keep_policy)
    else:
        run, robot = _begin(
            demonstrations,
            system,
            system_parameters(set_, **judges),
            learner,
            state=parse_names(state),
            max_trials=max_trials,
            seed=seed,
            **parse_parameters("--with", with_),
        )
    limits = Limits.of(
        robot,
        rate=_numbers("--rate-limit", rate_limit),
        jerk=_numbers("--jerk-limit", jerk_limit),
        safe=_numbers("--safe", safe),
        ranges=_ranges(range_),
    )
    new = folder if run.folder is None else None
    with resumable(folder, CONFIG, "serve"), kept_in(run, new):
        service = ExplorationService(
            run,
            system=robot,
            limits=limits,
            safety=safety,
            duration=duration,
            simulated_time=simulated_time,
            learning=not keep_policy,
            on_trial=_print_trial,
        )
        try:
            _listen(service, socket, websocket, origin or ())
        finally:
            service.close()
    return _conclude(run, service, json)


def explain(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="A log in the folder `actions` of a run.")
    ],
    json: JsonFile = None,
) -> None:
    """Say of each action that a service sent why it was sent."""
    from misstep.robot.limits import Reason
    from misstep.robot.log import Sent, read_log

    check_output_file(json, "--json")
    header, records = read_log(file)
    reasons: Counter[str] = Counter()
    events = []
    for record in records:
        print(record.explain())
        if isinstance(record, Sent):
            reasons.update(str(part.name).lower() for part in Reason if part in record.reason)
        else:
            events.append({"time": record.time, "text": record.text})
    write_result(json, {"header": header, "reasons": dict(reasons), "events": events})


def _refuse(folder: Path, given: Mapping[str, object]) -> None:
    """Refuse what only a new run can be told."""
    for option, value in given.items():
        if value is not None:
            raise MisstepError(f"{option} is for a new run, with --from; {folder} says its own")


def _load(folder: Path, robot: "System", keep_policy: bool) -> "Run":
    from misstep.runs import load_run

    run = load_run(folder, system=robot)
    if run.finished and not keep_policy:
        raise MisstepError(f"the run {folder} is finished; --keep-policy drives with its policy")
    return run


def _begin(
    demonstrations: Path,
    system: str | None,
    given: Mapping[str, "ParameterValue"],
    learner: str | None,
    **options: Any,
) -> tuple["Run", "System"]:
    """Return a run without a trial yet, and the system that describes the robot."""
    import misstep
    from misstep.learning import begin

    if system is None:
        raise MisstepError("--from begins a new run: give --system, what describes the robot")
    shown = misstep.load_dataset(demonstrations)
    robot = demonstrated_system(system, shown, given)
    return begin(robot, shown, learner, **options), robot


def _listen(
    service: "ExplorationService", socket: str, websocket: str | None, origins: Sequence[str]
) -> None:
    """Serve until the run is finished and the robot has heard of it, or a person quits."""
    from misstep.robot.keys import pressed_keys
    from misstep.robot.service import Phase
    from misstep.robot.session import Hub
    from misstep.robot.socket_server import SocketServer
    from misstep.robot.websocket_server import WebSocketServer

    token = os.environ.get(TOKEN) or secrets.token_urlsafe(16)
    with ExitStack() as closing:
        hub = Hub(service, token)
        closing.callback(hub.close)
        servers: list[SocketServer | WebSocketServer] = [SocketServer(hub, socket)]
        closing.callback(servers[0].close)
        if websocket is not None:
            servers.append(WebSocketServer(hub, websocket, origins))
            closing.callback(servers[1].close)
        if not os.environ.get(TOKEN):
            print(f"token {token}")
        for server in servers:
            print(f"listening at {server.address}", flush=True)
        key = closing.enter_context(pressed_keys())
        if sys.stdin.isatty():
            print(f"keys: {_KEYS}", flush=True)
        while service.phase is not Phase.FINISHED or hub.is_driven:
            if not _obey(service, key(_LOOK)):
                return


def _obey(service: "ExplorationService", key: str) -> bool:
    """Do what a key says; return whether to go on."""
    from misstep.trajectory import Outcome

    if key == " ":
        service.stop(_PERSON)
        print("stopped; c clears")
    elif key == "c":
        service.clear(_PERSON)
        print("cleared")
    elif key in ("f", "g"):
        outcome = Outcome.FAILURE if key == "f" else Outcome.SUCCESS
        print(f"marked {outcome}" if service.mark(outcome, _PERSON) else "no trial is running")
    return key != "q"


def _print_trial(run: "Run", trial: "Trajectory") -> None:
    print(
        f"{trial.outcome} after {trial.duration:.2f} s, {len(run.trials)} trials in all", flush=True
    )


def _conclude(run: "Run", service: "ExplorationService", json: Path | None) -> int:
    status = service.status()
    result = {
        "system": run.config.system,
        "learner": run.config.learner,
        "run": str(run.folder),
        "trials": len(run.trials),
        "trials_to_success": run.trials_to_success,
        "outcomes": [str(trial.outcome) for trial in run.trials],
        "costs": [trial.mean_cost for trial in run.trials],
        "robot": service.describe(),
        "service": status,
    }
    write_result(json, result)
    print_attempts("trial", run.trials)
    refused = sum(status["refused"].values())
    print(
        f"{status['states']} states answered, half within {status['p50_us'] or 0:g} µs and 99 % "
        f"within {status['p99_us'] or 0:g} µs; {refused} refused, {status['deadline_misses']} "
        "deadlines missed"
    )
    return 0 if run.succeeded else 1


def _numbers(option: str, text: str | None) -> list[float] | float:
    """Read one number, or one a column, separated by commas; no limit where there is no text."""
    if text is None:
        return math.inf
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError as error:
        raise MisstepError(f"{option} {text!r}: write a number, or one a column: 5,2.5") from error
    return numbers[0] if len(numbers) == 1 else numbers


def _ranges(texts: Sequence[str] | None) -> dict[str, tuple[float, float]]:
    ranges = {}
    for text in texts or ():
        name, _, bounds = text.partition("=")
        low, _, high = bounds.partition(":")
        try:
            ranges[name.strip()] = float(low), float(high)
        except ValueError as error:
            raise MisstepError(f"--range {text!r}: write name=low:high, such as x=-1:1") from error
    return ranges


COMMANDS = [
    (
        "serve",
        serve,
        "misstep serve RUN --from D.h5 --system cartpole --failure 'abs(theta) > 30deg' "
        "--rate-limit 200 --watchdog-ms 100",
    ),
    ("explain", explain, "misstep explain RUN/actions/0000.log"),
]
