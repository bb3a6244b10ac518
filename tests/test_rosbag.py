import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags import rosbag1, rosbag2
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from misstep import Column, Dataset, MisstepError, Outcome, Provenance, Trajectory
from misstep.formats import ReadOptions, load_dataset, read_episodes, save_dataset
from misstep.formats.bags import opening
from misstep.formats.bags.clock import Clock
from misstep.formats.bags.places import parse_place
from misstep.formats.format import BLOCK_ROWS, joined

SUFFIXES = {"rosbag": ".bag", "rosbag2": ".ros2", "mcap": ".mcap"}
START = 1_700_000_000_000_000_000  # ns
GRIPPER = "float64 opening\nstd_msgs/Header header\ngeometry_msgs/Point tip\nuint8[2] flags\n"
NAMES = ("x", "x_dot", "theta", "theta_dot")


def make(steps=5, seed=0, names=NAMES, **changes):
    rng = np.random.default_rng(seed)
    fields = {
        "observations": rng.normal(size=(steps + 1, len(names))),
        "actions": rng.normal(size=(steps, 1)),
        "dt": 0.02,
        "observation_columns": tuple(Column(name, "m") for name in names),
        "action_columns": (Column("force", "N"),),
        "provenance": Provenance(
            "cartpole", {"limit": float("inf")}, "weak", 2**70, "2024-05-31T12:00", ("a note",)
        ),
        "outcome": Outcome.FAILURE,
        "costs": rng.normal(size=steps),
        "failure_step": 3,
    }
    return Trajectory(**(fields | changes))


class Recording:
    """A bag in the making, through rosbags' own writers."""

    def __init__(self, path, kind):
        self.is_ros1 = kind == "rosbag"
        self.types = get_typestore(Stores.ROS1_NOETIC if self.is_ros1 else Stores.ROS2_HUMBLE)
        self.types.register(get_types_from_msg(GRIPPER, "lab_msgs/msg/Gripper"))
        if self.is_ros1:
            self.writer = rosbag1.Writer(path)
        else:
            plugin = {"rosbag2": "SQLITE3", "mcap": "MCAP"}[kind]
            plugin = rosbag2.StoragePlugin[plugin]
            self.writer = rosbag2.Writer(path, version=8, storage_plugin=plugin)
        self.connections = {}

    def __enter__(self):
        self.writer.open()
        return self

    def __exit__(self, *_):
        self.writer.close()

    def make(self, kind, **fields):
        return self.types.types[kind](**fields)

    def header(self, seconds):
        stamp = self.make(
            "builtin_interfaces/msg/Time", sec=int(seconds), nanosec=round(seconds % 1 * 1e9)
        )
        more = {"seq": 0} if self.is_ros1 else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id="", **more)

    def write(self, seconds, topic, kind, **fields):
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.types)
        serialize = self.types.serialize_ros1 if self.is_ros1 else self.types.serialize_cdr
        time = START + round(seconds * 1e9)
        message = self.make(kind, **fields)
        self.writer.write(self.connections[topic], time, serialize(message, kind))

    def joints(self, seconds, names, positions, velocities=(), topic="/joint_states", stamp=0.0):
        self.write(
            seconds,
            topic,
            "sensor_msgs/msg/JointState",
            header=self.header(stamp),
            name=list(names),
            position=np.array(positions, float),
            velocity=np.array(velocities, float),
            effort=np.empty(0),
        )

    def number(self, seconds, topic, value):
        self.write(seconds, topic, "std_msgs/msg/Float64", data=float(value))


def place(tmp_path, kind):
    # rosbags makes a folder of an MCAP bag, too
    return tmp_path / f"theirs{'.bag' if kind == 'rosbag' else ''}"


def episodes(path, **options):
    found = []
    for episode in read_episodes(path, ReadOptions(**options)):
        found.append((episode.header, joined(episode), episode.ending()))
    return found


# Out and back


