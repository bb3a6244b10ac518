"""Success lies between the failures: `balanced-mean`, `widest-gap` and `random-scaling`.

For tasks that are failed on both sides of success (too timid, too strong), where all that is known
is whether a trial succeeded. Each attempt is turned into a policy of its own, a small mixture of
its (state, action) pairs; what is tried next is a weighted mean of those. `balanced-mean` is our
reconstruction of what Grollman & Billard compare with; they do not publish it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.learners.learner import LEARNERS, Evidence, Task, joint_samples
from misstep.learners.mixtures import (
    MixtureParameters,
    MixturePolicy,
    mixture_arrays,
    restore_mixture,
)
from misstep.mixture import GaussianMixture
from misstep.parameters import check_parameters, parameter
from misstep.trajectory import Outcome, Trajectory

Array = NDArray[np.float64]

_ANYWHERE = 0.2  # probability that success is not in the widest gap between the demonstrations


class BlendPolicy:
    """A weighted mean of what several mixtures do on average at a state.

    Parameters
    ----------
    task : Task
    mixtures : sequence of GaussianMixture
        One an attempt, on the columns (state, action).
    shares : ndarray, shape (number of mixtures,)
        Weight of each; they need not sum to 1.
    """

    def __init__(self, task: Task, mixtures: Sequence[GaussianMixture], shares: Array) -> None:
        self.task = task
        self.shares = shares
        self._parts = [MixturePolicy(task, mixture) for mixture in mixtures]

    def reset(self) -> None:
        """Forget the attempt before: nothing is remembered."""

    def __call__(self, observation: Array, /) -> Array:
        """Return the blend of the conditional means, clipped."""
        state = self._parts[0].state_of(observation)
        means = np.array([part.conditioner.at(state).mean for part in self._parts])
        return self._parts[0].clipped(self.shares @ means)

    def arrays(self) -> dict[str, Array]:
        """Return the shares and each mixture's parameters."""
        arrays = {"shares": self.shares}
        for index, part in enumerate(self._parts):
            arrays |= mixture_arrays(part.mixture, f"{{}}_{index}")
        return arrays

    @classmethod
    def restore(cls, task: Task, arrays: Mapping[str, Array]) -> "BlendPolicy":
        """Return the policy that `arrays` described."""
        shares = arrays["shares"]
        if shares.ndim != 1 or not len(shares) or not np.all(np.isfinite(shares)):
            raise MisstepError(f"a blend takes at least one finite share, got {shares}")
        mixtures = [restore_mixture(arrays, f"{{}}_{index}") for index in range(len(shares))]
        return cls(task, mixtures, shares)


@dataclass(frozen=True)
class _Blend(MixtureParameters):
    """A mixture for each attempt, and what is common to the learners that blend them."""

    max_components: int = parameter(3, "", "largest number that BIC may choose", at_least=1)

    rung: ClassVar[int] = 1
    learner: ClassVar[str]

    def __post_init__(self) -> None:
        check_parameters(self, f"learner {self.learner}")

    def mixtures(
        self,
        task: Task,
        attempts: Sequence[Trajectory],
        among: Sequence[Trajectory],
        rng: np.random.Generator,
    ) -> list[GaussianMixture]:
        """Return a mixture of each attempt; a column that stands still is told `among` others."""
        spread = joint_samples(task, among).std(axis=0)
        return [self._mixture(task.joint(attempt), spread, rng) for attempt in attempts]

    def _mixture(self, samples: Array, spread: Array, rng: np.random.Generator) -> GaussianMixture:
        """Fit one attempt; a single Gaussian if it is too short or stays at one limit all along."""
        if len(samples) > len(spread) and np.all(np.ptp(samples, axis=0) > 0):
            return self.fit(samples, rng)
        covariance = np.cov(samples.T, bias=True) + np.diag((self.resolution * spread) ** 2)
        return GaussianMixture.from_parameters([1.0], [samples.mean(axis=0)], [covariance])

    @staticmethod
    def restore(task: Task, arrays: Mapping[str, Array]) -> BlendPolicy:
        """Return the policy that `BlendPolicy.arrays` described."""
        return BlendPolicy.restore(task, arrays)


@LEARNERS.register("balanced-mean")
@dataclass(frozen=True)
class BalancedMean(_Blend):
    """Rung 1: the mean of all failures, every demonstrator with an equal say (reconstructed).

    The first trial weighs all demonstrators equally, later ones by a Bayesian bootstrap. Where
    demonstrations succeeded, it is the mean of those.
    """

    learner: ClassVar[str] = "balanced-mean"

    def policy(self, task: Task, evidence: Evidence, rng: np.random.Generator) -> BlendPolicy:
        """Return the balanced mean."""
        shown = evidence.demonstrations
        shown = tuple(t for t in shown if t.outcome is Outcome.SUCCESS) or shown
        who = [t.provenance.demonstrator for t in shown]
        say = np.array([1.0 / who.count(name) for name in who])
        if evidence.trials:
            say = say * rng.exponential(size=len(say))
        mixtures = self.mixtures(task, shown, evidence.demonstrations, rng)
        return BlendPolicy(task, mixtures, say / say.sum())


