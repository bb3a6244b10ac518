"""Rows that carry times of their own are brought to one clock.

Rows that keep to a clock pass as they are, to the last bit. From the first row on that does not,
observations are interpolated linearly between the rows around each tick of the clock, and actions,
which hold from their row to the next, are averaged from tick to tick; a note says so.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain

import numpy as np

from misstep.errors import MisstepError
from misstep.formats.blocks import aligned, followed
from misstep.formats.format import Block, Ending, Episode, FloatArray
from misstep.recordings.angles import Turns

STILL_EVEN = 0.01
"""Share of dt by which a row may be off the clock and still counts as on it."""
LONGEST_GAP = 5.0
"""Intervals, in dt, that may pass between two rows; over a longer gap nothing is made up."""

_WHOLE = 1e-3  # a rate this near to a whole number of Hz is that number
_ROUNDING = 1e-9  # of a tick
_MARKS = 64  # rows between two of which it is remembered when they were


def on_one_clock(episode: Episode, rate: float | None = None) -> Episode:
    """Return the episode with rows at even times.

    Parameters
    ----------
    episode : Episode
        Returned as it is if its header has a dt.
    rate : float or None, Hz
        Of the clock; by default the rate of the first block of rows.

    Raises
    ------
    MisstepError
        If there are too few rows to tell the rate; on the way, if two rows are further apart than
        `LONGEST_GAP` intervals.
    """
    if episode.header.dt is not None:
        return episode
    blocks = aligned(episode.blocks, has_actions=bool(episode.header.action_columns))
    first = next(blocks)
    if len(first.observations) < 2:
        rest = next(blocks, None)
        first = first if rest is None else followed(first, rest)
    dt = 1.0 / rate if rate is not None else _dt_of(_times(first))
    clock = _Clock(episode, dt, chain([first], blocks))
    return replace(
        episode,
        header=replace(episode.header, dt=dt),
        blocks=clock.blocks(),
        ending=clock.ending,
        where=lambda row: f"time {row * dt:.6g} s",
    )


def _times(block: Block) -> FloatArray:
    return np.empty(0) if block.times is None else block.times


def _dt_of(times: FloatArray) -> float:
    if len(times) < 2:
        raise MisstepError("there are too few rows to tell their rate: give --rate")
    median = float(np.median(np.diff(times)))
    mean = float(times[-1] - times[0]) / (len(times) - 1)
    rate = 1.0 / (mean if abs(mean - median) < STILL_EVEN * median else median)
    whole = round(rate)
    return 1.0 / (whole if whole and abs(rate - whole) < _WHOLE * whole else rate)


class _Clock:
    """Brings the rows of one episode to even times, block by block."""

    def __init__(self, episode: Episode, dt: float, source: Iterator[Block]) -> None:
        self._episode, self._dt, self._source = episode, dt, source
        self._turns = Turns(episode.header.observation_columns)
        self._start: float | None = None
        self._rows = 0  # that came in
        self._tick = self._action_tick = 0  # the next ones to go out
        self._kept: Block | None = None  # rows from before the next tick on, angles unwrapped
        self._is_even = True
        self._marks: list[tuple[int, float]] = []  # row and time
        self._worst = 0.0  # how far a row was off the clock, in s

    def blocks(self) -> Iterator[Block]:
        """Yield the rows at the ticks of the clock."""
        for block in self._source:
            if len(_times(block)):
                yield self._passed(self._relative(block))

    def ending(self) -> Ending:
        """Return the ending with its step counted in ticks, and a note if rows were changed."""
        ending = self._episode.ending()
        if self._is_even:
            return ending
        note = (
            f"times: interpolated to a clock of {1.0 / self._dt:.6g} Hz, from which they were off "
            f"by up to {1e3 * self._worst:.3g} ms"
        )
        step = ending.failure_step
        if step is not None:
            rows, times = zip(*self._marks, strict=True)
            time = float(np.interp(step, rows, times))
            step = min(int(np.ceil(time / self._dt - STILL_EVEN)), self._tick - 1)
        return Ending(ending.outcome, step, (*ending.notes, note))

    def _relative(self, block: Block) -> Block:
        """Return the block with times from the start, and its angles unwrapped."""
        if self._start is None:
            self._start = float(_times(block)[0])
        times = _times(block) - self._start
        for i in {*range(-self._rows % _MARKS, len(times), _MARKS), len(times) - 1}:
            self._marks.append((self._rows + i, float(times[i])))
        self._marks.sort()
        off = np.abs(times - self._dt * np.arange(self._rows, self._rows + len(times)))
        self._is_even = self._is_even and bool((off <= STILL_EVEN * self._dt).all())
        nearest = np.abs(times / self._dt - np.round(times / self._dt)) * self._dt
        self._worst = max(self._worst, float(nearest.max()))
        self._check_gaps(times)
        self._rows += len(times)
        return replace(block, times=times)

    def _check_gaps(self, times: FloatArray) -> None:
        before = times[:1] if self._kept is None else _times(self._kept)[-1:]
        steps = np.diff(times, prepend=before)
        if steps.max() > LONGEST_GAP * self._dt:
            row = int(np.argmax(steps > LONGEST_GAP * self._dt))
            raise MisstepError(
                f"{self._episode.where(self._rows + row)}: {steps[row]:.6g} s have passed since "
                f"the row before, but {self._dt:.6g} s are usual: over a gap of more than "
                f"{LONGEST_GAP:g} rows nothing is made up; cut the recording there"
            )

    def _passed(self, block: Block) -> Block:
        whole = replace(block, observations=self._turns.unwrap(block.observations))
        if self._is_even:
            self._tick += len(block.observations)
            self._action_tick += len(block.observations)
            self._kept = _rows_from(whole, -1)
            return replace(block, times=None)
        if self._kept is not None:
            whole = followed(self._kept, whole)
        times = _times(whole)
        last = int(np.floor(times[-1] / self._dt + _ROUNDING))  # the last tick that is over
        ticks = np.arange(self._tick, last + 1) * np.float64(self._dt)
        edges = np.arange(self._action_tick, last + 1) * np.float64(self._dt)
        made = Block(
            self._turns.rewrap(_interpolated(ticks, times, whole.observations)),
            _averaged(edges, times, whole.actions),
            None if whole.costs is None else _averaged(edges, times, whole.costs[:, None])[:, 0],
        )
        self._tick, self._action_tick = max(self._tick, last + 1), max(self._action_tick, last)
        before = int(np.searchsorted(times, self._dt * self._action_tick, side="right")) - 1
        self._kept = _rows_from(whole, max(before, 0))
        return made


def _rows_from(block: Block, start: int) -> Block:
    costs = None if block.costs is None else block.costs[start:]
    return Block(block.observations[start:], block.actions[start:], costs, _times(block)[start:])


def _interpolated(ticks: FloatArray, times: FloatArray, table: FloatArray) -> FloatArray:
    columns = [np.interp(ticks, times, column) for column in table.T]
    return np.stack(columns, axis=1) if columns else np.empty((len(ticks), 0))


def _averaged(edges: FloatArray, times: FloatArray, table: FloatArray) -> FloatArray:
    """Return the means, from edge to edge, of what holds from its row to the next one."""
    held = table[: len(times) - 1]
    if not table.shape[1] or len(edges) < 2:
        return np.empty((max(0, len(edges) - 1) if table.shape[1] else 0, table.shape[1]))
    sums = np.concatenate(
        [np.zeros((1, table.shape[1])), np.cumsum(held * np.diff(times)[:, None], axis=0)]
    )
    return np.diff(_interpolated(edges, times, sums), axis=0) / np.diff(edges)[:, None]