@pytest.mark.parametrize(("kind", "suffix"), SUFFIXES.items())
def test_round_trip(tmp_path, kind, suffix):
    path = tmp_path / f"d{suffix}"
    dataset = Dataset(
        [
            make(),
            make(steps=BLOCK_ROWS + 5, seed=1, costs=None, outcome=Outcome.UNKNOWN),
            make(steps=1, seed=2, failure_step=None, outcome=Outcome.SUCCESS),
        ]
    )
    save_dataset(dataset, path)
    assert load_dataset(path) == dataset
    save_dataset(dataset[:1], path)  # in place of what was there
    assert load_dataset(path) == dataset[:1]


def test_the_columns_of_a_bag_go_back_to_their_places(tmp_path):
    names = ("/joint_states.position[cart]", "/joint_states.velocity[cart]", "b/c.d[e]")
    trajectory = make(names=names, action_columns=(Column("/cart/cmd.data", ""),))
    path = tmp_path / "d.bag"
    save_dataset(Dataset([trajectory]), path)
    assert load_dataset(path) == Dataset([trajectory])
    ((header, block, _),) = episodes(path, rate=50)
    there = [column.name for column in (*header.observation_columns, *header.action_columns)]
    assert there[0] == "/joint_states.position[cart]"
    assert there[-1] == "/cart/cmd.data"
    np.testing.assert_array_equal(block.actions, trajectory.actions)


@pytest.mark.parametrize(("kind", "suffix"), SUFFIXES.items())
def test_rosbags_reads_what_is_written(tmp_path, kind, suffix):
    trajectory = make()
    path = tmp_path / f"d{suffix}"
    save_dataset(Dataset([trajectory]), path)
    seen, done, costs, times = [], [], [], []
    with AnyReader([path]) as reader:
        for connection, time, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            if connection.topic == "/joint_states":
                assert message.name == ["x", "theta"]
                stamp = message.header.stamp
                assert stamp.sec * 10**9 + stamp.nanosec == time
                seen.append(np.column_stack([message.position, message.velocity]).ravel())
                times.append(time)
            elif connection.topic == "/force/command":
                done.append(message.data)
            elif connection.topic == "/misstep/cost":
                costs.append(message.data)
    np.testing.assert_array_equal(seen, trajectory.observations)
    np.testing.assert_array_equal(done, trajectory.actions[:, 0])
    np.testing.assert_array_equal(costs, trajectory.costs)
    assert set(np.diff(times)) == {20_000_000}
    assert times[0] == 1_717_156_800 * 10**9  # when it was recorded


BY_ROS = """
import json, sys
import rosbag
topics = {}
with rosbag.Bag(sys.argv[1]) as bag:
    for topic, message, time in bag.read_messages():
        row = [*message.position, *message.velocity] if hasattr(message, "name") else message.data
        topics.setdefault(topic, []).append([time.to_nsec(), row])
print(json.dumps(topics))
"""


def test_ros_1_reads_what_is_written(tmp_path):
    # Debian installs it for the system's Python, which is seldom the one that runs this.
    for python in (sys.executable, shutil.which("python3", path=os.defpath)):
        if python and not subprocess.run([python, "-c", "import rosbag"], check=False).returncode:
            break
    else:
        pytest.skip("needs ROS 1's own rosbag: apt-get install python3-rosbag")
    trajectory = make()
    path = tmp_path / "d.bag"
    save_dataset(Dataset([trajectory]), path)
    done = subprocess.run([python, "-c", BY_ROS, path], capture_output=True, check=True)
    topics = json.loads(done.stdout)
    times, seen = zip(*topics["/joint_states"], strict=True)
    np.testing.assert_array_equal(np.array(seen)[:, [0, 2, 1, 3]], trajectory.observations)
    assert set(np.diff(times)) == {20_000_000}
    actions = [row for _, row in topics["/force/command"]]
    np.testing.assert_array_equal(actions, trajectory.actions[:, 0])


# What others recorded


