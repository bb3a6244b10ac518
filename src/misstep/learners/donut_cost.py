"""`donut-cost`: the donut, with bad attempts counting more (the paper, section IV-C).

The paper trains a mixture on each attempt, draws samples from each in proportion to the attempt's
cost, and fits the mixture that is explored on those samples (`method=samples`). The same weighting
without the detour through samples is a weighted fit (`method=weights`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.learners.donut import DonutParameters, DonutPolicy
from misstep.learners.learner import LEARNERS, Evidence, Task, joint_samples
from misstep.learners.mixtures import check_choice
from misstep.mixture import GaussianMixture
from misstep.parameters import parameter
from misstep.trajectory import Trajectory

Array = NDArray[np.float64]

METHODS = ("samples", "weights")


@LEARNERS.register("donut-cost")
@dataclass(frozen=True)
class DonutCostLearner(DonutParameters):
    """Rung 3: the donut on a mixture in which an attempt counts in proportion to its cost."""

    method: str = parameter(
        "samples", "", "samples: drawn from a mixture of each attempt (the paper); weights: direct"
    )
    rung: ClassVar[int] = 3

    def __post_init__(self) -> None:
        self.check("learner donut-cost")
        check_choice("learner donut-cost", "method", self.method, METHODS)

    def policy(self, task: Task, evidence: Evidence, rng: np.random.Generator) -> DonutPolicy:
        """Return the donut policy on the cost-weighted attempts."""
        shares = cost_shares(evidence.attempts)
        fit = self._from_samples if self.method == "samples" else self._from_weights
        return self.act_on(task, fit(task, evidence.attempts, shares, rng), evidence.demonstrations)

    def _from_samples(
        self, task: Task, attempts: Sequence[Trajectory], shares: Array, rng: np.random.Generator
    ) -> GaussianMixture:
        """As many samples as there were steps, shared out by cost among the attempts' mixtures."""
        samples = joint_samples(task, attempts)
        ends = np.cumsum([t.n_steps for t in attempts])
        drawn = []
        for own, share in zip(np.split(samples, ends[:-1]), shares, strict=True):
            count = round(share * len(samples))
            if count:
                drawn.append(self._samples_like(own, count, rng))
        return self.fit(np.concatenate(drawn), rng)

    def _samples_like(self, samples: Array, count: int, rng: np.random.Generator) -> Array:
        """Draw from the mixture of one attempt; a column that never varies in it stays as it is."""
        drawn = np.tile(samples[0], (count, 1))
        varying = np.ptp(samples, axis=0) > 0
        if varying.any():
            mixture = self.fit(samples[:, varying], rng)
            drawn[:, varying] = mixture.sample(count, rng)[0]
        return drawn

    def _from_weights(
        self, task: Task, attempts: Sequence[Trajectory], shares: Array, rng: np.random.Generator
    ) -> GaussianMixture:
        """Each step weighs its attempt's share divided by the attempt's length."""
        lengths = np.array([t.n_steps for t in attempts])
        weight = np.repeat(shares / lengths, lengths) * lengths.sum()
        return self.fit(joint_samples(task, attempts), rng, weight)


def cost_shares(attempts: Sequence[Trajectory]) -> Array:
    """Return each attempt's mean cost as a share of all, shape (number of attempts,).

    Raises
    ------
    MisstepError
        If an attempt has no costs, a negative mean cost, or all cost nothing.
    """
    means = []
    for index, attempt in enumerate(attempts):
        if attempt.costs is None:
            raise MisstepError(
                f"attempt {index} has no costs: donut-cost needs the cost of each step (rung 3)"
            )
        means.append(attempt.costs.mean())
    costs = np.array(means)
    if costs.min() < 0 or costs.sum() <= 0:
        raise MisstepError(
            f"the mean costs of the attempts are {costs}: donut-cost needs them nowhere negative "
            f"and somewhere positive"
        )
    shares: Array = costs / costs.sum()
    return shares
