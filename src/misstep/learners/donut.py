"""`donut`: explore away from what was shown, where the demonstrators disagreed.

The method of Grollman & Billard (2011) as the paper runs it (sections IV-B and V-B): fit a mixture
on all attempts, condition it on the state, turn it into a donut mixture whose exploration grows
with the variance of the actions there, climb from the previous action to a mode, and do that.
Every failure counts the same.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from misstep.errors import MisstepError
from misstep.learners.learner import LEARNERS, Evidence, Task, joint_samples
from misstep.learners.mixtures import (
    MixtureParameters,
    MixturePolicy,
    restore_mixture,
)
from misstep.mixture import DonutMixture, GaussianMixture, compiled, exploration_from_variance
from misstep.mixture.donut import DEFAULT_K, DEFAULT_REACH, check_family
from misstep.mixture.donut_mixture import FORMULAS, component_arrays
from misstep.parameters import check_parameters, parameter
from misstep.trajectory import Trajectory

Array = NDArray[np.float64]

# How far demonstrated actions spread, times this, is the disagreement that counts as half.
SCALE_SHARE = 0.3
CLIMBS = ("warm", "density", "global")


@dataclass(frozen=True)
class DonutParameters(MixtureParameters):
    """Parameters of the learners that act at the mode of a donut mixture."""

    k: float = parameter(DEFAULT_K, "", "hole narrower than hill by this factor", above=1)
    reach: float = parameter(
        DEFAULT_REACH, "", "how much full exploration widens the hill", at_least=1
    )
    scale: float = parameter(
        0.0,
        "action's unit",
        "s in ε = 1 − 1/(1 + V/s²); 0: 0.3 × the demonstrated standard deviation of each action",
        at_least=0,
    )
    climb: str = parameter(
        "warm",
        "",
        "warm: up the log density from the previous action; density: up the density itself, as in "
        "the paper, so that the action stays where that is flat; global: from the best candidate",
    )
    formula: str = parameter(
        "prose", "", "exploration as the paper's text describes it, or as its equation is printed"
    )

    def check(self, owner: str) -> None:
        """Raise MisstepError if a parameter is out of its range."""
        check_parameters(self, owner)
        check_family(self.k, self.reach)
        for name, valid in (("climb", CLIMBS), ("formula", FORMULAS)):
            if getattr(self, name) not in valid:
                raise MisstepError(
                    f"{owner}: {name} is {getattr(self, name)!r}; there are: {', '.join(valid)}"
                )

    @staticmethod
    def restore(task: Task, arrays: Mapping[str, Array]) -> "DonutPolicy":
        """Return the policy that `DonutPolicy.arrays` described."""
        k, reach, climb, formula = arrays["settings"].tolist()
        settings = DonutSettings(k, reach, CLIMBS[int(climb)], FORMULAS[int(formula)])
        return DonutPolicy(task, restore_mixture(arrays), arrays["scale"], settings)

    def act_on(
        self, task: Task, mixture: GaussianMixture, demonstrations: Sequence[Trajectory]
    ) -> "DonutPolicy":
        """Return the policy that explores away from `mixture`."""
        m = len(task.action_columns)
        scale = np.full(m, self.scale)
        if self.scale == 0.0:
            shown = np.concatenate([t.actions for t in demonstrations])
            scale = SCALE_SHARE * shown.std(axis=0)
        settings = DonutSettings(self.k, self.reach, self.climb, self.formula)
        return DonutPolicy(task, mixture, scale, settings)


class DonutSettings(NamedTuple):
    """What a donut policy does with its mixture; see `DonutParameters`."""

    k: float
    reach: float
    climb: str
    formula: str


class DonutPolicy(MixturePolicy):
    """The mode of the donut mixture at the present state.

    Parameters
    ----------
    task : Task
    mixture : GaussianMixture
    scale : ndarray, shape (m,)
        s, in the action's unit.
    settings : DonutSettings

    Raises
    ------
    MisstepError
        If the mixture has other columns than the task, or a number is out of its range.

    Attributes
    ----------
    exploration : float
        ε at the last state.
    """

    def __init__(
        self,
        task: Task,
        mixture: GaussianMixture,
        scale: Array,
        settings: DonutSettings,
    ) -> None:
        super().__init__(task, mixture)
        m = len(task.action_columns)
        if scale.shape != (m,) or not np.all((scale > 0) & (scale < np.inf)):
            raise MisstepError(f"the policy's scale must be {m} positive numbers, got {scale}")
        check_family(settings.k, settings.reach)
        self.scale = scale
        self.settings = settings
        c = self.conditioner
        self._arrays = (
            c.state_constants,
            c.state_means,
            c.state_whiteners,
            c.gains,
            c.action_means,
            c.covariances,
            *component_arrays(c.covariances),
        )
        self.reset()

    def reset(self) -> None:
        """Forget the previous action: the first climb starts from the best candidate."""
        self._action = np.zeros(len(self.scale))
        self._first = True
        self.exploration = 0.0

    def __call__(self, observation: Array, /) -> Array:
        """Return the mode, clipped; the next climb starts from there."""
        k, reach, climb, formula = self.settings
        self.exploration = compiled.explore(
            self.state_of(observation),
            self._action,
            climb != "global" and not self._first,
            climb == "density",
            formula == "printed",
            k,
            reach,
            self.scale,
            *self._arrays,
        )
        self._first = False
        self._action = self.clipped(self._action)
        return self._action.copy()

    def donut_at(self, state: ArrayLike) -> DonutMixture:
        """Return the donut mixture at `state` (n,), for looking at and measuring."""
        k, reach, _, formula = self.settings
        conditional = self.conditioner.at(state)
        exploration = exploration_from_variance(conditional.variance, self.scale, formula)
        return DonutMixture(conditional, exploration, k, reach)

    def arrays(self) -> dict[str, Array]:
        """Return the mixture's parameters, s and the settings."""
        k, reach, climb, formula = self.settings
        settings = np.array([k, reach, CLIMBS.index(climb), FORMULAS.index(formula)])
        return super().arrays() | {"scale": self.scale, "settings": settings}


@LEARNERS.register("donut")
@dataclass(frozen=True)
class DonutLearner(DonutParameters):
    """Rung 1: the donut mixture of Grollman & Billard; all failures count the same."""

    rung: ClassVar[int] = 1

    def __post_init__(self) -> None:
        self.check("learner donut")

    def policy(self, task: Task, evidence: Evidence, rng: np.random.Generator) -> DonutPolicy:
        """Return the donut policy on all attempts."""
        mixture = self.fit(joint_samples(task, evidence.attempts), rng)
        return self.act_on(task, mixture, evidence.demonstrations)