@pytest.mark.parametrize("kind", SUFFIXES)
def test_joint_states_and_commands(tmp_path, kind):
    # A controller answers 2 ms after what it saw; joints change their order on the way.
    rng = np.random.default_rng(0)
    position, velocity, force = rng.normal(size=(3, 50, 2))
    with Recording(place(tmp_path, kind), kind) as bag:
        for k in range(50):
            order = [0, 1] if k % 3 else [1, 0]
            names = np.array(["cart", "pole"])[order]
            bag.joints(k / 100, names, position[k, order], velocity[k, order])
            bag.number(k / 100 + 0.002, "/effort_controller/command", force[k, 0])
            bag.number(k / 100, "/battery", 12.0)
    ((header, block, ending),) = episodes(place(tmp_path, kind))
    names = [column.name for column in header.observation_columns]
    assert sorted(names) == [
        f"/joint_states.{field}[{joint}]"
        for field in ("position", "velocity")
        for joint in ("cart", "pole")
    ]
    assert [c.name for c in header.action_columns] == ["/effort_controller/command.data"]
    assert header.dt == 0.01
    assert header.provenance.time.startswith("2023-11-14T22:13:20")
    for name, expected in zip(
        ("position[cart]", "position[pole]", "velocity[cart]", "velocity[pole]"),
        (*position.T, *velocity.T),
        strict=True,
    ):
        column = names.index(f"/joint_states.{name}")
        np.testing.assert_array_equal(block.observations[:, column], expected)
    np.testing.assert_array_equal(block.actions[:, 0], force[:-1, 0])
    assert any("/battery" in note for note in header.provenance.notes)
    assert ending.outcome is Outcome.UNKNOWN


@pytest.mark.parametrize("kind", SUFFIXES)
def test_types_that_the_bag_defines_and_other_rates(tmp_path, kind):
    rng = np.random.default_rng(1)
    opening, tip = rng.normal(size=40), rng.normal(size=(40, 3))
    slow, twist = rng.normal(size=9), rng.normal(size=(7, 6))
    slow_times, twist_times = np.arange(9) * 0.1 - 0.003, np.arange(7) * 0.13
    with Recording(place(tmp_path, kind), kind) as bag:
        events = []
        for k in range(40):
            point = bag.make("geometry_msgs/msg/Point", x=tip[k, 0], y=tip[k, 1], z=tip[k, 2])
            fields = {"opening": opening[k], "tip": point, "header": bag.header(0)}
            fields["flags"] = np.array([1, 2], np.uint8)
            events.append((k * 0.02, "/gripper", "lab_msgs/msg/Gripper", fields))
        for time, value in zip(slow_times, slow, strict=True):
            events.append((time, "/weight", "std_msgs/msg/Float64", {"data": value}))
        for time, row in zip(twist_times, twist, strict=True):
            linear, angular = (
                bag.make("geometry_msgs/msg/Vector3", x=a, y=b, z=c)
                for a, b, c in (row[:3], row[3:])
            )
            fields = {"linear": linear, "angular": angular}
            events.append((time, "/cmd_vel", "geometry_msgs/msg/Twist", fields))
        for time, topic, kind_of_message, fields in sorted(events, key=lambda event: event[0]):
            bag.write(time, topic, kind_of_message, **fields)

    chosen = {"observations": ("/gripper", "/weight.data"), "actions": ("/cmd_vel",)}
    ((header, block, _),) = episodes(place(tmp_path, kind), **chosen)
    assert [c.name for c in header.observation_columns] == [
        "/gripper.opening",
        "/gripper.tip.x",
        "/gripper.tip.y",
        "/gripper.tip.z",
        "/gripper.flags[0]",
        "/gripper.flags[1]",
        "/weight.data",
    ]
    assert [c.name for c in header.action_columns][-1] == "/cmd_vel.angular.z"
    assert header.dt == 0.02
    assert any("/weight interpolated linearly" in note for note in header.provenance.notes)
    ticks = np.arange(40) * 0.02
    np.testing.assert_array_equal(block.observations[:, 0], opening)
    np.testing.assert_array_equal(block.observations[:, 1:4], tip)
    expected = np.interp(ticks, slow_times, slow)
    np.testing.assert_allclose(block.observations[:, 6], expected, atol=1e-6)
    in_force = np.searchsorted(twist_times, ticks[:-1] + 0.01, side="right") - 1
    np.testing.assert_array_equal(block.actions, twist[in_force])

    ((header, block, _),) = episodes(place(tmp_path, kind), rate=30, **chosen)
    assert header.dt == 1 / 30
    ticks = np.arange(len(block.observations)) / 30
    assert ticks[-1] <= 0.78 < ticks[-1] + 1 / 30
    expected = np.interp(ticks, np.arange(40) * 0.02, opening)
    np.testing.assert_allclose(block.observations[:, 0], expected, atol=1e-6)


