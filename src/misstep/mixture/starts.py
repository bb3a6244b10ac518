"""Where expectation–maximisation starts: k-means++ seeds, drawn so that only the data matter.

The seeds are drawn by inverse transform over samples in lexicographic order, equal ones merged. A
sample of weight two is therefore the very same thing as two equal samples, and shuffling the rows
changes nothing: two properties that an ordinary k-means++ lacks and that "weights equal repetition"
needs.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Labels = NDArray[np.intp]


def sort_samples(X: Array, sample_weight: Array) -> tuple[Array, Array]:
    """Return the distinct samples (N', d), lexicographically sorted, and their summed weights."""
    order = np.lexsort(X.T[::-1])
    X, sample_weight = X[order], sample_weight[order]
    first = np.flatnonzero(np.append(True, np.any(X[1:] != X[:-1], axis=1)))
    return X[first], np.add.reduceat(sample_weight, first)


def kmeans_plus_plus(X: Array, sample_weight: Array, K: int, rng: np.random.Generator) -> Labels:
    """Assign sorted samples to K seeds, drawn in proportion to squared distance from the others.

    Parameters
    ----------
    X : ndarray, shape (N, d)
        Standardised samples, sorted by `sort_samples`.
    sample_weight : ndarray, shape (N,)
    K : int
    rng : numpy.random.Generator

    Returns
    -------
    labels : ndarray of int, shape (N,)
        Index of the nearest seed. Seeds that coincide leave later ones without samples.
    """
    nearest = np.full(len(X), np.inf)
    labels = np.zeros(len(X), dtype=np.intp)
    for k, u in enumerate(rng.random(K)):
        chance = sample_weight * nearest if k else sample_weight
        cumulative = np.cumsum(chance)
        seed = X[min(np.searchsorted(cumulative, u * cumulative[-1], side="right"), len(X) - 1)]
        distance = ((X - seed) ** 2).sum(axis=1)
        labels[distance < nearest] = k
        nearest = np.minimum(nearest, distance)
    return labels


def moments_of(
    X: Array, sample_weight: Array, labels: Labels, K: int, floor: float
) -> tuple[Array, Array, Array]:
    """Weights (K,), means (K, d) and covariances (K, d, d) of a hard assignment.

    A covariance is blended with that of all the data, as if d + 1 samples had been drawn from
    there, so that a seed with few samples still starts with a definite one.
    """
    d = X.shape[1]
    mean = np.average(X, axis=0, weights=sample_weight)
    spread = np.cov(X.T, aweights=sample_weight, ddof=0).reshape(d, d) + floor * np.eye(d)
    scale = sample_weight.sum() / len(X)
    weights, means, covariances = np.empty(K), np.empty((K, d)), np.empty((K, d, d))
    for k in range(K):
        w = sample_weight * (labels == k)
        mass = w.sum()
        means[k] = w @ X / mass if mass > 0 else mean
        deviations = X - means[k]
        prior = (d + 1) * scale
        covariances[k] = ((w * deviations.T) @ deviations + prior * spread / K) / (mass + prior)
        weights[k] = mass + scale
    return weights / weights.sum(), means, covariances
