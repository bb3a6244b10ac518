"""Full-covariance Gaussian mixtures with sample weights, as a scikit-learn estimator."""

import math
import warnings
from collections.abc import Iterable, Sequence
from functools import partial
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, DensityMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils.validation import check_is_fitted, validate_data

from misstep.errors import MisstepError
from misstep.mixture import compiled, em, fitting, starts
from misstep.mixture.checks import checked_columns, whiteners_of
from misstep.mixture.chunks import SUBSAMPLE, StandardisedChunks, survey
from misstep.mixture.conditional import Conditional, Conditioner
from misstep.mixture.em import Mixture, Rule, Samples

Array = NDArray[np.float64]
RandomState = int | np.random.Generator | np.random.RandomState | None

# Rounding leaves what is constant a spread of some units in the last place.
CONSTANT = 1e-13


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

    Fitting standardises the data inside, so tolerances and the covariance floor are in the data's
    own scale. For a given K, a sample of weight w counts as w equal samples; over K it does not,
    because weights say less than as many samples would (see Notes).

    The names are those of scikit-learn's own `GaussianMixture`, of which this is the one with full
    covariances, sample weights and a scan over K; defaults differ.

    Parameters
    ----------
    n_components : int or None, default=None
        Number of components K. None scans 1 … `max_components` and keeps the least BIC.
    max_components : int, default=10
        Largest K of the scan; also bounded so that each component can have d + 1 samples.
    covariance_type : str, default="full"
        The only one there is: conditioning on a state needs every covariance.
    n_init : int, default=5
        Starts for each K; the best after a few iterations goes on to convergence.
    init_params : str, default="k-means++"
        How they are made: ``"k-means++"``, samples far apart and their nearest; ``"kmeans"``, the
        clusters of k-means; ``"random_from_data"``, samples at random and their nearest;
        ``"random"``, shares of all samples at random.
    tol : float, default=1e-5
        Stop when the mean log-likelihood of a sample rises by less.
    max_iter : int, default=1000
        Bound on the iterations of one fit.
    covariance_floor : float, default=1e-6
        Added to the diagonal of each covariance, as a share of each column's variance.
    reg_covar : float, optional
        Added to the diagonal of each covariance instead, in the data's own units squared.
    weights_init : array-like, shape (K,), optional
    means_init : array-like, shape (K, d), optional
    precisions_init : array-like, shape (K, d, d), optional
        Parts of a start, in place of what `init_params` makes of them; together, all of it. They
        say what K is where `n_components` does not.
    start : GaussianMixture, optional
        A fitted mixture of the same columns to refit from, say of the trials before the last. Its
        number of components K is begun there alone, and a scan tries only K − 1, K and K + 1.
    n_jobs : int or None, default=None
        Threads. None takes one for each core, but a single one in a worker process. The result is
        the same to the last bit whatever their number.
    warm_start : bool, default=False
        Whether a second `fit` begins where the first ended, as with `start`.
    random_state : int, numpy.random.Generator, numpy.random.RandomState or None
        Source of the starts.
    verbose, verbose_interval : int, default=0 and 10
        Only there because scikit-learn has them: the compiled loops say nothing on the way, and
        `bics_` and `n_iter_` tell afterwards. Anything but the defaults is refused.

    Attributes
    ----------
    weights_ : ndarray, shape (K,)
    means_ : ndarray, shape (K, d)
    covariances_ : ndarray, shape (K, d, d)
    precisions_ : ndarray, shape (K, d, d)
        Their inverses.
    precisions_cholesky_ : ndarray, shape (K, d, d)
        Upper triangles U of U Uᵀ = the precisions.
    n_components_ : int
    lower_bound_ : float
        Mean log-likelihood of a sample.
    bics_ : dict of int to float
        The BIC of every K that was tried.
    scan_ended_at_largest_ : bool
        Whether the least BIC is that of the largest of several K that were tried: more components
        might do better, and `max_components`, or the number of samples, was in the way.
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
        covariance_type: str = "full",
        n_init: int = 5,
        init_params: str = "k-means++",
        tol: float = 1e-5,
        max_iter: int = 1000,
        covariance_floor: float = 1e-6,
        reg_covar: float | None = None,
        weights_init: ArrayLike | None = None,
        means_init: ArrayLike | None = None,
        precisions_init: ArrayLike | None = None,
        start: "GaussianMixture | None" = None,
        n_jobs: int | None = None,
        warm_start: bool = False,
        random_state: RandomState = None,
        verbose: int = 0,
        verbose_interval: int = 10,
    ) -> None:
        self.n_components = n_components
        self.max_components = max_components
        self.covariance_type = covariance_type
        self.n_init = n_init
        self.init_params = init_params
        self.tol = tol
        self.max_iter = max_iter
        self.covariance_floor = covariance_floor
        self.reg_covar = reg_covar
        self.weights_init = weights_init
        self.means_init = means_init
        self.precisions_init = precisions_init
        self.start = start
        self.n_jobs = n_jobs
        self.warm_start = warm_start
        self.random_state = random_state
        self.verbose = verbose
        self.verbose_interval = verbose_interval

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
        if not math.isclose(w.sum(), 1.0, rel_tol=1e-14):
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
            If a column is constant or its variance no number, a weight is negative, a setting is
            out of range or there are more components than samples.
        ValueError
            If `X` is not a finite matrix of at least two samples (scikit-learn's own messages).
        """
        samples = validate_data(self, X, dtype=np.float64, ensure_min_samples=2, copy=True)
        self._check_settings()
        weight = _checked_weight(sample_weight, samples)
        size = effective_size(weight)
        used = weight > 0
        if not np.all(used):
            samples, weight = samples[used], weight[used]
        # The order of the samples matters to what makes a start of them alone.
        if not self._start_is_whole():
            samples, weight = starts.sort_samples(samples, weight)
        Z, offset, scale = _standardise(samples, weight)
        blocks = em.in_blocks(Z, weight)
        candidates = self._candidates(Z, weight, blocks, offset, scale)
        fits = fitting.fit_each(blocks, candidates, self._rule(scale), self._threads())
        self._keep_best(fits, float(weight.sum()), size, offset, scale)
        return self

    def fit_chunks(self, chunks: Iterable[ArrayLike], n_subsample: int = SUBSAMPLE) -> Self:
        """Fit the mixture to samples that need not fit in memory.

        The starts are those of a fit to a random subsample; from there all chunks are read once
        for each iteration, for all K of a scan together. From given starts it takes the steps that
        `fit` would.

        Parameters
        ----------
        chunks : iterable of array-like, shape (n, d)
            Read several times, so a list or an object such as `misstep.mixture.RowChunks`, which
            reads an HDF5 dataset or a memory map.
        n_subsample : int, default=65536
            Samples in memory from which the starts come.

        Raises
        ------
        MisstepError
            As for `fit`, or if the chunks are not finite matrices of one width, cannot be read
            twice or change between passes.
        """
        if n_subsample < 2:
            raise MisstepError(f"n_subsample must be at least 2, got {n_subsample}")
        found = survey(chunks, n_subsample, generator_of(self.random_state))
        self.n_features_in_ = len(found.mean)
        self._check_settings()
        _check_spread(found.subsample[0], np.abs(found.subsample).max(axis=0), found.scale)
        offset, scale = found.mean, found.scale
        samples, weight = starts.sort_samples(found.subsample, np.ones(len(found.subsample)))
        Z = (samples - offset) / scale
        blocks = em.in_blocks(Z, weight)
        candidates = self._candidates(Z, weight, blocks, offset, scale)
        threads, rule = self._threads(), self._rule(scale)
        if not self._start_is_whole():
            begun = fitting.fit_each(blocks, candidates, rule, threads)
            mixtures = {K: fit.mixture for K, fit in begun.items()}
        else:
            mixtures = {K: only() for K, (only,) in candidates.items()}
        n = found.n_samples
        fits = fitting.fit_by_passes(
            StandardisedChunks(chunks, found), list(mixtures.values()), n, rule, threads
        )
        self._keep_best(dict(zip(mixtures, fits, strict=True)), n, n, offset, scale)
        return self

    def fit_predict(
        self, X: ArrayLike, y: object = None, sample_weight: ArrayLike | None = None
    ) -> NDArray[np.intp]:
        """Fit the mixture, and return the most responsible component of each sample, shape (N,)."""
        return self.fit(X, y, sample_weight).predict(X)

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

    def aic(self, X: ArrayLike, sample_weight: ArrayLike | None = None) -> float:
        """Return Akaike's information criterion on X (lower is better)."""
        log_density = self.score_samples(X)
        weight = _checked_weight(sample_weight, log_density)
        mean = float(np.average(log_density, weights=weight))
        return 2.0 * self._n_parameters() - 2.0 * effective_size(weight) * mean

    def _n_parameters(self) -> int:
        return n_parameters(*self.means_.shape)

    def sample(
        self, n_samples: int = 1, random_state: RandomState = None
    ) -> tuple[Array, NDArray[np.intp]]:
        """Draw samples.

        Parameters
        ----------
        n_samples : int
        random_state : int, numpy.random.Generator, numpy.random.RandomState or None
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
        rng = generator_of(self.random_state if random_state is None else random_state)
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

        Raises
        ------
        MisstepError
            If they are not some, and not all, of the columns, or `x` is no such state.
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
        self._check_words()
        bounds = {"n_components": 1, "max_components": 1, "n_init": 1, "max_iter": 0, "n_jobs": 1}
        optional = {"n_components", "n_jobs"}
        for name, least in bounds.items():
            value = getattr(self, name)
            if value is None and name in optional:
                continue
            if not isinstance(value, int | np.integer) or value < least:
                raise MisstepError(f"{name} must be a whole number ≥ {least}, got {value!r}")
        for name in ("tol", "covariance_floor", "reg_covar"):
            value = getattr(self, name)
            if value is None and name == "reg_covar":
                continue
            if not isinstance(value, int | float | np.number) or not 0 <= value < math.inf:
                raise MisstepError(f"{name} must be ≥ 0 and finite, got {value!r}")
        given = self._given()
        if self.start is not None:
            check_is_fitted(self.start)
            if self.start.means_.shape[1] != self.n_features_in_ or given:
                raise MisstepError(
                    f"start has {self.start.means_.shape[1]} columns and the samples "
                    f"{self.n_features_in_}: refit a mixture of the same columns, without "
                    f"weights_init, means_init and precisions_init"
                )

    def _check_words(self) -> None:
        """Refuse what scikit-learn's mixture can be told and this one cannot."""
        if self.covariance_type != "full":
            raise MisstepError(
                f"covariance_type is {self.covariance_type!r}: it is 'full', because conditioning "
                "on a state needs every covariance"
            )
        if self.init_params not in starts.MAKERS:
            raise MisstepError(
                f"init_params is {self.init_params!r}; there are: {', '.join(starts.MAKERS)}"
            )
        if self.verbose or self.verbose_interval != 10:
            raise MisstepError(
                "verbose cannot be set: the compiled loops say nothing on the way; bics_ and "
                "n_iter_ tell afterwards"
            )

    def _given(self) -> dict[str, Array]:
        """Return the parts of a start that are given, as arrays."""
        names = ("weights_init", "means_init", "precisions_init")
        parts = {name: getattr(self, name) for name in names}
        return {n: _numbers(part, n) for n, part in parts.items() if part is not None}

    def _start_is_whole(self) -> bool:
        return len(self._given()) == 3

    def _before(self) -> "GaussianMixture | None":
        """Return the mixture to refit from, if there is one."""
        begun = self.warm_start and hasattr(self, "weights_")
        if self.start is None and begun and self.means_.shape[1] == self.n_features_in_:
            own = self.weights_, self.means_, self.covariances_
            return GaussianMixture.from_parameters(*own)
        return self.start

    def _range(self, n_samples: int, d: int) -> range:
        given = {len(part) for part in self._given().values() if part.ndim}
        K = self.n_components if self.n_components is not None else next(iter(given), None)
        if K is not None:
            if n_samples < K:
                raise MisstepError(
                    f"n_components={K} but there are only {n_samples} distinct samples: K can be "
                    "at most their number"
                )
            return range(K, K + 1)
        most = max(1, min(self.max_components, n_samples // (d + 1)))
        before = self._before()
        if before is None:
            return range(1, most + 1)
        K = min(before.n_components_, most)
        return range(max(1, K - 1), min(K + 1, most) + 1)

    def _rule(self, scale: Array) -> Rule:
        floor = np.full(len(scale), float(self.covariance_floor))
        if self.reg_covar is not None:
            floor = float(self.reg_covar) / scale**2
        return Rule(floor, float(self.tol), int(self.max_iter))

    def _threads(self) -> int:
        return fitting.available_threads() if self.n_jobs is None else self.n_jobs

    def _candidates(
        self, Z: Array, weight: Array, samples: Samples, offset: Array, scale: Array
    ) -> dict[int, list[fitting.Start]]:
        """Return for each K the starts to choose from, given sorted standardised samples (N, d)."""
        K_range = self._range(*Z.shape)
        if self._start_is_whole():
            return {K: [partial(self._given_start, None, K, offset, scale)] for K in K_range}
        spread = starts.spread_of(Z, weight, self._rule(scale).floor)
        make = starts.MAKERS[self.init_params]
        before, given = self._before(), self._given()

        def start(K: int, child: np.random.Generator) -> Mixture:
            made = make(samples, Z, weight, K, child, spread)
            return self._given_start(made, K, offset, scale) if given else made

        candidates: dict[int, list[fitting.Start]] = {}
        rng = generator_of(self.random_state)
        for K in K_range:
            # Every start draws the same numbers whatever happens to the others.
            children = rng.spawn(self.n_init if K > 1 else 1)
            candidates[K] = [partial(start, K, child) for child in children]
            if before is not None and before.n_components_ == K:
                candidates[K] = [partial(_standardised, before, offset, scale)]
        return candidates

    def _keep_best(
        self, fits: dict[int, fitting.Fit], total: float, size: float, offset: Array, scale: Array
    ) -> None:
        """Keep the fit of least BIC as the estimator's own, in the data's units."""
        shift = float(np.log(scale).sum())
        self.bics_ = {}
        bounds = {}
        for K in sorted(fits):
            variances = np.diagonal(fits[K].mixture.covariances, axis1=1, axis2=2)
            if not math.isfinite(fits[K].log_likelihood) or variances.min() <= CONSTANT**2:
                raise MisstepError(
                    f"a covariance of the {K}-component fit collapsed: the samples lie on a line "
                    f"or a point; a covariance_floor > {self.covariance_floor:g} prevents it"
                )
            bounds[K] = fits[K].log_likelihood / total - shift
            self.bics_[K] = bic_of(bounds[K], size, K, len(scale))
        K = min(self.bics_, key=self.bics_.__getitem__)
        self.scan_ended_at_largest_ = len(self.bics_) > 1 and max(self.bics_) == K
        _, self.n_iter_, self.converged_, (weights, means, covariances) = fits[K]
        self.lower_bound_ = bounds[K]
        if not self.converged_:
            warnings.warn(
                f"expectation–maximisation did not converge in max_iter={self.max_iter} "
                f"iterations; raise max_iter or tol",
                ConvergenceWarning,
                stacklevel=3,
            )
        self._set_parameters(weights, means * scale + offset, covariances * np.outer(scale, scale))

    def _given_start(self, made: Mixture | None, K: int, offset: Array, scale: Array) -> Mixture:
        """Return a start of given parts, and of what was made where a part is not given."""
        given, d = self._given(), len(offset)
        shapes = {"weights_init": (K,), "means_init": (K, d), "precisions_init": (K, d, d)}
        for name, part in given.items():
            if part.shape != shapes[name]:
                raise MisstepError(
                    f"{name} has shape {part.shape}, but {K} components in {d} columns take "
                    f"{shapes[name]}"
                )
        weights, means, covariances = made or (np.empty(K), np.empty((K, d)), np.empty((K, d, d)))
        if "weights_init" in given:
            weights = given["weights_init"]
            if not np.all(weights > 0) or not np.isfinite(weights.sum()):
                raise MisstepError(
                    f"weights_init must be positive and finite, got {weights.tolist()}"
                )
            weights = weights / weights.sum()
        if "means_init" in given:
            means = (given["means_init"] - offset) / scale
            if not np.all(np.isfinite(means)):
                raise MisstepError("means_init must be finite")
        if "precisions_init" in given:
            whiteners = whiteners_of(given["precisions_init"] * np.outer(scale, scale))
            if whiteners is None:
                raise MisstepError("precisions_init must be symmetric positive definite")
            covariances = whiteners.transpose(0, 2, 1) @ whiteners
        return Mixture(weights, means, covariances)

    def _set_parameters(self, weights: Array, means: Array, covariances: Array) -> None:
        if whiteners_of(covariances) is None:
            raise MisstepError(
                "a mixture covariance is not symmetric positive definite, or too nearly singular"
            )
        K, d = means.shape
        whiteners, constants = np.empty((K, d, d)), np.empty(K)
        covariances = 0.5 * (covariances + covariances.transpose(0, 2, 1))
        compiled.precompute(weights, covariances, whiteners, constants)
        self.weights_, self.means_, self.covariances_ = weights, means, covariances
        self.n_components_ = K
        self._whiteners, self._constants = whiteners, constants
        self.precisions_cholesky_ = np.ascontiguousarray(whiteners.transpose(0, 2, 1))
        self.precisions_ = self.precisions_cholesky_ @ whiteners

    def _log_joint(self, X: ArrayLike) -> Array:
        check_is_fitted(self)
        samples = validate_data(self, X, dtype=np.float64, reset=False)
        blocks, _ = em.in_blocks(samples, np.zeros(len(samples)))
        work = em.Work.room_for(*self.means_.shape)
        work.whiteners[:], work.constants[:] = self._whiteners, self._constants
        joint = np.empty((len(blocks) * em.BLOCK, len(self.means_)))
        em.log_joint(blocks, self.means_, np.zeros(samples.shape[1]), work, joint)
        joint = joint[: len(samples)]
        told = joint.max(axis=1) >= compiled.LOWEST
        if not np.all(told):
            raise MisstepError(
                f"sample {int(np.argmin(told))} lies so far from every component that its "
                f"log density leaves the range of numbers"
            )
        return joint


def effective_size(sample_weight: Array) -> float:
    """Kish's effective sample size (Σw)² / Σw²."""
    return float(sample_weight.sum() ** 2 / (sample_weight**2).sum())


def bic_of(mean_log_likelihood: float, size: float, K: int, d: int) -> float:
    """BIC of a K-component mixture in d dimensions on `size` effective samples."""
    return -2.0 * size * mean_log_likelihood + n_parameters(K, d) * math.log(size)


def n_parameters(K: int, d: int) -> int:
    """Free parameters of a K-component mixture in d dimensions."""
    return K * (1 + d + d * (d + 1) // 2) - 1


def generator_of(random_state: RandomState) -> np.random.Generator:
    """Return a generator that can be split into independent ones.

    Raises
    ------
    MisstepError
        If it is no seed and no generator.
    """
    if isinstance(random_state, np.random.RandomState):
        # Its state cannot be split, but draws a seed like any other number.
        return np.random.default_rng(random_state.randint(2**32, size=4, dtype=np.uint64))
    try:
        return np.random.default_rng(random_state)
    except (TypeError, ValueError) as error:
        raise MisstepError(
            f"random_state is {random_state!r}: it is a whole number from 0 on, a Generator or "
            "RandomState of NumPy's, or None"
        ) from error


def _numbers(values: object, name: str) -> Array:
    try:
        return np.array(values, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise MisstepError(f"{name} has to be an array of numbers") from error


def _standardised(model: GaussianMixture, offset: Array, scale: Array) -> Mixture:
    """Return the parameters of a fitted mixture in units of standardised samples."""
    return Mixture(
        model.weights_.copy(),
        (model.means_ - offset) / scale,
        model.covariances_ / np.outer(scale, scale),
    )


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
    # A power of two changes no bit of the fit, and no sum of weights leaves the range of numbers.
    return np.ldexp(weight, -np.frexp(weight.max())[1])


def _standardise(X: Array, weight: Array) -> tuple[Array, Array, Array]:
    """Return samples (N, d) of mean 0 and variance 1, and the mean and deviation they had (d,)."""
    # With the samples innermost, sums over them are several times as fast.
    columns = np.ascontiguousarray(X.T)
    total = weight.sum()
    first, extent = X[0], np.maximum(columns.max(axis=1), -columns.min(axis=1))
    with np.errstate(over="ignore", invalid="ignore"):
        offset = (columns * weight).sum(axis=1) / total
        columns -= offset[:, None]
        scale = np.sqrt((columns**2 * weight).sum(axis=1) / total)
    _check_spread(first, extent, scale)
    columns /= scale[:, None]
    return columns.T, offset, scale


def _check_spread(first: Array, extent: Array, scale: Array) -> None:
    """Raise MisstepError if a column, of which `first` is a value, hardly varies, or too much."""
    wide = np.flatnonzero(~np.isfinite(scale))
    if len(wide):
        raise MisstepError(
            f"column {wide[0]} of X ranges so far that its variance leaves the range of numbers"
        )
    constant = np.flatnonzero(scale <= CONSTANT * extent)
    if len(constant):
        column = int(constant[0])
        raise MisstepError(
            f"column {column} of X is constant ({first[column]:g}): a mixture needs varying columns"
        )
