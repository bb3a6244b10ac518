"""gmr, Gaussian mixture regression."""

from collections.abc import Callable
from typing import Any

import numpy as np

from .ascent import climb, donut_shape, exploration
from .criterion import least_bic


def fit(X: Any, weights: Any, means: Any, covariances: Any, n: int) -> Any:
    """EM without a stopping rule."""
    import gmr  # type: ignore[import-not-found]

    model = gmr.GMM(len(weights), priors=weights, means=means, covariances=covariances)
    return model.from_samples(X, R_diff=0.0, n_iter=n)


def parameters(model: Any) -> tuple[Any, Any, Any]:
    """Priors, means, covariances."""
    return model.priors, model.means, model.covariances


def log_likelihood(model: Any, X: Any) -> float:
    """Sum logarithms of densities: it has no other."""
    return float(np.log(model.to_probability_density(X)).sum())


def scan(X: Any, most: int, seed: int) -> int:
    """One fit a K: random samples as means, identity covariances, 100 iterations."""
    import gmr

    def fitted(K: int) -> float:
        return log_likelihood(gmr.GMM(K, random_state=seed).from_samples(X), X)

    return least_bic(X, most, fitted)


def querier(mixture: Any, n: int, scale: Any, k: float, reach: float) -> Callable[[Any, Any], Any]:
    """Condition with `GMM.condition`, then two mixtures' densities make the donut mixture's."""
    import gmr

    weights, means, covariances = mixture
    joint = gmr.GMM(len(weights), priors=weights, means=means, covariances=covariances)
    columns = np.arange(n)

    def mode(state: Any, action: Any) -> Any:
        at = joint.condition(columns, state)
        epsilon = exploration(at.priors, at.means, at.covariances, scale)
        gamma, r_alpha, r_beta = donut_shape(epsilon, len(scale), k, reach)
        wide, narrow = (
            gmr.GMM(
                len(weights), priors=at.priors, means=at.means, covariances=at.covariances / r**2
            )
            for r in (r_alpha, r_beta)
        )

        def density(points: Any) -> Any:
            inner = (gamma - 1.0) * narrow.to_probability_density(points)
            return gamma * wide.to_probability_density(points) - inner

        return climb(density, action, np.sqrt(np.diagonal(at.to_mvn().covariance)))

    return mode
