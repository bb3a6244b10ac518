"""misstep."""

from collections.abc import Callable
from typing import Any

import numpy as np


def fit(X: Any, weights: Any, means: Any, covariances: Any, n: int) -> Any:
    """EM without a floor and without a stopping rule."""
    from misstep import GaussianMixture

    return GaussianMixture(
        len(weights),
        tol=0.0,
        covariance_floor=0.0,
        max_iter=n,
        weights_init=weights,
        means_init=means,
        precisions_init=np.linalg.inv(covariances),
    ).fit(X)


def parameters(model: Any) -> tuple[Any, Any, Any]:
    """Weights, means, covariances."""
    return model.weights_, model.means_, model.covariances_


def log_likelihood(model: Any, X: Any) -> float:
    """Return what the fit knows already."""
    return float(model.lower_bound_) * len(X)


def fit_all(X: Any, starts: list[Any], n: int) -> list[tuple[Any, float]]:
    """Share the samples and the threads, as `GaussianMixture.fit` does with starts of its own."""
    from misstep import GaussianMixture
    from misstep.mixture import em, fitting

    offset, scale = X.mean(axis=0), X.std(axis=0)
    samples = em.in_blocks((X - offset) / scale, np.ones(len(X)))
    rule, candidates = em.Rule(np.zeros(len(scale)), 0.0, n), {}
    for weights, means, covariances in starts:
        start = em.Mixture(weights, (means - offset) / scale, covariances / np.outer(scale, scale))
        candidates[len(weights)] = [lambda start=start: start]
    fits = fitting.fit_each(samples, candidates, rule, fitting.available_threads())
    fitted = []
    for K in candidates:
        weights, means, covariances = fits[K].mixture
        model = GaussianMixture.from_parameters(
            weights, means * scale + offset, covariances * np.outer(scale, scale)
        )
        fitted.append((model, fits[K].log_likelihood - len(X) * np.log(scale).sum()))
    return fitted


def scan(X: Any, most: int, seed: int) -> int:
    """Fit without a number of components: the estimator scans by itself."""
    from misstep import GaussianMixture

    return int(GaussianMixture(max_components=most, random_state=seed).fit(X).n_components_)


def querier(mixture: Any, n: int, scale: Any, k: float, reach: float) -> Callable[[Any, Any], Any]:
    """Return the policy that a control loop calls; it remembers the previous action itself."""
    from misstep import GaussianMixture
    from misstep.learners import Task
    from misstep.learners.donut import DonutPolicy, DonutSettings
    from misstep.trajectory import Column

    m = len(scale)
    observed = tuple(Column(f"x{i}", "") for i in range(n))
    applied = tuple(Column(f"a{i}", "") for i in range(m))
    names = tuple(column.name for column in observed)
    unbounded = np.full(m, np.inf)
    task = Task(observed, applied, -unbounded, unbounded, names, dt=0.02)
    settings = DonutSettings(k, reach, "warm", "prose")
    policy = DonutPolicy(task, GaussianMixture.from_parameters(*mixture), scale, settings)
    return lambda state, action: policy(state)