def test_uneven_times_are_handed_on(tmp_path):
    times = [0.0, 0.011, 0.02, 0.034]
    with Recording(place(tmp_path, "rosbag"), "rosbag") as bag:
        for time in times:
            bag.joints(time, ["a"], [time])
            bag.number(time, "/cmd", 2 * time)
    ((header, block, _),) = episodes(place(tmp_path, "rosbag"))
    assert header.dt is None
    np.testing.assert_allclose(block.times, times, atol=1e-9)
    np.testing.assert_array_equal(block.actions[:, 0], [0.0, 0.022, 0.04])


def test_stamps_instead_of_the_time_of_arrival(tmp_path):
    rng = np.random.default_rng(0)
    with Recording(place(tmp_path, "rosbag2"), "rosbag2") as bag:
        for k in range(20):
            arrival = k * 0.01 + rng.uniform(0, 0.005)
            bag.joints(arrival, ["a"], [k], stamp=1000 + k * 0.01)
    ((header, block, _),) = episodes(place(tmp_path, "rosbag2"), time="header.stamp")
    assert header.dt == 0.01
    assert len(block.observations) == 20
    assert header.action_columns == ()
    ((header, _, _),) = episodes(place(tmp_path, "rosbag2"))
    assert header.dt is None


def test_what_comes_before_all_columns_are_there_is_left_out(tmp_path):
    with Recording(place(tmp_path, "rosbag"), "rosbag") as bag:
        for k in range(10):
            bag.joints(k * 0.1, ["a"], [k])
            if k >= 3:
                bag.number(k * 0.1 + 0.001, "/cmd", k)
    ((_, block, ending),) = episodes(place(tmp_path, "rosbag"))
    np.testing.assert_array_equal(block.observations[:, 0], np.arange(3, 10))
    np.testing.assert_array_equal(block.actions[:, 0], np.arange(3, 9))
    assert any("3 observations at the start left out" in note for note in ending.notes)


@pytest.mark.parametrize(("until", "is_held"), [(3.0, True), (9.99, False)])
def test_a_topic_that_falls_silent_before_the_end_is_noted(tmp_path, until, is_held):
    with Recording(place(tmp_path, "rosbag"), "rosbag") as bag:
        for k in range(1000):
            bag.joints(k * 0.01, ["a"], [k])
            if k % 20 == 0 and k * 0.01 <= until:  # at a lower rate
                bag.joints(k * 0.01 + 0.001, ["b"], [k], topic="/other")
            bag.number(k * 0.01, "/cmd", k)
    ((_, block, ending),) = episodes(place(tmp_path, "rosbag"))
    assert block.observations[-1, 1] == 20 * int(until / 0.2)
    assert ("a topic fell silent: its last observation was held" in ending.notes) == is_held


