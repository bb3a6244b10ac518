"""What the mixture learners share: fitting the (state, action) pairs, and keeping the result."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.learners.learner import Task, joint_samples
from misstep.learners.spacing import SPACINGS, path_weights
from misstep.mixture import Conditioner, GaussianMixture
from misstep.parameters import parameter
from misstep.trajectory import Trajectory

Array = NDArray[np.float64]

_PARTS = ("weights", "means", "covariances")


@dataclass(frozen=True)
class MixtureParameters:
    """Parameters of every learner that fits a mixture."""

    n_components: int = parameter(
        0, "", "components of the mixture; 0: chosen by minimum BIC", at_least=0
    )
    max_components: int = parameter(6, "", "largest number that BIC may choose", at_least=1)
    # Without width, components would grow on forces that are clipped at the actuator's limit.
    resolution: float = parameter(
        0.005,
        "",
        "width of the narrowest component, as a share of each column's spread",
        above=0,
        at_most=1e6,
    )

    def fit(
        self, samples: Array, rng: np.random.Generator, sample_weight: Array | None = None
    ) -> GaussianMixture:
        """Fit joint samples (N, n + m), optionally weighted (N,)."""
        return GaussianMixture(
            n_components=self.n_components or None,
            max_components=self.max_components,
            covariance_floor=self.resolution**2,
            tol=1e-4,
            random_state=rng,
        ).fit(samples, sample_weight=sample_weight)


@dataclass(frozen=True)
class SpacedMixtureParameters(MixtureParameters):
    """Parameters of the learners that fit one mixture to all attempts, whatever came of them."""

    spacing: str = parameter(
        "time", "", "what each sample stands for: time, or path: the way travelled in the state"
    )

    def fit_attempts(
        self, task: Task, attempts: Sequence[Trajectory], rng: np.random.Generator
    ) -> GaussianMixture:
        """Fit the (state, action) pairs of all attempts."""
        samples = joint_samples(task, attempts)
        weight = path_weights(task, attempts) if self.spacing == "path" else None
        return self.fit(samples, rng, weight)

    def check_spacing(self, owner: str) -> None:
        """Raise MisstepError if there is no such spacing."""
        check_choice(owner, "spacing", self.spacing, SPACINGS)


def check_choice(owner: str, name: str, value: str, choices: Sequence[str]) -> None:
    """Raise MisstepError unless the parameter `name` of `owner` is one of `choices`."""
    if value not in choices:
        raise MisstepError(f"{owner}: {name} is {value!r}; there are: {', '.join(choices)}")


class MixturePolicy:
    """A policy read off a mixture of (state, action) pairs at the present state.

    Parameters
    ----------
    task : Task
    mixture : GaussianMixture
        Fitted on the columns (state, action) in that order.

    Raises
    ------
    MisstepError
        If the mixture has other columns.
    """

    def __init__(self, task: Task, mixture: GaussianMixture) -> None:
        n, m, columns = len(task.state), len(task.action_columns), mixture.means_.shape[1]
        if columns != n + m:
            raise MisstepError(
                f"the policy's mixture has {columns} columns, but the task has {n} of state and "
                f"{m} of action"
            )
        self.task = task
        self.mixture = mixture
        self.conditioner = Conditioner(mixture, range(len(task.state)))
        self._indices = task.state_indices

    def reset(self) -> None:
        """Forget the attempt before."""

    def arrays(self) -> dict[str, Array]:
        """Return the mixture's parameters."""
        return mixture_arrays(self.mixture)

    def state_of(self, observation: Array) -> Array:
        """Return the state's columns of an observation, shape (n,)."""
        state: Array = observation[self._indices]
        return state

    def clipped(self, action: Array) -> Array:
        """Return the action inside the actuator's limits."""
        return self.task.clipped(action)


def mixture_arrays(mixture: GaussianMixture, key: str = "{}") -> dict[str, Array]:
    """Return a mixture's parameters; `key` names them, for policies that hold several mixtures."""
    values = (mixture.weights_, mixture.means_, mixture.covariances_)
    return {key.format(part): value for part, value in zip(_PARTS, values, strict=True)}


def restore_mixture(arrays: Mapping[str, Array], key: str = "{}") -> GaussianMixture:
    """Return the mixture that `mixture_arrays` described."""
    return GaussianMixture.from_parameters(*(arrays[key.format(part)] for part in _PARTS))
