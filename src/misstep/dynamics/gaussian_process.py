"""A sparse Gaussian process for systems that the action enters linearly.

The change of a column is modelled as f(z) + Σ g_c(z) u_c, z the encoded state and u the action,
f and g_c each the sum of an affine and a smooth function. The kernel says so:

    k(z, u; z′, u′) = (σ_f² + σ_g² u·u′) exp(−½ Σ (Δz/ℓ)²) + (σ_l² + σ_a² u·u′) (z·z′ + 1)

The affine parts are what is left far from the data. With sine and cosine in z they are much of
what a mechanical system does: gravity goes with the sine of an angle, leverage with its cosine.

All columns share ℓ and σ, and each has a noise of its own. These are chosen by the exact evidence
on a few hundred rows; the exponential is then replaced by its projection on centres picked by
pivoted Cholesky, which leaves a linear regression whose size does not grow with the data.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, lapack, solve_triangular
from scipy.optimize import minimize
from threadpoolctl import threadpool_limits

Array = NDArray[np.float64]

EVIDENCE_ROWS = 350
CENTRE_ROWS = 3000
# A centre explained by the others to this much of the kernel's variance adds nothing.
CENTRE_TOLERANCE = 1e-6
JITTER = 1e-6
# Noise below a thousandth of a column's spread is rounding.
NOISE_FLOOR = 1e-3
MAX_ITERATIONS = 60

# Weak priors, bounds and starts of the natural logarithms, in units of standardised columns.
_LENGTHS = {"mean": 1.0, "precision": 0.5, "low": -2.0, "high": 5.0, "start": 1.0}
_AMPLITUDES = {"mean": 0.0, "precision": 0.1, "low": -4.0, "high": 4.0, "start": 0.0}
_NOISES = {"mean": -4.0, "precision": 0.02, "low": -8.0, "high": 1.0, "start": -3.0}
_SINGULAR = 1e10


class Hyperparameters(NamedTuple):
    """Of the kernel.

    Attributes
    ----------
    lengths : ndarray, shape (nz,)
        ℓ.
    amplitudes : ndarray, shape (4,)
        σ_f, σ_g, σ_l, σ_a.
    noise : ndarray, shape (ny,)
        Standard deviation of the noise on each column, the floor included.
    """

    lengths: Array
    amplitudes: Array
    noise: Array

    @classmethod
    def from_logarithms(cls, logarithms: Array, nz: int) -> Self:
        """Return the hyper-parameters of a vector of logarithms, shape (nz + 4 + ny,)."""
        noise = np.sqrt(np.exp(2.0 * logarithms[nz + 4 :]) + NOISE_FLOOR**2)
        return cls(np.exp(logarithms[:nz]), np.exp(logarithms[nz : nz + 4]), noise)


def squared_exponential(z: Array, other: Array, lengths: Array) -> Array:
    """Return exp(−½ Σ (Δz/ℓ)²), shape (N, M), between rows of `z` and `other`."""
    a, b = z / lengths, other / lengths
    squared = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * a @ b.T
    values: Array = np.exp(-0.5 * np.maximum(squared, 0.0))
    return values


def negative_log_evidence(
    logarithms: Array, z: Array, u: Array, y: Array, weights: Array
) -> tuple[float, Array]:
    """Return −log p(y | z, u) up to a constant, and its gradient.

    Parameters
    ----------
    logarithms : ndarray, shape (nz + 4 + ny,)
        ln ℓ, then ln σ_f, ln σ_g, ln σ_l, ln σ_a, then ln of each column's noise above the floor.
    z, u, y : ndarray, shapes (N, nz), (N, m) and (N, ny)
    weights : ndarray, shape (N, ny)
        A row's noise variance is divided by its weight.
    """
    nz, ny = z.shape[1], y.shape[1]
    h = Hyperparameters.from_logarithms(logarithms, nz)
    f, g, line, direct = h.amplitudes**2
    exponential = squared_exponential(z, z, h.lengths)
    actions = u @ u.T
    affine = z @ z.T + 1.0
    parts = (f * exponential, g * actions * exponential, line * affine, direct * actions * affine)
    kernel = sum(parts)
    value, gradient = 0.0, np.zeros_like(logarithms)
    # ∂(−log p)/∂K of the columns together.
    slope = np.zeros_like(exponential)
    for j in range(ny):
        factor, failed = lapack.dpotrf(kernel + np.diag(h.noise[j] ** 2 / weights[:, j]), lower=1)
        if failed:
            return _SINGULAR, gradient * 0.0
        alpha = cho_solve((factor, True), y[:, j])
        inverse = lapack.dpotri(factor, lower=1)[0]
        inverse = np.tril(inverse) + np.tril(inverse, -1).T
        value += 0.5 * y[:, j] @ alpha + np.log(np.diag(factor)).sum()
        own = 0.5 * (inverse - np.outer(alpha, alpha))
        slope += own
        varied = np.exp(2.0 * logarithms[nz + 4 + j])
        gradient[nz + 4 + j] = 2.0 * varied * (np.diag(own) / weights[:, j]).sum()
    local = slope * (parts[0] + parts[1])
    scaled = z / h.lengths
    # Σ_ij P_ij (a_i − a_j)² for a symmetric P, without the N² differences.
    gradient[:nz] = 2.0 * (local.sum(axis=1) @ scaled**2 - (scaled * (local @ scaled)).sum(axis=0))
    gradient[nz : nz + 4] = [2.0 * (slope * part).sum() for part in parts]
    return float(value), gradient


def fit_hyperparameters(z: Array, u: Array, y: Array, weights: Array) -> Hyperparameters:
    """Return the hyper-parameters of the largest evidence under weak priors."""
    nz, ny = z.shape[1], y.shape[1]
    groups = [_LENGTHS] * nz + [_AMPLITUDES] * 4 + [_NOISES] * ny
    mean = np.array([group["mean"] for group in groups])
    precision = np.array([group["precision"] for group in groups])

    def objective(p: Array) -> tuple[float, Array]:
        value, gradient = negative_log_evidence(p, z, u, y, weights)
        pull = precision * (p - mean)
        return value + 0.5 * float(pull @ (p - mean)), gradient + pull

    found = minimize(
        objective,
        np.array([group["start"] for group in groups]),
        jac=True,
        method="L-BFGS-B",
        bounds=[(group["low"], group["high"]) for group in groups],
        options={"maxiter": MAX_ITERATIONS},
    )
    return Hyperparameters.from_logarithms(found.x, nz)


def pivoted_centres(z: Array, lengths: Array, n_centres: int) -> Array:
    """Return up to `n_centres` rows of `z` that explain the others best, greedily.

    Pivoted Cholesky: the next centre is the row of the largest variance given those chosen.
    """
    n = len(z)
    factor = np.zeros((n, min(n_centres, n)))
    variance = np.ones(n)
    chosen: list[int] = []
    for k in range(factor.shape[1]):
        i = int(np.argmax(variance))
        if variance[i] < CENTRE_TOLERANCE:
            break
        chosen.append(i)
        column = squared_exponential(z, z[i : i + 1], lengths)[:, 0] - factor[:, :k] @ factor[i, :k]
        factor[:, k] = column / np.sqrt(variance[i])
        variance = np.maximum(variance - factor[:, k] ** 2, 0.0)
        variance[chosen] = 0.0
    return z[chosen]


class Coefficients(NamedTuple):
    """The mean function, multiplied out.

    y_j = Σ_c u_c (local[c, j] · exp(−½|(z − centres)/ℓ|²) + linear[c, j] · z + constant[c, j]),
    with u_0 = 1.
    """

    local: Array
    """Shape (1 + m, ny, D)."""
    linear: Array
    """Shape (1 + m, ny, nz)."""
    constant: Array
    """Shape (1 + m, ny)."""


@dataclass(frozen=True)
class SparseGaussianProcess:
    """A fitted process; `fit` makes one.

    Parameters
    ----------
    hyperparameters : Hyperparameters
    centres : ndarray, shape (D, nz)
    whitener : ndarray, shape (D, D)
        Turns the exponentials at the centres into features of unit prior variance.
    weights : ndarray, shape (P, ny)
        Of the features, for standardised columns.
    factors : sequence of ndarray, shape (P, P)
        Lower Cholesky factor of each column's posterior precision.
    mean, scale : ndarray, shape (ny,)
        Of the columns.
    """

    hyperparameters: Hyperparameters
    centres: Array
    whitener: Array
    weights: Array
    factors: Sequence[Array]
    mean: Array
    scale: Array

    @classmethod
    def fit(
        cls,
        z: Array,
        u: Array,
        y: Array,
        rng: np.random.Generator,
        *,
        n_centres: int,
        weights: Array | None = None,
        hyperparameters: Hyperparameters | None = None,
    ) -> Self:
        """Fit columns y (N, ny) as functions of z (N, nz) and u (N, m).

        Parameters
        ----------
        z, u, y : ndarray
        rng : numpy.random.Generator
            Chooses the rows that the evidence and the centres are computed on.
        n_centres : int
            At most.
        weights : ndarray, shape (N, ny), optional
            A row's noise variance is divided by its weight.
        hyperparameters : Hyperparameters, optional
            Chosen by the evidence if left out.
        """
        mean, scale = y.mean(axis=0), y.std(axis=0)
        scale[scale < 1e-12] = 1.0
        standard = (y - mean) / scale
        w = np.ones_like(y) if weights is None else weights
        rows = rng.permutation(len(z))
        some = rows[:EVIDENCE_ROWS]
        # More threads than one make these small matrices slower.
        with threadpool_limits(limits=1, user_api="blas"):
            h = hyperparameters or fit_hyperparameters(z[some], u[some], standard[some], w[some])
            centres = pivoted_centres(z[rows[:CENTRE_ROWS]], h.lengths, n_centres)
            gram = squared_exponential(centres, centres, h.lengths) + JITTER * np.eye(len(centres))
            eye = np.eye(len(centres))
            whitener = solve_triangular(np.linalg.cholesky(gram), eye, lower=True).T
            x = _features(h, centres, whitener, z, u)
            solution, factors = _ridge(x, standard, w / h.noise**2)
        return cls(h, centres, whitener, solution, factors, mean, scale)

    def predict(self, z: Array, u: Array) -> tuple[Array, Array]:
        """Return mean and variance of the columns, noise included, both (N, ny).

        The variance is that of the regression on the centres: right near the data, and too small
        far from every centre, where only the linear part is left to be uncertain.
        """
        x = _features(self.hyperparameters, self.centres, self.whitener, z, u)
        variances = [
            (solve_triangular(factor, x.T, lower=True) ** 2).sum(axis=0) for factor in self.factors
        ]
        variance = np.stack(variances, axis=1) + self.hyperparameters.noise**2
        return x @ self.weights * self.scale + self.mean, variance * self.scale**2

    def coefficients(self) -> Coefficients:
        """Return the mean function with everything constant multiplied out."""
        n_centres, nz = self.centres.shape
        amplitudes = self.hyperparameters.amplitudes
        blocks = (self.weights * self.scale).reshape(-1, n_centres + nz + 1, len(self.mean))
        controlled = np.arange(len(blocks)) > 0
        smooth = np.where(controlled, amplitudes[1], amplitudes[0])
        affine = np.where(controlled, amplitudes[3], amplitudes[2])
        local = smooth[:, None, None] * (self.whitener @ blocks[:, :n_centres])
        rest = affine[:, None, None] * blocks[:, n_centres:]
        rest[0, nz] += self.mean
        return Coefficients(
            np.ascontiguousarray(local.transpose(0, 2, 1)),
            np.ascontiguousarray(rest[:, :nz].transpose(0, 2, 1)),
            rest[:, nz].copy(),
        )


def _features(h: Hyperparameters, centres: Array, whitener: Array, z: Array, u: Array) -> Array:
    """Features (N, P) whose inner products are the kernel, projected on the centres."""
    f, g, line, direct = h.amplitudes
    local = squared_exponential(z, centres, h.lengths) @ whitener
    affine = np.hstack([z, np.ones((len(z), 1))])
    controlled = np.hstack([g * local, direct * affine])
    blocks = [u[:, c : c + 1] * controlled for c in range(u.shape[1])]
    return np.hstack([f * local, line * affine, *blocks])


def _ridge(x: Array, y: Array, precision: Array) -> tuple[Array, list[Array]]:
    """Bayesian linear regression of each column under a unit prior, `precision` (N, ny)."""
    solution = np.empty((x.shape[1], y.shape[1]))
    factors: list[Array] = []
    for j in range(y.shape[1]):
        weighted = x * precision[:, j : j + 1]
        precise = x.T @ weighted + np.eye(x.shape[1])
        factor = np.asarray(np.linalg.cholesky(precise), dtype=np.float64)
        solution[:, j] = cho_solve((factor, True), weighted.T @ y[:, j])
        factors.append(factor)
    return solution, factors
