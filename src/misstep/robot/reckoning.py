"""The guard's arithmetic, compiled: is a state fresh and can it be true, and how far to move.

All that is reckoned with lies in one vector, because to hand an array over takes longer than the
arithmetic itself:

============ ==================================================================================
part         what it holds
============ ==================================================================================
times        8 numbers, see below; a time that there is not yet is NaN, with which no
             comparison holds
sizes        m and n
actions      the table (7, m) of a `misstep.robot.limiter.Limiter`
states       smallest and largest observation that can be, (2, n)
============ ==================================================================================

`misstep.robot.guard` says what comes of each answer; tests/robots.py says the same a second time,
in plain Python.
"""

import math

import numpy as np
from numba.types import boolean, float64, int64, void
from numpy.typing import NDArray

from misstep.compiling import njit
from misstep.robot.limiter import ROWS, WANTED, move, table_of
from misstep.robot.limits import Limits

Vector = NDArray[np.float64]

LENGTH, NOT_FINITE, RANGE, ORDER, STALE, FUTURE = range(1, 7)
"""What is wrong with a state; 0 where nothing is."""
SILENT = 8
"""Added where there had been no fresh state for too long when this one came."""
NO_ACTION = -1
"""In place of a reason, where what is wanted is not finite."""

CLOCK = 0
"""As last handed in."""
TIME = 1
"""The same, without steps back."""
STAMP = 2
"""Of the last fresh state, by the robot's clock."""
OFFSET = 3
"""From the robot's clock to ours, since the first state of the trial."""
FRESH_AT = 4
"""When the last fresh state of the trial came."""
SENT_AT = 5
"""When the last command was sent."""
WATCHDOG = 6
"""The longest that a state may be old, or away."""
PERIOD = 7
"""The longest time that an action moves for at once."""
_M, _N, _HEAD = 8, 9, 10


def new_vector(limits: Limits, watchdog: float) -> Vector:
    """Return what a guard reckons with before anything has happened."""
    table = table_of(limits)
    states = np.array([limits.observation_low, limits.observation_high])
    head = np.full(_HEAD, np.nan)
    head[[TIME, WATCHDOG, PERIOD]] = 0.0, watchdog, limits.period
    head[[_M, _N]] = table.shape[1], states.shape[1]
    return np.concatenate([head, table.ravel(), states.ravel()])


def table_in(vector: Vector) -> NDArray[np.float64]:
    """Return the actions' table (7, m) as a view."""
    m = int(vector[_M])
    return vector[_HEAD : _HEAD + ROWS * m].reshape(ROWS, m)


# The types are given so that everything is compiled when it is imported, not while a robot waits.
_VECTOR = float64[::1]


@njit(void(_VECTOR, float64), cache=True)
def advance(v: Vector, now: float) -> None:
    """Let the time go on to `now`; a clock that jumps back stands still."""
    if now > v[CLOCK]:
        v[TIME] += now - v[CLOCK]
    v[CLOCK] = now


@njit(boolean(_VECTOR, float64), cache=True)
def is_silent(v: Vector, now: float) -> bool:
    """Return whether there has been no fresh state for longer than the watchdog waits."""
    advance(v, now)
    silent: bool = v[TIME] - v[FRESH_AT] > v[WATCHDOG]
    return silent


@njit(int64(_VECTOR, _VECTOR), cache=True)
def _flaw(v: Vector, observation: Vector) -> int:
    """Return what is wrong with an observation by itself."""
    n = int(v[_N])
    if len(observation) != n:
        return LENGTH
    low, high = v[len(v) - 2 * n : len(v) - n], v[len(v) - n :]
    flaw = 0
    for i in range(n):
        if not math.isfinite(observation[i]):
            return NOT_FINITE
        if not low[i] <= observation[i] <= high[i]:
            flaw = RANGE
    return flaw


@njit(int64(_VECTOR, boolean, float64), cache=True)
def _lag(v: Vector, in_order: bool, stamp: float) -> int:
    """Return what is wrong with the time of a state."""
    if not in_order:
        return ORDER
    if math.isnan(v[OFFSET]):
        return 0
    age = v[TIME] - stamp - v[OFFSET]
    if stamp <= v[STAMP] or age > v[WATCHDOG]:
        return STALE
    return FUTURE if age < -v[WATCHDOG] else 0


@njit(int64(_VECTOR, _VECTOR, boolean, float64, float64, float64), cache=True)
def admit(
    v: Vector, observation: Vector, in_order: bool, stamp: float, cost: float, now: float
) -> int:
    """Let a state in, which sets the times, or return what is wrong with it.

    Parameters
    ----------
    v, observation : ndarray
    in_order : bool
        Whether it was counted after the one before.
    stamp, cost, now : float
    """
    silent = SILENT if is_silent(v, now) else 0
    flaw = _flaw(v, observation)
    if flaw != LENGTH and not (math.isfinite(stamp) and math.isfinite(cost)):
        flaw = NOT_FINITE
    if flaw == 0:
        flaw = _lag(v, in_order, stamp)
    if flaw == 0:
        v[STAMP], v[FRESH_AT] = stamp, v[TIME]
        if math.isnan(v[OFFSET]):
            v[OFFSET] = v[TIME] - stamp
    return flaw + silent


@njit(int64(_VECTOR, float64), cache=True)
def follow(v: Vector, now: float) -> int:
    """Move the action towards what is wanted, for the time since the last command.

    Returns
    -------
    int
        What held it up, as bits of `Reason`; `NO_ACTION`, and nothing has moved, if what is wanted
        is not finite.
    """
    m = int(v[_M])
    table = v[_HEAD : _HEAD + ROWS * m].reshape((ROWS, m))
    for value in table[WANTED]:
        if not math.isfinite(value):
            return NO_ACTION
    advance(v, now)
    elapsed = v[TIME] - v[SENT_AT]
    v[SENT_AT] = v[TIME]
    return move(table, elapsed if elapsed < v[PERIOD] else v[PERIOD])
