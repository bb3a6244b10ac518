"""`mean`: repeat the average of what was shown. The baseline that any learner has to beat."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from misstep.learners.learner import LEARNERS, Evidence, Task
from misstep.learners.mixtures import MixturePolicy, SpacedMixtureParameters, restore_mixture
from misstep.parameters import check_parameters

Array = NDArray[np.float64]


class MeanPolicy(MixturePolicy):
    """The conditional mean of the actions: Gaussian mixture regression."""

    def __call__(self, observation: Array, /) -> Array:
        """Return E[action | state], clipped."""
        return self.clipped(self.conditioner.at(self.state_of(observation)).mean)


@LEARNERS.register("mean")
@dataclass(frozen=True)
class Mean(SpacedMixtureParameters):
    """Rung 0: Gaussian mixture regression on everything that was tried; explores nothing."""

    rung: ClassVar[int] = 0

    def __post_init__(self) -> None:
        check_parameters(self, "learner mean")
        self.check_spacing("learner mean")

    def policy(self, task: Task, evidence: Evidence, rng: np.random.Generator) -> MeanPolicy:
        """Return the average of all attempts as a policy."""
        return MeanPolicy(task, self.fit_attempts(task, evidence.attempts, rng))

    @staticmethod
    def restore(task: Task, arrays: Mapping[str, Array]) -> MeanPolicy:
        """Return the policy that `MeanPolicy.arrays` described."""
        return MeanPolicy(task, restore_mixture(arrays))
