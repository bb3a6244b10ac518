"""``misstep ros1`` and ``misstep ros2``: the nodes of ROS 1 and of ROS 2."""

import math
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from misstep.cli.options import (
    Cost,
    Failure,
    JsonFile,
    NewRunFrom,
    NewRunLearner,
    Seed,
    ServedRun,
    Success,
    SystemName,
    SystemParameters,
    parse_names,
    parse_pairs,
    parse_parameters,
    run_system,
    system_parameters,
)
from misstep.cli.output import check_output_file, print_attempts, write_result
from misstep.errors import MisstepError
from misstep.parameters import build_parameters

if TYPE_CHECKING:
    from collections.abc import Callable

    from misstep import Dataset, Run, System, Trajectory
    from misstep.robot.limits import Row
    from misstep.robot.ros.bus import Bus, Recorder
    from misstep.robot.ros.joint_system import JointSystem

With = Annotated[
    list[str] | None,
    typer.Option("--with", metavar="NAME=VALUE", help="A parameter; repeatable."),
]
JointStates = Annotated[
    str, typer.Option(metavar="TOPIC", help="Where the joint states are published.")
]
Command = Annotated[
    str, typer.Option(metavar="TOPICS", help="Where each effort is sent, separated by commas.")
]
Joint = Annotated[
    list[str] | None,
    typer.Option("--joint", metavar="NAME=JOINT", help="The robot's name of a joint; repeatable."),
]
LockStep = Annotated[
    bool, typer.Option("--lock-step", help="The simulation waits for each command.")
]
Patience = Annotated[
    float, typer.Option(metavar="S", help="How long to wait for the other nodes and for files.")
]

_JOINT_STATES, _COMMAND = "joint_states", "effort_controller/command"
_KEYBOARD = "keyboard"
_KEY_FORCE = 0.5  # of the largest force
_SILENCE = 0.5  # s without a joint state, after which a robot is given up
_SILENCE_IN_LOCK_STEP = 60.0  # s: another process may be at work for long


def simulate(
    context: typer.Context,
    system: SystemName = "cartpole",
    set_: SystemParameters = None,
    rate: Annotated[
        float, typer.Option(metavar="HZ", help="States per second; 0: each step of the physics.")
    ] = 0.0,
    lock_step: LockStep = False,
    watchdog_ms: Annotated[
        float, typer.Option(help="Without a command for so long the effort drops; by the clock.")
    ] = 100.0,
    joint_states: JointStates = _JOINT_STATES,
    command: Command = _COMMAND,
    joint: Joint = None,
) -> None:
    """Simulate a cart-pole behind the topics of a Gazebo robot, until interrupted."""
    from misstep.robot.ros.joints import Joints
    from misstep.robot.ros.plant import Plant
    from misstep.robot.ros.simulation_node import SimulationNode
    from misstep.robot.ros.topics import Topics

    plant = Plant(system, parse_parameters("--set", set_), rate)
    topics = Topics(joint_states, _topics(command, plant.system))
    joints = Joints(plant.system.observation_columns, _joint_names(joint))
    with closing(_open_bus(context, "simulation")) as bus:
        node = SimulationNode(
            bus, plant, topics, joints, lock_step=lock_step, watchdog=watchdog_ms / 1e3
        )
        try:
            node.run()
        finally:
            print(f"{node.steps} steps, {node.late} of them late", flush=True)


