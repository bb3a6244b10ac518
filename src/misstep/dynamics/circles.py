"""Angles that are observed as a cosine and a sine, found in the data and turned back into angles.

Learned as two columns, a rollout would leave the unit circle, for states that do not exist; and a
column that is the integral of a velocity would not be seen to be one.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Self

import numpy as np
from numpy.typing import NDArray

from misstep.costs import StateCost

Array = NDArray[np.float64]

# Rounding of observations in single precision, and no more: noise would come out as an angle's.
TOLERANCE = 2e-6
# Two columns that hardly move lie on many curves.
LEAST_SPREAD = 1e-4


@dataclass(frozen=True)
class Circles:
    """Pairs of columns that lie on the unit circle.

    Which of the two is called the cosine makes no difference but for the angle's sense and origin.

    Parameters
    ----------
    n_columns : int
        Number of columns observed, n.
    cosines, sines : ndarray of int, shape (k,)
        The pairs, no column in two of them.
    """

    n_columns: int
    cosines: NDArray[np.int64]
    sines: NDArray[np.int64]

    @classmethod
    def find(cls, states: Array, cost: StateCost) -> Self:
        """Find the pairs in `states` (N, n) whose cost is that of an angle; best first."""
        n = states.shape[1]
        squares = states**2
        moving = np.flatnonzero(squares.std(axis=0) > LEAST_SPREAD).tolist()
        candidates = sorted(
            (np.abs(squares[:, i] + squares[:, j] - 1.0).max(), i, j)
            for i, j in combinations(moving, 2)
            if _costs_as_angle(cost, i, j)
        )
        pairs: list[tuple[int, int]] = []
        for residual, i, j in candidates:
            taken = {column for pair in pairs for column in pair}
            if residual < TOLERANCE and i not in taken and j not in taken:
                pairs.append((i, j))
        cosines, sines = np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2).T
        return cls(n, cosines, sines)

    @property
    def pairs(self) -> NDArray[np.int64]:
        """Cosines, then sines, shape (2, k)."""
        return np.stack([self.cosines, self.sines])

    @cached_property
    def kept(self) -> NDArray[np.int64]:
        """Columns that remain, shape (n − k,): an angle takes its cosine's place."""
        return np.setdiff1d(np.arange(self.n_columns), self.sines)

    @cached_property
    def angles(self) -> NDArray[np.bool_]:
        """Which of the remaining columns are the pairs' angles, shape (n − k,)."""
        return np.isin(self.kept, self.cosines)

    def unroll(self, states: Array) -> Array:
        """Return `states` (…, n) with an angle in (−π, π] for each pair, shape (…, n − k)."""
        unrolled: Array = states[..., self.kept]
        unrolled[..., self.angles] = np.arctan2(states[..., self.sines], states[..., self.cosines])
        return unrolled

    def unroll_cost(self, cost: StateCost) -> StateCost:
        """Return the cost of unrolled states; the same but for a constant.

        With c, s on the unit circle and a goal r (cos θ*, sin θ*), the cost
        ½ w (c − r cos θ*)² + ½ w (s − r sin θ*)² is w r (1 − cos(θ − θ*)) and a constant.
        """
        goal, weights = np.array(cost.goal), np.array(cost.weights)
        radius = np.hypot(goal[self.cosines], goal[self.sines])
        angles = self.angles
        new_goal, new_weights = self.unroll(goal), weights[self.kept]
        new_weights[angles] *= radius
        return StateCost(
            tuple(new_goal), tuple(new_weights), tuple(np.array(cost.limits)[self.kept])
        )


def _costs_as_angle(cost: StateCost, i: int, j: int) -> bool:
    """Whether two columns on a circle cost what an angle can: as much either way, no limits."""
    free = np.isinf(cost.limits[i]) and np.isinf(cost.limits[j])
    return bool(free and cost.weights[i] == cost.weights[j])