@pytest.mark.parametrize("kind", SUFFIXES)
def test_one_bag_many_episodes(tmp_path, kind):
    path = place(tmp_path, kind)
    with Recording(path, kind) as bag:
        clock = 0.0
        for number, rows in enumerate((4, 7, 1, 5)):
            bag.number(clock - 0.005, "/attempt", number)
            for k in range(rows):
                bag.joints(clock + k * 0.1, ["a"], [number])
                bag.number(clock + k * 0.1, "/cmd", k)
            clock += rows * 0.1 + 2
    for how in ("1s", "/attempt.data"):
        found = episodes(path, episode=how)
        # Of one row nothing can be made.
        assert [len(block.observations) for _, block, _ in found] == [4, 7, 5]
        assert [set(block.observations[:, 0]) for _, block, _ in found] == [{0}, {1}, {3}]
        assert {header.dt for header, _, _ in found} == {0.1}
        for _, block, _ in found:
            np.testing.assert_array_equal(block.actions[:, 0], np.arange(len(block.actions)))


# The clock


@settings(max_examples=12)
@given(seed=st.integers(0, 2**32))
def test_blocks_make_no_difference(seed):
    # Many samples, a block at a time, against all of them at once.
    rng = np.random.default_rng(seed)
    n = 2 * BLOCK_ROWS + int(rng.integers(1, 300))
    ticks = np.cumsum(rng.integers(1, 10**7, n))
    others = np.unique(rng.integers(-(10**6), ticks[-1] + 10**6, int(rng.integers(2, n))))
    commands = np.unique(rng.integers(-(10**6), ticks[-1], int(rng.integers(2, 3000))))
    samples = [(t, 0, k) for k, t in enumerate(ticks)]
    samples += [(t, 1, k) for k, t in enumerate(others)]
    samples += [(t, 2, k) for k, t in enumerate(commands)]
    clock, blocks = Clock(2, 1, None), []
    for time, what, value in sorted(samples):
        if what == 2:
            clock.command(0, int(time), float(value))
            continue
        clock.observe(what, int(time), float(value))
        if what == 0:
            clock.tick(int(time))
            if clock.has_block:
                blocks.append(clock.block())
    blocks.append(clock.last_block())
    blocks = [block for block in blocks if block is not None]
    middles = (ticks[:-1] + ticks[1:]) / 2
    start = max(np.searchsorted(ticks, others[0]), np.searchsorted(middles, commands[0]))
    observations = np.concatenate([block.observations for block in blocks])
    actions = np.concatenate([block.actions for block in blocks])
    np.testing.assert_array_equal(observations[:, 0], np.arange(start, n))
    expected = np.interp(ticks[start:], others, np.arange(len(others)))
    np.testing.assert_allclose(observations[:, 1], expected, rtol=1e-6, atol=1e-6)
    in_force = np.searchsorted(commands, middles[start:], side="right") - 1
    np.testing.assert_array_equal(actions[:, 0], in_force)
    assert clock.left_out == start


# What is refused


def test_refused(tmp_path, refused):
    path = place(tmp_path, "rosbag")
    with Recording(path, "rosbag") as bag:
        for k in range(5):
            bag.number(k, "/a", k)
            bag.write(k, "/say", "std_msgs/msg/String", data="x")
    with refused(r"nothing in it looks like observations: .*/a \(std_msgs/msg/Float64\)"):
        episodes(path)
    with refused("no topic /b; there are: /a"):
        episodes(path, observations=("/b.data",))
    with refused("no number at /say.data"):
        episodes(path, observations=("/say.data",))
    with refused("'a' is no place|no topic a"):
        episodes(path, observations=("a",))
    assert len(episodes(path, observations=("/a.data",))) == 1
    (path2 := tmp_path / "empty.bag").write_bytes(b"")
    with refused("seems to be empty"):
        episodes(path2)


def test_a_pause_of_years_is_refused(tmp_path, refused):
    path = place(tmp_path, "rosbag")
    with Recording(path, "rosbag") as bag:
        for time in (0, 0.01, 10**8):
            bag.joints(time, ["a"], [1])
    with refused("a pause of 1e"):
        episodes(path, rate=1000)


@pytest.mark.parametrize("text", ["", "x y", "/a.", "/a..b", "/a[", "/a.b[]", "/a]b"])
def test_places_that_are_none(text):
    with pytest.raises(MisstepError, match="no place"):
        parse_place(text or ".")


