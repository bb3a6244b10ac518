"""The Bayesian information criterion, for libraries that do not have it."""

import math
from collections.abc import Callable
from typing import Any


def bic(log_likelihood: float, n: int, K: int, d: int) -> float:
    """BIC of a full-covariance mixture of K components in d dimensions on n samples."""
    return -2.0 * log_likelihood + (K * (1 + d + d * (d + 1) // 2) - 1) * math.log(n)


def least_bic(X: Any, most: int, log_likelihood: Callable[[int], float]) -> int:
    """Return the K of 1 … `most` with the least BIC; NaN never wins."""
    n, d = X.shape
    scores = {K: bic(log_likelihood(K), n, K, d) for K in range(1, most + 1)}
    return min(scores, key=lambda K: scores[K] if not math.isnan(scores[K]) else math.inf)
