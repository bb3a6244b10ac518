"""Policies that are linear in the state, and the random searches among them.

`random-linear` draws gains and learns nothing: the baseline that any learner has to beat (about a
fifth of all linear policies balance a cart-pole that may drift). `hill-climbing` perturbs the
policy that lasted longest.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.learners.learner import LEARNERS, Evidence, Task, joint_samples
from misstep.parameters import check_parameters, parameter
from misstep.trajectory import Trajectory

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
        return self.task.clipped(self.bias + self.gain @ observation[self._indices])

    def arrays(self) -> dict[str, Array]:
        """Return the bias and the gain."""
        return {"bias": self.bias, "gain": self.gain}

    @classmethod
    def restore(cls, task: Task, arrays: Mapping[str, Array]) -> "LinearPolicy":
        """Return the policy that `arrays` described.

        Raises
        ------
        MisstepError
            If the arrays do not fit the task.
        """
        bias, gain = arrays["bias"], arrays["gain"]
        m, n = len(task.action_columns), len(task.state)
        if bias.shape != (m,) or gain.shape != (m, n):
            raise MisstepError(
                f"a linear policy here has a bias ({m},) and a gain ({m}, {n}), got {bias.shape} "
                f"and {gain.shape}"
            )
        if not np.all(np.isfinite(bias)) or not np.all(np.isfinite(gain)):
            raise MisstepError("a linear policy's bias and gain must be finite")
        return cls(task, bias, gain)


class LinearSpace:
    """Linear policies as vectors of numbers around 1, the space in which searches are at home.

    A vector holds the bias in units of the actuator's range, then each gain in units of that range
    per standard deviation of the demonstrated state.

    Parameters
    ----------
    task : Task
    demonstrations : sequence of Trajectory

    Raises
    ------
    MisstepError
        If a column never varies in the demonstrations, or an action has no limits.
    """

    def __init__(self, task: Task, demonstrations: Sequence[Trajectory]) -> None:
        self.task = task
        n = len(task.state)
        samples = joint_samples(task, demonstrations)
        self.spread = samples[:, :n].std(axis=0)
        self.centre, self.half = task.action_range()
        self.samples = samples

    @property
    def shape(self) -> tuple[int, int]:
        """Actions by one plus the states: (m, 1 + n)."""
        return len(self.half), 1 + len(self.spread)

    def policy(self, vector: Array) -> LinearPolicy:
        """Return the policy of a vector of m (1 + n) numbers."""
        rows = vector.reshape(self.shape) * self.half[:, None]
        return LinearPolicy(self.task, self.centre + rows[:, 0], rows[:, 1:] / self.spread)

    def vector(self, policy: LinearPolicy) -> Array:
        """Return the vector of a policy; the inverse of `policy`."""
        rows = np.column_stack([policy.bias - self.centre, policy.gain * self.spread])
        return (rows / self.half[:, None]).ravel()

    def idle(self) -> Array:
        """Return the vector of doing nothing."""
        return np.zeros(self.shape).ravel()

    def average(self, sample_weight: Array | None = None) -> Array:
        """Return the vector that fits the demonstrations by (weighted) least squares, unbiased."""
        n = len(self.spread)
        root = np.ones(len(self.samples)) if sample_weight is None else np.sqrt(sample_weight)
        states = self.samples[:, :n] / self.spread
        actions = (self.samples[:, n:] - self.centre) / self.half
        design = np.column_stack([np.ones(len(states)), states]) * root[:, None]
        rows = np.linalg.lstsq(design, actions * root[:, None], rcond=None)[0].T
        # What pushes to one side was chance, or the failure itself.
        rows[:, 0] = 0.0
        vector: Array = rows.ravel()
        return vector

    def perturbed(self, vector: Array, size: float, rng: np.random.Generator) -> Array:
        """Return the vector with normal noise on its gains; the bias stays."""
        rows = vector.reshape(self.shape).copy()
        rows[:, 1:] += size * rng.standard_normal(rows[:, 1:].shape)
        return rows.ravel()


class LinearLearner:
    """What the learners of linear policies share: how such a policy comes back from a file."""

    @staticmethod
    def restore(task: Task, arrays: Mapping[str, Array]) -> LinearPolicy:
        """Return the policy that `LinearPolicy.arrays` described."""
        return LinearPolicy.restore(task, arrays)


@LEARNERS.register("random-linear")
@dataclass(frozen=True)
class RandomLinear(LinearLearner):
    """Rung 1: random linear policies until one succeeds; learns nothing."""

    size: float = parameter(
        1.0, "", "standard deviation of a gain, in actuator limits per spread of the state", above=0
    )

    rung: ClassVar[int] = 1

    def __post_init__(self) -> None:
        check_parameters(self, "learner random-linear")

    def policy(self, task: Task, evidence: Evidence, rng: np.random.Generator) -> LinearPolicy:
        """Return a random policy."""
        space = LinearSpace(task, evidence.demonstrations)
        return space.policy(space.perturbed(space.idle(), self.size, rng))


@LEARNERS.register("hill-climbing")
@dataclass(frozen=True)
class HillClimbing(LinearLearner):
    """Rung 2: perturbs the linear policy that lasted longest before it failed."""

    size: float = parameter(
        0.5, "", "standard deviation of a step, in actuator limits per spread of the state", above=0
    )

    rung: ClassVar[int] = 2

    def __post_init__(self) -> None:
        check_parameters(self, "learner hill-climbing")

    def policy(self, task: Task, evidence: Evidence, rng: np.random.Generator) -> LinearPolicy:
        """Return the average of the demonstrations first, then neighbours of the best."""
        space = LinearSpace(task, evidence.demonstrations)
        if not evidence.trials:
            return space.policy(space.average())
        vector = space.vector(longest_lasting(evidence))
        return space.policy(space.perturbed(vector, self.size, rng))


def longest_lasting(evidence: Evidence) -> LinearPolicy:
    """Return the linear policy of the trial that went well for longest."""
    best = max(range(len(evidence.trials)), key=lambda i: time_lasted(evidence.trials[i]))
    return evidence.policies[best]  # type: ignore[return-value]


def time_lasted(trial: Trajectory) -> float:
    """Return how long a trial went well, s: to its failure, or to its end if it did not fail."""
    return trial.duration if trial.failure_time is None else trial.failure_time
