"""What was done wrong on the way to the point of no return, and how to say it.

From when the danger last rose to the point of no return every action is held against what the plans
did that still avoided the failure with the least strength: it went the other way, or the right way
with less strength than it took, or the right way and strongly enough, but too late. The kind that
lasted longest is what is said.
"""

from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from misstep.blame.recovery import Recovery
from misstep.trajectory import Column, Trajectory

Array = NDArray[np.float64]

# The failure sets in when the danger last leaves this behind.
ONSET = 0.25
# An action this small, as a share of its limit, goes no way at all.
NOTHING = 0.02
# A run of the same fault may be interrupted for as long as this, s.
INTERRUPTION = 0.06
# Departures that are worth a word, and for how long, s.
LEFT, LEFT_FOR = 0.5, 0.1

_PUSHES = ("N", "N·m", "Nm", "N*m")


class FaultKind(StrEnum):
    """What was wrong with the actions."""

    WRONG_WAY = "wrong way"
    TOO_WEAK = "too weak"
    TOO_LATE = "too late"


class Fault(NamedTuple):
    """What was wrong, and from when on."""

    kind: FaultKind
    time: float
    """s from the start."""
    words: str


def find_fault(
    trajectory: Trajectory, danger: Array, lost: int, recovery: Recovery
) -> Fault | None:
    """Say what was done wrong before observation `lost`, the last recoverable one.

    Returns
    -------
    fault : Fault or None
        None if the plans that avoid it do nothing in particular.
    """
    calm = np.flatnonzero(danger[: lost + 1] < ONSET)
    onset = int(calm[-1]) if len(calm) else 0
    steps = np.arange(onset, min(lost + 1, trajectory.n_steps))
    wanted = recovery.rescue(trajectory.observations[steps], danger[steps])
    size = np.linalg.norm(wanted, axis=1)
    if not size.any():
        return None
    done = recovery.limits.scaled(trajectory.actions[steps])
    along = (done * wanted).sum(axis=1) / np.maximum(size, 1e-12)
    kinds = np.where(along < -NOTHING, 0, np.where(along < danger[steps], 1, 2))
    counts = np.bincount(kinds, minlength=3)
    kind = int(np.argmax(counts[:2])) if counts[:2].any() else 2
    first = _start_of_last_run(kinds == kind, max(1, round(INTERRUPTION / trajectory.dt)))
    words = _words(list(FaultKind)[kind], trajectory.action_columns)
    if kind == 1 and len(trajectory.action_columns) == 1:
        last = int(steps[np.flatnonzero(kinds == kind)[-1]])
        words += _strength(trajectory, last, danger, recovery)
    return Fault(list(FaultKind)[kind], float(steps[first] * trajectory.dt), words)


def find_departure(trajectory: Trajectory, departure: Array, lost: int) -> float | None:
    """Return when the actions first left for long what worked elsewhere, s; None if never."""
    least = max(2, round(LEFT_FOR / trajectory.dt))
    left = departure[: lost + 1] > LEFT
    runs = np.convolve(left, np.ones(least), mode="valid") if len(left) >= least else np.empty(0)
    whole = np.flatnonzero(runs > least - 0.5)
    return float(whole[0] * trajectory.dt) if len(whole) else None


def _start_of_last_run(wrong: NDArray[np.bool_], interruption: int) -> int:
    """Return where the last run begins in which no gap is longer than an interruption."""
    at = np.flatnonzero(wrong)
    gaps = np.flatnonzero(np.diff(at) > interruption)
    return int(at[gaps[-1] + 1]) if len(gaps) else int(at[0])


def _words(kind: FaultKind, columns: Sequence[Column]) -> str:
    if len(columns) == 1:
        subject, pushes = f"the {columns[0].name}", columns[0].unit in _PUSHES
        verb = "pushed" if pushes else "went"
        be = "was"
    else:
        subject, verb, be = "the actions", "went", "were"
    return {
        FaultKind.WRONG_WAY: f"{subject} {verb} the wrong way",
        FaultKind.TOO_WEAK: f"{subject} {be} too weak",
        FaultKind.TOO_LATE: f"{subject} {verb} the right way, too late",
    }[kind]


def _strength(trajectory: Trajectory, last: int, danger: Array, recovery: Recovery) -> str:
    """Say how strong the action was in the last step of a fault, and how strong it had to be."""
    unit = trajectory.action_columns[0].unit
    limits = recovery.limits
    wanted = recovery.rescue(trajectory.observations[last : last + 1], danger[last : last + 1])
    full = (limits.high if wanted[0, 0] > 0 else limits.low)[0] - limits.neutral[0]
    took = abs(danger[last] * full)
    was = abs(trajectory.actions[last, 0] - limits.neutral[0])
    return f" ({was:.3g} of the {took:.3g} {unit}".rstrip() + " that it took in the end)"