def control(
    context: typer.Context,
    system: SystemName = "cartpole",
    set_: SystemParameters = None,
    success: Success = None,
    failure: Failure = None,
    cost: Cost = None,
    by: Annotated[
        str | None,
        typer.Option(
            metavar="KIND",
            help="Demonstrate first: a kind of `misstep list demonstrators`, or keyboard.",
            show_default="no demonstrations",
        ),
    ] = None,
    n: Annotated[int, typer.Option("-n", help="Failed demonstrations to record.")] = 4,
    with_: With = None,
    seed: Seed = 0,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Where the demonstrations go.")
    ] = None,
    explore: Annotated[
        bool, typer.Option(help="Then make the trials of the exploration node.")
    ] = True,
    bags: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Record a bag of each attempt here.")
    ] = None,
    ready: Annotated[
        str | None,
        typer.Option(
            metavar="EXPR",
            help="No simulation to reset: an attempt begins when this has held for a second.",
        ),
    ] = None,
    lock_step: LockStep = False,
    joint_states: JointStates = _JOINT_STATES,
    command: Command = _COMMAND,
    joint: Joint = None,
    node: Annotated[
        str, typer.Option(metavar="NAME", help="The exploration node.")
    ] = "exploration",
    patience: Patience = 60.0,
    json: JsonFile = None,
) -> None:
    """Drive a robot: demonstrate with a control law or by hand, then as the exploration says."""
    from misstep.formats import save_dataset
    from misstep.robot.ros.explorer import NodeExplorer
    from misstep.robot.ros.exploring import explore as explore_on
    from misstep.robot.ros.joint_system import JointSystem
    from misstep.robot.ros.joints import Joints
    from misstep.robot.ros.topics import TopicRobot, Topics

    check_output_file(json, "--json")
    check_output_file(out, "--out")
    if by is not None and out is None:
        raise MisstepError("--by demonstrates: give --out, the file for the demonstrations")
    given = parse_parameters("--with", with_)
    if by is not None:
        _check_demonstrator(by, given)
    described = _make_system(system, set_, success, failure, cost)
    topics = Topics(joint_states, _topics(command, described))
    joints = Joints(described.observation_columns, _joint_names(joint))
    predicate = _ready(ready, described)
    silence = _SILENCE_IN_LOCK_STEP if lock_step else _SILENCE
    result: dict[str, Any] = {"demonstrations": 0, "trials": 0}
    with ExitStack() as stack:
        bus = stack.enter_context(closing(_open_bus(context, "controller")))
        recorder = None if bags is None else _open_recorder(context, bags)
        robot = stack.enter_context(
            closing(
                TopicRobot(
                    bus, topics, joints, lock_step=lock_step, ready=predicate, recorder=recorder
                )
            )
        )
        driven = stack.enter_context(closing(JointSystem(described, robot, patience=silence)))
        robot.wait(patience)
        if by is not None and out is not None:
            shown = _demonstrate(driven, by, n, seed, given)
            save_dataset(shown, out)
            print_attempts("demonstration", shown)
            result["demonstrations"] = len(shown)
        if explore:
            explorer = NodeExplorer(bus, node, patience)
            result["trials"] = explore_on(explorer, driven)
    write_result(json, result)


def explore(
    context: typer.Context,
    folder: ServedRun,
    demonstrations: NewRunFrom = None,
    system: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Of a new run, or of one whose system is no simulation.",
            show_default="cartpole",
        ),
    ] = None,
    set_: SystemParameters = None,
    success: Success = None,
    failure: Failure = None,
    cost: Cost = None,
    learner: NewRunLearner = None,
    with_: With = None,
    state: Annotated[
        str | None, typer.Option(metavar="NAMES", help="Of a new run: columns of the policy.")
    ] = None,
    max_trials: Annotated[int, typer.Option(help="Of a new run.")] = 20,
    keep_going: Annotated[
        bool, typer.Option(help="Of a new run: make all trials whatever comes of them.")
    ] = False,
    seed: Seed = 0,
    rate_limit: Annotated[
        float, typer.Option(metavar="NUMBER", help="Largest change of an effort in a second.")
    ] = math.inf,
    jerk_limit: Annotated[
        float, typer.Option(metavar="NUMBER", help="Largest change of that rate in a second.")
    ] = math.inf,
    watchdog_ms: Annotated[
        float, typer.Option(help="Without a fresh state for so long: to the safe effort.")
    ] = 100.0,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Send the safe effort; log what would be sent.")
    ] = False,
    lock_step: LockStep = False,
    command: Command = _COMMAND,
    patience: Patience = 60.0,
    json: JsonFile = None,
) -> int:
    """Offer the exploration service: a state comes in, the action to try goes out.

    The exit code is 0 if a trial succeeded or all were to be made, and 1 otherwise.
    """
    from misstep.robot.guard import Safety
    from misstep.robot.limits import Limits
    from misstep.robot.ros.exploration_node import ExplorationNode
    from misstep.robot.service import ExplorationService
    from misstep.runs import load_run

    check_output_file(json, "--json")
    safety = Safety(watchdog_ms / 1e3, 0.0, dry_run)
    given = parse_parameters("--with", with_)
    with ExitStack() as stack:
        bus = stack.enter_context(closing(_open_bus(context, "exploration")))
        if demonstrations is None:
            described = run_system(folder, system, set_)
            run = load_run(folder, system=described)
        else:
            described = _make_system(system or "cartpole", set_, success, failure, cost)
            run = _begin(
                folder,
                _wait_for(demonstrations, patience),
                described,
                learner,
                state=parse_names(state),
                max_trials=max_trials,
                seed=seed,
                stop_on_success=not keep_going,
                **given,
            )
        service = ExplorationService(
            run,
            system=described,
            limits=Limits.of(described, rate=rate_limit, jerk=jerk_limit),
            safety=safety,
            simulated_time=lock_step,
            on_trial=_print_trial,
        )
        stack.enter_context(closing(service))
        topics = _topics(command, described)
        node = ExplorationNode(bus, service, topics, lock_step=lock_step)
        stack.enter_context(closing(node))
        node.wait()
    write_result(json, {"run": str(run.folder), **service.status()})
    return 0 if run.succeeded or not run.config.stop_on_success else 1


def _open_bus(context: typer.Context, node: str) -> "Bus":
    """Join the graph of the middleware that the command is of."""
    if _is_ros1(context):
        from misstep.robot.ros1.bus import Ros1Bus

        return Ros1Bus(node)
    from misstep.robot.ros2 import open_bus

    return open_bus(node)


