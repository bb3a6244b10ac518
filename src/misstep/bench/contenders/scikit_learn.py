"""scikit-learn's GaussianMixture."""

from typing import Any

import numpy as np


def fit(X: Any, weights: Any, means: Any, covariances: Any, n: int) -> Any:
    """EM without regularisation and without a stopping rule."""
    from sklearn.mixture import GaussianMixture

    model = GaussianMixture(
        len(weights),
        tol=0.0,
        reg_covar=0.0,
        max_iter=n,
        weights_init=weights,
        means_init=means,
        precisions_init=np.linalg.inv(covariances),
    )
    return model.fit(X)


def parameters(model: Any) -> tuple[Any, Any, Any]:
    """Weights, means, covariances."""
    return model.weights_, model.means_, model.covariances_


def log_likelihood(model: Any, X: Any) -> float:
    """`score` is the mean."""
    return float(model.score(X)) * len(X)


def scan(X: Any, most: int, seed: int) -> int:
    """One fit a K: one k-means start, tolerance 1e-3, 100 iterations."""
    from sklearn.mixture import GaussianMixture

    scores = [GaussianMixture(K, random_state=seed).fit(X).bic(X) for K in range(1, most + 1)]
    return 1 + int(np.argmin(scores))