def test_places_are_written_as_they_are_read():
    for text in ("/a", "/a/b.c.d[3]", "/joint_states.position[left arm/1]", "/a.b[0].c[x].d"):
        assert str(parse_place(text)) == text


def packed_bag(folder, kind, size):
    """Write a bag whose messages are packed, one of them `size` equal bytes long."""
    is_ros1 = kind.startswith("ROS 1")
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    path = folder / ("d.bag" if is_ros1 else "d.ros2")
    if is_ros1:
        writer = rosbag1.Writer(path)
        writer.set_compression(writer.CompressionFormat[kind.split()[-1]])
    else:
        storage = rosbag2.StoragePlugin.MCAP if "MCAP" in kind else rosbag2.StoragePlugin.SQLITE3
        writer = rosbag2.Writer(path, version=8, storage_plugin=storage)
        mode = rosbag2.CompressionMode[kind.split()[-1]]
        writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    serialize = store.serialize_ros1 if is_ros1 else store.serialize_cdr
    with writer:
        for topic, name, fields in (
            ("/value", "std_msgs/msg/Float64", [{"data": float(i)} for i in range(9)]),
            ("/text", "std_msgs/msg/String", [{"data": "0" * size}]),
        ):
            connection = writer.add_connection(topic, name, typestore=store)
            for i, field in enumerate(fields):
                writer.write(
                    connection, 10**7 * (i + 1), serialize(store.types[name](**field), name)
                )
    return path


KINDS = (
    "ROS 1, BZ2",
    "ROS 1, LZ4",
    "ROS 2, MESSAGE",
    "ROS 2, FILE",
    "ROS 2, MCAP, STORAGE",
    "ROS 2, MCAP, FILE",
)


@pytest.mark.parametrize("kind", KINDS)
def test_packed_bags_are_read(tmp_path, kind):
    path = packed_bag(tmp_path, kind, 10)
    (episode,) = read_episodes(path, ReadOptions(observations=("/value.data",)))
    assert joined(episode).observations[:, 0].tolist() == list(range(9))


@pytest.mark.parametrize("kind", KINDS)
def test_bombs_are_refused(tmp_path, refused, monkeypatch, kind):
    for name in ("_LARGEST_CHUNK", "_SMALL"):
        monkeypatch.setattr(opening, name, 2**16)
    path = packed_bag(tmp_path, kind, 2**23)
    with refused("unpacks to more than|bytes is too large"):
        list(read_episodes(path, ReadOptions(observations=("/value.data", "/text.data"))))


def test_a_piece_unpacks_to_what_was_packed_or_not_at_all(refused):
    from lz4 import frame

    packed = frame.compress(b"misstep" * 100)
    assert opening._unpacked(opening._lz4(), packed) == b"misstep" * 100
    for damaged in (packed[:-4], packed + b"more"):
        with refused("longer or shorter than it has to be"):
            opening._unpacked(opening._lz4(), damaged)
    with refused("unpacks to more than 699 bytes"):
        opening._unpacked(opening._lz4(), packed, 699)


def test_a_joint_without_a_name_does_not_shift_the_others(tmp_path):
    path = tmp_path / "a.bag"
    with Recording(path, "rosbag") as bag:
        for i in range(5):
            bag.joints(i / 10, ["", "cart"], [-1.0, i])
    (episode,) = read_episodes(path, ReadOptions(("/joint_states.position[cart]",)))
    assert joined(episode).observations.tolist() == [[0], [1], [2], [3], [4]]


def test_a_file_may_have_any_name(tmp_path):
    for name in ("bag", "bag.mcap", "a b.mcap"):
        save_dataset(Dataset([make()]), tmp_path / name, "mcap")
        assert (tmp_path / name).is_file()
    assert sorted(os.listdir(tmp_path)) == ["a b.mcap", "bag", "bag.mcap"]
