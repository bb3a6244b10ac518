"""What is in a recording: lengths, rates, ranges, and what is odd about it.

Everything is read off the rows as they were recorded, before they are made into trajectories: with
the values that are missing, and the times as they are.
"""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from misstep.formats import Block, Ending, Header
from misstep.trajectory import Column
from misstep.units import TURNS

Array = NDArray[np.float64]

# Times further apart than this many usual intervals leave a gap.
GAP = 1.5
# A change that is this many times those around it, and this share of the column's range, is a jump.
JUMP, JUMP_SHARE = 10.0, 0.1
_AROUND = 3


class Gap(NamedTuple):
    """Times that are too far apart."""

    time: float
    """Of the row before it, s from the start."""
    seconds: float


class Jump(NamedTuple):
    """A change much larger than those around it: a lost stretch, a bad sample, a collision."""

    column: str
    time: float
    """s from the start."""


@dataclass(frozen=True)
class EpisodeSummary:
    """What one episode holds.

    Parameters
    ----------
    number : int
        From 1.
    rows : int
        Observations.
    duration : float, s
    rate : float or None, Hz
        None where the times are uneven.
    outcome : str
    failure_time : float or None, s
    system, demonstrator, recorded : str
        Empty where the file does not say.
    seed : int or None
    notes : tuple of str
        What was inferred or changed.
    missing : int
        Values that are no finite numbers.
    gaps : tuple of Gap
    jumps : tuple of Jump
    repeated : int
        Rows that are the same as the one before, in every column.
    longest_repeat : float, s
        The longest stretch of those.
    duplicate_of : int or None
        Number of an earlier episode with the same observations and actions.
    """

    number: int
    rows: int
    duration: float
    rate: float | None
    outcome: str
    failure_time: float | None
    system: str
    demonstrator: str
    recorded: str
    seed: int | None
    notes: tuple[str, ...]
    missing: int
    gaps: tuple[Gap, ...]
    jumps: tuple[Jump, ...]
    repeated: int
    longest_repeat: float
    duplicate_of: int | None

    @classmethod
    def of(
        cls, number: int, header: Header, block: Block, ending: Ending, duplicate_of: int | None
    ) -> Self:
        """Summarise an episode, its blocks joined."""
        times = times_of(header, block)
        source, failed = header.provenance, ending.failure_step
        repeated = (block.observations[1:] == block.observations[:-1]).all(axis=1)
        intervals = np.diff(times)
        return cls(
            number=number,
            rows=len(block.observations),
            duration=float(times[-1]) if len(times) else 0.0,
            rate=None if header.dt is None else 1.0 / header.dt,
            outcome=str(ending.outcome),
            failure_time=None if failed is None else float(times[failed]),
            system=source.system,
            demonstrator=source.demonstrator,
            recorded=source.time,
            seed=source.seed,
            notes=(*source.notes, *ending.notes),
            missing=sum(int((~np.isfinite(t)).sum()) for t in (block.observations, block.actions)),
            gaps=_gaps(times),
            jumps=_jumps(times, block.observations, header.observation_columns),
            repeated=int(repeated.sum()),
            longest_repeat=_longest(repeated, intervals),
            duplicate_of=duplicate_of,
        )

    @property
    def oddities(self) -> list[str]:
        """What is odd about it, a phrase each."""
        found = []
        if self.duplicate_of is not None:
            found.append(f"the same as episode {self.duplicate_of}")
        if self.missing:
            found.append(_count(self.missing, "missing value"))
        if self.gaps:
            worst = max(self.gaps, key=lambda gap: gap.seconds)
            found.append(
                f"{_count(len(self.gaps), 'gap')}, the longest {worst.seconds:.3g} s at "
                f"{worst.time:.2f} s"
            )
        if self.repeated:
            found.append(
                f"{_count(self.repeated, 'row')} the same as the one before, for up to "
                f"{self.longest_repeat:.3g} s"
            )
        if self.jumps:
            first = self.jumps[0]
            found.append(
                f"{_count(len(self.jumps), 'jump')}, the first of {first.column} at "
                f"{first.time:.2f} s"
            )
        return found


@dataclass(frozen=True)
class ColumnSummary:
    """What one column holds in all episodes together.

    Parameters
    ----------
    name, unit : str
    kind : str
        ``"observation"`` or ``"action"``.
    minimum, maximum, mean, deviation : float or None
        In the column's unit; None where every value is missing.
    missing : int
        Values that are no finite numbers.
    at_limit : float or None
        Of an action, the share of steps at the smallest or largest value: those of the actuator
        where they are known, else those that were seen. None of an observation.
    """

    name: str
    unit: str
    kind: str
    minimum: float | None
    maximum: float | None
    mean: float | None
    deviation: float | None
    missing: int
    at_limit: float | None


