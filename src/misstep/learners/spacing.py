"""What a sample stands for: a moment, or a piece of the way through the states.

A recording has a sample every control period, so they crowd where the state changes slowly. A slow
strike then outweighs a fast one, and the start of each, where it picks up speed, outweighs the
rest. For a policy that is conditioned on where it is, how long it took to get there says nothing:
with the spacing ``path`` a sample weighs as much as the way it stands for. The attempts are not
resampled, so nothing that was done is made up.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from misstep.learners.learner import Task
from misstep.trajectory import Trajectory

Array = NDArray[np.float64]

SPACINGS = ("time", "path")

# An attempt that stood still stays known: of the mean weight of a sample, each has this at least.
_LEAST_SHARE = 0.01


def path_weights(task: Task, attempts: Sequence[Trajectory]) -> Array:
    """Return the way that each sample stands for, on average 1 before the floor, shape (N,).

    That is half the way to either neighbour, and the whole way to the only one at the ends. Each
    column of the state is divided by its standard deviation over all attempts, the shorter way
    round is taken between two angles, and no weight is below 0.01. The observation after the last
    action takes no part: there a strike has been followed up to its verdict.
    """
    states = [attempt.select(task.state)[:-1] for attempt in attempts]
    scale = np.concatenate(states).std(axis=0)
    wraps = task.angles[task.state_indices]
    ways = np.concatenate([_ways(own, scale, wraps) for own in states])
    mean = ways.mean()
    weights: Array = np.maximum(ways / mean, _LEAST_SHARE) if mean > 0 else np.ones(len(ways))
    return weights


def _ways(states: Array, scale: Array, wraps: NDArray[np.bool_]) -> Array:
    """Return the way that each state (T, n) of one attempt stands for, shape (T,)."""
    if len(states) == 1:
        return np.zeros(1)
    steps = np.diff(states, axis=0)
    steps[:, wraps] -= 2.0 * np.pi * np.round(steps[:, wraps] / (2.0 * np.pi))
    lengths = np.linalg.norm(steps / scale, axis=1)
    ways: Array = 0.5 * (np.append(lengths, lengths[-1]) + np.insert(lengths, 0, lengths[0]))
    return ways
