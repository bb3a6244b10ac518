"""Where expectation–maximisation starts: k-means++ seeds, drawn so that only the data matter.

The seeds are drawn by inverse transform over samples in lexicographic order, equal ones merged. A
sample of weight two is therefore the very same thing as two equal samples, and shuffling the rows
changes nothing: two properties that an ordinary k-means++ lacks and that "weights equal repetition"
needs.
"""

# mypy: disallow-untyped-defs=False, check-untyped-defs=False
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from misstep.compiling import njit
from misstep.mixture.compiled import COMPILED
from misstep.mixture.em import BLOCK, Mixture, Samples

Array = NDArray[np.float64]
Labels = NDArray[np.int32]


def sort_samples(X: Array, sample_weight: Array) -> tuple[Array, Array]:
    """Return the distinct samples (N', d), lexicographically sorted, and their summed weights."""
    order = np.argsort(X[:, 0], kind="stable")
    leading = X[order, 0]
    if np.any(leading[1:] == leading[:-1]):
        order = np.lexsort(X.T[::-1])
    X, sample_weight = X[order], sample_weight[order]
    first = np.flatnonzero(np.append(True, np.any(X[1:] != X[:-1], axis=1)))
    if len(first) == len(X):
        return X, sample_weight
    return X[first], np.add.reduceat(sample_weight, first)


def spread_of(X: Array, sample_weight: Array, floor: Array) -> Array:
    """Return the covariance (d, d) of all samples, with the floor."""
    d = X.shape[1]
    covariance: Array = np.cov(X.T, aweights=sample_weight, ddof=0).reshape(d, d)
    return covariance + np.diag(floor)


Maker = Callable[[Samples, Array, Array, int, np.random.Generator, Array], Mixture]
"""Makes a start of K components: of samples in blocks and as sorted rows (N, d), their weights, K,
a generator, and the covariance of all samples."""


def from_kmeans_plus_plus(
    samples: Samples, Z: Array, weight: Array, K: int, rng: np.random.Generator, spread: Array
) -> Mixture:
    """Draw seeds far apart, and take the samples nearest to each."""
    labels = kmeans_plus_plus(samples, len(Z), rng.random(K))
    return moments_of(samples, len(Z), labels, K, spread)


def from_kmeans(
    samples: Samples, Z: Array, weight: Array, K: int, rng: np.random.Generator, spread: Array
) -> Mixture:
    """Take the clusters of scikit-learn's k-means."""
    from sklearn.cluster import KMeans  # slow to import

    seed = int(rng.integers(2**31))
    clusters = KMeans(K, n_init=1, random_state=seed).fit(Z, sample_weight=weight)
    return moments_of(samples, len(Z), _blocks_of(samples, clusters.labels_), K, spread)


def from_random_samples(
    samples: Samples, Z: Array, weight: Array, K: int, rng: np.random.Generator, spread: Array
) -> Mixture:
    """Draw samples at random, and take those nearest to each."""
    seeds = Z[rng.choice(len(Z), size=K, replace=False, p=weight / weight.sum())]
    nearest = np.argmin([((Z - seed) ** 2).sum(axis=1) for seed in seeds], axis=0)
    return moments_of(samples, len(Z), _blocks_of(samples, nearest), K, spread)


def from_random_shares(
    samples: Samples, Z: Array, weight: Array, K: int, rng: np.random.Generator, spread: Array
) -> Mixture:
    """Draw shares of all samples at random: every component begins near the middle."""
    shares = rng.random((len(Z), K))
    shares *= (weight / shares.sum(axis=1))[:, None]
    mass = shares.sum(axis=0)
    means = shares.T @ Z / mass[:, None]
    covariances = np.stack(
        [np.cov(Z.T, aweights=share, ddof=0).reshape(spread.shape) for share in shares.T]
    )
    floor = 1e-6 * np.eye(len(spread))  # two equal samples have no spread
    return Mixture(mass / mass.sum(), means, covariances + floor)


MAKERS: dict[str, Maker] = {
    "k-means++": from_kmeans_plus_plus,
    "kmeans": from_kmeans,
    "random_from_data": from_random_samples,
    "random": from_random_shares,
}
"""By the names that scikit-learn gives them."""


