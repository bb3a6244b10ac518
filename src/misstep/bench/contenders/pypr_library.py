"""PyPR of 2012, the paper's library, converted to Python 3 (`misstep.bench.peers`)."""

from collections.abc import Callable
from typing import Any

import numpy as np

from .ascent import climb, donut_shape, exploration
from .criterion import least_bic


def fit(X: Any, weights: Any, means: Any, covariances: Any, n: int) -> Any:
    """EM without a stopping rule; its floor must not be zero, so it is next to nothing."""
    from pypr.clustering import gmm  # type: ignore[import-not-found]

    return gmm.gmm_em_continue(
        X,
        list(means),
        list(covariances),
        weights,
        max_iter=n,
        delta_stop=0.0,
        diag_add=1e-300,
    )


def parameters(model: Any) -> tuple[Any, Any, Any]:
    """Take apart what it returns: centres, covariances, weights, log-likelihood."""
    centres, covariances, weights, _ = model
    return weights, centres, covariances


def log_likelihood(model: Any, X: Any) -> float:
    """Of the returned parameters: what `em_gm` returns is that of an iteration before."""
    from pypr.clustering import gmm

    return float(gmm.gm_log_likelihood(X, *model[:3]))


def scan(X: Any, most: int, seed: int) -> int:
    """One fit a K: random samples as means, 50 iterations; another start where a fit collapses."""
    from pypr.clustering import gmm

    np.random.seed(seed)  # noqa: NPY002 - the only source of randomness that PyPR knows

    def fitted(K: int) -> float:
        try:
            return log_likelihood(gmm.em_gm(X, K), X)
        except gmm.Cov_problem:
            return float("nan")

    return least_bic(X, most, fitted)


def querier(mixture: Any, n: int, scale: Any, k: float, reach: float) -> Callable[[Any, Any], Any]:
    """Condition with `cond_dist`, then two calls of `gmm_pdf` make the donut mixture's density."""
    from pypr.clustering import gmm

    weights, means, covariances = mixture[0], list(mixture[1]), list(mixture[2])
    unknown = np.full(len(scale), np.nan)

    def mode(state: Any, action: Any) -> Any:
        m, S, h = gmm.cond_dist(np.concatenate([state, unknown]), means, covariances, weights)
        spread = np.array(m), np.array(S)
        epsilon = exploration(h, *spread, scale)
        gamma, r_alpha, r_beta = donut_shape(epsilon, len(scale), k, reach)
        wide, narrow = ([c / r**2 for c in S] for r in (r_alpha, r_beta))

        def density(points: Any) -> Any:
            inner = (gamma - 1.0) * gmm.gmm_pdf(points, m, narrow, h)
            return gamma * gmm.gmm_pdf(points, m, wide, h) - inner

        deviations = spread[0] - h @ spread[0]
        variances = np.diagonal(spread[1], axis1=1, axis2=2) + deviations**2
        return climb(density, action, np.sqrt(h @ variances))

    return mode
