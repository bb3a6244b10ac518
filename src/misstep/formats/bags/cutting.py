"""Where one episode of a bag ends and the next begins."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from misstep.errors import MisstepError
from misstep.formats.bags.places import parse_place
from misstep.formats.bags.topics import ANNOTATIONS
from misstep.formats.format import ReadOptions


@dataclass(frozen=True)
class Message:
    """One message of one topic; the content is None where nobody needs it."""

    episode: int
    time: int
    topic: str
    content: Any


class Cutter:
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

    def passing(self, messages: Iterable[tuple[int, str, Any]]) -> Iterator[Message]:
        """Yield the messages that belong to an episode."""
        for time, topic, content in messages:
            if self._is_ours and topic == ANNOTATIONS and _begins(content):
                self._episode, self._within = self._episode + 1, True
            elif not self._is_ours and self._cuts(time, topic, content):
                self._episode += 1
            if self._within:
                yield Message(self._episode, time, topic, content)
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
