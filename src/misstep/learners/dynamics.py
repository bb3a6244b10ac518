"""`dynamics`: learn how the system responds from every attempt, and plan in that.

A failed demonstration is perfectly good data on how the system moves. A probabilistic forward model
is fitted on all attempts, and the policy plans in it at every step. Planning needs the cost of
states nobody has been in, so the cost is wanted as a function.

The model and the planner see the state's columns alone: what is left out of the state is neither
predicted nor does it cost anything.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from misstep.costs import StateCost
from misstep.dynamics import ForwardModel, Planner
from misstep.dynamics.compiled import Model
from misstep.dynamics.planner import HORIZON
from misstep.errors import MisstepError
from misstep.learners.learner import LEARNERS, Evidence, Task
from misstep.parameters import check_parameters, parameter
from misstep.trajectory import Outcome, Trajectory

Array = NDArray[np.float64]

_MODEL = "model_"
_MODEL_TYPES: dict[str, Any] = {"angles": np.bool_, "learned": np.int64, "source": np.int64}
_LONGEST_HORIZON = 10_000


class DynamicsPolicy:
    """Plans in a forward model at every step; deterministic.

    Parameters
    ----------
    task : Task
    model : Model
        Of the state's columns, with actions in [−1, 1].
    cost : StateCost
        Of the state's columns.
    horizon : int
        Length of a plan, in control periods.
    seed : int
        Of the random plans.

    Raises
    ------
    MisstepError
        If the model or the cost has other columns than the task.
    """

    def __init__(self, task: Task, model: Model, cost: StateCost, horizon: int, seed: int) -> None:
        model.check()
        n, m = len(task.state), len(task.action_columns)
        lengths = {len(values) for values in (cost.goal, cost.weights, cost.limits)}
        if (len(model.angles), model.n_actions) != (n, m) or lengths != {n}:
            raise MisstepError(
                f"the policy's model has {len(model.angles)} columns and {model.n_actions} "
                f"actions and its cost {sorted(lengths)} columns, but the task has {n} and {m}"
            )
        if not 1 <= horizon <= _LONGEST_HORIZON:
            raise MisstepError(
                f"the policy's horizon is {horizon} steps; it must be 1 to {_LONGEST_HORIZON}"
            )
        self.task = task
        self.planner = Planner(model, cost, horizon=horizon, seed=seed)
        self._settings = np.array([horizon, seed], dtype=np.int64)
        self._cost = cost
        self._indices = task.state_indices
        self._middle = 0.5 * (task.action_high + task.action_low)
        self._reach = 0.5 * (task.action_high - task.action_low)

    def reset(self) -> None:
        """Forget the plan."""
        self.planner.reset()

    def __call__(self, observation: Array, /) -> Array:
        """Return the first action of the best plan found from here."""
        state = np.asarray(observation[self._indices], dtype=np.float64)
        action: Array = self._middle + self._reach * self.planner(state)
        return action

    def arrays(self) -> dict[str, Array]:
        """Return the model, the cost and the settings."""
        model = {_MODEL + name: values for name, values in self.planner.model._asdict().items()}
        cost = {name: np.array(getattr(self._cost, name)) for name in ("goal", "weights", "limits")}
        return {**model, **cost, "settings": self._settings}


@LEARNERS.register("dynamics")
@dataclass(frozen=True)
class Dynamics:
    """Rung 4: a forward model learned from every attempt, and a plan in it at every step."""

    horizon: int = parameter(
        HORIZON, "control periods", "how far ahead a plan looks", at_least=2, at_most=1000
    )
    centres: int = parameter(
        150, "", "most centres of the sparse Gaussian process", at_least=1, at_most=1000
    )
    trial_seconds: float = parameter(
        5.0, "s", "how much of a failed trial, from its start, is learned from", above=0
    )
    rung: ClassVar[int] = 4

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
        cost = _cost_of_state(task)
        attempts = [*evidence.demonstrations, *map(self._worth_learning, evidence.trials)]
        model = ForwardModel.fit(
            [(t.select(task.state), t.actions) for t in attempts],
            task.angles[task.state_indices],
            task.action_low,
            task.action_high,
            rng,
            n_centres=self.centres,
        )
        seed = int(rng.integers(2**32))
        return DynamicsPolicy(task, model.compiled(), cost, self.horizon, seed)

    @staticmethod
    def restore(task: Task, arrays: Mapping[str, Array]) -> DynamicsPolicy:
        """Return the policy that `DynamicsPolicy.arrays` described."""
        values = [
            np.ascontiguousarray(arrays[_MODEL + name], dtype=_MODEL_TYPES.get(name, np.float64))
            for name in Model._fields
        ]
        goal, weights, limits = (
            tuple(arrays[name].astype(np.float64)) for name in ("goal", "weights", "limits")
        )
        horizon, seed = (int(setting) for setting in arrays["settings"])
        return DynamicsPolicy(task, Model(*values), StateCost(goal, weights, limits), horizon, seed)

    def _worth_learning(self, trial: Trajectory) -> Trajectory:
        """Leave out what a failed trial did long after it could still have succeeded."""
        steps = max(1, round(self.trial_seconds / trial.dt))
        long = trial.outcome is Outcome.FAILURE and trial.n_steps > steps
        return trial.cut(steps) if long else trial


def _cost_of_state(task: Task) -> StateCost:
    """Return the task's cost, of the state's columns alone."""
    if task.cost is None:
        raise MisstepError(
            "dynamics needs a cost as a function of the observation (rung 4): give the system a "
            "cost, for example StateCost(goal, weights, limits)"
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
