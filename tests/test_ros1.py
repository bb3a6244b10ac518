"""ROS 1 for real: a roscore, nodes in processes of their own, topics, services, bags."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from ros_faults import RosRobot, harm_robot
from ros_graphs import ROOT, Graph, ended, missing, until, untimed

import misstep
from misstep.paper.calibration import FIRST
from misstep.paper.experiments import PAPER_DONUT
from misstep.robot.log import Event, read_log
from misstep.robot.ros1.recorder import BagRecorder
from misstep.runs import load_run

pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())


@pytest.fixture(scope="module")
def graph(tmp_path_factory):
    graph = Graph(tmp_path_factory.mktemp("ros"))
    yield graph
    graph.close()


def options(parameters):
    return [word for name, value in parameters.items() for word in ("--set", f"{name}={value}")]


def test_the_papers_experiment_runs_through_the_middleware_as_without_it(graph, tmp_path):
    duration, trials = 6.0, 11
    launched = graph.start(
        "roslaunch", "misstep_ros", "experiment.launch", f"out:={tmp_path}", f"duration:={duration}"
    )
    own = misstep.make_system("cartpole", **{**FIRST.system, "duration": duration})
    shown = misstep.demonstrate(own, "noisy", n=4, seed=0, **FIRST.demonstrator)
    expected = misstep.learn(
        own,
        shown,
        "donut",
        state=("theta",),
        max_trials=trials,
        seed=0,
        stop_on_success=False,
        **PAPER_DONUT,
    )
    assert launched.wait(120.0) == 0, launched.said()
    demonstrations = misstep.load_dataset(tmp_path / "demonstrations.h5")
    run = load_run(tmp_path / "run")
    assert untimed(demonstrations) == untimed(shown)
    assert run.finished
    assert len(run.trials) == trials
    assert untimed(run.trials) == untimed(expected.trials)
    for ours, theirs in zip(run.policies, expected.policies, strict=True):
        arrays, others = ours.arrays(), theirs.arrays()
        assert all(np.array_equal(arrays[name], others[name]) for name in others)
    check_bag(sorted((tmp_path / "bags").glob("*.bag"))[-1], run.trials[-1])


def check_bag(path, trial):
    """A bag, read without ROS, holds what the trial holds."""
    from rosbags.highlevel import AnyReader

    positions, efforts = [], []
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            if connection.topic == "joint_states":
                positions.append(message.position)
            else:
                efforts.append(message.data)
    every = round(trial.dt / 0.01)
    states = np.array(positions)[: len(trial.actions) * every + 1 : every]
    assert np.array_equal(states, trial.observations[:, [0, 2]])
    assert np.array_equal(
        np.array(efforts)[: len(trial.actions) * every : every], trial.actions[:, 0]
    )
    assert efforts[-1] == 0.0


def test_nothing_is_lost_when_roscore_is_killed_and_started_again(graph, tmp_path):
    own = misstep.make_system("cartpole", duration=20.0, stop_at_fall=False)
    settings = {"state": ("theta", "theta_dot"), "max_trials": 6, "seed": 3}
    shown = misstep.demonstrate(own, "weak", n=2, seed=1)
    expected = misstep.learn(own, shown, "donut", stop_on_success=False, **settings)
    misstep.save_dataset(shown, tmp_path / "shown.h5")
    plant = options({"duration": 20.0, "stop_at_fall": "false"})
    simulation = graph.node("simulate", "cartpole", *plant, "--lock-step")
    exploration = graph.node(
        "explore",
        *(tmp_path / "run", "--from", tmp_path / "shown.h5", *plant, "--learner", "donut"),
        *("--state", "theta,theta_dot", "--max-trials", 6, "--seed", 3, "--keep-going"),
        *("--lock-step", "--json", tmp_path / "result.json"),
    )
    controller = graph.node("control", "cartpole", *plant, "--lock-step")
    until(lambda: list(tmp_path.glob("run/trials/*")), "the first trial")
    master = graph.master_pid()
    graph.kill(graph.core)
    graph.start_core()
    assert graph.master_pid() != master
    assert len(trials(tmp_path / "run")) < 6  # while the trials went on
    for node in (controller, exploration):
        ended(node)
    graph.stop(simulation)
    assert untimed(load_run(tmp_path / "run").trials) == untimed(expected.trials)
    assert json.loads((tmp_path / "result.json").read_text())["trials"] == 6


def test_a_node_that_is_terminated_ends_in_order(graph):
    node = graph.node("simulate", "cartpole")
    until(lambda: "/effort_controller/command" in graph.call("rostopic", "list"), "the node")
    node.terminate()
    assert node.wait(30.0) == 143
    assert "misstep: terminated" in node.said()
    assert "steps, " in node.said()


def trials(folder):
    return sorted(folder.glob("trials/*.h5"))


def test_whatever_goes_wrong_the_actuator_ends_safe_and_the_trials_are_kept(tmp_path):
    """A handful of studies/robot_faults.py."""
    ways = (
        RosRobot.controller_is_killed,
        RosRobot.exploration_is_killed,
        RosRobot.states_are_not_finite,
        RosRobot.somebody_stops,
    )
    made, kept = harm_robot(tmp_path, ways, len(ways))
    assert made.total() == len(ways)
    assert kept > 0
    logs = [read_log(log)[1] for log in sorted(tmp_path.glob("run/actions/*.log"))]
    said = [record.text for records in logs for record in records if isinstance(record, Event)]
    assert any(text.startswith("emergency stop by /rosservice") for text in said)
    for why in ("watchdog", "not finite"):
        assert any(why in text for text in said), said


def test_debians_generator_makes_the_same_services(tmp_path):
    """`gensrv_py.py` and the classes made at run time agree, to the checksum."""
    source = ROOT / "ros" / "misstep_ros" / "srv"
    names = sorted(path.stem for path in source.glob("*.srv"))
    generator = Path("/usr/lib/genpy/gensrv_py.py")
    python = "/usr/bin/python3"
    files = [str(source / f"{name}.srv") for name in names]
    subprocess.run(
        [python, str(generator), "-p", "misstep_ros", "-o", str(tmp_path), *files], check=True
    )
    program = (
        "import sys; from misstep.robot.ros1.services import service_type\n"
        f"for name in {names}: print(name, service_type(name)._md5sum)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    for line in done.stdout.splitlines():
        name, checksum = line.split()
        assert f'"{checksum}"' in (tmp_path / f"_{name}.py").read_text().replace("'", '"')
    assert names == ["Connect", "Explore", "Mark", "Reset", "Start"]


QUICK = """
import io, random, struct
from misstep.robot.ros1.services import generated_type, service_type
rng = random.Random(0)
numbers = [0.0, -0.0, 1.5, float("inf"), float("-inf"), float("nan"), 5e-324, 1e308]
def row(): return tuple(rng.choice(numbers) for _ in range(rng.randrange(5)))
def flag(): return rng.random() < 0.5
slow, quick = generated_type("Explore"), service_type("Explore")
def same(a, b): return repr([getattr(a, n) for n in a.__slots__]) == repr(
    [getattr(b, n) for n in b.__slots__])
