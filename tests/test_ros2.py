"""ROS 2 without ROS 2: the bridge over Zenoh, between nodes of our own in one process."""

import socket
import struct
import threading
import time

import numpy as np
import pytest
from ros_graphs import until, untimed

import misstep
from misstep.errors import MisstepError
from misstep.learning import begin
from misstep.robot.limits import Reason
from misstep.robot.ros.bus import TRIGGER, JointArrays
from misstep.robot.ros.exploration_node import ExplorationNode
from misstep.robot.ros.explorer import NodeExplorer
from misstep.robot.ros.exploring import explore
from misstep.robot.ros.joint_system import JointSystem
from misstep.robot.ros.joints import Joints
from misstep.robot.ros.plant import Plant
from misstep.robot.ros.simulation_node import SimulationNode
from misstep.robot.ros.topics import TopicRobot, Topics
from misstep.robot.service import ExplorationService

zenoh = pytest.importorskip("zenoh", reason="needs misstep[ros2]")
pytest.importorskip("rosbags", reason="needs misstep[ros2]")

from misstep.robot.ros2.types import FLOAT64, JOINT_STATE, Types, joint_fields  # noqa: E402
from misstep.robot.ros2.zenoh_bus import ZenohBus  # noqa: E402

JOINTS = JointArrays(1234.000000025, ("x", "theta"), (0.5, -0.25), (1.5, 2.5), (3.0, 0.0))


@pytest.fixture
def network(monkeypatch):
    """A Zenoh network of its own."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        where = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    override = f'listen/endpoints=["{where}","tcp/127.0.0.1:0"];connect/endpoints=["{where}"]'
    monkeypatch.setenv("ZENOH_CONFIG_OVERRIDE", override)
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    return where


@pytest.fixture
def join(network):
    """Join the network as a node; everybody leaves it in the end."""
    buses = []

    def join(node):
        buses.append(ZenohBus(node))
        return buses[-1]

    yield join
    for bus in buses:
        bus.close()


@pytest.fixture
def raw(network):
    """A Zenoh session that knows nothing of ROS."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", f'["{network}"]')
    sessions = []

    def open_session():
        sessions.append(zenoh.open(config))
        return sessions[-1]

    yield open_session
    for session in sessions:
        session.close()


@pytest.mark.parametrize(
    ("name", "digest"),
    [  # as published with ROS 2 Jazzy and in rmw_zenoh's design
        (FLOAT64, "RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a"),
        (JOINT_STATE, "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"),
    ],
)
def test_hashes_of_messages_are_those_of_ros_2(name, digest):
    assert Types().hash(name) == digest


def test_hashes_of_services_are_those_of_ros_2():
    types = Types()
    published = "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"
    assert types.hash(types.service(TRIGGER)) == published
    assert types.hash(types.service("Explore")) != types.hash(types.service("Start"))


def test_a_joint_state_is_the_bytes_that_cdr_says():
    """Written by hand: a header of 4 bytes, then every value at a multiple of its size."""
    text = {"x": b"\x02\0\0\0x\0\0\0", "theta": b"\x06\0\0\0theta\0\0\0"}
    expected = b"\0\1\0\0" + struct.pack("<iI", 1234, 25) + b"\x01\0\0\0\0\0\0\0"
    expected += struct.pack("<I", 2) + text["x"] + text["theta"]
    for pair in (JOINTS.positions, JOINTS.velocities, JOINTS.efforts):
        expected += struct.pack("<I", 2)
        expected += bytes(-(len(expected) - 4) % 8) + struct.pack("<2d", *pair)
    data = Types().encode(JOINT_STATE, joint_fields(JOINTS))
    assert data == expected

    from rosbags.typesys import Stores, get_typestore

    told = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(data, JOINT_STATE)
    assert told.name == ["x", "theta"]
    assert told.velocity.tolist() == [1.5, 2.5]


@pytest.mark.parametrize("data", [b"", b"\0\1\0\0", b"\0\1\0\0" + bytes(3), b"\1\1\1\1" * 9])
def test_bytes_that_are_no_message_are_refused(data):
    with pytest.raises(MisstepError, match=f"^{len(data)} bytes are no std_msgs/msg/Float64"):
        Types().decode(FLOAT64, data)


def test_topics_look_to_zenoh_as_those_of_ros_2(join, raw):
    bus = join("talker")
    push = bus.publish_effort("/cartpole/slide/command")
    session, samples = raw(), []
    key = f"7/cartpole/slide/command/std_msgs::msg::dds_::Float64_/{Types().hash(FLOAT64)}"
    subscriber = session.declare_subscriber(key, samples.append)

    def pushed():
        push(2.5)
        return samples

    sample = until(pushed, "a sample")[0]
    assert str(sample.key_expr) == key
    assert sample.payload.to_bytes() == b"\0\1\0\0" + struct.pack("<d", 2.5)
    number, stamp, length, gid = struct.unpack("<qqB16s", sample.attachment.to_bytes())
    assert (number > 0, length, any(gid)) == (True, 16, True)
    assert abs(stamp * 1e-9 - time.time()) < 60.0
    subscriber.undeclare()
    tokens = [str(r.ok.key_expr) for r in session.liveliness().get("@ros2_lv/**")]
    node, end = sorted(tokens, key=len)
    parts = node.split("/")
    assert [parts[i] for i in (1, 3, 5, 6, 7, 8)] == ["7", "0", "NN", "%", "%", "talker"]
    assert end.split("/")[5:9] == ["MP", "%", "%", "talker"]
    assert end.endswith(f"/%cartpole%slide%command/{key.split('/', 4)[4]}/::,10:,:,:,,")


