"""Another rate, without what the lower rate cannot show.

Observations pass through a low-pass filter before rows are left out, or a vibration at 70 Hz would
come out of a recording at 50 Hz as one of 20 Hz. The filter is symmetric, so that nothing is
delayed: a sinc with its cutoff below half the lower rate, in a Kaiser window of 12 periods on
either side. Evaluated at the new times directly, it serves every pair of rates, up or down
(Oppenheim and Schafer, Discrete-Time Signal Processing, 7.6). At the ends a recording is continued
by its reflection through the last point.

Actions hold over their step, so the action of a new step is their mean over it; the same goes for
costs.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction

import numpy as np

from misstep.errors import MisstepError
from misstep.formats.format import Block, Ending, Episode, FloatArray
from misstep.recordings.angles import Turns

HALF_WIDTH = 12
"""Periods of the lower rate that the filter reaches to either side."""
CUTOFF = 0.41
"""Cutoff, in units of the lower rate: what lies above half of it is down by 70 dB."""

_BETA = 6.76  # of the Kaiser window, for 70 dB
_SAME = 1e-9  # relative difference of two rates that are one
_MOST_PHASES = 1000
_BATCH = 2**19  # numbers that are worked on at a time


def at_rate(episode: Episode, rate: float | None) -> Episode:
    """Return the episode at another rate.

    Parameters
    ----------
    episode : Episode
        On one clock.
    rate : float or None, Hz
        None: as it is.

    Raises
    ------
    MisstepError
        If the rate is not positive, or the rows are not on one clock.
    """
    if rate is None:
        return episode
    if not 0 < rate < math.inf:
        raise MisstepError(f"--to-rate is {rate:g}: it has to be positive, in Hz")
    dt = episode.header.dt
    if dt is None:
        raise MisstepError("its rows have uneven times: bring them to one clock first")
    if abs(dt * rate - 1.0) < _SAME:
        return episode
    resampler = _Resampler(episode, dt, rate)
    return replace(
        episode,
        header=replace(episode.header, dt=1.0 / rate),
        blocks=resampler.blocks(),
        ending=resampler.ending,
        where=lambda row: f"time {row / rate:.6g} s",
    )


class _Resampler:
    """Brings the rows of one episode to another rate, block by block."""

    def __init__(self, episode: Episode, dt: float, rate: float) -> None:
        self._episode, self._dt, self._rate = episode, dt, rate
        exact = 1.0 / (dt * rate)
        near = Fraction(exact).limit_denominator(_MOST_PHASES)
        self._ratio = near if abs(near - exact) < _SAME * exact else Fraction(exact)
        self._turns = Turns(episode.header.observation_columns)
        self._filter = _Filter(self._ratio, len(episode.header.observation_columns))
        self._means: _Means | None = None
        self._n_out = 0

    def blocks(self) -> Iterator[Block]:
        """Yield the rows at the new rate."""
        m = len(self._episode.header.action_columns)
        has_costs = False
        for block in self._episode.blocks:
            if self._means is None:
                has_costs = block.costs is not None
                self._means = _Means(self._ratio, m + has_costs)
            rows = self._filter.add(self._turns.unwrap(block.observations))
            yield self._block(rows, self._means.add(_beside(block, m, has_costs)), m, has_costs)
        # No mean is left over at the end: a step that is not over is not taken.
        yield self._block(self._filter.finish(), np.empty((0, m + has_costs)), m, has_costs)

    def _block(self, rows: FloatArray, means: FloatArray, m: int, has_costs: bool) -> Block:
        self._n_out += len(rows)
        costs = means[:, m] if has_costs else None
        return Block(self._turns.rewrap(rows), means[:, :m] if m else np.empty((0, 0)), costs)

    def ending(self) -> Ending:
        """Return the ending with its step counted at the new rate, and a note on the change."""
        ending, step = self._episode.ending(), None
        if ending.failure_step is not None:
            step = min(math.ceil(ending.failure_step / self._ratio), self._n_out - 1)
        return replace(ending, failure_step=step, notes=(*ending.notes, self._note()))

    def _note(self) -> str:
        note = f"rate: from {1.0 / self._dt:.6g} Hz to {self._rate:.6g} Hz"
        if self._ratio > 1:
            note += f", observations filtered below {CUTOFF * self._rate:.4g} Hz"
        if self._episode.header.action_columns:
            note += ", actions averaged over each step"
        return note


def _beside(block: Block, m: int, has_costs: bool) -> FloatArray:
    """Return actions and costs side by side; a block may hold more of one than of the other."""
    parts = [block.actions] if m else []
    if has_costs and block.costs is not None:
        parts.append(block.costs[:, None])
    return np.concatenate(parts, axis=1) if parts else np.empty((0, 0))


class _Filter:
    """Evaluates the low-pass filtered rows at the new times."""

    def __init__(self, ratio: Fraction, n: int) -> None:
        self._ratio = ratio
        slower = max(1.0, float(ratio))
        self._reach = math.ceil(HALF_WIDTH * slower)  # rows to either side
        self._half_width = HALF_WIDTH * slower
        self._cutoff = CUTOFF / slower if ratio > 1 else 0.5  # cycles a row
        self._offsets = np.arange(-self._reach, self._reach + 1)
        self._table = self._phases() if ratio.denominator <= _MOST_PHASES else None
        self._rows = np.empty((0, n))  # from row `_start` on, which may lie before the first
        self._start = 0
        self._is_padded = False
        self._next = 0  # number of the next row to go out

    def add(self, rows: FloatArray) -> FloatArray:
        """Take rows (b, n) and return those at the new rate that can be told by now."""
        self._rows = np.concatenate([self._rows, rows])
        if not self._is_padded:
            if len(self._rows) <= 2 * self._reach:
                return self._rows[:0]
            self._pad_front()
        # Twice the reach stays, of which the reflection at the end is made.
        return self._out(self._start + len(self._rows) - 1 - self._reach)

    def finish(self) -> FloatArray:
        """Return the rows that are left."""
        if not len(self._rows):
            return self._rows
        if not self._is_padded:
            self._pad_front()
        end = self._start + len(self._rows) - 1
        self._rows = _reflected(self._rows, 0, self._reach)
        return self._out(end)

    def _pad_front(self) -> None:
        self._rows = _reflected(self._rows, self._reach, 0)
        self._start, self._is_padded = -self._reach, True

    def _out(self, last: int) -> FloatArray:
        """Return the new rows up to the time of the old row `last`."""
        count = math.floor(last / self._ratio + Fraction(1, 10**6)) + 1 - self._next
        n = self._rows.shape[1]
        batch = max(1, _BATCH // (len(self._offsets) * max(1, n)))
        parts = [self._rows[:0]]
        for start in range(0, max(0, count), batch):
            parts.append(self._evaluate(self._next + start, min(batch, count - start)))
        self._next += max(0, count)
        keep = math.floor(self._next * self._ratio) - 2 * self._reach - self._start
        if keep > 0:
            self._rows, self._start = self._rows[keep:], self._start + keep
        return np.concatenate(parts)

    def _evaluate(self, first: int, count: int) -> FloatArray:
        numbers = np.arange(first, first + count)
        if self._table is not None:
            p, q = self._ratio.numerator, self._ratio.denominator
            bases, weights = numbers * p // q, self._table[numbers * p % q]
        else:
            at = numbers * float(self._ratio)
            bases = np.floor(at).astype(np.int64)
            weights = self._weights(at - bases)
        around = self._rows[(bases - self._start)[:, None] + self._offsets]
        return np.einsum("kl,kln->kn", weights, around)

    def _phases(self) -> FloatArray:
        return self._weights(np.arange(self._ratio.denominator) / self._ratio.denominator)

    def _weights(self, fractions: FloatArray) -> FloatArray:
        """Return the weights (k, 2 reach + 1) of the rows around times between two rows."""
        x = self._offsets - fractions[:, None]
        inside = 1.0 - (x / self._half_width) ** 2
        window = np.where(inside >= 0, np.i0(_BETA * np.sqrt(np.maximum(inside, 0.0))), 0.0)
        weights = np.sinc(2.0 * self._cutoff * x) * window
        return weights / weights.sum(axis=1, keepdims=True)


def _reflected(rows: FloatArray, before: int, after: int) -> FloatArray:
    """Continue rows by their reflection through the first and the last one."""
    if len(rows) < 2:
        return np.pad(rows, ((before, after), (0, 0)), mode="edge")
    return np.pad(rows, ((before, after), (0, 0)), mode="reflect", reflect_type="odd")


class _Means:
    """Averages what holds over a step over the new steps."""

    def __init__(self, ratio: Fraction, m: int) -> None:
        self._ratio = ratio
        self._rows = np.empty((0, m))  # from row `_start` on
        self._start = 0
        self._next = 0  # number of the next new step

    def add(self, rows: FloatArray) -> FloatArray:
        """Take rows (b, m) and return the means of the new steps that are over by now."""
        if not self._rows.shape[1]:
            return self._rows
        self._rows = np.concatenate([self._rows, rows])
        end = self._start + len(self._rows)
        count = math.floor(end / self._ratio + Fraction(1, 10**6)) - self._next
        if count <= 0:
            return self._rows[:0]
        means = self._means(count)
        self._next += count
        keep = math.floor(self._next * self._ratio) - self._start
        self._rows, self._start = self._rows[keep:], self._start + keep
        return means

    def _means(self, count: int) -> FloatArray:
        if self._ratio.denominator == 1:
            size = self._ratio.numerator
            return self._rows[: count * size].reshape(count, size, -1).mean(axis=1)
        edges = [float((self._next + i) * self._ratio - self._start) for i in range(count + 1)]
        sums = np.concatenate([self._rows[:1] * 0.0, np.cumsum(self._rows, axis=0)])
        at = np.arange(len(sums))
        columns = [np.interp(edges, at, column) for column in sums.T]
        return np.diff(np.stack(columns, axis=1), axis=0) / float(self._ratio)
