"""pomegranate's GeneralMixtureModel on PyTorch, in single precision as it is by default."""

from typing import Any

import numpy as np

from .criterion import least_bic


def fit(X: Any, weights: Any, means: Any, covariances: Any, n: int) -> Any:
    """EM without a stopping rule."""
    import torch  # type: ignore[import-not-found]
    from pomegranate.distributions import Normal  # type: ignore[import-not-found]
    from pomegranate.gmm import GeneralMixtureModel  # type: ignore[import-not-found]

    def single(array: Any) -> Any:
        return torch.tensor(array, dtype=torch.float32)

    components = [Normal(single(m), single(c)) for m, c in zip(means, covariances, strict=True)]
    model = GeneralMixtureModel(components, priors=single(weights), max_iter=n, tol=-float("inf"))
    return model.fit(single(X))


def parameters(model: Any) -> tuple[Any, Any, Any]:
    """Priors, means, covariances."""
    means, covariances = (
        np.array([getattr(c, name).detach().numpy() for c in model.distributions])
        for name in ("means", "covs")
    )
    return model.priors.detach().numpy(), means, covariances


def log_likelihood(model: Any, X: Any) -> float:
    """Sum in double precision."""
    import torch

    points = torch.tensor(X, dtype=torch.float32)
    return float(model.log_probability(points).double().sum())


def scan(X: Any, most: int, seed: int) -> int:
    """One fit a K: a few iterations of k-means, tolerance 0.1 on the sum."""
    import torch
    from pomegranate.distributions import Normal
    from pomegranate.gmm import GeneralMixtureModel

    torch.manual_seed(seed)
    points = torch.tensor(X, dtype=torch.float32)

    def fitted(K: int) -> float:
        # Its own start refuses K = 1.
        components = [Normal() for _ in range(K)] if K > 1 else [Normal().fit(points)]
        return log_likelihood(GeneralMixtureModel(components, random_state=seed).fit(points), X)

    return least_bic(X, most, fitted)
