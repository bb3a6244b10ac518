"""Writing bags of ROS 1 and ROS 2; `misstep.formats.bags` says what goes where."""

import json
import re
import sqlite3
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from misstep.errors import MisstepError
from misstep.formats.annotation import Annotation
from misstep.formats.bags.topics import ANNOTATIONS, COST, recognise
from misstep.formats.folders import write_folder
from misstep.formats.format import Ending, Episode, Header
from misstep.formats.guard import prefixed
from misstep.formats.libraries import needed
from misstep.formats.steps import dt_of, steps_of, uniform
from misstep.storage import atomic_write

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


@dataclass(frozen=True)
class _Plan:
    """Where each column goes.

    Parameters
    ----------
    joints : tuple of str
    fields : tuple of (str, int)
        Of each observation: ``position`` or ``velocity``, and the number of its joint.
    topics : tuple of str
        Of each action.
    """

    joints: tuple[str, ...]
    fields: tuple[tuple[str, int], ...]
    topics: tuple[str, ...]

    def places(self) -> dict[str, list[str]]:
        """Return the place of each column."""
        return {
            "observations": [f"{_JOINTS}.{kind}[{joint}]" for kind, joint in self.fields],
            "actions": [f"{topic}.data" for topic in self.topics],
        }


_JOINTS = "/joint_states"
_FROM_JOINT = re.compile(r"/[^.]+\.(position|velocity)\[(.+)\]")
_FROM_DATA = re.compile(r"((?:/[A-Za-z]\w*)+)\.data")


def _plan(header: Header) -> _Plan:
    names = [column.name for column in header.observation_columns]
    parts = [_joint_of(name, names) for name in names]
    if len(set(parts)) < len(parts):  # joints of one name on two topics
        parts = [("position", name) for name in names]
    joints = list(dict.fromkeys(joint for _, joint in parts))
    topics = [_topic_of(column.name) for column in header.action_columns]
    if len({*topics, _JOINTS, ANNOTATIONS, COST}) < len(topics) + 3:
        topics = [f"/action_{i}/command" for i in range(len(topics))]
    return _Plan(
        tuple(joints),
        tuple((field, joints.index(joint)) for field, joint in parts),
        tuple(topics),
    )


def _joint_of(name: str, names: list[str]) -> tuple[str, str]:
    """Return field and joint for a column: those that it came from, or the velocity of another."""
    if match := _FROM_JOINT.fullmatch(name):
        return match[1], match[2]
    if name.endswith("_dot") and name.removesuffix("_dot") in names:
        return "velocity", name.removesuffix("_dot")
    return "position", name


def _topic_of(name: str) -> str:
    if match := _FROM_DATA.fullmatch(name):
        return match[1]
    plain = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")
    return f"/{plain if plain[:1].isalpha() else f'action_{plain}'}/command"


