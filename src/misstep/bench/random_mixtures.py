"""Random mixtures whose number of components is known, to see who finds it.

Two components overlap by the share of samples of either that the other would claim (Maitra &
Melnykov, "Simulating data to study performance of finite mixture modeling and clustering
algorithms", 2010): ω = P(i claims | j) + P(j claims | i). Each mixture here is shrunk or widened
until its worst pair overlaps by a number drawn between 0 and 5 %.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from misstep.mixture import GaussianMixture

Array = NDArray[np.float64]

COMPONENTS = (2, 3, 4, 5, 6)
DIMENSIONS = (2, 3, 4, 5)
N_SAMPLES = 6000
MOST_OVERLAP = 0.05
LEAST_SHARE = 0.5
"""A component's weight times K is at least this."""

_DRAWS = 4000
_HALVINGS = 12


def random_mixtures(
    count: int, seed: int = 0, n_samples: int = N_SAMPLES
) -> Iterator[tuple[Array, int]]:
    """Yield samples of shape (n_samples, d) of `count` mixtures, and each one's true K.

    K goes through 2 … 6 and d through 2 … 5, each pair as often as the others.
    """
    for i in range(count):
        rng = np.random.default_rng([seed, i])
        K = COMPONENTS[i % len(COMPONENTS)]
        d = DIMENSIONS[i // len(COMPONENTS) % len(DIMENSIONS)]
        yield draw_separate(rng, K, d).sample(n_samples, rng)[0], K


def draw_separate(rng: np.random.Generator, K: int, d: int) -> GaussianMixture:
    """Draw a mixture of K components in d columns whose worst pair overlaps by less than 5 %.

    Covariances have axes drawn at random, whose standard deviations differ by up to a factor of
    five.
    """
    weights = (LEAST_SHARE + (1.0 - LEAST_SHARE) * K * rng.dirichlet(np.ones(K))) / K
    means = rng.uniform(0.0, 1.0, (K, d))
    axes = np.linalg.qr(rng.normal(size=(K, d, d)))[0]
    deviations = 5.0 ** rng.uniform(-1.0, 0.0, (K, 1, d))
    factors = axes * deviations
    noise = rng.standard_normal((_DRAWS, d))
    aim = MOST_OVERLAP * (1.0 - rng.random())
    low, high = 1e-4, 4.0
    for _ in range(_HALVINGS):
        size = np.sqrt(low * high)
        if worst_overlap(weights, means, size * factors, noise) < aim:
            low = size
        else:
            high = size
    covariances = low**2 * factors @ factors.transpose(0, 2, 1)
    return GaussianMixture.from_parameters(weights, means, covariances)


def worst_overlap(weights: Array, means: Array, factors: Array, noise: Array) -> float:
    """Return the largest ω of two components, with samples made of `noise` (draws, d).

    Parameters
    ----------
    weights : ndarray, shape (K,)
    means : ndarray, shape (K, d)
    factors : ndarray, shape (K, d, d)
        A with covariance A Aᵀ.
    noise : ndarray, shape (draws, d)
        Standard normal.
    """
    K = len(means)
    inverses = np.linalg.inv(factors)
    offsets = np.log(weights) - np.linalg.slogdet(factors)[1]
    claimed = np.zeros((K, K))
    for i in range(K):
        samples = means[i] + noise @ factors[i].T
        whitened = np.einsum("kij,nkj->nki", inverses, samples[:, None, :] - means)
        score = offsets - 0.5 * (whitened**2).sum(axis=2)
        claimed[i] = (score > score[:, i, None]).mean(axis=0)
    overlap: float = (claimed + claimed.T).max()
    return overlap