def test_a_service_answers_whoever_speaks_as_ros_2_does(join, raw):
    bus, types = join("server"), Types()
    name = types.service(TRIGGER)
    bus.serve("~stop", TRIGGER, lambda request, who: (True, "stopped"))
    key = f"7/server/stop/std_srvs::srv::dds_::Trigger_/{types.hash(name)}"
    attachment = struct.pack("<qqB16s", 41, 0, 16, b"client.")
    session = raw()

    def answers():
        replies = session.get(
            key,
            target=zenoh.QueryTarget.ALL_COMPLETE,
            payload=types.encode(f"{name}_Request", {}),
            attachment=attachment,
        )
        return [reply.ok for reply in replies]

    (answer,) = until(answers, "an answer")
    response = types.decode(f"{name}_Response", answer.payload.to_bytes())
    assert (response.success, response.message) == (True, "stopped")
    number, _, _, gid = struct.unpack("<qqB16s", answer.attachment.to_bytes())
    assert (number, gid.rstrip(b"\0")) == (41, b"client.")
    # Whoever does not is told so, and the service goes on.
    for told in ({}, {"attachment": b"short"}, {"payload": b"x", "attachment": attachment}):
        (refusal,) = session.get(key, target=zenoh.QueryTarget.ALL_COMPLETE, **told)
        assert refusal.ok is None
    assert answers()[0] is not None


def test_a_refusal_and_silence_reach_the_caller(join):
    server, client = join("server"), join("client")

    def refuse(request, who):
        raise MisstepError("nobody drives: connect first")

    server.serve("~mark", "Mark", refuse)
    call = client.call("server/mark", "Mark")

    def refused():
        with pytest.raises(MisstepError) as caught:
            call(outcome="success")
        return str(caught.value) if "nobody drives" in str(caught.value) else ""

    assert until(refused, "a refusal") == "the service server/mark: nobody drives: connect first"
    with pytest.raises(MisstepError, match="the service nowhere does not answer"):
        client.call("nowhere", TRIGGER, timeout=0.5)()


class Network:
    """Simulation, exploration and controller in threads, each a node of its own."""

    def __init__(self, join, system, run):
        self.topics = Topics("/joint_states", ("/effort_controller/command",))
        self.joints = Joints(system.observation_columns)
        plant = Plant(system.system_id, system.parameters)
        self.simulation = SimulationNode(
            join("simulation"), plant, self.topics, self.joints, lock_step=True
        )
        self.thread = threading.Thread(target=self.simulation.run, daemon=True)
        self.thread.start()
        self.service = ExplorationService(run, system=system, simulated_time=True)
        self.exploration_bus = join("exploration")
        self.exploration = ExplorationNode(
            self.exploration_bus, self.service, self.topics.commands, lock_step=True
        )
        bus = join("controller")
        robot = TopicRobot(bus, self.topics, self.joints, lock_step=True)
        robot.wait(20.0)
        self.driven = JointSystem(system, robot, patience=20.0)
        self.explorer = NodeExplorer(bus, patience=20.0)

    def close(self):
        self.simulation.close()
        self.thread.join(20.0)
        assert not self.thread.is_alive()
        self.service.close()


def test_exploration_over_ros_2_is_that_of_learn(join):
    settings = {"state": ("theta", "theta_dot"), "max_trials": 3, "seed": 2}
    own = misstep.make_system("cartpole", duration=2.0)
    shown = misstep.demonstrate(own, "weak", n=3, seed=0)
    expected = misstep.learn(own, shown, "donut", stop_on_success=False, **settings)
    run = begin(own, shown, "donut", stop_on_success=False, **settings)
    network = Network(join, own, run)
    assert untimed(misstep.demonstrate(network.driven, "weak", n=3, seed=0)) == untimed(shown)
    assert explore(network.explorer, network.driven) == 3
    network.close()
    assert untimed(run.trials) == untimed(expected.trials)


def test_without_an_exploration_node_the_action_is_safe(join):
    own = misstep.make_system("cartpole", duration=2.0)
    run = begin(own, misstep.demonstrate(own, "weak", n=2, seed=0), "mean")
    network = Network(join, own, run)
    start = network.explorer.start()
    observation, _ = network.driven.reset(seed=start.seed)
    said = {"cost": None, "failed": False, "succeeded": False, "over": False}
    state = tuple(observation.tolist())
    answered = network.explorer.ask(state, stamp=network.driven.stamp, **said)
    assert answered.in_trial
    network.driven.step(np.array(answered.action))
    network.exploration_bus.close()
    lost = network.explorer.ask(state, stamp=network.driven.stamp, **said)
    assert lost.reason == Reason.SILENT | Reason.WATCHDOG
    assert lost.action == (0.0,)
    network.close()
