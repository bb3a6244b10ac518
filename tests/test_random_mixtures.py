import numpy as np
import pytest
from scipy.stats import norm

from misstep.bench.random_mixtures import (
    LEAST_SHARE,
    MOST_OVERLAP,
    draw_separate,
    random_mixtures,
    worst_overlap,
)


def test_overlap_of_two_gaussians_in_closed_form():
    # Equal weights and widths: each side loses what lies beyond the middle.
    noise = np.random.default_rng(0).standard_normal((200_000, 1))
    means, factors = np.array([[0.0], [3.0]]), np.ones((2, 1, 1))
    expected = 2.0 * norm.cdf(-1.5)
    assert worst_overlap(np.full(2, 0.5), means, factors, noise) == pytest.approx(
        expected, abs=5 * np.sqrt(expected / 200_000)
    )


def test_components_overlap_by_less_than_promised():
    for seed in range(10):
        K, d = 2 + seed % 5, 2 + seed % 4
        mixture = draw_separate(np.random.default_rng(seed), K, d)
        assert mixture.weights_.min() >= LEAST_SHARE / K - 1e-12
        X, labels = mixture.sample(20_000, random_state=seed)
        score = np.log(mixture.predict_proba(X) + 1e-300)
        lost = np.array([(score > score[:, [i]])[labels == i].mean(axis=0) for i in range(K)])
        # Twice 20,000 samples and 4,000 draws stand between this and the promise.
        assert (lost + lost.T).max() < MOST_OVERLAP + 0.02


def test_each_pair_of_k_and_d_comes_by():
    drawn = list(random_mixtures(20, seed=1, n_samples=50))
    assert len({(K, X.shape[1]) for X, K in drawn}) == 20
    assert all(len(X) == 50 for X, _ in drawn)
    again = list(random_mixtures(2, seed=1, n_samples=50))
    for (X, _), (same, _) in zip(drawn, again, strict=False):
        np.testing.assert_array_equal(X, same)
