"""Gaussian mixture regression: what a joint mixture says of the actions, given a state.

For component k with state block x and action block a,

    h_k(ξ) ∝ π_k N(ξ; μ_x, Σ_xx)
    m_k(ξ) = μ_a + Σ_ax Σ_xx⁻¹ (ξ − μ_x)
    S_k    = Σ_aa − Σ_ax Σ_xx⁻¹ Σ_xa

The h_k are computed in logs, so they are finite and sum to 1 however far ξ is from the data.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_factor, cho_solve

from misstep.errors import MisstepError
from misstep.mixture import compiled
from misstep.mixture.checks import checked_columns, checked_points, whiteners_of

if TYPE_CHECKING:
    from misstep.mixture.gaussian_mixture import GaussianMixture

Array = NDArray[np.float64]


class Conditional(NamedTuple):
    """The mixture of actions at one state."""

    weights: Array
    """h_k, shape (K,), summing to 1."""
    means: Array
    """m_k, shape (K, d), in the action's unit."""
    covariances: Array
    """S_k, shape (K, d, d)."""

    @property
    def mean(self) -> Array:
        """E = Σ h_k m_k, shape (d,)."""
        return self.weights @ self.means

    @property
    def variance(self) -> Array:
        """V = Σ h_k (S_k + m_k m_kᵀ) − E Eᵀ, shape (d, d), summed about E for accuracy.

        Where means lie so far apart that an entry leaves the range of numbers, it is infinite.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            deviations = self.means - self.mean
            deviations[self.weights == 0.0] = 0.0  # 0 × ∞ is no number
            outer = deviations[:, :, None] * deviations[:, None, :]
            variance = np.einsum("k,kij->ij", self.weights, self.covariances + outer)
        variance[np.isnan(variance)] = np.inf
        return variance


class Conditioner:
    """A joint mixture made ready to be conditioned on some of its columns, many times.

    Parameters
    ----------
    mixture : GaussianMixture
        Fitted, with d_joint columns.
    given : sequence of int, length n
        The columns that will be known (the state); the others are the d actions.

    Raises
    ------
    MisstepError
        If `given` is not some, and not all, of the columns, or a covariance is so nearly singular
        that nothing but rounding would be left of what remains.
    """

    def __init__(self, mixture: "GaussianMixture", given: Sequence[int]) -> None:
        joint = mixture.means_.shape[1]
        known = checked_columns(given, joint)
        others = [i for i in range(joint) if i not in known]
        if not others:
            raise MisstepError(
                f"condition on some, not all, of the columns 0 to {joint - 1}, got {known}"
            )
        covariances = mixture.covariances_
        K, n, d = len(covariances), len(known), len(others)
        self.state_means = np.ascontiguousarray(mixture.means_[:, known])
        self.action_means = np.ascontiguousarray(mixture.means_[:, others])
        self.gains = np.empty((K, d, n))
        self.covariances = np.empty((K, d, d))
        self.state_whiteners = np.empty((K, n, n))
        self.state_constants = np.empty(K)
        state_covariances = np.ascontiguousarray(covariances[:, known][:, :, known])
        told = compiled.precompute(
            mixture.weights_, state_covariances, self.state_whiteners, self.state_constants
        )
        if told:
            for k in range(K):
                cross = covariances[k][np.ix_(known, others)]
                own = covariances[k][np.ix_(others, others)]
                self.gains[k] = cho_solve(cho_factor(state_covariances[k]), cross).T
                remaining = own - self.gains[k] @ cross
                self.covariances[k] = 0.5 * (remaining + remaining.T)
                told &= bool(np.all(np.diag(remaining) > compiled.SINGULAR * np.diag(own)))
        if not told or whiteners_of(self.covariances) is None:
            raise MisstepError(
                f"a covariance is too nearly singular to be conditioned on the columns {known}"
            )

    def at(self, state: ArrayLike) -> Conditional:
        """Return the mixture of the other columns at `state` of shape (n,).

        Raises
        ------
        MisstepError
            If `state` has another shape, is not finite, or so far away that the means are not.
        """
        x = np.array(state, dtype=np.float64)
        n = self.state_means.shape[1]
        if x.shape != (n,) or not np.all(np.isfinite(x)):
            raise MisstepError(f"a state here is {n} finite numbers, got {x.tolist()}")
        h, m = np.empty(len(self.gains)), np.empty_like(self.action_means)
        compiled.condition(
            x,
            self.state_constants,
            self.state_means,
            self.state_whiteners,
            self.gains,
            self.action_means,
            h,
            m,
        )
        _refuse_overflow(m)
        return Conditional(h, m, self.covariances)

    def at_each(self, states: ArrayLike) -> tuple[Array, Array]:
        """Return the weights (N, K) and means (N, K, d) at many states (N, n).

        The covariances, which do not depend on the state, are `covariances`.

        Raises
        ------
        MisstepError
            If `states` has another shape, is not finite, or so far away that the means are not.
        """
        x = checked_points(states, self.state_means.shape[1])
        h = np.empty((len(x), len(self.gains)))
        m = np.empty((len(x), *self.action_means.shape))
        compiled.conditions(
            x,
            self.state_constants,
            self.state_means,
            self.state_whiteners,
            self.gains,
            self.action_means,
            h,
            m,
        )
        _refuse_overflow(m)
        return h, m


def _refuse_overflow(means: Array) -> None:
    if not np.all(np.isfinite(means)):
        raise MisstepError(
            "a state lies so far from the mixture that the actions there leave the range of numbers"
        )
