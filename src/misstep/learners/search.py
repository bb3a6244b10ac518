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
        # The library takes 0 to mean "by the clock".
        options = {"seed": evidence.seed % (2**31 - 2) + 1, "verbose": -9}
        search = cma.CMAEvolutionStrategy(space.average(), self.size, options)
        losses = [total_cost(trial) for trial in evidence.trials]
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
        rewards = _rewards(evidence.attempts)
        lengths = [t.n_steps for t in evidence.demonstrations]
        start = space.average(np.repeat(rewards[: len(lengths)], lengths))
        if not evidence.trials:
            return space.policy(start)
        vectors = np.array([space.vector(p) for p in evidence.policies])  # type: ignore[arg-type]
        own = rewards[len(lengths) :]
        chosen = np.argsort(-own, kind="stable")[: self.best]
        mean = np.average(vectors[chosen], axis=0, weights=own[chosen])
        return space.policy(space.perturbed(mean, self.size, rng))


def total_cost(attempt: Trajectory) -> float:
    """Return by how much an attempt's steps cost less than its worst one, summed, with a minus.

    Of two attempts that end as badly, the one that lasts longer costs less.

    Raises
    ------
    MisstepError
        If no costs were recorded.
    """
    if attempt.costs is None:
        raise MisstepError("an attempt has no costs: this learner needs the cost of each step")
    return float(attempt.costs.sum() - attempt.costs.max() * attempt.n_steps)


def _rewards(attempts: Sequence[Trajectory]) -> Array:
    """Return a positive reward for each attempt: exp(−cost) in units of the costs' spread."""
    costs = np.array([total_cost(t) for t in attempts])
    spread = costs.std()
    return np.ones(len(costs)) if spread == 0 else np.exp(-(costs - costs.min()) / spread)
