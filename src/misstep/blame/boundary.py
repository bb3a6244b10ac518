"""What a failure is, learned from where attempts were when they failed.

A failure predicate nearly always says that some column left a range: the pole beyond 30°, the cart
at the end of its rail. Then every attempt was inside that range until it failed and outside when it
did, which the recordings show: a column whose value at a failure lies beyond everything that was
ever survived is one that may have told the failure. Of several such columns

- positions come before velocities (a column is a position if it is the integral of another), since
  whatever falls is also fastest at its end;
- then the one that tells most failures;
- then the one whose ends differ least in size, as a share of it: limits are mostly the same to
  either side of zero, and ends that line up are not likely to do so by chance.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from misstep.dynamics.encoding import wrapped_differences
from misstep.trajectory import Trajectory

Array = NDArray[np.float64]

# Share of the survived states that may lie beyond a limit: sensors are noisy.
OUTLIERS = 0.005
# Positions are believed if they tell at least this share of the failures.
POSITION_SHARE = 0.5
# A failure whose last step is this many times the largest before came out of nowhere.
LEAP = 5.0


@dataclass(frozen=True)
class Boundary:
    """The range of states in which nothing has failed yet.

    Parameters
    ----------
    low, high : ndarray, shape (n,)
        Each in its column's unit; infinite where no failure was seen.
    told : tuple of bool
        Of each trajectory that it was found in: whether its failure is one of leaving the range.
    """

    low: Array
    high: Array
    told: tuple[bool, ...]

    @classmethod
    def find(cls, trajectories: Sequence[Trajectory], positions: NDArray[np.bool_]) -> Self:
        """Find the range from trajectories of which some have failed.

        Parameters
        ----------
        trajectories : sequence of Trajectory
        positions : ndarray of bool, shape (n,)
            Which columns are positions.
        """
        survived = np.concatenate([t.observations[: t.failure_step] for t in trajectories])
        leaps = leapt(trajectories)
        # Those that failed at their start never went well, so 0 counts as none.
        failed = [i for i, t in enumerate(trajectories) if t.failure_step and not leaps[i]]
        n = survived.shape[1]
        low, high = np.full(n, -np.inf), np.full(n, np.inf)
        ends = np.array(
            [trajectories[i].observations[trajectories[i].failure_step] for i in failed]
        )
        left = np.arange(len(failed))
        while len(left):
            sides = [_Side.of(ends[left, c], survived[:, c]) for c in range(n)]
            column = _most_telling(sides, positions, np.abs(ends[left]))
            side = sides[column]
            if not side.told.any():
                break
            low[column] = max(low[column], side.low)
            high[column] = min(high[column], side.high)
            left = left[~side.told]
        untold = {failed[i] for i in left}
        told = (i in failed and i not in untold for i in range(len(trajectories)))
        return cls(low, high, tuple(told))

    def inside(self, states: Array) -> NDArray[np.bool_]:
        """Return whether states (N, n) are inside the range, shape (N,)."""
        within = (states > self.low) & (states < self.high)
        return np.asarray(within.all(axis=1))


def leapt(trajectories: Sequence[Trajectory]) -> list[bool]:
    """Tell which trajectories failed in one step that no earlier one is like.

    Such is a ball that is observed where it was thrown from, and then where it landed: nothing
    before the failure announces it.
    """
    angles = np.array([c.unit == "rad" for c in trajectories[0].observation_columns])
    steps = [
        np.abs(wrapped_differences(t.observations[:-1], t.observations[1:], angles))
        for t in trajectories
    ]
    before = [
        s if t.failure_step is None else s[: max(t.failure_step - 1, 0)]
        for s, t in zip(steps, trajectories, strict=True)
    ]
    largest = np.concatenate(before).max(axis=0, initial=0.0)
    # A column that had not moved at all has no usual step to be compared with.
    limit = np.where(largest > 0, LEAP * largest, np.inf)
    return [
        bool(t.failure_step and np.any(s[t.failure_step - 1] > limit))
        for s, t in zip(steps, trajectories, strict=True)
    ]


class _Side(NamedTuple):
    """What the two limits of one column would be, and which failures they would tell."""

    low: float
    high: float
    told: NDArray[np.bool_]

    @classmethod
    def of(cls, ends: Array, survived: Array) -> Self:
        ordered = np.sort(survived)
        allowed = int(OUTLIERS * len(ordered))
        lowest, highest = ordered[allowed], ordered[-1 - allowed]
        below, above = ends < lowest, ends > highest
        low = 0.5 * (lowest + ends[below].max()) if below.any() else -np.inf
        high = 0.5 * (highest + ends[above].min()) if above.any() else np.inf
        return cls(float(low), float(high), below | above)


def _most_telling(sides: Sequence[_Side], positions: NDArray[np.bool_], sizes: Array) -> int:
    """Return the column whose limits tell the failures best; see the module for the order."""
    counts = np.array([side.told.sum() for side in sides])
    believed = positions & (counts >= POSITION_SHARE * counts.max()) & (counts > 0)
    candidates = np.flatnonzero(believed).tolist() if believed.any() else list(range(len(sides)))

    def order(column: int) -> tuple[int, float]:
        told = sizes[sides[column].told, column]
        return -len(told), float(told.std() / told.mean()) if len(told) else np.inf

    return min(candidates, key=order)
