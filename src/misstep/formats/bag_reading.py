"""Reading bags of ROS 1 and ROS 2; `misstep.formats.rosbag` says what is taken for what."""

import bz2
import json
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import chain, groupby
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from misstep.errors import MisstepError
from misstep.formats.annotation import Annotation, read_annotation
from misstep.formats.bag_clock import Clock
from misstep.formats.bag_library import ANNOTATIONS, COST, installed, library_errors
from misstep.formats.bag_places import Place, numbers_below, parse_place
from misstep.formats.format import Block, Ending, Episode, Header, ReadOptions
from misstep.trajectory import Column, Provenance

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

_LARGEST_CHUNK = 2**28  # bytes, unpacked
_LARGEST_YAML = 2**24  # bytes
_LONGEST_ARRAY = 2**24  # elements
_SAMPLES = 20  # messages of a topic in which its numbers are looked for
_EVENNESS = 1e-3  # of dt, by which the times of an even clock may differ

# What is observed and what is commanded, if nobody says so: the fields that matter.
_OBSERVED = {
    "sensor_msgs/msg/JointState": ("position", "velocity"),
    "nav_msgs/msg/Odometry": ("pose.pose", "twist.twist"),
    "sensor_msgs/msg/Imu": ("orientation", "angular_velocity", "linear_acceleration"),
    "geometry_msgs/msg/Pose": ("position", "orientation"),
    "geometry_msgs/msg/PoseStamped": ("pose",),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("pose.pose",),
    "geometry_msgs/msg/TransformStamped": ("transform",),
}
_COMMANDED = {
    "std_msgs/msg/Float64": ("data",),
    "std_msgs/msg/Float32": ("data",),
    "std_msgs/msg/Float64MultiArray": ("data",),
    "std_msgs/msg/Float32MultiArray": ("data",),
    "geometry_msgs/msg/Twist": ("linear", "angular"),
    "geometry_msgs/msg/TwistStamped": ("twist",),
    "geometry_msgs/msg/Wrench": ("force", "torque"),
    "geometry_msgs/msg/WrenchStamped": ("wrench",),
}
_SOUNDS_COMMANDED = re.compile(r"command|cmd|control_input|desired|setpoint", re.IGNORECASE)


# Messages


@dataclass(frozen=True)
class _Message:
    """One message of one topic; the content is None where nobody needs it."""

    episode: int
    time: int
    topic: str
    content: Any


@contextmanager
def _opened(path: Path) -> Iterator["AnyReader"]:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    metadata = path / "metadata.yaml"
    if metadata.is_file() and metadata.stat().st_size > _LARGEST_YAML:
        raise MisstepError("metadata.yaml is too large to be one")
    with library_errors("it"):
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    try:
        with library_errors("it"):
            reader.typestore.max_sequence_length = _LONGEST_ARRAY
            for part in reader.readers:
                _bound(part)
        yield reader
    finally:
        with library_errors("it"):
            reader.close()


def _bound(part: Any) -> None:
    """Keep a few kilobytes from being unpacked into as much memory as they claim."""
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2.storage_mcap import McapReader

    if isinstance(part, Reader1):
        for place, chunk in part.chunks.items():
            if chunk.decompressor is bz2.decompress:
                part.chunks[place] = chunk._replace(decompressor=_unpack_bz2)
            elif chunk.datasize > _LARGEST_CHUNK:
                raise MisstepError(f"a chunk of {chunk.datasize} bytes is too large")
        return
    for storage in getattr(part.storage, "storages", [part.storage]):
        for info in storage.chunks if isinstance(storage, McapReader) else ():
            if max(info.uncompressed_size, info.compressed_size) > _LARGEST_CHUNK:
                raise MisstepError(f"a chunk of {info.uncompressed_size} bytes is too large")


def _unpack_bz2(packed: bytes) -> bytes:
    plain = bz2.BZ2Decompressor().decompress(packed, _LARGEST_CHUNK + 1)
    if len(plain) > _LARGEST_CHUNK:
        raise MisstepError("a chunk is too large when it is unpacked")
    return plain


