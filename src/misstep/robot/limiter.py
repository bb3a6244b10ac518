"""An action that moves towards where it is wanted, and obeys the limits on its way; compiled.

The `Limiter` moves the action so that at every command

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

import numpy as np
from numba.types import float64, int64
from numpy.typing import ArrayLike, NDArray

from misstep.compiling import njit
from misstep.robot.limits import Limits, Reason, Row

Table = NDArray[np.float64]

_VALUE, _RATE, _JERK = int(Reason.VALUE), int(Reason.RATE), int(Reason.JERK)


LOW, HIGH, RATE, JERK, ACTION, SLOPE, WANTED = range(7)
"""Rows of the table: the limits; the action sent last; how fast it was changing; what is wanted."""
ROWS = 7


def table_of(limits: Limits) -> Table:
    """Return the table (7, m) of actions that rest at the safe one."""
    rest = (0.0,) * len(limits.safe)
    limit_rows = [limits.low, limits.high, limits.rate, limits.jerk]
    return np.array([*limit_rows, limits.safe, rest, limits.safe])


class Limiter:
    """Moves the action towards what is wanted, within the limits of value, rate and jerk.

    Parameters
    ----------
    limits : Limits
    """

    def __init__(self, limits: Limits) -> None:
        self._table, self._period = table_of(limits), limits.period

    @property
    def action(self) -> Row:
        """The action sent last, (m,); the safe one at first."""
        return tuple(self._table[ACTION].tolist())

    def move(self, wanted: ArrayLike, elapsed: float) -> int:
        """Move the action towards `wanted`; return what held it up, as bits of `Reason`.

        Parameters
        ----------
        wanted : array_like, shape (m,)
            Finite.
        elapsed : float, s
            Since the command before; anything below 0 counts as 0.
        """
        self._table[WANTED] = wanted
        reason: int = move(self._table, min(max(elapsed, 0.0), self._period))
        return reason


# The types are given so that everything is compiled when it is imported, not while a robot waits.
_TABLE = float64[:, ::1]


@njit(float64(float64, float64, float64), cache=True)
def _braking_rate(room: float, step: float, jerk: float) -> float:
    """Return the rate v with v h + v² / (2 jerk) = room: one step, and room enough to brake."""
    return 2.0 * room / (math.sqrt(step * step + 2.0 * room / jerk) + step)


@njit(int64(_TABLE, int64, float64, float64), cache=True)
def _move_steadily(table: Table, i: int, target: float, step: float) -> int:
    reach = table[RATE, i] * step
    here = table[ACTION, i]
    table[ACTION, i] = min(max(target, here - reach), here + reach)
    return 0 if table[ACTION, i] == target else _RATE


@njit(int64(_TABLE, int64, float64, float64), cache=True)
def _move_smoothly(table: Table, i: int, target: float, step: float) -> int:
    low, high, rate, jerk, here, before, _ = table[:, i]
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
    table[ACTION, i] = target if at_target else min(max(here + now * step, low), high)
    table[SLOPE, i] = now
    return reason


@njit(int64(_TABLE, float64), cache=True)
def move(table: Table, step: float) -> int:
    """Move every action for a time `step`, s; return bits of `Reason`."""
    reason = 0
    for i in range(table.shape[1]):
        wanted = table[WANTED, i]
        target = min(max(wanted, table[LOW, i]), table[HIGH, i])
        if target != wanted:
            reason |= _VALUE
        if table[JERK, i] < math.inf:
            reason |= _move_smoothly(table, i, target, step)
        elif table[RATE, i] < math.inf:
            reason |= _move_steadily(table, i, target, step)
        else:
            table[ACTION, i] = target
    return reason
