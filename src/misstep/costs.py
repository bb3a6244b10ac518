"""A cost as a function of the state: a planner needs it, where a learner needs only its values."""

from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError

Array = NDArray[np.float64]

# A planner keeps this share of a limit free of cost; the wall beyond is steep.
FREE_SHARE = 0.8
WALL = 2000.0
EFFORT = 0.005


@dataclass(frozen=True)
class StateCost:
    """Σ w (1 − cos e) on angles, Σ ½ w e² on other columns, e the distance from the goal.

    Beyond `FREE_SHARE` of a column's limit L a wall ½ · `WALL` · (excess/L)² is added. A planner
    adds `EFFORT` u² for an action u in units of the actuator's limit; a call here knows no action.

    Parameters
    ----------
    goal : tuple of float, length n
        Each in its column's unit.
    weights : tuple of float, length n
        Not negative.
    limits : tuple of float, length n
        Largest |value| of each column, positive; infinite where there is none.

    Raises
    ------
    MisstepError
        If the three differ in length, a goal or weight is not finite, a weight is negative, or a
        limit is not positive.
    """

    goal: tuple[float, ...]
    weights: tuple[float, ...]
    limits: tuple[float, ...]

    def __post_init__(self) -> None:
        goal, weights, limits = (np.array(v, dtype=np.float64) for v in astuple(self))
        if not (goal.ndim == 1 and goal.shape == weights.shape == limits.shape):
            raise MisstepError(
                f"a cost has one goal, weight and limit for each column, but here are "
                f"{len(self.goal)}, {len(self.weights)} and {len(self.limits)}"
            )
        if not (np.isfinite(goal).all() and np.isfinite(weights).all() and (weights >= 0).all()):
            raise MisstepError(
                f"a cost has finite goals and weights that are not negative, got {self.goal} and "
                f"{self.weights}"
            )
        if not (limits > 0).all():
            raise MisstepError(
                f"a cost has positive limits, infinite where there is none, got {self.limits}"
            )

    def __call__(self, states: Array, angles: NDArray[np.bool_]) -> Array:
        """Return the cost of states (N, n), shape (N,); `angles` (n,) says which columns wrap."""
        error = states - np.array(self.goal)
        weights, limits = np.array(self.weights), np.array(self.limits)
        near = np.where(angles, 1.0 - np.cos(error), 0.5 * error**2)
        excess = np.maximum(np.abs(states) / limits - FREE_SHARE, 0.0)
        cost: Array = near @ weights + 0.5 * WALL * (excess**2).sum(axis=1)
        return cost