class _Cutter:
    """Numbers messages by the episode that they belong to.

    Where misstep wrote the bag, an episode goes from one of its messages to the next; else the
    whole bag is one, or ends where `ReadOptions` says.
    """

    def __init__(self, options: ReadOptions, clock_topic: str, is_ours: bool) -> None:
        self._clock_topic, self._is_ours = clock_topic, is_ours
        self._gap = _pause(options.episode)
        is_place = options.episode is not None and self._gap is None
        self._place = parse_place(str(options.episode)) if is_place else None
        self._episode = 0
        self._within = not is_ours
        self._last: int | None = None
        self._value: Any = None

    @property
    def topics(self) -> set[str]:
        """The topics that say where an episode ends."""
        return ({ANNOTATIONS} if self._is_ours else set()) | (
            {self._place.topic} if self._place else set()
        )

    def passing(self, messages: Iterable[tuple[int, str, Any]]) -> Iterator[_Message]:
        """Yield the messages that belong to an episode."""
        for time, topic, content in messages:
            if self._is_ours and topic == ANNOTATIONS and _begins(content):
                self._episode, self._within = self._episode + 1, True
            elif not self._is_ours and self._cuts(time, topic, content):
                self._episode += 1
            if self._within:
                yield _Message(self._episode, time, topic, content)
            if self._is_ours and topic == ANNOTATIONS and not _begins(content):
                self._within = False

    def _cuts(self, time: int, topic: str, content: Any) -> bool:
        cuts = False
        if self._place is not None and topic == self._place.topic:
            value = self._place.found(content)
            if not isinstance(value, str | int | float | np.generic):
                raise MisstepError(f"{self._place} is no single number or text to cut at")
            cuts = self._value is not None and value != self._value
            self._value = value
        if topic == self._clock_topic:
            if self._gap is not None and self._last is not None:
                cuts |= time - self._last > self._gap
            self._last = time
        return cuts


def _pause(text: str | None) -> int | None:
    """Return a pause such as ``1.5s`` in ns; None for whatever else is said of episodes."""
    match = re.fullmatch(r"(\d{1,9}(\.\d{1,9})?) ?s", text or "")
    return round(float(match[1]) * 1e9) if match else None


def _begins(content: Any) -> bool:
    return str(getattr(content, "data", "")).startswith('{"begins"')


# Which places


@dataclass(frozen=True)
class _Layout:
    """Which columns are read, and what is not.

    Parameters
    ----------
    observations, actions : tuple of Place
    left_out : tuple of str
        Topics.
    """

    observations: tuple[Place, ...]
    actions: tuple[Place, ...]
    left_out: tuple[str, ...] = ()

    @property
    def topics(self) -> set[str]:
        """The topics whose messages are needed."""
        return {place.topic for place in (*self.observations, *self.actions)}