class Tally:
    """Sums of the columns of one kind, episode by episode.

    Parameters
    ----------
    columns : sequence of Column
    kind : str
        ``"observation"`` or ``"action"``.
    """

    def __init__(self, columns: Sequence[Column], kind: str) -> None:
        n = len(columns)
        self._columns, self._kind = columns, kind
        self._low, self._high = np.full(n, np.inf), np.full(n, -np.inf)
        self._at_low, self._at_high = np.zeros(n), np.zeros(n)
        self._count, self._missing = np.zeros(n), np.zeros(n)
        self._mean, self._squares = np.zeros(n), np.zeros(n)

    def add(self, rows: Array) -> None:
        """Take in the rows (N, n) of an episode."""
        known = np.isfinite(rows)
        filled = np.where(known, rows, 0.0)
        count = known.sum(axis=0)
        self._missing += len(rows) - count
        mean = filled.sum(axis=0) / np.maximum(count, 1)
        squares = (np.where(known, rows - mean, 0.0) ** 2).sum(axis=0)
        # Chan's update of mean and variance: no large numbers are subtracted from each other.
        total = np.maximum(self._count + count, 1)
        apart = mean - self._mean
        self._squares += squares + apart**2 * self._count * count / total
        self._mean += apart * count / total
        self._count += count
        self._add_extremes(rows, known)

    def _add_extremes(self, rows: Array, known: NDArray[np.bool_]) -> None:
        low = np.where(known, rows, np.inf).min(axis=0, initial=np.inf)
        high = np.where(known, rows, -np.inf).max(axis=0, initial=-np.inf)
        new_low, new_high = np.minimum(low, self._low), np.maximum(high, self._high)
        self._at_low = np.where(new_low < self._low, 0, self._at_low) + (rows == new_low).sum(0)
        self._at_high = np.where(new_high > self._high, 0, self._at_high) + (rows == new_high).sum(
            0
        )
        self._low, self._high = new_low, new_high

    def summaries(self, limits: tuple[Array, Array] | None = None) -> list[ColumnSummary]:
        """Return one a column; `limits` are the actuators', shape (n,) each, where known."""
        return [self._summary(i, limits) for i in range(len(self._columns))]

    def _summary(self, i: int, limits: tuple[Array, Array] | None) -> ColumnSummary:
        count = self._count[i]
        seen = count > 0
        return ColumnSummary(
            name=self._columns[i].name,
            unit=self._columns[i].unit,
            kind=self._kind,
            minimum=float(self._low[i]) if seen else None,
            maximum=float(self._high[i]) if seen else None,
            mean=float(self._mean[i]) if seen else None,
            deviation=math.sqrt(self._squares[i] / count) if seen else None,
            missing=int(self._missing[i]),
            at_limit=self._at_limit(i, limits) if seen and self._kind == "action" else None,
        )

    def _at_limit(self, i: int, limits: tuple[Array, Array] | None) -> float:
        low, high = self._low[i], self._high[i]
        at_low = self._at_low[i] * (limits is None or low <= limits[0][i])
        at_high = self._at_high[i] * (limits is None or high >= limits[1][i])
        if low == high:
            return 1.0 if at_low or at_high else 0.0
        return float((at_low + at_high) / self._count[i])


def fingerprint(block: Block) -> bytes:
    """Return what two episodes with the same observations and actions have in common."""
    digest = hashlib.sha256()
    for rows in (block.observations, block.actions):
        digest.update(repr(rows.shape).encode())
        digest.update(np.ascontiguousarray(rows).tobytes())
    return digest.digest()


def times_of(header: Header, block: Block) -> Array:
    """Return the time of each observation from the first, shape (rows,), s."""
    if block.times is not None:
        times: Array = block.times - block.times[0] if len(block.times) else block.times
        return times
    return np.arange(len(block.observations), dtype=np.float64) * (header.dt or 0.0)


def _gaps(times: Array) -> tuple[Gap, ...]:
    intervals = np.diff(times)
    if not len(intervals):
        return ()
    wide = np.flatnonzero(intervals > GAP * np.median(intervals))
    return tuple(Gap(float(times[i]), float(intervals[i])) for i in wide)


def _jumps(times: Array, observations: Array, columns: Sequence[Column]) -> tuple[Jump, ...]:
    if len(observations) <= 2 * _AROUND + 1:
        return ()
    known = np.where(np.isfinite(observations), observations, np.nan)
    changes = np.diff(known, axis=0)
    turns = np.array([TURNS.get(column.unit, np.inf) for column in columns])
    angles = np.isfinite(turns)
    half = 0.5 * turns[angles]
    changes[:, angles] = (changes[:, angles] + half) % turns[angles] - half
    size = np.nan_to_num(np.abs(changes))
    padded = np.pad(size, ((_AROUND, _AROUND), (0, 0)), mode="reflect")
    around = np.median(
        np.lib.stride_tricks.sliding_window_view(padded, 2 * _AROUND + 1, axis=0), axis=-1
    )
    reach = np.array([np.ptp(c[np.isfinite(c)]) if np.isfinite(c).any() else 0.0 for c in known.T])
    reach = np.minimum(reach, turns)
    found = (size > JUMP * around) & (size > JUMP_SHARE * reach)
    # Something that stands still for a while and then moves on does not jump.
    found &= around > 0
    return tuple(Jump(columns[j].name, float(times[i + 1])) for i, j in np.argwhere(found))


def _longest(repeated: NDArray[np.bool_], intervals: Array) -> float:
    longest = lasting = 0.0
    for same, seconds in zip(repeated, intervals, strict=True):
        lasting = lasting + float(seconds) if same else 0.0
        longest = max(longest, lasting)
    return longest


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