def _open_recorder(context: typer.Context, folder: Path) -> "Recorder":
    if not _is_ros1(context):
        raise MisstepError("--bags records bags of ROS 1; in ROS 2, `ros2 bag record` does it")
    from misstep.robot.ros1.recorder import BagRecorder

    return BagRecorder(folder)


def _is_ros1(context: typer.Context) -> bool:
    return context.parent is None or context.parent.info_name == "ros1"


def _make_system(name: str, set_: Sequence[str] | None, *judges: str | None) -> "System":
    from misstep.systems import make_system

    given = dict(zip(("success", "failure", "cost"), judges, strict=True))
    return make_system(name, **system_parameters(set_, **given))


def _topics(text: str, system: "System") -> tuple[str, ...]:
    names = tuple(parse_names(text) or ())
    if len(names) != len(system.action_columns):
        raise MisstepError(
            f"--command {text!r} names {len(names)} topics, but {system.system_id} has "
            f"{len(system.action_columns)} actions: name one for each"
        )
    return names


def _joint_names(texts: Sequence[str] | None) -> Mapping[str, str]:
    return parse_pairs("--joint", texts, "theta=hinge")


def _ready(text: str | None, system: "System") -> "Callable[[Row], bool] | None":
    if text is None:
        return None
    import numpy as np

    from misstep.judges import parse_predicate

    formula = parse_predicate(text, system.observation_columns, "--ready")
    return lambda observation: bool(formula(np.array(observation)))


def _check_demonstrator(by: str, parameters: Mapping[str, Any]) -> None:
    """Raise MisstepError for an unknown demonstrator or parameter, before a robot is waited for."""
    from misstep.demonstrators import DEMONSTRATORS

    if by != _KEYBOARD:
        build_parameters(DEMONSTRATORS[by], f"demonstrator {by}", parameters)
    elif parameters:
        raise MisstepError("--with is for demonstrators that are simulated, not for the keyboard")


def _demonstrate(
    system: "JointSystem", by: str, n: int, seed: int, parameters: Mapping[str, Any]
) -> "Dataset":
    from misstep.demonstrators import demonstrate

    if by != _KEYBOARD:
        return demonstrate(system, by, n=n, seed=seed, **parameters)
    return _demonstrate_by_hand(system, n)


def _demonstrate_by_hand(system: "JointSystem", n: int) -> "Dataset":
    """Let a person fail `n` times; attempts that do not fail are not kept."""
    from misstep.robot.keys import pressed_keys
    from misstep.robot.ros.keyboard import LEFT, RIGHT, KeyboardPolicy
    from misstep.rollout import rollout
    from misstep.trajectory import Dataset, Outcome

    force = _KEY_FORCE * float(system.action_space.high[0])  # type: ignore[attr-defined]
    failures: list[Trajectory] = []
    with pressed_keys() as read_key:
        while len(failures) < n:
            print(f"attempt {len(failures) + 1} of {n}: {LEFT} pushes left, {RIGHT} right")
            policy = KeyboardPolicy(read_key, force, system.dt)
            attempt = rollout(system, policy, seed=len(failures), demonstrator=_KEYBOARD)
            if attempt.outcome is Outcome.FAILURE:
                failures.append(attempt)
    return Dataset(failures)


def _wait_for(file: Path, patience: float) -> Path:
    """Wait until the controller has written its demonstrations."""
    deadline = time.monotonic() + patience
    while not file.exists():
        if time.monotonic() > deadline:
            raise MisstepError(f"there is no {file} after {patience:g} s")
        time.sleep(0.05)
    return file


def _begin(
    folder: Path, demonstrations: Path, system: "System", learner: str | None, **options: Any
) -> "Run":
    from misstep.formats import load_dataset
    from misstep.learning import begin

    return begin(system, load_dataset(demonstrations), learner, **options).keep_in(folder)


def _print_trial(run: "Run", trial: "Trajectory") -> None:
    cost = "" if trial.mean_cost is None else f", mean cost {trial.mean_cost:.4g}"
    print(
        f"trial {len(run.trials)}: {trial.outcome} after {trial.duration:.2f} s{cost}", flush=True
    )


_COMMANDS = (
    ("simulate", simulate, "misstep {} simulate cartpole --rate 1000"),
    ("control", control, "misstep {} control cartpole --by noisy -n 4 --out D.h5"),
    ("explore", explore, "misstep {} explore RUN --from D.h5 --learner donut"),
)

GROUPS = [
    (group, help_, [(name, command, example.format(group)) for name, command, example in _COMMANDS])
    for group, help_ in (
        ("ros1", "The nodes of ROS 1: simulation, controller, exploration."),
        ("ros2", "The nodes of ROS 2: simulation, controller, exploration."),
    )
]
"""Groups of commands: name, help, and (name, function, example) of each."""
