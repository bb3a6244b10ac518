"""The messages of a bag, and which of their numbers are observations and actions."""

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from misstep.errors import MisstepError
from misstep.formats.bags.cutting import Cutter
from misstep.formats.bags.opening import Unpack
from misstep.formats.bags.places import Place, numbers_below, parse_place
from misstep.formats.bags.topics import ANNOTATIONS
from misstep.formats.format import ReadOptions
from misstep.formats.libraries import library_errors

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

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


@dataclass(frozen=True)
class Layout:
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


class Bag:
    """An open bag, and what the user says about it."""

    def __init__(self, reader: "AnyReader", unpack: Unpack, options: ReadOptions) -> None:
        self._reader, self._unpack, self._options = reader, unpack, options
        self.types = {each.topic: each.msgtype for each in reader.connections}
        if not all(isinstance(text, str) for pair in self.types.items() for text in pair):
            raise MisstepError("a topic or its type has no name: it is damaged")
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
        with library_errors("the number of its messages"):
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
                    content = self._reader.deserialize(self._unpack(data), connection.msgtype)
                time = self._time(time, content)
            yield time, connection.topic, content
            done += 1
            if report and self._options.report is not None and done % 1000 == 0:
                self._options.report(done, max(total, done))

    def _time(self, received: int, content: Any) -> int:
        if not isinstance(received, int):  # SQLite keeps anything anywhere
            raise MisstepError("the time when it was received is no whole number")
        stamp = None if self._stamp is None else self._stamp.found(content)
        seconds, rest = getattr(stamp, "sec", None), getattr(stamp, "nanosec", 0)
        return received if seconds is None else int(seconds) * 10**9 + int(rest)

    def layout(self) -> Layout:
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
        return Layout(observations, actions, tuple(sorted(set(self.types) - used)))

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
        asked_for = {*(self._options.observations or ()), *(self._options.actions or ())}
        missing = {place.topic: _SAMPLES for place in places}
        for _, topic, content in self.messages(missing):
            missing[topic] -= 1
            for place in places if missing[topic] >= 0 else ():
                if place.topic == topic:
                    found[place] |= dict.fromkeys(_known(numbers_below(place, content), content))
            if all(left <= 0 for left in missing.values()):
                break
        for place, numbers in found.items():
            if not numbers and str(place) in asked_for:
                kind = self.types[place.topic]
                raise MisstepError(f"there is no number at {place}: messages there are {kind}")
        return {place: list(numbers) for place, numbers in found.items()}

    def even_step(self, cutter: Cutter, clock_topic: str) -> float | None:
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
