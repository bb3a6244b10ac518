"""What is fitted and asked: data, starts and paths of states, the same for every contender."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from misstep.mixture import GaussianMixture

Array = NDArray[np.float64]
Mixture = tuple[Array, Array, Array]
"""Weights (K,), means (K, d), covariances (K, d, d)."""

# How many of the joint columns are actions; the others are the state.
ACTIONS = {2: 1, 5: 1, 14: 2}


def draw_mixture(rng: np.random.Generator, K: int, d: int) -> Mixture:
    """Draw a mixture whose components overlap somewhat, as those of demonstrations do."""
    factors = rng.normal(size=(K, d, d)) / np.sqrt(d)
    covariances = factors @ factors.transpose(0, 2, 1) + 0.1 * np.eye(d)
    return rng.dirichlet(np.full(K, 5.0)), 3.0 / np.sqrt(d) * rng.normal(size=(K, d)), covariances


def draw_samples(n: int, d: int, seed: int = 0) -> Array:
    """Draw n samples of a mixture of four components, shape (n, d)."""
    rng = np.random.default_rng([seed, d])
    samples, _ = GaussianMixture.from_parameters(*draw_mixture(rng, 4, d)).sample(n, rng)
    return np.ascontiguousarray(samples)


def draw_start(X: Array, K: int, seed: int = 0) -> Mixture:
    """Return a start: the data in K slices of equal size across a random direction.

    Weights are equal, means are the slices', every covariance is that of all data. From samples
    drawn at random a component may shrink onto its neighbours and become singular, in 14 columns.
    """
    rng = np.random.default_rng([seed, K])
    d = X.shape[1]
    slices = np.array_split(np.argsort(X @ rng.normal(size=d)), K)
    covariances = np.repeat(np.cov(X.T).reshape(1, d, d), K, axis=0)
    return np.full(K, 1.0 / K), np.array([X[rows].mean(axis=0) for rows in slices]), covariances


class StatePath(NamedTuple):
    """States to answer one after the other."""

    mixture: Mixture
    states: Array
    """Shape (N, n)."""
    scale: Array
    """s of the exploration, shape (m,)."""


def draw_path(K: int, d: int, n: int, seed: int = 0) -> StatePath:
    """Draw a mixture of K components in d columns, and a smooth path of n states through it."""
    rng = np.random.default_rng([seed, K, d])
    mixture = draw_mixture(rng, K, d)
    m = ACTIONS[d]
    # From component to component, fifty states each, with a wobble.
    stops = mixture[1][rng.integers(K, size=2 + n // 50)][:, : d - m]
    share = np.arange(n) / 50.0
    low = share.astype(int)
    part = (share - low)[:, None]
    wobble = 0.1 * np.sin(share[:, None] * (1.0 + np.arange(d - m)))
    states = (1.0 - part) * stops[low] + part * stops[low + 1] + wobble
    spread = GaussianMixture.from_parameters(*mixture).sample(5000, rng)[0].std(axis=0)
    return StatePath(mixture, states, 0.3 * spread[d - m :])
