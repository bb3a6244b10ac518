"""`donut`: explore away from what was shown, where the demonstrators disagreed.

The method of Grollman & Billard (2011) as the paper runs it (sections IV-B and V-B): fit a mixture
on all attempts, condition it on the state, turn it into a donut mixture whose exploration grows
with the variance of the actions there, climb from the previous action to a mode, and do that.
Every failure counts the same.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from misstep.errors import MisstepError
from misstep.learners.learner import LEARNERS, Evidence, Task
from misstep.learners.mixtures import (
    MixtureParameters,
    MixturePolicy,
    SpacedMixtureParameters,
    check_choice,
    restore_mixture,
)
from misstep.mixture import (
    DonutMixture,
    DonutQuery,
    GaussianMixture,
    exploration_from_variance,
)
from misstep.mixture.donut import DEFAULT_K, DEFAULT_REACH, check_family
from misstep.mixture.donut_mixture import FORMULAS
from misstep.parameters import check_parameters, parameter
from misstep.trajectory import Outcome, Trajectory

Array = NDArray[np.float64]

_SCALE_SHARE = 0.3
# s beside which any disagreement is none.
NO_EXPLORATION = 1e9
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
        check_choice(owner, "climb", self.climb, CLIMBS)
        check_choice(owner, "formula", self.formula, FORMULAS)

    @staticmethod
    def restore(task: Task, arrays: Mapping[str, Array]) -> "DonutPolicy":
        """Return the policy that `DonutPolicy.arrays` described."""
        k, reach, climb, formula = arrays["settings"].tolist()
        if climb not in range(len(CLIMBS)) or formula not in range(len(FORMULAS)):
            raise MisstepError(f"a donut policy has no climb {climb:g} or no formula {formula:g}")
        settings = DonutSettings(k, reach, CLIMBS[int(climb)], FORMULAS[int(formula)])
        return DonutPolicy(task, restore_mixture(arrays), arrays["scale"], settings)

    def act_on(
        self, task: Task, mixture: GaussianMixture, demonstrations: Sequence[Trajectory]
    ) -> "DonutPolicy":
        """Return the policy that explores away from `mixture`."""
        scale = np.full(len(task.action_columns), self.scale)
        if self.scale == 0.0:
            scale = default_scale(demonstrations)
        settings = DonutSettings(self.k, self.reach, self.climb, self.formula)
        return DonutPolicy(task, mixture, scale, settings)


def default_scale(attempts: Sequence[Trajectory]) -> Array:
    """Return the s that nobody chose, shape (m,): 0.3 × the standard deviation of each action."""
    return _SCALE_SHARE * np.concatenate([t.actions for t in attempts]).std(axis=0)


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
        k, reach, _, formula = settings
        low, high = task.action_low, task.action_high
        columns = self._indices
        self._query = DonutQuery(self.conditioner, scale, k, reach, formula, low, high, columns)
        self.scale = scale
        self.settings = settings
        self._on_density = settings.climb == "density"
        self.reset()

    def reset(self) -> None:
        """Forget the previous action: the first climb starts from the best candidate."""
        self._action = np.zeros(len(self.scale))
        self._is_warm = False
        self.exploration = 0.0

    def __call__(self, observation: Array, /) -> Array:
        """Return the mode, clipped; the next climb starts from there."""
        action, warm = self._action, self._is_warm
        self.exploration = self._query.explore(observation, action, warm, self._on_density)
        if not warm:
            self._is_warm = self.settings.climb != "global"
            if self._is_at_a_bound(action):
                # Moved there it is no mode, and every trial after it would be the same.
                action[:] = self.clipped(self._possible_mode(self.state_of(observation)))
        return action.copy()

    def _is_at_a_bound(self, action: Array) -> bool:
        low, high = self.task.action_low, self.task.action_high
        return bool(((action <= low) | (action >= high)).any())

    def _possible_mode(self, state: Array) -> Array:
        """Return the mode above the best analytic candidate that the actuators can do, (m,)."""
        donuts = self.donut_at(state)
        candidates = _candidates(donuts)
        clipped = self.clipped(candidates)
        inside = np.all(candidates == clipped, axis=1)
        starts = clipped[inside] if inside.any() else clipped
        return donuts.mode(starts[np.argmax(donuts.log_pdf(starts))])

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
class DonutLearner(DonutParameters, SpacedMixtureParameters):
    """Rung 1: the donut mixture of Grollman & Billard; all failures count the same."""

    variation: float = parameter(
        0.0,
        "",
        "v: over the trials reach is multiplied by 1, 1 − v, 1 + v in turn",
        at_least=0,
        at_most=1,
    )

    rung: ClassVar[int] = 1

    def __post_init__(self) -> None:
        self.check("learner donut")
        self.check_spacing("learner donut")
        if self.reach * (1.0 - self.variation) < 1.0:
            raise MisstepError(
                f"learner donut: variation is {self.variation:g}, but reach · (1 − variation) must "
                f"be at least 1, and reach is {self.reach:g}"
            )

    def policy(self, task: Task, evidence: Evidence, rng: np.random.Generator) -> DonutPolicy:
        """Return the donut policy on all attempts; once some succeeded, the mode of those."""
        succeeded = [t for t in evidence.attempts if t.outcome is Outcome.SUCCESS]
        mixture = self.fit_attempts(task, succeeded or evidence.attempts, rng)
        if succeeded:
            return replace(self, scale=NO_EXPLORATION).act_on(task, mixture, ())
        turn = (0.0, -1.0, 1.0)[len(evidence.trials) % 3]
        reach = self.reach * (1.0 + turn * self.variation)
        return replace(self, reach=reach, variation=0.0).act_on(
            task, mixture, evidence.demonstrations
        )


def _candidates(donuts: DonutMixture) -> Array:
    """Return the centres m_k and the points m_k ± m*_k on their ridges, shape (K (2m + 1), m)."""
    means, covariances = donuts.conditional.means, donuts.conditional.covariances
    arms = donuts.ridge_radius * np.linalg.cholesky(covariances)
    # The columns of a Cholesky factor are points of the unit ellipsoid.
    ridges = np.stack([means[:, :, None] + arms, means[:, :, None] - arms], axis=1)
    on_ridges = ridges.transpose(0, 1, 3, 2).reshape(-1, means.shape[1])
    return np.concatenate([means, on_ridges])