class _Recorder:
    """Writes messages through one of rosbags' writers.

    Parameters
    ----------
    writer : rosbags' writer
        Open.
    typestore : Typestore
    is_ros1 : bool
    """

    def __init__(self, writer: Any, typestore: "Typestore", is_ros1: bool) -> None:
        self._writer, self._typestore, self._is_ros1 = writer, typestore, is_ros1
        self._connections: dict[str, Any] = {}  # by topic
        self._end = 0

    def episode(self, episode: Episode) -> None:
        """Write one episode after what is there."""
        header, plan = episode.header, _plan(episode.header)
        start = self._start(header)
        dt = dt_of(header)
        before = {"begins": Annotation(header, Ending(), True).to_text(), **plan.places()}
        self._text(start - _MOMENT, json.dumps(before))
        count, has_costs, last = 0, False, None
        for steps in steps_of(episode.blocks):
            has_costs |= steps.costs is not None
            for row in range(len(steps.actions)):
                time = start + round((count + row) * dt * 1e9)
                self._joints(time, plan, steps.observations[row])
                for topic, value in zip(plan.topics, steps.actions[row], strict=True):
                    self._number(time, topic, value)
                if steps.costs is not None:
                    self._number(time, COST, steps.costs[row])
            count += len(steps.actions)
            last = steps.next_observations[-1]
        if last is None:
            raise MisstepError("it has no steps")
        self._end = start + round(count * dt * 1e9)
        self._joints(self._end, plan, last)
        after = Annotation(header, episode.ending(), has_costs).to_text()
        self._text(self._end + _MOMENT, json.dumps({"ends": after}))

    def _start(self, header: Header) -> int:
        """Return when an episode starts, ns: when it was recorded, if that is after the last."""
        earliest = self._end + _SECOND
        if not header.provenance.time:
            return earliest
        told = datetime.fromisoformat(header.provenance.time)
        moment = told if told.tzinfo else told.replace(tzinfo=UTC)
        start = round(moment.timestamp() * 1e9)
        return start if earliest < start < _LATEST else earliest

    def _text(self, time: int, text: str) -> None:
        self._write(time, ANNOTATIONS, "std_msgs/msg/String", data=text)

    def _number(self, time: int, topic: str, value: float) -> None:
        self._write(time, topic, "std_msgs/msg/Float64", data=float(value))

    def _joints(self, time: int, plan: _Plan, row: Any) -> None:
        values = {
            kind: np.full(len(plan.joints), np.nan) for kind in {kind for kind, _ in plan.fields}
        }
        for (kind, joint), value in zip(plan.fields, row, strict=True):
            values[kind][joint] = value
        types, empty = self._typestore.types, np.empty(0)
        stamp = types["builtin_interfaces/msg/Time"](sec=time // _SECOND, nanosec=time % _SECOND)
        counter = {"seq": 0} if self._is_ros1 else {}
        self._write(
            time,
            _JOINTS,
            "sensor_msgs/msg/JointState",
            header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="", **counter),
            name=list(plan.joints),
            position=values.get("position", empty),
            velocity=values.get("velocity", empty),
            effort=empty,
        )

    def _write(self, time: int, topic: str, kind: str, **fields: Any) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=self._typestore
            )
        message = self._typestore.types[kind](**fields)
        serialize = (
            self._typestore.serialize_ros1 if self._is_ros1 else self._typestore.serialize_cdr
        )
        self._writer.write(self._connections[topic], time, serialize(message, kind))


_MOMENT, _SECOND = 10**6, 10**9  # ns
_LATEST = 2**32 * _SECOND  # that ROS 1 can say


def _record(path: Path, writer: Any, episodes: Iterable[Episode], is_ros1: bool) -> None:
    from rosbags.typesys import Stores, get_typestore

    typestore = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    with writer:
        recorder = _Recorder(writer, typestore, is_ros1)
        for index, episode in enumerate(uniform(path, episodes)):
            with prefixed(f"cannot write {path}: episode_{index}"):
                recorder.episode(episode)


def write_ros1(path: Path, episodes: Iterable[Episode]) -> None:
    """Write episodes as a bag of ROS 1, in a single step.

    Raises
    ------
    MisstepError
        If an episode has no actions, no common dt, or another kind than the first; there is none;
        or the file cannot be written.
    """
    needed("rosbags.highlevel", "a bag", "ros")
    from rosbags.rosbag1 import Writer

    atomic_write(path, lambda temporary: _record(path, Writer(temporary), episodes, True))


def write_ros2(path: Path, episodes: Iterable[Episode]) -> None:
    """Write episodes as a bag of ROS 2, a folder with an SQLite file, in a single step.

    Raises
    ------
    MisstepError
        As `write_ros1`.
    """
    write_folder(path, partial(_fill_ros2, path=path, episodes=episodes, kind="SQLITE3"), recognise)


def write_mcap(path: Path, episodes: Iterable[Episode]) -> None:
    """Write episodes as one MCAP file of ROS 2, in a single step.

    Raises
    ------
    MisstepError
        As `write_ros1`.
    """

    def fill(temporary: Path) -> None:
        folder = temporary.with_name(f"{temporary.name}.folder")
        _fill_ros2(folder, path, episodes, "MCAP")
        (made,) = folder.glob("*.mcap")
        made.replace(temporary)

    atomic_write(path, fill)


def _fill_ros2(folder: Path, path: Path, episodes: Iterable[Episode], kind: str) -> None:
    needed("rosbags.highlevel", "a bag", "ros")
    from rosbags.rosbag2 import StoragePlugin, Writer

    writer = Writer(folder, version=8, storage_plugin=StoragePlugin[kind])
    try:
        _record(path, writer, episodes, False)
    except sqlite3.Error as error:
        raise MisstepError(f"cannot write {path}: {error}") from error