class _Bag:
    """An open bag, and what the user says about it."""

    def __init__(self, reader: "AnyReader", options: ReadOptions) -> None:
        self._reader, self._options = reader, options
        self.types = {each.topic: each.msgtype for each in reader.connections}
        self._stamp = None if options.time is None else parse_place(f"/any.{options.time}")

    def messages(
        self, topics: Iterable[str], needed: Iterable[str] | None = None, report: bool = False
    ) -> Iterator[tuple[int, str, Any]]:
        """Yield time [ns], topic and content of all messages of some topics, in their order.

        The content is None, which saves time, unless its topic is `needed`; by default all are.
        """
        wanted = set(topics)
        connections = [each for each in self._reader.connections if each.topic in wanted]
        if not connections:
            return
        is_needed = wanted if needed is None or self._stamp else set(needed)
        total = sum(each.msgcount for each in connections)
        raw = self._reader.messages(connections)
        done = 0
        while True:
            with library_errors(f"message {done}"):
                found = next(raw, None)
                if found is None:
                    return
                connection, time, data = found
                content = None
                if connection.topic in is_needed:
                    content = self._reader.deserialize(data, connection.msgtype)
            yield self._time(time, content), connection.topic, content
            done += 1
            if report and self._options.report is not None and done % 1000 == 0:
                self._options.report(done, max(total, done))

    def _time(self, received: int, content: Any) -> int:
        stamp = None if self._stamp is None else self._stamp.found(content)
        seconds, rest = getattr(stamp, "sec", None), getattr(stamp, "nanosec", 0)
        return received if seconds is None else int(seconds) * 10**9 + int(rest)

    def layout(self) -> _Layout:
        """Return the columns that the user names, or else those that look like it.

        Raises
        ------
        MisstepError
            If there are none.
        """
        options = self._options
        observed, commanded = self._usual()
        if options.observations is not None:
            observed = [parse_place(text) for text in options.observations]
            named = {place.topic for place in observed}
            commanded = [place for place in commanded if place.topic not in named]
        if options.actions is not None:
            commanded = [parse_place(text) for text in options.actions]
            named = {place.topic for place in commanded}
            if options.observations is None:
                observed = [place for place in observed if place.topic not in named]
        for place in (*observed, *commanded):
            if place.topic not in self.types:
                raise MisstepError(f"there is no topic {place.topic}; there are: {self._listing()}")
        numbers = self._numbers([*observed, *commanded])
        observations, actions = (
            tuple(each for place in places for each in numbers[place])
            for places in (observed, commanded)
        )
        if not observations:
            raise MisstepError(
                "nothing in it looks like observations: name them with --observations "
                f"/topic.field,...; there are: {self._listing()}"
            )
        used = {place.topic for place in (*observations, *actions)}
        return _Layout(observations, actions, tuple(sorted(set(self.types) - used)))

    def _listing(self) -> str:
        topics = sorted(self.types.items())
        listed = ", ".join(f"{topic} ({kind})" for topic, kind in topics[:20])
        return (listed or "none") + (" ..." if len(topics) > 20 else "")

    def _usual(self) -> tuple[list[Place], list[Place]]:
        """Return what is usually observed and commanded."""
        sounds = {topic for topic in self.types if _SOUNDS_COMMANDED.search(topic)}
        observed: list[Place] = []
        commanded: list[Place] = []
        commands = {topic for topic in self.types if self.types[topic] in _COMMANDED}
        for topic, kind in sorted(self.types.items()):
            if topic.startswith(ANNOTATIONS):
                continue
            if kind in _OBSERVED:
                places = [parse_place(f"{topic}.{way}") for way in _OBSERVED[kind]]
                (commanded if topic in sounds else observed).extend(places)
            elif kind in _COMMANDED and (topic in sounds or not commands & sounds):
                commanded += [parse_place(f"{topic}.{way}") for way in _COMMANDED[kind]]
        return observed, commanded

    def _numbers(self, places: Sequence[Place]) -> dict[Place, list[Place]]:
        """Return all numbers below each place, as the first messages of its topic have them."""
        found: dict[Place, dict[Place, None]] = {place: {} for place in places}
        missing = {place.topic: _SAMPLES for place in places}
        for _, topic, content in self.messages(missing):
            missing[topic] -= 1
            for place in places if missing[topic] >= 0 else ():
                if place.topic == topic:
                    found[place] |= dict.fromkeys(_known(numbers_below(place, content), content))
            if all(left <= 0 for left in missing.values()):
                break
        for place, numbers in found.items():
            named = str(place) in (*(self._options.observations or ()), *self._named_actions())
            if not numbers and named:
                kind = self.types[place.topic]
                raise MisstepError(f"there is no number at {place}: messages there are {kind}")
        return {place: list(numbers) for place, numbers in found.items()}

    def _named_actions(self) -> tuple[str, ...]:
        return self._options.actions or ()

    def even_step(self, cutter: _Cutter, clock_topic: str) -> float | None:
        """Return the time between messages of the clock's topic, s; None if they are uneven."""
        last, episode, steps, total = 0, -1, 0, 0
        shortest, longest = math.inf, 0
        topics = cutter.topics | {clock_topic}
        for message in cutter.passing(self.messages(topics, needed=cutter.topics)):
            if message.topic != clock_topic:
                continue
            step = message.time - last
            last = message.time
            if message.episode == episode and step > 0:
                steps, total = steps + 1, total + step
                shortest, longest = min(shortest, step), max(longest, step)
            episode = message.episode
        if steps == 0 or longest - shortest > _EVENNESS * total / steps + 2:
            return None
        return round(total / steps) * 1e-9