for part in ("_request_class", "_response_class"):
    theirs, ours = getattr(slow, part), getattr(quick, part)
    assert ours._md5sum == theirs._md5sum and ours._type == theirs._type
    assert same(ours(), theirs()) or part == "_response_class" or ours().observation == ()
    for _ in range(2000):
        n = rng.randrange(2**64)
        if part == "_request_class":
            fields = (n, rng.random(), rng.choice(numbers), flag(), flag(), flag(), row())
        else:
            fields = (n, rng.randrange(2**64), rng.randrange(2**16), row(), row())
        expected, given = io.BytesIO(), io.BytesIO()
        theirs(*fields).serialize(expected)
        ours(*fields).serialize(given)
        data = given.getvalue()
        assert data == expected.getvalue()
        assert same(ours().deserialize(data), theirs().deserialize(data))
        for cut in (data[:-1], data[: rng.randrange(len(data))], data + b"x", rng.randbytes(99)):
            try:
                told = theirs().deserialize(cut)
            except Exception as error:
                told = type(error)
            try:
                found = ours().deserialize(cut)
            except Exception as error:
                found = type(error)
            assert found == told if isinstance(told, type) else same(found, told)
    try:
        ours("x").serialize(io.BytesIO())
    except Exception as error:
        print(type(error).__name__)
"""


def test_quick_messages_are_those_that_genpy_makes_to_the_byte():
    done = subprocess.run([sys.executable, "-c", QUICK], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["SerializationError"] * 2


def test_without_a_roscore_there_is_one_line(tmp_path):
    environment = {"ROS_MASTER_URI": "http://127.0.0.1:1", "ROS_HOME": str(tmp_path), "PATH": ""}
    program = "import sys; from misstep.cli import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", program, "ros1", "simulate"],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert done.stderr.splitlines() == [
        "misstep: error: no roscore answers at http://127.0.0.1:1: start one, or set ROS_MASTER_URI"
    ]


def test_a_bag_that_is_taken_away_leaves_the_others_alone(tmp_path):
    recorder = BagRecorder(tmp_path)
    for n_attempts in (2, 1):
        for _ in range(n_attempts):
            recorder.begin()
            recorder.effort("command", float(n_attempts), 1.0)
            recorder.end()
        if n_attempts == 2:
            (tmp_path / "attempt_000.bag").unlink()
            second = (tmp_path / "attempt_001.bag").read_bytes()
    kept = ["attempt_001.bag", "attempt_002.bag"]
    assert sorted(path.name for path in tmp_path.iterdir()) == kept
    assert (tmp_path / "attempt_001.bag").read_bytes() == second
