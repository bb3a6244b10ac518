"""Messages that come when they like, brought to one clock.

What was seen is interpolated linearly between the messages around each tick of the clock, which is
exact where the clock is that of the messages themselves. What was commanded is held until the next
command; of each step, the command in force in its middle counts, since a controller answers a
little after what it saw. Only what is still needed is kept.
"""

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.formats.format import BLOCK_ROWS, Block, FloatArray

_LONGEST_WAIT = 16 * BLOCK_ROWS  # ticks, for a topic that has fallen silent

_LONGEST_PAUSE = 10**6  # ticks without a message
_SILENCE = 2.0  # pauses of a topic, the longest, after which it has fallen silent

_Nanoseconds = int


class _Track:
    """The samples of one column that are still needed."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._values: list[float] = []
        self.longest = 0.0  # s between two samples

    @property
    def last(self) -> float:
        """Time of the last sample, s."""
        return self._times[-1] if self._times else -np.inf

    def add(self, time: float, value: float) -> bool:
        """Add a sample; return whether it was later than the last one, as it has to be."""
        if time <= self.last:
            return False
        if self._times:
            self.longest = max(self.longest, time - self._times[-1])
        self._times.append(time)
        self._values.append(value)
        return True

    def interpolated(self, ticks: FloatArray) -> FloatArray:
        if not self._times:
            return np.full(len(ticks), np.nan)
        values: FloatArray = np.interp(ticks, self._times, self._values, left=np.nan)
        return values

    def held(self, ticks: FloatArray) -> FloatArray:
        places = np.searchsorted(self._times, ticks, side="right") - 1
        values = np.array([np.nan, *self._values])
        return values[places + 1]

    def forget(self, before: float) -> None:
        """Drop what no tick at or after `before` needs."""
        keep = max(0, int(np.searchsorted(self._times, before, side="right")) - 1)
        del self._times[:keep], self._values[:keep]


class Clock:
    """Brings the messages of one episode to one clock, block by block.

    Parameters
    ----------
    n_observations, n_actions : int
    rate : float or None, Hz
        Of the clock; None: it ticks where `tick` says.

    Attributes
    ----------
    left_out : int
        Ticks at the start, before every column had its first message.
    ignored : int
        Samples that were not later than the one before them.
    held : bool
        Whether a topic fell silent so long, on the way or at the end, that its last observation was
        held.
    """

    def __init__(self, n_observations: int, n_actions: int, rate: float | None) -> None:
        self._observations = [_Track() for _ in range(n_observations)]
        self._actions = [_Track() for _ in range(n_actions)]
        self._costs = _Track()
        self._rate = rate
        self._zero: _Nanoseconds | None = None
        self._ticks: list[float] = []
        self._count = 0  # ticks so far, at a rate
        self._enough = BLOCK_ROWS
        self._begun = False
        self._first_tick = 0.0
        self.left_out = self.ignored = 0
        self.held = False

    def observe(self, column: int, time: _Nanoseconds, value: float) -> None:
        """Add a sample of an observation."""
        self.ignored += not self._observations[column].add(self._seconds(time), value)

    def command(self, column: int, time: _Nanoseconds, value: float) -> None:
        """Add a sample of an action."""
        self.ignored += not self._actions[column].add(self._seconds(time), value)

    def charge(self, time: _Nanoseconds, value: float) -> None:
        """Add the cost of a step."""
        self.ignored += not self._costs.add(self._seconds(time), value)

    def tick(self, time: _Nanoseconds) -> None:
        """Let the clock tick, or, where it has a rate, up to this time."""
        now = self._seconds(time)
        if self._rate is None:
            if not self._ticks or now > self._ticks[-1]:
                self._ticks.append(now)
            return
        if self._count == 0:
            self._first_tick = now
        if (now - self._ticks[-1] if self._ticks else 0.0) * self._rate > _LONGEST_PAUSE:
            raise MisstepError(
                f"a pause of {now - self._ticks[-1]:g} s: let pauses begin new episodes, with "
                "--episode 10s"
            )
        # A billionth of a step off the last message is on it.
        while (at := self._first_tick + self._count / self._rate) <= now + 1e-9 / self._rate:
            self._ticks.append(min(at, now))
            self._count += 1

    @property
    def has_block(self) -> bool:
        """Whether there are enough ticks for a block."""
        return len(self._ticks) > self._enough

    def block(self) -> Block | None:
        """Return what is complete: all but the last tick, at most."""
        ready = min(track.last for track in self._observations)
        count = int(np.searchsorted(self._ticks[:-1], ready, side="right"))
        if len(self._ticks) > _LONGEST_WAIT:
            count, self.held = len(self._ticks) - 1, True
        self._enough = len(self._ticks) - count + BLOCK_ROWS
        return self._emitted(count, is_last=False)

    def last_block(self) -> Block | None:
        """Return what is left, when no message comes any more."""
        if not self._ticks:
            return None
        end = self._ticks[-1]
        self.held |= any(t.last + _SILENCE * t.longest < end for t in self._observations)
        return self._emitted(len(self._ticks), is_last=True)

    def _seconds(self, time: _Nanoseconds) -> float:
        if self._zero is None:
            self._zero = time
        return (time - self._zero) * 1e-9

    def _emitted(self, count: int, is_last: bool) -> Block | None:
        if count == 0:
            return None
        ticks = np.array(self._ticks[: count + 1])
        steps = len(ticks) - 1 if is_last else count
        middles = (ticks[:steps] + ticks[1 : steps + 1]) / 2
        seen = np.stack([track.interpolated(ticks[:count]) for track in self._observations], axis=1)
        held = [track.held(middles) for track in self._actions]
        done = np.stack(held, axis=1) if held else np.empty((0, 0))
        costs = self._costs.held(middles) if self._costs.last > -np.inf else None
        del self._ticks[:count]
        if self._ticks:
            for track in (*self._observations, *self._actions, self._costs):
                track.forget(self._ticks[0])
        start = 0 if self._begun else self._beginning(seen, done)
        self.left_out += start
        if start == count:
            return None
        times = ticks[start:count]
        if not self._begun:
            self._begun, self._start = True, float(times[0])
        return Block(
            seen[start:],
            done[start:],
            None if costs is None else costs[start:],
            times - self._start,
        )

    def _beginning(self, seen: FloatArray, done: FloatArray) -> int:
        """Return the first row in which every column has a value."""
        complete: NDArray[np.bool_] = np.logical_not(np.isnan(seen).any(axis=1))
        complete[: len(done)] &= ~np.isnan(done).any(axis=1)
        return int(np.argmax(complete)) if complete.any() else len(complete)
