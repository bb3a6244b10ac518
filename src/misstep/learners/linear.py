"""Policies that are linear in the state: what `fall` and the random searches produce."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from misstep.learners.learner import Task

Array = NDArray[np.float64]


class LinearPolicy:
    """action = bias + gain · state, clipped.

    Parameters
    ----------
    task : Task
    bias : ndarray, shape (m,)
        In the action's unit.
    gain : ndarray, shape (m, n)
        In the action's unit per unit of the state.
    """

    def __init__(self, task: Task, bias: Array, gain: Array) -> None:
        self.task = task
        self.bias = bias
        self.gain = gain
        self._indices = task.state_indices

    def reset(self) -> None:
        """Forget the attempt before: nothing is remembered."""

    def __call__(self, observation: Array, /) -> Array:
        """Return the action at an observation, inside the actuator's limits."""
        action = self.bias + self.gain @ observation[self._indices]
        limited: Array = np.minimum(np.maximum(action, self.task.action_low), self.task.action_high)
        return limited

    def arrays(self) -> dict[str, Array]:
        """Return the bias and the gain."""
        return {"bias": self.bias, "gain": self.gain}

    @classmethod
    def restore(cls, task: Task, arrays: Mapping[str, Array]) -> "LinearPolicy":
        """Return the policy that `arrays` described."""
        return cls(task, arrays["bias"], arrays["gain"])
