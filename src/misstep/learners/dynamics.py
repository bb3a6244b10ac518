"""`dynamics`: learn how the system responds from every attempt, and plan in that.

A failed demonstration is perfectly good data on how the system moves. A probabilistic forward model
is fitted on all attempts, and the policy plans in it at every step. Planning needs the cost of
states nobody has been in, so the cost is wanted as a function.

The model and the planner see the state's columns alone: what is left out of the state is neither
predicted nor does it cost anything.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from misstep.costs import StateCost
from misstep.dynamics import Circles, ForwardModel, Planner
from misstep.dynamics.compiled import Model
from misstep.dynamics.forward_model import Recording
from misstep.dynamics.planner import HORIZON
from misstep.errors import MisstepError
from misstep.learners.learner import LEARNERS, Evidence, Task
from misstep.parameters import check_parameters, parameter
from misstep.trajectory import Outcome, Trajectory

Array = NDArray[np.float64]

_MODEL = "model_"
_MODEL_TYPES: dict[str, Any] = {"angles": np.bool_, "learned": np.int64, "source": np.int64}
_COST = ("goal", "weights", "limits")
_LONGEST_HORIZON = 10_000


class Known(NamedTuple):
    """What has been learned of a system, in the coordinates that it was learned in."""

    circles: Circles
    """Which columns of the state are cosines and sines: the others see their angles."""
    model: Model
    """Of the unrolled state, with actions in [−1, 1]."""
    cost: StateCost
    """Of the unrolled state."""

    def arrays(self) -> dict[str, Array]:
        """Return all of it under distinct names."""
        model = {_MODEL + name: values for name, values in self.model._asdict().items()}
        cost = {name: np.array(getattr(self.cost, name)) for name in _COST}
        return {**model, **cost, "circles": self.circles.pairs.astype(np.float64)}

    @classmethod
    def restore(cls, task: Task, arrays: Mapping[str, Array]) -> Self:
        """Return what `arrays` described.

        Raises
        ------
        MisstepError
            If the arrays fit neither each other nor the task.
        """
        circles = restored_circles(task, arrays)
        model = Model(
            *(
                np.ascontiguousarray(
                    arrays[_MODEL + name], dtype=_MODEL_TYPES.get(name, np.float64)
                )
                for name in Model._fields
            )
        )
        model.check()
        cost = StateCost(*(tuple(arrays[name].astype(np.float64)) for name in _COST))
        lengths = {len(getattr(cost, name)) for name in _COST}
        n_kept, m = len(circles.kept), len(task.action_columns)
        if (len(model.angles), model.n_actions) != (n_kept, m) or lengths != {n_kept}:
            raise MisstepError(
                f"the policy's model has {len(model.angles)} columns and {model.n_actions} "
                f"actions and its cost {sorted(lengths)} columns, but the task has {n_kept} and {m}"
            )
        return cls(circles, model, cost)


class DynamicsPolicy:
    """Plans in a forward model at every step; deterministic.

    Parameters
    ----------
    task : Task
    known : Known
    horizon : int
        Length of a plan, in control periods.
    seed : int
        Of the random plans.

    Raises
    ------
    MisstepError
        If the horizon is not from 1 to 10,000, or an action has no limits.
    """

    def __init__(self, task: Task, known: Known, horizon: int, seed: int) -> None:
        if not 1 <= horizon <= _LONGEST_HORIZON:
            raise MisstepError(
                f"the policy's horizon is {horizon} steps; it must be 1 to {_LONGEST_HORIZON}"
            )
        self.task = task
        self.known = known
        self.planner = Planner(known.model, known.cost, horizon=horizon, seed=seed)
        self._settings = np.array([horizon, seed], dtype=np.float64)
        self._indices = task.state_indices
        self._middle, self._reach = task.action_range()

    def reset(self) -> None:
        """Forget the plan."""
        self.planner.reset()

    def __call__(self, observation: Array, /) -> Array:
        """Return the first action of the best plan found from here."""
        state = np.asarray(observation[self._indices], dtype=np.float64)
        action: Array = self._middle + self._reach * self.planner(self.known.circles.unroll(state))
        return action

    def arrays(self) -> dict[str, Array]:
        """Return the model, the cost and the settings."""
        return {**self.known.arrays(), "settings": self._settings}


@dataclass(frozen=True)
class ModelParameters:
    """Parameters of the learners that model the system."""

    centres: int = parameter(
        150, "", "most centres of the sparse Gaussian process", at_least=1, at_most=1000
    )
    trial_seconds: float = parameter(
        5.0,
        "s",
        "how much of a failed trial, from its start, is learned from",
        above=0,
        at_most=1e9,
    )
    rung: ClassVar[int] = 4


@LEARNERS.register("dynamics")
@dataclass(frozen=True)
class Dynamics(ModelParameters):
    """Rung 4: a forward model learned from every attempt, and a plan in it at every step."""

    horizon: int = parameter(
        HORIZON, "control periods", "how far ahead a plan looks", at_least=2, at_most=1000
    )

    def __post_init__(self) -> None:
        check_parameters(self, "learner dynamics")

    def policy(self, task: Task, evidence: Evidence, rng: np.random.Generator) -> DynamicsPolicy:
        """Return the policy that plans in the model of all attempts.

        Raises
        ------
        MisstepError
            If the task has no cost as a function, an action without limits, or there are too few
            transitions to learn from.
        """
        learned = learn_dynamics(task, evidence, rng, self.centres, self.trial_seconds)
        known = Known(learned.circles, learned.model.compiled(), learned.cost)
        return DynamicsPolicy(task, known, self.horizon, int(rng.integers(2**32)))

    @staticmethod
    def restore(task: Task, arrays: Mapping[str, Array]) -> DynamicsPolicy:
        """Return the policy that `DynamicsPolicy.arrays` described."""
        settings = arrays["settings"]
        if settings.shape != (2,) or not np.all((settings >= 0) & (settings < 2**32)):
            raise MisstepError(
                f"the policy's horizon and seed are {settings.tolist()}: two whole numbers, at "
                f"least 0, are wanted"
            )
        return DynamicsPolicy(task, Known.restore(task, arrays), *map(int, settings))


def restored_circles(task: Task, arrays: Mapping[str, Array]) -> Circles:
    """Return the circles that were kept as the array ``circles``.

    Raises
    ------
    MisstepError
        If they are no pairs of the state's columns.
    """
    n, pairs = len(task.state), np.asarray(arrays["circles"], dtype=np.int64)
    if pairs.ndim != 2 or len(pairs) != 2 or len(set(pairs.flat) & {*range(n)}) < pairs.size:
        raise MisstepError(
            f"the policy's circles are {pairs.tolist()}: they must be two rows of distinct "
            f"columns, from 0 to {n - 1}"
        )
    return Circles(n, *pairs)


class Learned(NamedTuple):
    """What all attempts say of a system."""

    circles: Circles
    model: ForwardModel
    cost: StateCost
    """Of the unrolled state."""
    recordings: list[Recording]
    """Unrolled, and what the model was fitted on."""


def learn_dynamics(
    task: Task, evidence: Evidence, rng: np.random.Generator, centres: int, trial_seconds: float
) -> Learned:
    """Learn how the system responds from all attempts, of failed trials from their start.

    Parameters
    ----------
    task : Task
    evidence : Evidence
    rng : numpy.random.Generator
    centres : int
        Most centres of the sparse Gaussian process.
    trial_seconds : float, s
        How much of a failed trial is learned from: long after its start it could not have
        succeeded any more.

    Raises
    ------
    MisstepError
        If the task has no cost as a function, an action without limits, or there are too few
        transitions to learn from.
    """
    cost = _cost_of_state(task)
    trials = (_start_of(trial, trial_seconds) for trial in evidence.trials)
    attempts = [(t.select(task.state), t.actions) for t in (*evidence.demonstrations, *trials)]
    circles = Circles.find(np.concatenate([states for states, _ in attempts]), cost)
    recordings = [(circles.unroll(states), actions) for states, actions in attempts]
    angles = task.angles[task.state_indices][circles.kept] | circles.angles
    model = ForwardModel.fit(
        recordings, angles, task.action_low, task.action_high, rng, n_centres=centres
    )
    return Learned(circles, model, circles.unroll_cost(cost), recordings)


def _start_of(trial: Trajectory, seconds: float) -> Trajectory:
    steps = max(1, round(seconds / trial.dt))
    long = trial.outcome is Outcome.FAILURE and trial.n_steps > steps
    return trial.cut(steps) if long else trial


def _cost_of_state(task: Task) -> StateCost:
    """Return the task's cost, of the state's columns alone."""
    if task.cost is None:
        raise MisstepError(
            "learning the dynamics needs a cost as a function of the observation (rung 4): give "
            "the system a cost, for example StateCost(goal, weights, limits)"
        )
    n = len(task.observation_columns)
    goal, weights, limits = task.cost.goal, task.cost.weights, task.cost.limits
    if {len(goal), len(weights), len(limits)} != {n}:
        raise MisstepError(
            f"the cost has {len(goal)} goals, {len(weights)} weights and {len(limits)} limits, but "
            f"the system observes {n} columns"
        )
    return StateCost(
        *(tuple(values[i] for i in task.state_indices) for values in (goal, weights, limits))
    )
