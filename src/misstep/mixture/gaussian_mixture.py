"""Full-covariance Gaussian mixtures with sample weights, as a scikit-learn estimator."""

import math
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, DensityMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils.validation import check_is_fitted, validate_data

from misstep.errors import MisstepError
from misstep.mixture import compiled, starts
from misstep.mixture.checks import are_definite
from misstep.mixture.conditional import Conditional, Conditioner

Array = NDArray[np.float64]

# Iterations after which the starts of one K are compared and only the best goes on.
TRYOUT = 15


class Ellipse(NamedTuple):
    """An ellipse in the plane of two columns."""

    centre: tuple[float, float]
    width: float
    """Full length of the first axis, in the first column's unit when `angle` is 0."""
    height: float
    angle: float
    """Rotation of the first axis, degrees, counter-clockwise."""


class GaussianMixture(DensityMixin, BaseEstimator):
    """A Gaussian mixture on joint (state, action) samples, K chosen by minimum BIC.

    A sample of weight w counts as w equal samples. Fitting standardises the data inside, so
    tolerances and the covariance floor are in the data's own scale.

    Parameters
    ----------
    n_components : int or None, default=None
        Number of components K. None scans 1 … `max_components` and keeps the least BIC.
    max_components : int, default=10
        Largest K of the scan; also bounded so that each component can have d + 1 samples.
    n_init : int, default=5
        k-means++ starts for each K; the best after a few iterations goes on to convergence.
    tol : float, default=1e-5
        Stop when the mean log-likelihood of a sample rises by less.
    max_iter : int, default=1000
        Bound on the iterations of one fit.
    covariance_floor : float, default=1e-6
        Added to the diagonal of each covariance, as a share of each column's variance.
    weights_init : array-like, shape (K,), optional
    means_init : array-like, shape (K, d), optional
    precisions_init : array-like, shape (K, d, d), optional
        A start to use instead of k-means++: all three or none, with `n_components` given.
    random_state : int, numpy.random.Generator or None
        Source of the starts.

    Attributes
    ----------
    weights_ : ndarray, shape (K,)
    means_ : ndarray, shape (K, d)
    covariances_ : ndarray, shape (K, d, d)
    n_components_ : int
    lower_bound_ : float
        Mean log-likelihood of a sample.
    bics_ : dict of int to float
        The BIC of every K that was tried.
    converged_ : bool
    n_iter_ : int
    n_features_in_ : int

    Notes
    -----
    With weights, BIC uses Kish's effective sample size n = (Σw)² / Σw²:
    BIC = −2 n ℓ + p log n, where ℓ is the weighted mean log-likelihood and
    p = K(1 + d + d(d+1)/2) − 1. Without weights this is the usual formula, and multiplying all
    weights by a constant changes nothing.

    References
    ----------
    Expectation–maximisation and minimum BIC: the paper, section IV-A.

    Examples
    --------
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> X = np.concatenate([rng.normal(-3, 1, (200, 2)), rng.normal(3, 1, (200, 2))])
    >>> GaussianMixture(random_state=0).fit(X).n_components_
    2
    """

    def __init__(
        self,
        n_components: int | None = None,
        *,
        max_components: int = 10,
        n_init: int = 5,
        tol: float = 1e-5,
        max_iter: int = 1000,
        covariance_floor: float = 1e-6,
        weights_init: ArrayLike | None = None,
        means_init: ArrayLike | None = None,
        precisions_init: ArrayLike | None = None,
        random_state: int | np.random.Generator | None = None,
    ) -> None:
        self.n_components = n_components
        self.max_components = max_components
        self.n_init = n_init
        self.tol = tol
        self.max_iter = max_iter
        self.covariance_floor = covariance_floor
        self.weights_init = weights_init
        self.means_init = means_init
        self.precisions_init = precisions_init
        self.random_state = random_state

    @classmethod
    def from_parameters(
        cls, weights: ArrayLike, means: ArrayLike, covariances: ArrayLike
    ) -> "GaussianMixture":
        """Return a fitted mixture with the given parameters.

        Parameters
        ----------
        weights : array-like, shape (K,)
            Positive; normalised to sum to 1.
        means : array-like, shape (K, d)
        covariances : array-like, shape (K, d, d)

        Raises
        ------
        MisstepError
            If the shapes disagree, a weight is not positive or a covariance is not definite.
        """
        w, m, c = (np.array(v, np.float64, order="C") for v in (weights, means, covariances))
        shapes = m.ndim == 2 and w.shape == m.shape[:1] and c.shape == (*m.shape, m.shape[1])
        if not shapes or m.size == 0:
            raise MisstepError(
                f"a mixture takes weights (K,), means (K, d) and covariances (K, d, d), "
                f"got {w.shape}, {m.shape} and {c.shape}"
            )
        if not np.all(w > 0) or not np.isfinite(w.sum()):
            raise MisstepError(f"mixture weights must be positive and finite, got {w.tolist()}")
        if not np.all(np.isfinite(m)):
            raise MisstepError("mixture means must be finite")
        # Weights that sum to 1 but for rounding stay as they are: a mixture restored is the same.
        if not math.isclose(w.sum(), 1.0, rel_tol=1e-12):
            w /= w.sum()
        self = cls(n_components=len(w))
        self._set_parameters(w, m, c)
        self.n_features_in_ = m.shape[1]
        return self

    def fit(self, X: ArrayLike, y: object = None, sample_weight: ArrayLike | None = None) -> Self:
        """Fit the mixture by weighted expectation–maximisation.

        Parameters
        ----------
        X : array-like, shape (N, d)
        y : ignored
        sample_weight : array-like, shape (N,), optional
            Non-negative and finite. A weight of w counts as w equal samples.

        Raises
        ------
        MisstepError
            If a column is constant, a weight is negative, a setting is out of range or there are
            more components than samples.
        ValueError
            If `X` is not a finite matrix of at least two samples (scikit-learn's own messages).
        """
        samples = validate_data(self, X, dtype=np.float64, ensure_min_samples=2, copy=True)
        self._check_settings()
        weight = _checked_weight(sample_weight, samples)
        size = effective_size(weight)
        used = weight > 0
        samples, weight = starts.sort_samples(samples[used], weight[used])
        offset = np.average(samples, axis=0, weights=weight)
        scale = np.sqrt(np.average((samples - offset) ** 2, axis=0, weights=weight))
        _refuse_constant(samples, scale)
        Z = (samples - offset) / scale
        shift = float(np.log(scale).sum())

        best: tuple[float, Any] | None = None
        rng = np.random.default_rng(self.random_state)
        self.bics_ = {}
        for K in self._range(len(samples), samples.shape[1]):
            fitted = self._fit_one(Z, weight, K, offset, scale, rng)
            mean_log_likelihood = float(fitted[0] / weight.sum()) - shift
            bic = bic_of(mean_log_likelihood, size, K, samples.shape[1])
            self.bics_[K] = bic
            if best is None or bic < best[0]:
                best = (bic, fitted)
                self.lower_bound_ = mean_log_likelihood
        if best is None:
            raise RuntimeError("the scan over K was empty")
        _, (_, self.n_iter_, self.converged_, weights, means, covariances) = best
        if not self.converged_:
            warnings.warn(
                f"expectation–maximisation did not converge in max_iter={self.max_iter} "
                f"iterations; raise max_iter or tol",
                ConvergenceWarning,
                stacklevel=2,
            )
        self._set_parameters(weights, means * scale + offset, covariances * np.outer(scale, scale))
        return self

    def score_samples(self, X: ArrayLike) -> Array:
        """Return the log density of each sample, shape (N,)."""
        joint = self._log_joint(X)
        top = joint.max(axis=1)
        density: Array = top + np.log(np.exp(joint - top[:, None]).sum(axis=1))
        return density

    def score(
        self, X: ArrayLike, y: object = None, sample_weight: ArrayLike | None = None
    ) -> float:
        """Return the (weighted) mean log density of the samples."""
        log_density = self.score_samples(X)
        return float(np.average(log_density, weights=_checked_weight(sample_weight, log_density)))

    def predict_proba(self, X: ArrayLike) -> Array:
        """Return the responsibility of each component for each sample, shape (N, K)."""
        joint = self._log_joint(X)
        p = np.exp(joint - joint.max(axis=1, keepdims=True))
        responsibilities: Array = p / p.sum(axis=1, keepdims=True)
        return responsibilities

    def predict(self, X: ArrayLike) -> NDArray[np.intp]:
        """Return the most responsible component of each sample, shape (N,)."""
        labels: NDArray[np.intp] = self._log_joint(X).argmax(axis=1)
        return labels

    def bic(self, X: ArrayLike, sample_weight: ArrayLike | None = None) -> float:
        """Return the Bayesian information criterion on X (see Notes; lower is better)."""
        log_density = self.score_samples(X)
        weight = _checked_weight(sample_weight, log_density)
        mean = float(np.average(log_density, weights=weight))
        return bic_of(mean, effective_size(weight), *self.means_.shape)

    def sample(
        self, n_samples: int = 1, random_state: int | np.random.Generator | None = None
    ) -> tuple[Array, NDArray[np.intp]]:
        """Draw samples.

        Parameters
        ----------
        n_samples : int
        random_state : int, numpy.random.Generator or None
            None draws from the estimator's own `random_state`.

        Returns
        -------
        X : ndarray, shape (n_samples, d)
        labels : ndarray of int, shape (n_samples,)
            The component of each sample.
        """
        check_is_fitted(self)
        if n_samples < 1:
            raise MisstepError(f"n_samples must be at least 1, got {n_samples}")
        rng = np.random.default_rng(self.random_state if random_state is None else random_state)
        labels = rng.choice(len(self.weights_), size=n_samples, p=self.weights_)
        noise = rng.standard_normal((n_samples, self.means_.shape[1]))
        lower = np.linalg.cholesky(self.covariances_)
        return self.means_[labels] + np.einsum("nij,nj->ni", lower[labels], noise), labels

    def condition(self, indices: Sequence[int], x: ArrayLike) -> Conditional:
        """Return the mixture of the other columns, given that columns `indices` equal `x`.

        Gaussian mixture regression; see `misstep.mixture.conditional`.

        Parameters
        ----------
        indices : sequence of int, length n
        x : array-like, shape (n,)
        """
        check_is_fitted(self)
        return Conditioner(self, indices).at(x)

    def marginal(self, indices: Sequence[int]) -> "GaussianMixture":
        """Return the mixture of the columns `indices` alone, in that order."""
        check_is_fitted(self)
        columns = checked_columns(indices, self.means_.shape[1])
        return GaussianMixture.from_parameters(
            self.weights_,
            self.means_[:, columns],
            self.covariances_[np.ix_(range(len(self.weights_)), columns, columns)],
        )

    def to_ellipse(self, n_std: float = 3.0, columns: tuple[int, int] = (0, 1)) -> list[Ellipse]:
        """Return each component's `n_std` ellipse in the plane of two columns (as in figure 11)."""
        plane = self.marginal(columns)
        ellipses = []
        for mean, covariance in zip(plane.means_, plane.covariances_, strict=True):
            variances, axes = np.linalg.eigh(covariance)
            width, height = 2.0 * n_std * np.sqrt(variances)
            angle = math.degrees(math.atan2(axes[1, 0], axes[0, 0]))
            ellipses.append(Ellipse((mean[0], mean[1]), float(width), float(height), angle))
        return ellipses

    def _check_settings(self) -> None:
        bounds = {"n_components": 1, "max_components": 1, "n_init": 1, "max_iter": 0}
        for name, least in bounds.items():
            value = getattr(self, name)
            if value is not None and (not isinstance(value, int | np.integer) or value < least):
                raise MisstepError(f"{name} must be a whole number ≥ {least}, got {value!r}")
        for name in ("tol", "covariance_floor"):
            value = getattr(self, name)
            if not isinstance(value, int | float | np.number) or not 0 <= value < math.inf:
                raise MisstepError(f"{name} must be ≥ 0 and finite, got {value!r}")
        given = [v is not None for v in (self.weights_init, self.means_init, self.precisions_init)]
        if any(given) and not (all(given) and self.n_components is not None):
            raise MisstepError(
                "a start needs weights_init, means_init, precisions_init and n_components together"
            )

    def _range(self, n_samples: int, d: int) -> range:
        if self.n_components is not None:
            if self.n_components > n_samples:
                raise MisstepError(
                    f"n_components={self.n_components} but there are only {n_samples} distinct "
                    f"samples: K can be at most their number"
                )
            return range(self.n_components, self.n_components + 1)
        return range(1, max(1, min(self.max_components, n_samples // (d + 1))) + 1)

    def _fit_one(
        self, Z: Array, weight: Array, K: int, offset: Array, scale: Array, rng: np.random.Generator
    ) -> tuple[float, int, bool, Array, Array, Array]:
        """Fit K components to standardised samples; return log-likelihood, n_iter, …, mixture."""
        x = np.ascontiguousarray(Z.T)
        floor, tol = float(self.covariance_floor), float(self.tol)
        if self.means_init is not None:
            start = self._given_start(K, offset, scale)
        else:
            # Every start draws the same numbers whatever happens to the others.
            tryouts = []
            for child in rng.spawn(self.n_init if K > 1 else 1):
                labels = starts.kmeans_plus_plus(Z, weight, K, child)
                start = starts.moments_of(Z, weight, labels, K, floor)
                value, _, _ = compiled.fit_em(x, weight, *start, floor, tol, TRYOUT)
                tryouts.append((-value if math.isfinite(value) else math.inf, start))
            start = min(tryouts, key=lambda tryout: tryout[0])[1]
        value, n_iter, converged = compiled.fit_em(x, weight, *start, floor, tol, self.max_iter)
        if not math.isfinite(value):
            raise MisstepError(
                f"a covariance of the {K}-component fit collapsed: the samples lie on a line or a "
                f"point; a covariance_floor > {floor:g} prevents it"
            )
        return value, n_iter, converged, *start

    def _given_start(self, K: int, offset: Array, scale: Array) -> tuple[Array, Array, Array]:
        weights = np.array(self.weights_init, dtype=np.float64)
        means = (np.array(self.means_init, dtype=np.float64) - offset) / scale
        precisions = np.array(self.precisions_init, dtype=np.float64, order="C")
        d = len(offset)
        if weights.shape != (K,) or means.shape != (K, d) or precisions.shape != (K, d, d):
            raise MisstepError(
                f"a start of {K} components in {d} columns has weights ({K},), means ({K}, {d}) "
                f"and precisions ({K}, {d}, {d}), got {weights.shape}, {means.shape} and "
                f"{precisions.shape}"
            )
        if not np.all(weights > 0) or not np.isfinite(weights.sum()):
            raise MisstepError(f"weights_init must be positive and finite, got {weights.tolist()}")
        if not np.all(np.isfinite(means)):
            raise MisstepError("means_init must be finite")
        if not are_definite(precisions):
            raise MisstepError("precisions_init must be symmetric positive definite")
        covariances = np.linalg.inv(precisions) / np.outer(scale, scale)
        return weights / weights.sum(), means, covariances

    def _set_parameters(self, weights: Array, means: Array, covariances: Array) -> None:
        if not are_definite(covariances):
            raise MisstepError("a mixture covariance is not symmetric positive definite")
        K, d = means.shape
        whiteners, constants = np.empty((K, d, d)), np.empty(K)
        compiled.precompute(weights, covariances, whiteners, constants)
        self.weights_, self.means_, self.covariances_ = weights, means, covariances
        self.n_components_ = K
        self._whiteners, self._constants = whiteners, constants

    def _log_joint(self, X: ArrayLike) -> Array:
        check_is_fitted(self)
        samples = validate_data(self, X, dtype=np.float64, reset=False)
        # Whitening is exact only near the origin, and the data may lie far from it.
        origin = self.means_[0]
        joint: Array = compiled.log_joint(
            np.ascontiguousarray((samples - origin).T),
            self._constants,
            self.means_ - origin,
            self._whiteners,
        )
        return joint


def effective_size(sample_weight: Array) -> float:
    """Kish's effective sample size (Σw)² / Σw²."""
    return float(sample_weight.sum() ** 2 / (sample_weight**2).sum())


def bic_of(mean_log_likelihood: float, size: float, K: int, d: int) -> float:
    """BIC of a K-component mixture in d dimensions on `size` effective samples."""
    n_parameters = K * (1 + d + d * (d + 1) // 2) - 1
    return -2.0 * size * mean_log_likelihood + n_parameters * math.log(size)


def checked_columns(indices: Sequence[int], d: int) -> list[int]:
    """Return `indices` as a list; raise MisstepError unless they are distinct columns of d."""
    columns = [int(i) for i in indices]
    if not columns or len(set(columns)) < len(columns) or not all(0 <= i < d for i in columns):
        raise MisstepError(f"columns must be distinct numbers from 0 to {d - 1}, got {columns}")
    return columns


def _checked_weight(sample_weight: ArrayLike | None, X: Array) -> Array:
    if sample_weight is None:
        return np.ones(len(X))
    weight = np.array(sample_weight, dtype=np.float64)
    if weight.shape != (len(X),):
        raise MisstepError(
            f"sample_weight has shape {weight.shape}, but {len(X)} samples take ({len(X)},)"
        )
    if not np.all(np.isfinite(weight)) or np.any(weight < 0):
        raise MisstepError("sample_weight must be finite and nowhere negative")
    if not np.any(weight > 0):
        raise MisstepError("every sample_weight is zero: nothing is left to fit")
    return weight


def _refuse_constant(X: Array, scale: Array) -> None:
    # Rounding leaves a constant column a spread of some units in the last place.
    constant = np.flatnonzero(scale <= 1e-13 * np.abs(X).max(axis=0))
    if len(constant):
        column = int(constant[0])
        raise MisstepError(
            f"column {column} of X is constant ({X[0, column]:g}): a mixture needs varying columns"
        )
