"""Reading bags of ROS 1 and ROS 2; `misstep.formats.bags` says what is taken for what."""

import json
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from itertools import chain, groupby
from operator import attrgetter
from pathlib import Path

from misstep.errors import MisstepError
from misstep.formats.annotation import Annotation, read_annotation
from misstep.formats.bags.clock import Clock
from misstep.formats.bags.cutting import Cutter, Message
from misstep.formats.bags.layout import Bag, Layout
from misstep.formats.bags.opening import opened
from misstep.formats.bags.places import Place, parse_place
from misstep.formats.bags.topics import ANNOTATIONS, COST
from misstep.formats.format import Block, Ending, Episode, Header, ReadOptions
from misstep.formats.libraries import library_errors, needed
from misstep.trajectory import Column, Provenance


def read(path: Path, options: ReadOptions) -> Iterator[Episode]:
    """Read a bag; see `misstep.formats.format.Format`.

    What of ``options`` it heeds: ``observations`` and ``actions``, places as in
    `misstep.formats.bags.places`; ``rate``, of the clock; ``time``, such as ``header.stamp``: a
    field of times that counts, where a message has it, rather than when it was received;
    ``episode``: a place, where every change begins a new episode, or a pause of the observations
    such as ``1.5s``, after which one begins. Pieces without two observations are skipped.

    Raises
    ------
    MisstepError
        If it is damaged, a topic is missing, or nothing in it looks like observations.
    """
    needed("rosbags.highlevel", "a bag", "ros")
    with opened(path) as (reader, unpack):
        bag = Bag(reader, unpack, options)
        says_nothing = all(
            said is None
            for said in (options.observations, options.actions, options.episode, options.rate)
        )
        if ANNOTATIONS in bag.types and says_nothing:
            yield from _our_episodes(bag, options)
        else:
            yield from _episodes(bag, options)


def _episodes(bag: Bag, options: ReadOptions) -> Iterator[Episode]:
    """Yield the episodes of a bag that misstep did not write, or is told how to read."""
    layout = bag.layout()
    clock_topic = layout.observations[0].topic
    dt = 1 / options.rate if options.rate else None
    if dt is None:
        dt = bag.even_step(Cutter(options, clock_topic, False), clock_topic)
    cutter = Cutter(options, clock_topic, False)
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
    layout: Layout, dt: float | None, options: ReadOptions, clock_topic: str, start: int
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

    def __init__(self, layout: Layout, clock_topic: str, rate: float | None) -> None:
        self._clock_topic = clock_topic
        self._clock = Clock(len(layout.observations), len(layout.actions), rate)
        self._observations = _by_topic(layout.observations)
        self._actions = _by_topic(layout.actions)
        self.start = 0  # time of the first message, ns

    def blocks(self, messages: Iterable[Message]) -> Iterator[Block]:
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


def _our_episodes(bag: Bag, options: ReadOptions) -> Iterator[Episode]:
    """Yield the episodes of a bag that misstep wrote."""
    cutter = Cutter(options, "", is_ours=True)
    messages = cutter.passing(bag.messages(bag.types, report=True))
    for _, group in groupby(messages, key=attrgetter("episode")):
        yield _our_episode(group)


def _our_episode(messages: Iterator[Message]) -> Episode:
    annotation, layout = _said_before(str(next(messages).content.data))
    said_after: list[Annotation] = []

    def within() -> Iterator[Message]:
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


def _said_before(text: str) -> tuple[Annotation, Layout]:
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
    return annotation, Layout(observations, actions)