def _blocks_of(samples: Samples, labels: NDArray[np.integer]) -> Labels:
    """Return labels of rows (N,) as labels of blocks; padding has no weight and label 0."""
    blocks = np.zeros(samples.weight.shape, np.int32)
    blocks.ravel()[: len(labels)] = labels
    return blocks


def kmeans_plus_plus(samples: Samples, n_samples: int, draws: Array) -> Labels:
    """Assign sorted samples to K seeds, drawn in proportion to squared distance from the others.

    Parameters
    ----------
    samples : Samples
        `n_samples` standardised samples, sorted by `sort_samples`.
    n_samples : int
    draws : ndarray, shape (K,)
        Uniform on [0, 1): one for each seed.

    Returns
    -------
    labels : ndarray of int32, shape (blocks, BLOCK)
        Index of the nearest seed. Seeds that coincide leave later ones without samples.
    """
    nearest = np.full_like(samples.weight, np.inf)
    labels = np.zeros(samples.weight.shape, np.int32)
    _assign(samples, n_samples, draws, nearest, labels, np.empty((2, BLOCK)))
    return labels


@njit(**COMPILED)
def _assign(samples, n_samples, draws, nearest, labels, room):
    blocks, weight = samples.blocks, samples.weight
    n_blocks, d, _ = blocks.shape
    distance, gap = room[0], room[1]
    for k in range(draws.shape[0]):
        total = 0.0
        for i in range(n_samples):
            block, b = divmod(i, BLOCK)
            total += weight[block, b] * nearest[block, b] if k else weight[block, b]
        aim = draws[k] * total
        seed = n_samples - 1
        total = 0.0
        for i in range(n_samples):
            block, b = divmod(i, BLOCK)
            total += weight[block, b] * nearest[block, b] if k else weight[block, b]
            if total > aim:
                seed = i
                break
        at, column = divmod(seed, BLOCK)
        for block in range(n_blocks):
            for b in range(BLOCK):
                distance[b] = 0.0
            for j in range(d):
                x, s = blocks[block, j], blocks[at, j, column]
                for b in range(BLOCK):
                    gap[b] = x[b] - s
                    distance[b] += gap[b] * gap[b]
            for b in range(BLOCK):
                if distance[b] < nearest[block, b]:
                    labels[block, b] = k
                    nearest[block, b] = distance[b]


def moments_of(samples: Samples, n_samples: int, labels: Labels, K: int, spread: Array) -> Mixture:
    """Weights, means and covariances of a hard assignment of standardised samples.

    A covariance is blended with that of all the data, `spread` (d, d), as if d + 1 samples had been
    drawn from there, so that a seed with few samples still starts with a definite one.
    """
    d = len(spread)
    mass, first, second = np.zeros(K), np.zeros((K, d)), np.zeros((K, d, d))
    _add_masses(samples, labels, mass, first)
    scale = mass.sum() / n_samples
    means = first / np.maximum(mass, 1e-300)[:, None]
    _add_squares(samples, labels, means, np.empty(d), second)
    second += np.tril(second, -1).transpose(0, 2, 1)
    prior = (d + 1) * scale
    covariances = (second + prior * spread / K) / (mass + prior)[:, None, None]
    weights = mass + scale
    return Mixture(weights / weights.sum(), means, covariances)


@njit(**COMPILED)
def _add_masses(samples, labels, mass, first):
    n_blocks, d, _ = samples.blocks.shape
    for block in range(n_blocks):
        for b in range(BLOCK):
            k, w = labels[block, b], samples.weight[block, b]
            mass[k] += w
            for j in range(d):
                first[k, j] += w * samples.blocks[block, j, b]


@njit(**COMPILED)
def _add_squares(samples, labels, means, deviation, second):
    n_blocks, d, _ = samples.blocks.shape
    for block in range(n_blocks):
        for b in range(BLOCK):
            k, w = labels[block, b], samples.weight[block, b]
            for j in range(d):
                deviation[j] = samples.blocks[block, j, b] - means[k, j]
                for m in range(j + 1):
                    second[k, j, m] += w * deviation[j] * deviation[m]
