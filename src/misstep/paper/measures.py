"""What is measured on each run: costs, models, and how the explorations moved.

Every claim of the paper is judged on these numbers; a figure may show them, none is computed twice.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from misstep.learners import DonutPolicy
from misstep.paper.costs import horizon_costs
from misstep.paper.modes import count_modes
from misstep.runs import Run
from misstep.trajectory import Outcome, Trajectory

Array = NDArray[np.float64]

# A change of force between two steps of more than this share of the demonstrated standard deviation
# is a jump; two modes further apart than this are different modes.
JUMP = 0.5
# States along a trial at which the modes are counted, and demonstrated states at which the
# conditional variance is taken.
PROBES = 12
DEMONSTRATED_PROBES = 200


class CellMeasures(NamedTuple):
    """The numbers of one run; shapes with E explorations."""

    demonstration_costs: Array
    """(4, 3), deg, over `HORIZONS`."""
    exploration_costs: Array
    """(E, 3), deg."""
    successes: int
    components: Array
    """(E,) number of components of each model."""
    action_spread: Array
    """(E,) standard deviation of the force in each model, N."""
    disagreement: Array
    """(E,) root mean conditional variance of the force over the demonstrated states, N."""
    narrowest: Array
    """(E,) smallest over largest standard deviation of the state among the components."""
    exploration: Array
    """(E,) mean ε along each trial; 0 for plain averaging."""
    jumps: Array
    """(E,) jumps of the force along each trial."""
    above: Array
    """(E,) share of the steps with a force above the model's mean there."""
    several_modes: Array
    """(E,) share of probed states at which the donut mixture has several modes."""
    modes_differ: Array
    """(E,) share of probed states at which the chosen and the best mode differ."""

    def to_json(self) -> dict[str, Any]:
        """Return the measures as JSON can hold them."""
        return {name: np.asarray(value).tolist() for name, value in self._asdict().items()}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """Return the measures that `to_json` wrote."""
        plain: dict[str, Any] = {name: np.array(value) for name, value in values.items()}
        return cls(**{**plain, "successes": int(values["successes"])})


def measure(run: Run) -> CellMeasures:
    """Measure a finished run."""
    shown = np.concatenate([t.actions for t in run.demonstrations])
    scale = float(shown.std())
    states = np.concatenate([t.select(run.config.state)[:-1] for t in run.demonstrations])
    states = states[np.linspace(0, len(states) - 1, DEMONSTRATED_PROBES).astype(int)]
    pairs = list(zip(run.policies, run.trials, strict=True))
    rows = [
        {"disagreement": _disagreement(policy, states), **_measure_trial(policy, trial, scale)}
        for policy, trial in pairs
    ]
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return CellMeasures(
        demonstration_costs=horizon_costs(run.demonstrations),
        exploration_costs=horizon_costs(run.trials),
        successes=sum(t.outcome is Outcome.SUCCESS for t in run.trials),
        **columns,
    )


def _measure_trial(policy: Any, trial: Trajectory, scale: float) -> dict[str, float]:
    mixture = policy.mixture
    state_spread = np.sqrt(mixture.covariances_[:, 0, 0])
    states, force = trial.select(policy.task.state)[:-1], trial.actions[:, 0]
    means = np.array([policy.conditioner.at(state).mean[0] for state in states])
    return {
        "components": len(mixture.weights_),
        "action_spread": _marginal_spread(mixture),
        "narrowest": float(state_spread.min() / state_spread.max()),
        "jumps": int(np.sum(np.abs(np.diff(force)) > JUMP * scale)),
        "above": float(np.mean(force > means)),
        **_measure_donuts(policy, states, force, JUMP * scale),
    }


def _measure_donuts(policy: Any, states: Array, force: Array, tolerance: float) -> dict[str, float]:
    """Probe the donut mixtures along a trial; plain averaging has none, and explores nothing."""
    if not isinstance(policy, DonutPolicy):
        return {"exploration": 0.0, "several_modes": 0.0, "modes_differ": 0.0}
    probes = np.linspace(0, len(states) - 1, PROBES).astype(int)
    donuts = [policy.donut_at(states[t]) for t in probes]
    best = np.array([donut.mode()[0] for donut in donuts])
    return {
        "exploration": float(np.mean([donut.exploration for donut in donuts])),
        "several_modes": float(np.mean([count_modes(donut) > 1 for donut in donuts])),
        "modes_differ": float(np.mean(np.abs(best - force[probes]) > tolerance)),
    }


def _disagreement(policy: Any, states: Array) -> float:
    variances = [policy.conditioner.at(state).variance[0, 0] for state in states]
    return float(np.sqrt(np.mean(variances)))


def _marginal_spread(mixture: Any) -> float:
    """Return the standard deviation of the last column, the force, in the whole mixture."""
    w, m, v = mixture.weights_, mixture.means_[:, -1], mixture.covariances_[:, -1, -1]
    return float(np.sqrt(w @ (v + m**2) - (w @ m) ** 2))
