"""`donut-incremental`: keep what works in part, explore only the rest.

The paper's proposed future work ("we explore until we improve a part of the response for certain
angles in the state and use that mapping to bootstrap subsequent demonstrations", section VI). Each
step is worth keeping to the degree that little cost followed it; a mixture weighted by that says
what to do, and the exploration of the donut is scaled down where what was kept is good already.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from misstep.errors import MisstepError
from misstep.learners.donut import default_scale
from misstep.learners.learner import LEARNERS, Evidence, Task, joint_samples
from misstep.learners.mixtures import (
    MixtureParameters,
    MixturePolicy,
    mixture_arrays,
    restore_mixture,
)
from misstep.mixture import Conditioner, DonutMixture, GaussianMixture, exploration_from_variance
from misstep.mixture.donut_mixture import check_scale
from misstep.parameters import check_parameters, parameter
from misstep.trajectory import Trajectory

Array = NDArray[np.float64]

LEAST_WEIGHT = 1e-3


class IncrementalPolicy(MixturePolicy):
    """The mode of a donut mixture that explores less where the kept steps were good.

    Parameters
    ----------
    task : Task
    mixture : GaussianMixture
        On the columns (state, action), weighted by merit.
    merit : GaussianMixture
        On the columns (state, merit).
    scale : ndarray, shape (m,)
        s of the exploration formula, in the action's unit.

    Raises
    ------
    MisstepError
        If a mixture has other columns than the task, or s is out of its range.
    """

    def __init__(
        self, task: Task, mixture: GaussianMixture, merit: GaussianMixture, scale: Array
    ) -> None:
        super().__init__(task, mixture)
        check_scale(scale, len(task.action_columns))
        self.merit = merit
        self.scale = scale
        n, columns = len(task.state), merit.means_.shape[1]
        if columns != n + 1:
            raise MisstepError(
                f"the policy's merit has {columns} columns, but the task has {n} of state"
            )
        self._merit = Conditioner(merit, range(n))
        self.reset()

    def reset(self) -> None:
        """Forget the previous action: the first climb starts from the best candidate."""
        self._previous: Array | None = None

    def __call__(self, observation: Array, /) -> Array:
        """Return the mode, clipped; the next climb starts from there."""
        state = self.state_of(observation)
        conditional = self.conditioner.at(state)
        kept = float(np.clip(self._merit.at(state).mean[0], 0.0, 1.0))
        exploration = exploration_from_variance(conditional.variance, self.scale) * (1.0 - kept)
        mode = DonutMixture(conditional, exploration).mode(self._previous)
        self._previous = self.clipped(mode)
        return self._previous.copy()

    def arrays(self) -> dict[str, Array]:
        """Return both mixtures and s."""
        merit = mixture_arrays(self.merit, "merit_{}")
        return {**super().arrays(), **merit, "scale": self.scale}


@LEARNERS.register("donut-incremental")
@dataclass(frozen=True)
class DonutIncremental(MixtureParameters):
    """Rung 3: the donut, keeping what was followed by little cost and exploring the rest."""

    outlook: float = parameter(
        0.5, "s", "how far ahead the cost of a step is counted", above=0, at_most=3600
    )

    rung: ClassVar[int] = 3

    def __post_init__(self) -> None:
        check_parameters(self, "learner donut-incremental")

    def policy(self, task: Task, evidence: Evidence, rng: np.random.Generator) -> IncrementalPolicy:
        """Return the policy that explores where nothing good is known."""
        samples = joint_samples(task, evidence.attempts)
        merit = merits(evidence.attempts, max(1, round(self.outlook / task.dt)))
        if np.ptp(merit) == 0.0:
            raise MisstepError(
                "all steps of all attempts cost the same: donut-incremental needs costs that tell "
                "good steps from bad ones"
            )
        states = samples[:, : len(task.state)]
        return IncrementalPolicy(
            task,
            self.fit(samples, rng, np.maximum(merit, LEAST_WEIGHT)),
            self.fit(np.column_stack([states, merit]), rng),
            default_scale(evidence.demonstrations),
        )

    @staticmethod
    def restore(task: Task, arrays: Mapping[str, Array]) -> IncrementalPolicy:
        """Return the policy that `IncrementalPolicy.arrays` described."""
        merit = restore_mixture(arrays, "merit_{}")
        return IncrementalPolicy(task, restore_mixture(arrays), merit, arrays["scale"])


def merits(attempts: Sequence[Trajectory], outlook: int) -> Array:
    """Return each step's rank by the mean cost of the next `outlook` steps, 1 the best, shape (N,).

    Past the end of a failed attempt every step costs as much as the worst that was seen, past the
    end of another as much as its last.

    Raises
    ------
    MisstepError
        If an attempt has no costs.
    """
    if any(t.costs is None for t in attempts):
        raise MisstepError(
            "donut-incremental needs the cost of each step of every attempt (rung 3)"
        )
    worst = max(float(np.max(t.costs)) for t in attempts)  # type: ignore[arg-type]
    following = []
    for attempt in attempts:
        costs = np.asarray(attempt.costs)
        beyond = worst if attempt.failure_step is not None else float(costs[-1])
        total = np.concatenate([[0.0], np.cumsum(np.append(costs, np.full(outlook, beyond)))])
        following.append((total[outlook:-1] - total[: -outlook - 1]) / outlook)
    ranks: Array = rankdata(-np.concatenate(following)) / sum(len(f) for f in following)
    return ranks