def _known(places: Iterable[Place], content: Any) -> Iterator[Place]:
    """Yield those places where there is more than NaN, as joints have without a velocity."""
    for place in places:
        value = place.value(content)
        if value is not None and not math.isnan(value):
            yield place


# Episodes


def read(path: Path, options: ReadOptions) -> Iterator[Episode]:
    """Read a bag; see `misstep.formats.format.Format`.

    What of ``options`` it heeds: ``observations`` and ``actions``, places as in
    `misstep.formats.bag_places`; ``rate``, of the clock; ``time``, such as ``header.stamp``: a
    field of times that counts, where a message has it, rather than when it was received;
    ``episode``: a place, where every change begins a new episode, or a pause of the observations
    such as ``1.5s``, after which one begins. Pieces without two observations are skipped.

    Raises
    ------
    MisstepError
        If it is damaged, a topic is missing, or nothing in it looks like observations.
    """
    installed()
    with _opened(path) as reader:
        bag = _Bag(reader, options)
        says_nothing = all(
            said is None
            for said in (options.observations, options.actions, options.episode, options.rate)
        )
        if ANNOTATIONS in bag.types and says_nothing:
            yield from _our_episodes(bag, options)
        else:
            yield from _episodes(bag, options)


def _episodes(bag: _Bag, options: ReadOptions) -> Iterator[Episode]:
    """Yield the episodes of a bag that misstep did not write, or is told how to read."""
    layout = bag.layout()
    clock_topic = layout.observations[0].topic
    dt = 1 / options.rate if options.rate else None
    if dt is None:
        dt = bag.even_step(_Cutter(options, clock_topic, False), clock_topic)
    cutter = _Cutter(options, clock_topic, False)
    messages = cutter.passing(bag.messages(layout.topics | cutter.topics, report=True))
    count = 0
    for _, group in groupby(messages, key=attrgetter("episode")):
        rows = _Rows(layout, clock_topic, options.rate)
        blocks = rows.blocks(group)
        beginning = _beginning(blocks)
        if options.episode is not None and sum(len(block.observations) for block in beginning) < 2:
            continue
        count += 1
        header = _header(layout, dt, options, clock_topic, rows.start)
        yield Episode(header, _timed(chain(beginning, blocks), dt), rows.ending)
    if count == 0:
        raise MisstepError("there is no time at which every column has a value")


def _beginning(blocks: Iterator[Block]) -> list[Block]:
    """Return blocks with two observations, if there are as many."""
    beginning: list[Block] = []
    while sum(len(block.observations) for block in beginning) < 2:
        block = next(blocks, None)
        if block is None:
            break
        beginning.append(block)
    return beginning


def _timed(blocks: Iterable[Block], dt: float | None) -> Iterator[Block]:
    """Drop the times of rows, where there is a common dt."""
    for block in blocks:
        yield block if dt is None else Block(block.observations, block.actions, block.costs)


def _header(
    layout: _Layout, dt: float | None, options: ReadOptions, clock_topic: str, start: int
) -> Header:
    notes = []
    interpolated = {place.topic for place in layout.observations} - {clock_topic}
    if options.rate:
        notes.append(f"observations interpolated linearly to {options.rate:g} Hz")
    elif interpolated:
        listed = ", ".join(sorted(interpolated))
        notes.append(f"{listed} interpolated linearly to the times of {clock_topic}")
    if layout.actions:
        notes.append("actions: the command in force in the middle of each step")
    if layout.left_out:
        notes.append("topics left out: " + ", ".join(layout.left_out))
    # Clocks that start at zero say nothing about when it was.
    told = 10**18 < start < 4 * 10**18
    time = datetime.fromtimestamp(start * 1e-9, UTC).isoformat() if told else ""
    return Header(
        dt,
        tuple(Column(str(place), "") for place in layout.observations),
        tuple(Column(str(place), "") for place in layout.actions),
        Provenance("", {}, "", None, time, tuple(notes)),
    )


