"""The Donut Mixture Model at one state, its mode, and how much to explore there.

DMM(a | ξ) = Σ_k h_k(ξ) D(a; m_k, S_k, ε(ξ)), with one ε per state.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from misstep.errors import MisstepError
from misstep.mixture import compiled
from misstep.mixture.checks import checked_points
from misstep.mixture.conditional import Conditional
from misstep.mixture.donut import DEFAULT_K, DEFAULT_REACH, DonutShape

Array = NDArray[np.float64]
FORMULAS = ("prose", "printed")


def exploration_from_variance(
    variance: ArrayLike, scale: ArrayLike, formula: str = "prose"
) -> float:
    """How much to explore where the demonstrators differ by `variance`.

    Parameters
    ----------
    variance : array-like, shape (d, d)
        V of the actions at the state (`Conditional.variance`).
    scale : array-like, shape (d,)
        s, in the action's own unit: the disagreement that counts as half.
    formula : {"prose", "printed"}
        ``"prose"``: ε = 1 − 1/(1 + V/s²), near 0 where demonstrators agree, as the paper's text and
        its figures 5 and 6 have it. ``"printed"``: ε = 1/(1 + V/s²), as its equation is printed,
        which says the opposite.

    Returns
    -------
    exploration : float
        From 0 to 1. With several action columns, V/s² is the mean of V_ii/s_i².

    Raises
    ------
    MisstepError
        If the shapes disagree, a variance is no number or negative, the scale is not positive and
        finite, or there is no such formula.
    """
    v, s = np.array(variance, dtype=np.float64), np.array(scale, dtype=np.float64)
    check_formula(formula)
    if s.ndim != 1 or v.shape != 2 * s.shape or not np.all((s > 0) & (s < np.inf)):
        raise MisstepError(
            f"exploration takes a variance (d, d) and a positive scale (d,), got {v.shape} and "
            f"{s.tolist()}"
        )
    if np.any(np.isnan(v)) or np.any(np.diag(v) < 0):
        raise MisstepError(
            f"exploration takes a variance of numbers, none negative, got {v.tolist()}"
        )
    with np.errstate(over="ignore"):
        spread = float(np.mean(np.diag(v) / s**2))
    exploration: float = compiled.exploration_of(spread, formula == "printed")
    return exploration


def check_formula(formula: str) -> None:
    """Raise MisstepError unless there is such a formula of the exploration."""
    if formula not in FORMULAS:
        raise MisstepError(f"the formula is 'prose' or 'printed', got {formula!r}")


def check_scale(scale: Array, d: int) -> None:
    """Raise MisstepError unless s holds d positive numbers whose squares are numbers too."""
    if scale.shape != (d,) or not np.all((scale > 1e-150) & (scale < 1e150)):
        raise MisstepError(
            f"the scale must be {d} positive numbers, 1e-150 to 1e150, got {scale.tolist()}"
        )


class DonutMixture:
    """A mixture of donuts over actions: the conditional mixture with holes at its centres.

    Parameters
    ----------
    conditional : Conditional
        h (K,), m (K, d), S (K, d, d) of the actions at a state.
    exploration : float
        ε from 0 to 1.
    k, reach : float
        The donut family, see `DonutShape.of`.

    Raises
    ------
    MisstepError
        If a value is out of its range or a covariance is not definite.
    """

    def __init__(
        self,
        conditional: Conditional,
        exploration: float,
        k: float = DEFAULT_K,
        reach: float = DEFAULT_REACH,
    ) -> None:
        self.conditional = conditional
        self.exploration = float(exploration)
        d = conditional.means.shape[1]
        self.shape = DonutShape.of(exploration, d, k, reach)
        self.ridge_radius = compiled.donut_shape(self.exploration, d, float(k), float(reach))[1]
        with np.errstate(divide="ignore"):  # a component without weight is not there
            self._log_h = np.log(conditional.weights)
        self._components = component_arrays(conditional.covariances)

    def log_pdf(self, a: ArrayLike) -> Array:
        """Return the log density at points of shape (N, d), shape (N,); −inf where it is zero."""
        return self._evaluate(a)[0]

    def pdf(self, a: ArrayLike) -> Array:
        """Return the density at points of shape (N, d), shape (N,)."""
        density: Array = np.exp(self.log_pdf(a))
        return density

    def gradient(self, a: ArrayLike) -> Array:
        """Return the gradient of the density at points of shape (N, d), shape (N, d)."""
        values, gradients = self._evaluate(a)
        # Beyond the range of double precision the density is flat, and the slope infinite.
        gradients[values == -np.inf] = 0.0
        scaled: Array = np.exp(values)[:, None] * gradients
        return scaled

    def mode(self, start: ArrayLike | None = None) -> Array:
        """Return a mode, shape (d,), by Newton's ascent in a trust region.

        Parameters
        ----------
        start : array-like, shape (d,), optional
            Where the climb begins (the paper's listing: the previous action), and so which of
            several modes is found. None begins at the best of the analytic candidates: the centres
            m_k and the points m_k ± m*_k on their ridges. So does a climb that ends on a hill of
            next to no weight (`compiled.GONE`).
        """
        means = self.conditional.means
        a = np.empty(means.shape[1]) if start is None else self._points(np.array(start)[None])[0]
        compiled.climb(
            a,
            self._log_h,
            means,
            *self._components,
            self.shape,
            self.ridge_radius,
            start is not None,
            True,
            self._scratch(),
        )
        return a

    def _scratch(self) -> Array:
        """Return room to work in, for one call: several threads may ask one object."""
        return compiled.scratch_for(*self.conditional.means.shape)

    def _points(self, a: ArrayLike) -> Array:
        return checked_points(a, self.conditional.means.shape[1])

    def _evaluate(self, a: ArrayLike) -> tuple[Array, Array]:
        """Return the log density (N,) and its gradient (N, d) at points (N, d)."""
        points = self._points(a)
        whiteners, _, _, log_norms = self._components
        values, gradients = np.empty(len(points)), np.empty_like(points)
        compiled.mixture_densities(
            points,
            self._log_h,
            self.conditional.means,
            whiteners,
            log_norms,
            self.shape,
            values,
            gradients,
            self._scratch(),
        )
        return values, gradients


def component_arrays(covariances: Array) -> tuple[Array, Array, Array, Array]:
    """Whiteners L⁻¹, precisions, lower factors L (K, d, d) and log norms (K,) of covariances.

    Raises
    ------
    MisstepError
        If a covariance is not definite.
    """
    K, d, _ = covariances.shape
    whiteners: Array = np.empty((K, d, d))
    log_norms: Array = np.empty(K)
    if not compiled.precompute(np.ones(K), np.ascontiguousarray(covariances), whiteners, log_norms):
        raise MisstepError("a donut mixture's covariance is not symmetric positive definite")
    lowers = np.linalg.cholesky(covariances).astype(np.float64)
    precisions = whiteners.transpose(0, 2, 1) @ whiteners
    return whiteners, np.ascontiguousarray(precisions), lowers, log_norms
