"""What a robot may be told and what it can have measured: limits, and an action that obeys them.

The `Limiter` moves the action from where it is towards where it is wanted, so that at every command

- value: ``low <= a <= high``;
- rate: ``|a - a'| <= rate * h``, where a' is the action before;
- jerk: ``|v - v'| <= jerk * h``, where ``v = (a - a') / h`` is the rate of change;

and h is the time since the command before, but never more than one control period. An action that
changes fast cannot stop at once where jerk is limited, so it has to slow down in time: braking
from the rate v takes at most ``v² / (2 jerk)``, in steps of whatever length, and the limiter only
takes a rate that leaves so much room before the limit of the value. From there, slowing down is
always within all three limits at once.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntFlag
from typing import Any, Self

from misstep.errors import MisstepError
from misstep.systems import System
from misstep.trajectory import Column

Row = tuple[float, ...]
PerColumn = float | Sequence[float]
"""One number for all columns, or one for each."""


class Reason(IntFlag):
    """Why an action is what it is; several can hold at once."""

    POLICY = 1
    """The policy of the trial asked for it."""
    VALUE = 2
    """Moved into the limits of the value."""
    RATE = 4
    """Slowed down by the limit of the rate."""
    JERK = 8
    """Slowed down by the limit of the jerk, or braking before a limit."""
    REFUSED = 16
    """The state was refused: it goes on towards what was wanted before."""
    LATE = 32
    """The policy missed the deadline: towards the safe action."""
    WATCHDOG = 64
    """No fresh state for too long: towards the safe action."""
    IDLE = 128
    """No trial is running: towards the safe action."""
    STOP = 256
    """Emergency stop: the safe action at once."""
    DRY_RUN = 512
    """The safe action, in place of what would have been sent."""
    SILENT = 1024
    """Said by a client to itself: the service did not answer in time."""


# Plain numbers for what happens a thousand times a second: enumerations are ten times as slow.
_VALUE, _RATE, _JERK = int(Reason.VALUE), int(Reason.RATE), int(Reason.JERK)


@dataclass(frozen=True)
class Limits:
    """Limits of the action, the safe action, and the range of states that can be.

    Parameters
    ----------
    observation_columns : tuple of n Column
    action_columns : tuple of m Column
    period : float, s
        Control period.
    low, high : tuple of m float
        Of the action, in its columns' units; finite.
    rate : tuple of m float
        Largest change of the action in a second, unit/s; infinite where there is none.
    jerk : tuple of m float
        Largest change of that rate in a second, unit/s²; infinite where there is none.
    safe : tuple of m float
        Where the action goes when in doubt, and where it is taken to be at the beginning.
    observation_low, observation_high : tuple of n float
        What lies outside cannot have been measured; infinite where anything can.

    Raises
    ------
    MisstepError
        If a limit is missing, empty or not positive, or the safe action lies outside.
    """

    observation_columns: tuple[Column, ...]
    action_columns: tuple[Column, ...]
    period: float
    low: Row
    high: Row
    rate: Row
    jerk: Row
    safe: Row
    observation_low: Row
    observation_high: Row

    def __post_init__(self) -> None:
        columns = zip(self.action_columns, self.low, self.high, strict=True)
        for i, (column, low, high) in enumerate(columns):
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise MisstepError(
                    f"action {column.name} goes from {low:g} to {high:g} {column.unit}: a robot "
                    "needs finite limits, the smaller first"
                )
            if not low <= self.safe[i] <= high:
                raise MisstepError(
                    f"the safe action is {self.safe[i]:g} for {column.name}, outside its limits "
                    f"{low:g} .. {high:g} {column.unit}: give one inside"
                )
            for name, bound in (("rate", self.rate[i]), ("jerk", self.jerk[i])):
                if not bound > 0:
                    raise MisstepError(
                        f"the {name} limit of {column.name} is {bound:g}: it has to be positive"
                    )

    @classmethod
    def of(
        cls,
        system: System,
        *,
        rate: PerColumn = math.inf,
        jerk: PerColumn = math.inf,
        safe: PerColumn = 0.0,
        ranges: Mapping[str, tuple[float, float]] | None = None,
    ) -> Self:
        """Return the limits of a system's own spaces, and further ones.

        Parameters
        ----------
        system : System
        rate, jerk, safe : float or sequence of m float
            See the class.
        ranges : mapping from str to (float, float)
            Narrower ranges of observation columns.

        Raises
        ------
        MisstepError
            If there is no such column, a sequence has another length than the action, or as the
            class.
        """
        actions: Any = system.action_space
        observations: Any = system.observation_space
        names = [column.name for column in system.observation_columns]
        low, high = observations.low.tolist(), observations.high.tolist()
        for name, (least, most) in (ranges or {}).items():
            if name not in names:
                raise MisstepError(f"no observation column {name!r}; there are: {', '.join(names)}")
            if not least < most:
                raise MisstepError(f"the range of {name} is {least:g} .. {most:g}: it is empty")
            i = names.index(name)
            low[i], high[i] = max(low[i], least), min(high[i], most)
        m = len(system.action_columns)
        return cls(
            system.observation_columns,
            system.action_columns,
            system.dt,
            tuple(actions.low.tolist()),
            tuple(actions.high.tolist()),
            _row(rate, m, "rate limit"),
            _row(jerk, m, "jerk limit"),
            _row(safe, m, "safe action"),
            tuple(low),
            tuple(high),
        )


class Limiter:
    """Moves the action towards what is wanted, within the limits of value, rate and jerk.

    Plain numbers rather than arrays: an action has one or a few.

    Parameters
    ----------
    limits : Limits

    Attributes
    ----------
    action : list of m float
        The one sent last; the safe one at first.
    rate : list of m float
        How fast it was changing then, unit/s.
    """

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._bounds = tuple(zip(limits.low, limits.high, limits.rate, limits.jerk, strict=True))
        self.action = list(limits.safe)
        self.rate = [0.0] * len(limits.safe)

    def move(self, wanted: Sequence[float], elapsed: float) -> int:
        """Move the action towards `wanted` and return what held it up, as bits of `Reason`.

        Parameters
        ----------
        wanted : sequence of m float
            Finite.
        elapsed : float, s
            Since the command before; anything below 0 counts as 0.
        """
        step = min(max(elapsed, 0.0), self._limits.period)
        reason = 0
        for i, (low, high, rate, jerk) in enumerate(self._bounds):
            target = min(max(wanted[i], low), high)
            if target != wanted[i]:
                reason |= _VALUE
            if jerk < math.inf:
                reason |= self._move_smoothly(i, target, step)
            elif rate < math.inf:
                reason |= self._move_steadily(i, target, step)
            else:
                self.action[i] = target
        return reason

    def jump(self, action: Sequence[float]) -> None:
        """Be at `action` at once, at rest, whatever the limits of rate and jerk."""
        self.action = list(action)
        self.rate = [0.0] * len(self.action)

    def _move_steadily(self, i: int, target: float, step: float) -> int:
        reach = self._bounds[i][2] * step
        here = self.action[i]
        self.action[i] = min(max(target, here - reach), here + reach)
        return 0 if self.action[i] == target else _RATE

    def _move_smoothly(self, i: int, target: float, step: float) -> int:
        low, high, rate, jerk = self._bounds[i]
        here, before = self.action[i], self.rate[i]
        if step == 0.0:
            return 0 if here == target else _JERK
        way = target - here
        # Near enough to be at rest one step after the arrival; else braking in time to arrive.
        arrives = abs(way) <= jerk * step * step
        wanted = way / step
        if not arrives:
            wanted = math.copysign(_braking_rate(abs(way), step, jerk), way)
        most = min(before + jerk * step, _braking_rate(high - here, step, jerk))
        least = max(before - jerk * step, -_braking_rate(here - low, step, jerk))
        now = min(max(wanted, -rate), rate)
        reason = _RATE if now != wanted else 0
        if not least <= now <= most:
            now = max(min(now, most), least)
            reason |= _JERK
        at_target = arrives and now == wanted
        self.action[i] = target if at_target else min(max(here + now * step, low), high)
        self.rate[i] = now
        return reason


def _braking_rate(room: float, step: float, jerk: float) -> float:
    """Return the rate v with v h + v² / (2 jerk) = room: one step, and room enough to brake."""
    return 2.0 * room / (math.sqrt(step * step + 2.0 * room / jerk) + step)


def _row(values: PerColumn, m: int, what: str) -> Row:
    row = (float(values),) * m if isinstance(values, int | float) else tuple(map(float, values))
    if len(row) != m:
        raise MisstepError(f"the {what} has {len(row)} numbers, but there are {m} actions")
    return row
