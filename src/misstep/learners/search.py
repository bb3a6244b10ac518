"""Black-box search of linear policies by the cost of a trial: `cma-es` and `power`.

Both are given what the paper's related work gives them, a cost, and both start from the (weighted)
average of the failed demonstrations.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.learners.learner import LEARNERS, Evidence, Task
from misstep.learners.linear import LinearLearner, LinearPolicy, LinearSpace
from misstep.parameters import check_parameters, parameter
from misstep.trajectory import Trajectory

Array = NDArray[np.float64]


@LEARNERS.register("cma-es")
@dataclass(frozen=True)
class CmaEs(LinearLearner):
    """Rung 3: CMA-ES on the gains of a linear policy, from the demonstrations' average."""

    size: float = parameter(
        0.5, "", "first step size, in actuator limits per spread of the state", above=0
    )

    rung: ClassVar[int] = 3

    def __post_init__(self) -> None:
        check_parameters(self, "learner cma-es")

    def policy(self, task: Task, evidence: Evidence, rng: np.random.Generator) -> LinearPolicy:
        """Return the next candidate; the search so far is replayed from the run's seed."""
        import cma  # slow to import, and no other learner needs it

        space = LinearSpace(task, evidence.demonstrations)
        past = np.random.default_rng(evidence.seed)

        def normal(*shape: int) -> Array:
            return past.standard_normal(shape)

        # Not a number: leave NumPy's global generator alone.
        options = {"seed": np.nan, "randn": normal, "verbose": -9}
        search = cma.CMAEvolutionStrategy(space.average(), self.size, options)
        worst = worst_cost(evidence.demonstrations)
        losses = [excess_cost(trial, worst) for trial in evidence.trials]
        candidates = search.ask()
        while len(losses) >= len(candidates):
            search.tell(candidates, losses[: len(candidates)])
            losses = losses[len(candidates) :]
            candidates = search.ask()
        return space.policy(np.asarray(candidates[len(losses)]))


@LEARNERS.register("power")
@dataclass(frozen=True)
class Power(LinearLearner):
    """Rung 3: PoWER (the paper's reference [3]): average the best trials, perturb the average.

    The demonstrations are its first data: the search starts from their average, weighted by
    exp(−cost). A trial is then the reward-weighted mean of the best trials' gains, plus noise.

    References
    ----------
    Kober & Peters, *Policy search for motor primitives in robotics* (2009), episodic form.
    """

    size: float = parameter(
        0.5, "", "standard deviation of the exploration, in actuator limits per spread", above=0
    )
    best: int = parameter(5, "", "how many of the best trials are averaged", at_least=1)

    rung: ClassVar[int] = 3

    def __post_init__(self) -> None:
        check_parameters(self, "learner power")

    def policy(self, task: Task, evidence: Evidence, rng: np.random.Generator) -> LinearPolicy:
        """Return the reward-weighted mean of the best, perturbed."""
        space = LinearSpace(task, evidence.demonstrations)
        rewards = _rewards(evidence.attempts, worst_cost(evidence.demonstrations))
        lengths = [t.n_steps for t in evidence.demonstrations]
        start = space.average(np.repeat(rewards[: len(lengths)], lengths))
        if not evidence.trials:
            return space.policy(start)
        vectors = np.array([space.vector(p) for p in evidence.policies])  # type: ignore[arg-type]
        own = rewards[len(lengths) :]
        chosen = np.argsort(-own, kind="stable")[: self.best]
        mean = np.average(vectors[chosen], axis=0, weights=own[chosen])
        return space.policy(space.perturbed(mean, self.size, rng))


def worst_cost(demonstrations: Sequence[Trajectory]) -> float:
    """Return the largest cost of a step in any demonstration: what all attempts are held against.

    Raises
    ------
    MisstepError
        If no costs were recorded.
    """
    return max(float(_costs_of(demonstration).max()) for demonstration in demonstrations)


def excess_cost(attempt: Trajectory, worst: float) -> float:
    """Return Σ (cost − worst) of an attempt's steps; each step that was not the worst lowers it.

    Of two attempts whose steps cost the same, the one that lasts longer has less. The worst cost
    has to be the same for all that are compared: by its own, a success, whose worst step is a good
    one, would seem worse than the falls that it came from.

    Raises
    ------
    MisstepError
        If no costs were recorded.
    """
    return float((_costs_of(attempt) - worst).sum())


def _costs_of(attempt: Trajectory) -> Array:
    if attempt.costs is None:
        raise MisstepError("an attempt has no costs: this learner needs the cost of each step")
    return attempt.costs


def _rewards(attempts: Sequence[Trajectory], worst: float) -> Array:
    """Return a positive reward for each attempt: exp(−cost) in units of the costs' spread."""
    costs = np.array([excess_cost(t, worst) for t in attempts])
    spread = costs.std()
    return np.ones(len(costs)) if spread == 0 else np.exp(-(costs - costs.min()) / spread)
