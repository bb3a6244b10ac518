"""`segments`: attract to the good part of each failure, repel from the bad one.

The paper's own open problem ("within each trajectory certain portions could be success while others
could be failures. We need to come up with some heuristic to separate the trajectory", section II),
in mixtures. Each step of a failed attempt is bad to the degree e^{−R/τ}, R the time to its failure,
and good to the rest; two weighted mixtures model both. The action maximises

    log DMM_good(a | ξ) − β log p_bad(a | ξ):

near what was done when all went well, away from what was done on the way down, with a donut's hole
where the good parts disagree.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.learners.donut import default_scale
from misstep.learners.learner import LEARNERS, Evidence, Task, joint_samples
from misstep.learners.mixtures import (
    MixtureParameters,
    MixturePolicy,
    mixture_arrays,
    restore_mixture,
)
from misstep.mixture import DonutMixture, GaussianMixture, exploration_from_variance
from misstep.mixture.donut_mixture import check_scale
from misstep.parameters import check_parameters, parameter
from misstep.trajectory import Trajectory

Array = NDArray[np.float64]

# Actions that are weighed against each other, in each dimension.
CANDIDATES = {1: 81, 2: 15}
# A step weighs at least this in either mixture, so that neither lacks samples.
LEAST_WEIGHT = 1e-3


class SegmentsPolicy(MixturePolicy):
    """The best of a grid of actions, by the good and the bad mixture.

    Parameters
    ----------
    task : Task
    good, bad : GaussianMixture
        On the columns (state, action).
    scale : ndarray, shape (m,)
        s of the exploration formula, in the action's unit.
    repulsion : float
        β.

    Raises
    ------
    MisstepError
        If a mixture has other columns than the task, s or β is out of its range, or there are more
        than two actions or one without limits.
    """

    def __init__(
        self,
        task: Task,
        good: GaussianMixture,
        bad: GaussianMixture,
        scale: Array,
        repulsion: float,
    ) -> None:
        super().__init__(task, good)
        check_scale(scale, len(task.action_columns))
        if not 0.0 <= repulsion < math.inf:
            raise MisstepError(
                f"the policy's repulsion is {repulsion:g}: a number, at least 0, is wanted"
            )
        self.bad = MixturePolicy(task, bad)
        self.scale = scale
        self.repulsion = repulsion
        self._candidates = _grid(task)

    def __call__(self, observation: Array, /) -> Array:
        """Return the candidate that is most like the good parts and least like the bad."""
        state = self.state_of(observation)
        liked = self.conditioner.at(state)
        exploration = exploration_from_variance(liked.variance, self.scale)
        attraction = DonutMixture(liked, exploration).log_pdf(self._candidates)
        plain = DonutMixture(self.bad.conditioner.at(state), 0.0).log_pdf(self._candidates)
        # Beyond all bad examples one action is not better than another for being further off.
        repulsion = np.maximum(plain, plain.max() - 20.0)
        best: Array = self._candidates[int(np.argmax(attraction - self.repulsion * repulsion))]
        return best.copy()

    def arrays(self) -> dict[str, Array]:
        """Return both mixtures, s and β."""
        bad = mixture_arrays(self.bad.mixture, "bad_{}")
        own = {"scale": self.scale, "repulsion": np.array(self.repulsion)}
        return {**super().arrays(), **bad, **own}


@LEARNERS.register("segments")
@dataclass(frozen=True)
class Segments(MixtureParameters):
    """Rung 2: attracts to what was done well before a failure, repels from what was done last."""

    blame: float = parameter(
        0.3, "s", "τ: how long before its failure an attempt turns bad", above=0
    )
    repulsion: float = parameter(0.5, "", "β: weight of the bad parts", at_least=0)

    rung: ClassVar[int] = 2

    def __post_init__(self) -> None:
        check_parameters(self, "learner segments")

    def policy(self, task: Task, evidence: Evidence, rng: np.random.Generator) -> SegmentsPolicy:
        """Return the policy between the good and the bad parts of all attempts."""
        samples = joint_samples(task, evidence.attempts)
        bad = np.concatenate([self.badness(t) for t in evidence.attempts])
        if bad.max() == 0.0:
            raise MisstepError(
                "segments needs the time of at least one failure: set a failure predicate (rung 2)"
            )
        return SegmentsPolicy(
            task,
            self.fit(samples, rng, np.maximum(1.0 - bad, LEAST_WEIGHT)),
            self.fit(samples, rng, np.maximum(bad, LEAST_WEIGHT)),
            default_scale(evidence.demonstrations),
            self.repulsion,
        )

    def badness(self, attempt: Trajectory) -> Array:
        """Return how bad each step is, from 0 to 1, shape (T,)."""
        if attempt.failure_step is None:
            return np.zeros(attempt.n_steps)
        remaining = (attempt.failure_step - np.arange(attempt.n_steps)) * attempt.dt
        bad: Array = np.exp(-np.maximum(remaining, 0.0) / self.blame)
        return bad

    @staticmethod
    def restore(task: Task, arrays: Mapping[str, Array]) -> SegmentsPolicy:
        """Return the policy that `SegmentsPolicy.arrays` described."""
        return SegmentsPolicy(
            task,
            restore_mixture(arrays),
            restore_mixture(arrays, "bad_{}"),
            arrays["scale"],
            float(arrays["repulsion"]),
        )


def _grid(task: Task) -> Array:
    """Return the candidate actions, shape (number, m)."""
    m = len(task.action_columns)
    if m not in CANDIDATES:
        raise MisstepError(f"segments handles one or two actions, the system takes {m}")
    task.check_limits()
    axes = [
        np.linspace(low, high, CANDIDATES[m])
        for low, high in zip(task.action_low, task.action_high, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, m)
