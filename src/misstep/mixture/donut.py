"""The donut: a density with a hole where the demonstrations were.

D(a) = γ N(a; μ, Σ/r_α²) − (γ − 1) N(a; μ, Σ/r_β²),   γ ≥ 1,  r_β = k r_α,  k > 1.

It integrates to 1, and is nowhere negative exactly when γ ≤ 1/(1 − k⁻ᵈ). Grollman & Billard
(2011) introduced it; the paper uses it in section IV-B. Their own choice of γ, r_α and r_β is not
available to us, so the one-parameter family here is ours:

    γ = 1 + ε/(kᵈ − 1),   r_α = 1/(1 + (reach − 1) ε),   so that D(μ) = (1 − ε) r_αᵈ N(μ; μ, Σ).

At ε = 0 it is the Gaussian itself; at ε = 1 it is zero at the centre. In between, a ridge leaves
the centre when ε > (kᵈ − 1)/(kᵈ⁺² − 1), at Mahalanobis radius m*² = 2 ln(q kᵈ⁺²)/(r_β² − r_α²) with
q = (γ − 1)/γ. At reach 1 the ridge never lies further out than √2 standard deviations; reach
multiplies it.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from misstep.errors import MisstepError
from misstep.mixture import compiled
from misstep.mixture.checks import checked_points, whiteners_of

Array = NDArray[np.float64]

DEFAULT_K = 2.0
DEFAULT_REACH = 2.0


class DonutShape(NamedTuple):
    """The three numbers that make a Gaussian a donut."""

    gamma: float
    r_alpha: float
    r_beta: float

    @classmethod
    def of(
        cls, exploration: float, d: int, k: float = DEFAULT_K, reach: float = DEFAULT_REACH
    ) -> "DonutShape":
        """Return the family's member for an exploration in d dimensions.

        Parameters
        ----------
        exploration : float
            ε from 0 (repeat: the Gaussian itself) to 1 (avoid: zero at the centre).
        d : int
            Dimension of the action.
        k : float, default=2
            r_β/r_α > 1: how much narrower the hole is than the hill.
        reach : float, default=2
            ≥ 1: by how much full exploration widens the hill.

        Raises
        ------
        MisstepError
            If a value is out of its range.
        """
        check_family(k, reach)
        if d < 1:
            raise MisstepError(f"a donut takes at least one dimension, got d={d!r}")
        check_hole(k, d)
        if not 0.0 <= exploration <= 1.0:
            raise MisstepError(f"exploration must be from 0 to 1, got {exploration!r}")
        shape, _ = compiled.donut_shape(float(exploration), d, float(k), float(reach))
        return cls(*shape)


def check_family(k: float, reach: float) -> None:
    """Raise MisstepError unless k > 1 is finite and reach from 1 to 10⁹."""
    if not (1.0 < k < math.inf and 1.0 <= reach <= 1e9):
        raise MisstepError(
            f"a donut takes k > 1 and reach ≥ 1, at most 1e9, got k={k!r} and reach={reach!r}"
        )


def check_hole(k: float, d: int) -> None:
    """Raise MisstepError unless kᵈ − 1, which γ is made of, leaves the hole enough digits."""
    exponent = d * math.log(k)
    if not 1e-9 <= exponent <= math.log(1e9):
        raise MisstepError(
            f"a donut in {d} dimensions takes k from {math.exp(1e-9 / d):.12g} to "
            f"{math.exp(math.log(1e9) / d):.4g}, or rounding closes its hole; got k={k!r}"
        )


class Donut:
    """One donut: density, gradient, moments and ridge.

    Parameters
    ----------
    mean : array-like, shape (d,)
        In the action's unit.
    covariance : array-like, shape (d, d)
    shape : DonutShape
        γ, r_α, r_β; `DonutShape.of` gives the family's.

    Raises
    ------
    MisstepError
        If the shapes disagree, the covariance is not definite, or the density would be negative.

    Examples
    --------
    >>> donut = Donut([0.0], [[1.0]], DonutShape.of(exploration=1.0, d=1))
    >>> float(donut.pdf([[0.0]])[0])
    0.0
    """

    def __init__(self, mean: ArrayLike, covariance: ArrayLike, shape: DonutShape) -> None:
        self.mean = np.array(mean, dtype=np.float64)
        self.base_covariance = np.array(covariance, np.float64, order="C")
        self.shape = shape
        d = self.mean.size
        if self.mean.ndim != 1 or d == 0 or self.base_covariance.shape != (d, d):
            raise MisstepError(
                f"a donut takes a mean (d,) and a covariance (d, d), got {self.mean.shape} and "
                f"{self.base_covariance.shape}"
            )
        if not np.all(np.isfinite(self.mean)):
            raise MisstepError(f"a donut's mean must be finite, got {self.mean.tolist()}")
        if whiteners_of(self.base_covariance[None]) is None:
            raise MisstepError("a donut's covariance must be symmetric positive definite")
        gamma, r_alpha, r_beta = shape
        if not 0.0 < r_alpha < r_beta:
            raise MisstepError(f"a donut needs 0 < r_alpha < r_beta, got {r_alpha} and {r_beta}")
        if gamma > 1.0:
            check_hole(r_beta / r_alpha, d)
        most = 1.0 / (1.0 - (r_alpha / r_beta) ** d)
        if not 1.0 <= gamma <= most * (1.0 + 4e-15 * most):
            raise MisstepError(
                f"gamma must be from 1 to 1/(1 − k⁻ᵈ) = {most:g}, or the density is negative at "
                f"the centre; got {gamma:g}"
            )
        self._whitener = np.empty((d, d))
        log_det = compiled.cholesky_whitener(self.base_covariance, self._whitener)
        self._log_norm = log_det - 0.5 * d * compiled.LOG_2PI

    @property
    def covariance(self) -> Array:
        """Σ (γ/r_α² − (γ − 1)/r_β²), shape (d, d)."""
        gamma, r_alpha, r_beta = self.shape
        return self.base_covariance * (gamma / r_alpha**2 - (gamma - 1.0) / r_beta**2)

    @property
    def ridge_radius(self) -> float:
        """Mahalanobis distance of the ridge from the mean; 0 where the mode is the mean."""
        gamma, r_alpha, r_beta = self.shape
        k, d = r_beta / r_alpha, self.mean.size
        steepness = (gamma - 1.0) / gamma * k ** (d + 2)
        if steepness <= 1.0:
            return 0.0
        return math.sqrt(2.0 * math.log(steepness) / (r_beta**2 - r_alpha**2))

    def log_pdf(self, a: ArrayLike) -> Array:
        """Return the log density at points of shape (N, d), shape (N,); −inf where it is zero."""
        return np.array([self._evaluate(point)[0] for point in checked_points(a, self.mean.size)])

    def pdf(self, a: ArrayLike) -> Array:
        """Return the density at points of shape (N, d), shape (N,)."""
        density: Array = np.exp(self.log_pdf(a))
        return density

    def gradient(self, a: ArrayLike) -> Array:
        """Return the gradient of the density at points of shape (N, d), shape (N, d)."""
        rows = []
        for point in checked_points(a, self.mean.size):
            value, slope, direction = self._evaluate(point)
            density = math.exp(value)
            # Beyond the range of double precision the density is flat, and the slope infinite.
            rows.append(density * slope * direction if density else np.zeros_like(point))
        return np.array(rows)

    def _evaluate(self, point: Array) -> tuple[float, float, Array]:
        with np.errstate(over="ignore", invalid="ignore"):
            y = self._whitener @ (point - self.mean)
            squared = float(y @ y)
        if not squared < math.inf:
            return -math.inf, 0.0, np.zeros_like(y)
        value, slope = compiled.donut_log_density(
            squared, self._log_norm, *self.shape, self.mean.size
        )
        return value, slope, self._whitener.T @ y
