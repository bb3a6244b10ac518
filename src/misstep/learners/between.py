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
    max_components: int = parameter(3, "", "largest number that BIC may choose", at_least=1)

    rung: ClassVar[int] = 1

    def __post_init__(self) -> None:
        check_parameters(self, f"learner {type(self).__name__}")

    def mixtures(
        self, task: Task, attempts: Sequence[Trajectory], rng: np.random.Generator
    ) -> list[GaussianMixture]:
        """Return a mixture of each attempt."""
        return [self.fit(joint_samples(task, [attempt]), rng) for attempt in attempts]

    @staticmethod
    def restore(task: Task, arrays: Mapping[str, Array]) -> BlendPolicy:
        """Return the policy that `BlendPolicy.arrays` described."""
        return BlendPolicy.restore(task, arrays)


@LEARNERS.register("balanced-mean")
@dataclass(frozen=True)
class BalancedMean(_Blend):
    """Rung 1: the mean of all failures, every demonstrator with an equal say (reconstructed).

    The first trial weighs all demonstrators equally, later ones by a Bayesian bootstrap.
    """

    def policy(self, task: Task, evidence: Evidence, rng: np.random.Generator) -> BlendPolicy:
        """Return the balanced mean."""
        who = [t.provenance.demonstrator for t in evidence.demonstrations]
        say = np.array([1.0 / who.count(name) for name in who])
        if evidence.trials:
            say = say * rng.exponential(size=len(say))
        mixtures = self.mixtures(task, evidence.demonstrations, rng)
        return BlendPolicy(task, mixtures, say / say.sum())


@LEARNERS.register("widest-gap")
@dataclass(frozen=True)
class WidestGap(_Blend):
    """Rung 1: the middle of the widest gap between neighbouring failures that nobody tried yet.

    Attempts are ordered by their mean action over all states that were met; trials that failed
    close gaps.
    """

    def policy(self, task: Task, evidence: Evidence, rng: np.random.Generator) -> BlendPolicy:
        """Return the mean of the two failures around the widest gap."""
        failed = [t for t in evidence.attempts if t.outcome is not Outcome.SUCCESS]
        mixtures = self.mixtures(task, failed, rng)
        if len(mixtures) == 1:
            return BlendPolicy(task, mixtures, np.ones(1))
        strengths = _strengths(task, failed, mixtures)
        order = np.argsort(strengths, kind="stable")
        gap = int(np.argmax(np.diff(strengths[order])))
        pair = [mixtures[order[gap]], mixtures[order[gap + 1]]]
        return BlendPolicy(task, pair, np.array([0.5, 0.5]))


@LEARNERS.register("random-scaling")
@dataclass(frozen=True)
class RandomScaling(_Blend):
    """Rung 1: the demonstrations' mean times a random factor; learns nothing."""

    widest: float = parameter(2.0, "", "largest factor, and the inverse of the smallest", above=1)

    def policy(self, task: Task, evidence: Evidence, rng: np.random.Generator) -> BlendPolicy:
        """Return the scaled mean; the first trial is not scaled."""
        bound = np.log(self.widest)
        factor = np.exp(rng.uniform(-bound, bound)) if evidence.trials else 1.0
        mixtures = self.mixtures(task, evidence.demonstrations, rng)
        return BlendPolicy(task, mixtures, np.full(len(mixtures), factor / len(mixtures)))


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