@LEARNERS.register("widest-gap")
@dataclass(frozen=True)
class WidestGap(_Blend):
    """Rung 1: the middle of the widest gap between neighbouring failures that nobody tried yet.

    Attempts are ordered by their mean action over all states that were met; trials that failed
    close gaps. How wide a gap is, and where its middle, is told by `success_probability`. Where
    something has succeeded, that is repeated instead.
    """

    learner: ClassVar[str] = "widest-gap"

    def policy(self, task: Task, evidence: Evidence, rng: np.random.Generator) -> BlendPolicy:
        """Return the blend of the two failures around the widest gap."""
        attempts = evidence.attempts
        succeeded = [t for t in attempts if t.outcome is Outcome.SUCCESS]
        mixtures = self.mixtures(task, succeeded or attempts, attempts, rng)
        if succeeded or len(mixtures) == 1:
            return BlendPolicy(task, mixtures, np.full(len(mixtures), 1.0 / len(mixtures)))
        strengths = _strengths(task, attempts, mixtures)
        shown = strengths[: len(evidence.demonstrations)]
        order = np.argsort(strengths, kind="stable")
        places = success_probability(strengths[order], strengths, shown)
        gap = int(np.argmax(np.diff(places)))
        below, above = order[gap : gap + 2]
        shares = np.linspace(0.0, 1.0, 1001)
        blends = (1.0 - shares) * strengths[below] + shares * strengths[above]
        middle = 0.5 * (places[gap] + places[gap + 1])
        share = np.interp(middle, success_probability(blends, strengths, shown), shares)
        pair = [mixtures[below], mixtures[above]]
        return BlendPolicy(task, pair, np.array([1.0 - share, share]))


@LEARNERS.register("random-scaling")
@dataclass(frozen=True)
class RandomScaling(_Blend):
    """Rung 1: the demonstrations' mean times a random factor; learns nothing."""

    learner: ClassVar[str] = "random-scaling"

    widest: float = parameter(2.0, "", "largest factor, and the inverse of the smallest", above=1)

    def policy(self, task: Task, evidence: Evidence, rng: np.random.Generator) -> BlendPolicy:
        """Return the scaled mean; the first trial is not scaled."""
        bound = np.log(self.widest)
        factor = np.exp(rng.uniform(-bound, bound)) if evidence.trials else 1.0
        mixtures = self.mixtures(task, evidence.demonstrations, evidence.demonstrations, rng)
        return BlendPolicy(task, mixtures, np.full(len(mixtures), factor / len(mixtures)))


def success_probability(strengths: Array, tried: Array, shown: Array) -> Array:
    """Return how probable it is that no more than these strengths succeeds, shape (N,).

    That is judged from the demonstrations alone. Success is expected near the middle of the widest
    gap between them, with density 6u(1 − u) for u from 0 to 1 across it, because next to a failure
    there is mostly another one. Should that be wrong, one part in five is spread evenly over
    everything that was tried.

    Parameters
    ----------
    strengths : ndarray, shape (N,)
    tried : ndarray, shape (at least 2,)
        The strengths of all attempts.
    shown : ndarray, shape (at least 1,)
        Those of the demonstrations.
    """
    low, high = tried.min(), tried.max()
    ordered = np.sort(shown) if len(shown) > 1 else np.array([low, high])
    gap = int(np.argmax(np.diff(ordered)))
    middle = _share_of(strengths, ordered[gap], ordered[gap + 1])
    even = _share_of(strengths, low, high)
    probability: Array = (1.0 - _ANYWHERE) * middle**2 * (3.0 - 2.0 * middle) + _ANYWHERE * even
    return probability


def _share_of(values: Array, low: float, high: float) -> Array:
    """Return where values lie from `low`, 0, to `high`, 1; cut off there."""
    share: Array = np.clip((values - low) / max(high - low, np.finfo(np.float64).tiny), 0.0, 1.0)
    return share


def _strengths(
    task: Task, attempts: Sequence[Trajectory], mixtures: Sequence[GaussianMixture]
) -> Array:
    """Return each mixture's mean action, in actuator ranges, over the states of all attempts."""
    states = np.concatenate([t.observations[:-1] for t in attempts])
    states = states[:: max(1, len(states) // 200)]
    scale = task.action_high - task.action_low
    strengths = []
    for mixture in mixtures:
        part = MixturePolicy(task, mixture)
        actions = [part.conditioner.at(part.state_of(s)).mean / scale for s in states]
        strengths.append(np.mean(actions))
    return np.array(strengths)
