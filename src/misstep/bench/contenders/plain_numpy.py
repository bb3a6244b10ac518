"""The readable NumPy that misstep's compiled loops are tested against."""

from collections.abc import Callable
from typing import Any

import numpy as np

from .ascent import climb, donut_shape, exploration


def fit(X: Any, weights: Any, means: Any, covariances: Any, n: int) -> Any:
    """`reference.em_step`, n times."""
    from misstep.mixture import reference

    ones = np.ones(len(X))
    for _ in range(n):
        _, weights, means, covariances = reference.em_step(
            X, ones, weights, means, covariances, 0.0
        )
    return weights, means, covariances


def parameters(model: Any) -> tuple[Any, Any, Any]:
    """Weights, means, covariances."""
    weights, means, covariances = model
    return weights, means, covariances


def log_likelihood(model: Any, X: Any) -> float:
    """`reference.log_joint`, summed."""
    from scipy.special import logsumexp

    from misstep.mixture import reference

    return float(logsumexp(reference.log_joint(X, *model), axis=1).sum())


def querier(mixture: Any, n: int, scale: Any, k: float, reach: float) -> Callable[[Any, Any], Any]:
    """`reference.condition` and `reference.donut_mixture_density`."""
    from misstep.mixture import reference

    def mode(state: Any, action: Any) -> Any:
        h, m, S = reference.condition(state, *mixture)
        shape = donut_shape(exploration(h, m, S, scale), len(scale), k, reach)
        deviation = np.sqrt(np.diagonal(reference.moments(h, m, S)[1]))

        def density(points: Any) -> Any:
            return reference.donut_mixture_density(points, h, m, S, *shape)

        return climb(density, action, deviation)

    return mode
