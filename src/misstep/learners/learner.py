"""What a learner is: a strategy that turns what was tried into the next policy.

A learner keeps nothing between trials. It is handed all the evidence again each time and draws
from the generator of that trial alone, so that a run that was interrupted goes on exactly as one
that was not.

Each learner states its rung on the ladder of feedback, and the evidence holds no more than that
rung may see:

==== ===================================================================
rung what the learner is told of an attempt
==== ===================================================================
0    observations and actions
1    … and whether it succeeded
2    … and when it failed
3    … and what each step cost
4    … and it may learn how the system responds
==== ===================================================================
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from misstep.costs import StateCost
from misstep.errors import MisstepError
from misstep.registry import Registry
from misstep.rollout import Policy
from misstep.systems.system import System
from misstep.trajectory import Column, Outcome, Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Task:
    """What a learner knows of the system before anybody has tried anything."""

    observation_columns: tuple[Column, ...]
    action_columns: tuple[Column, ...]
    action_low: Array
    """Smallest action, shape (m,)."""
    action_high: Array
    """Largest action, shape (m,)."""
    state: tuple[str, ...]
    """Names of the observation columns that the policy may depend on."""
    dt: float
    """Control period, s."""
    cost: StateCost | None = None
    """Cost of a whole observation as a function, where the user supplies one; for rung 4 alone."""

    @classmethod
    def of(cls, system: System, state: Sequence[str] | None = None) -> Self:
        """Return the task of driving `system`, seen through the columns `state` (None: all).

        Raises
        ------
        MisstepError
            If `state` is empty, repeats a column or names one that the system does not observe.
        """
        names = [column.name for column in system.observation_columns]
        chosen = tuple(names if state is None else state)
        unknown = [name for name in chosen if name not in names]
        if unknown or not chosen or len(set(chosen)) < len(chosen):
            raise MisstepError(
                f"state {','.join(chosen) or '(empty)'}: choose distinct columns among "
                f"{', '.join(names)}"
            )
        space: Any = system.action_space
        return cls(
            system.observation_columns,
            system.action_columns,
            np.array(space.low, dtype=np.float64),
            np.array(space.high, dtype=np.float64),
            chosen,
            system.dt,
            system.cost,
        )

    def seen_from(self, rung: int) -> "Task":
        """Return the task as a learner of that rung may see it."""
        return self if rung >= 4 else replace(self, cost=None)

    @property
    def angles(self) -> NDArray[np.bool_]:
        """Which observation columns wrap around: those in rad, shape (columns,)."""
        return np.array([column.unit == "rad" for column in self.observation_columns])

    @property
    def state_indices(self) -> NDArray[np.intp]:
        """Positions of the state's columns among the observations, shape (n,)."""
        names = [column.name for column in self.observation_columns]
        return np.array([names.index(name) for name in self.state], dtype=np.intp)

    def action_range(self) -> tuple[Array, Array]:
        """Return the middle of each action's range and half of its width, both of shape (m,).

        Raises
        ------
        MisstepError
            If an action has no limits.
        """
        self.check_limits()
        low, high = self.action_low, self.action_high
        return 0.5 * (low + high), 0.5 * (high - low)

    def check_limits(self) -> None:
        """Raise MisstepError unless every action has limits."""
        limited = np.isfinite(self.action_low) & np.isfinite(self.action_high)
        for column, has_limits in zip(self.action_columns, limited, strict=True):
            if not has_limits:
                raise MisstepError(
                    f"the action {column.name} has no limits, and this learner measures actions by "
                    f"them: choose another learner, or a system with limits"
                )

    def clipped(self, action: Array) -> Array:
        """Return an action (m,) inside the actuator's limits."""
        limited: Array = np.minimum(np.maximum(action, self.action_low), self.action_high)
        return limited

    def joint(self, trajectory: Trajectory) -> Array:
        """Return the (state, action) pairs of a trajectory, shape (T, n + m)."""
        return np.concatenate([trajectory.select(self.state)[:-1], trajectory.actions], axis=1)


@dataclass(frozen=True)
class Evidence:
    """Everything that has been tried so far, as far as the learner's rung may see it."""

    demonstrations: tuple[Trajectory, ...]
    trials: tuple[Trajectory, ...]
    policies: tuple["LearnedPolicy", ...] = ()
    """The learner's own policy of each trial."""
    seed: int = 0
    """The same for all trials of a run, for learners that replay their own past."""

    @classmethod
    def seen_from(
        cls,
        rung: int,
        demonstrations: Iterable[Trajectory],
        trials: Iterable[Trajectory],
        policies: Iterable["LearnedPolicy"] = (),
        seed: int = 0,
    ) -> Self:
        """Return the evidence with everything above `rung` taken out."""
        return cls(
            tuple(_seen_from(rung, t) for t in demonstrations),
            tuple(_seen_from(rung, t) for t in trials),
            tuple(policies),
            seed,
        )

    @property
    def attempts(self) -> tuple[Trajectory, ...]:
        """Demonstrations, then trials."""
        return self.demonstrations + self.trials


class LearnedPolicy(Policy, Protocol):
    """A policy that can be kept in a file of plain arrays."""

    def arrays(self) -> dict[str, Array]:
        """Return all that `Learner.restore` needs to build the same policy again."""


class Learner(Protocol):
    """A strategy; by convention a frozen dataclass of parameters (`misstep.parameters`)."""

    rung: ClassVar[int]

    def policy(self, task: Task, evidence: Evidence, rng: np.random.Generator) -> LearnedPolicy:
        """Return the policy to try next."""

    @staticmethod
    def restore(task: Task, arrays: Mapping[str, Array]) -> LearnedPolicy:
        """Return the policy that `LearnedPolicy.arrays` described."""


def joint_samples(task: Task, attempts: Sequence[Trajectory]) -> Array:
    """Return the (state, action) pairs of all attempts, shape (N, n + m).

    Raises
    ------
    MisstepError
        If a column never varies: then there is nothing to learn from it.
    """
    samples = np.concatenate([task.joint(t) for t in attempts])
    names = [*task.state, *(column.name for column in task.action_columns)]
    for name, column in zip(names, samples.T, strict=True):
        if np.all(column == column[0]):
            raise MisstepError(
                f"column {name} is constant ({column[0]:g}) in all attempts: leave it out of the "
                f"state, or record attempts in which it varies"
            )
    return samples


LEARNERS: Registry[type[Learner]] = Registry("learner", "misstep.learners")


def _seen_from(rung: int, trajectory: Trajectory) -> Trajectory:
    if rung >= 3:
        return trajectory
    return replace(
        trajectory,
        outcome=trajectory.outcome if rung >= 1 else Outcome.UNKNOWN,
        failure_step=trajectory.failure_step if rung >= 2 else None,
        costs=None,
    )