class _Rows:
    """Turns the messages of one episode into blocks."""

    def __init__(self, layout: _Layout, clock_topic: str, rate: float | None) -> None:
        self._clock_topic = clock_topic
        self._clock = Clock(len(layout.observations), len(layout.actions), rate)
        self._observations = _by_topic(layout.observations)
        self._actions = _by_topic(layout.actions)
        self.start = 0  # time of the first message, ns

    def blocks(self, messages: Iterable[_Message]) -> Iterator[Block]:
        """Yield the rows of the episode."""
        clock = self._clock
        for message in messages:
            self.start = self.start or message.time
            for column, place in self._observations.get(message.topic, ()):
                if (value := place.value(message.content)) is not None:
                    clock.observe(column, message.time, value)
            for column, place in self._actions.get(message.topic, ()):
                if (value := place.value(message.content)) is not None:
                    clock.command(column, message.time, value)
            if message.topic == COST and (cost := _DATA.value(message.content)) is not None:
                clock.charge(message.time, cost)
            if message.topic == self._clock_topic:
                clock.tick(message.time)
                if clock.has_block and (block := clock.block()) is not None:
                    yield block
        if (block := clock.last_block()) is not None:
            yield block

    def ending(self) -> Ending:
        """Return what was found on the way."""
        clock, notes = self._clock, []
        if clock.left_out:
            notes.append(
                f"{clock.left_out} observations at the start left out: not every column had had a "
                "message"
            )
        if clock.ignored:
            notes.append(f"{clock.ignored} values ignored that were not later than the one before")
        if clock.held:
            notes.append("a topic fell silent: its last observation was held")
        return Ending(notes=tuple(notes))


_DATA = parse_place(f"{COST}.data")


def _by_topic(places: Sequence[Place]) -> dict[str, list[tuple[int, Place]]]:
    found: dict[str, list[tuple[int, Place]]] = {}
    for column, place in enumerate(places):
        found.setdefault(place.topic, []).append((column, place))
    return found


def _our_episodes(bag: _Bag, options: ReadOptions) -> Iterator[Episode]:
    """Yield the episodes of a bag that misstep wrote."""
    cutter = _Cutter(options, "", is_ours=True)
    messages = cutter.passing(bag.messages(bag.types, report=True))
    for _, group in groupby(messages, key=attrgetter("episode")):
        yield _our_episode(group)


def _our_episode(messages: Iterator[_Message]) -> Episode:
    annotation, layout = _said_before(str(next(messages).content.data))
    said_after: list[Annotation] = []

    def within() -> Iterator[_Message]:
        for message in messages:
            if message.topic != ANNOTATIONS:
                yield message
                continue
            with library_errors("what misstep says after an episode"):
                said_after.append(read_annotation(json.loads(message.content.data)["ends"]))

    rows = _Rows(layout, layout.observations[0].topic, None)
    return Episode(
        annotation.header,
        _timed(rows.blocks(within()), annotation.header.dt),
        ending=lambda: said_after[-1].ending if said_after else Ending(),
    )


def _said_before(text: str) -> tuple[Annotation, _Layout]:
    with library_errors("what misstep says before an episode"):
        said = json.loads(text)
        annotation = read_annotation(said["begins"])
        observations, actions = (
            tuple(parse_place(str(place)) for place in said[kind])
            for kind in ("observations", "actions")
        )
    header = annotation.header
    widths = len(header.observation_columns), len(header.action_columns)
    if widths != (len(observations), len(actions)) or not observations:
        raise MisstepError("misstep's annotation names other columns than there are")
    return annotation, _Layout(observations, actions)
