import math

import numpy as np
import pytest
import sklearn.mixture
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import logsumexp
from sklearn.exceptions import ConvergenceWarning, NotFittedError
from sklearn.utils.estimator_checks import check_estimator
from threadpoolctl import threadpool_limits

from misstep.mixture import GaussianMixture, reference

SEEDS = st.integers(0, 2**32 - 1)
may_stop_early = pytest.mark.filterwarnings(
    "ignore:expectation–maximisation did not converge:sklearn.exceptions.ConvergenceWarning"
)


def samples_of(mixture, n, rng):
    weights, means, covariances = mixture
    labels = rng.choice(len(weights), size=n, p=weights)
    noise = rng.normal(size=(n, means.shape[1]))
    return means[labels] + np.einsum("nij,nj->ni", np.linalg.cholesky(covariances)[labels], noise)


def start_from(X, K, rng):
    """Return weights, means and precisions of a start that fits X loosely."""
    d = X.shape[1]
    covariance = np.cov(X.T).reshape(d, d)
    means = X[rng.choice(len(X), size=K, replace=False)]
    return np.full(K, 1.0 / K), means, np.tile(np.linalg.inv(covariance), (K, 1, 1))


def assert_same_parameters(one, other, rtol):
    scale = np.sqrt(np.diagonal(other.covariances_, axis1=1, axis2=2).max(axis=0))
    np.testing.assert_allclose(one.weights_, other.weights_, rtol=rtol, atol=rtol)
    np.testing.assert_allclose(one.means_ / scale, other.means_ / scale, rtol=rtol, atol=rtol)
    np.testing.assert_allclose(
        one.covariances_ / np.outer(scale, scale),
        other.covariances_ / np.outer(scale, scale),
        rtol=rtol,
        atol=rtol,
    )


def fit_both(X, K, iterations, rng):
    """Fit ours and scikit-learn's from one start for the same number of iterations."""
    weights, means, precisions = start_from(X, K, rng)
    start = {"weights_init": weights, "means_init": means, "precisions_init": precisions}
    ours = GaussianMixture(K, tol=0.0, max_iter=iterations, covariance_floor=0.0, **start).fit(X)
    theirs = sklearn.mixture.GaussianMixture(
        K, tol=0.0, max_iter=iterations, reg_covar=0.0, **start
    )
    with threadpool_limits(1):
        theirs.fit(X)
    return ours, theirs


@pytest.mark.filterwarnings(
    "ignore:.*pandas is not installed:sklearn.exceptions.SkipTestWarning",
    "ignore:.*SCIPY_ARRAY_API is not set:sklearn.exceptions.SkipTestWarning",
)
def test_is_a_scikit_learn_estimator():
    results = check_estimator(GaussianMixture(), on_fail="raise")
    assert sum(result["status"] == "passed" for result in results) > 30


# Against scikit-learn


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("K", [1, 2, 4])
@pytest.mark.parametrize("d", [1, 2, 3, 5])
def test_same_start_same_iterations_same_likelihood_as_scikit_learn(random_mixture, d, K):
    rng = np.random.default_rng(10 * d + K)
    X = samples_of(random_mixture(rng, K, d), 600, rng) * np.logspace(-2, 2, d) + 5.0
    ours, theirs = fit_both(X, K, 25, rng)
    assert ours.n_iter_ == theirs.n_iter_ == 25
    assert ours.score(X) == pytest.approx(theirs.score(X), rel=1e-6, abs=1e-6)
    assert ours.lower_bound_ == pytest.approx(theirs.score(X), rel=1e-6, abs=1e-6)
    assert ours.bic(X) == pytest.approx(theirs.bic(X), rel=1e-6)
    assert ours.bics_[K] == pytest.approx(theirs.bic(X), rel=1e-6)
    assert_same_parameters(ours, theirs, 1e-6)
    np.testing.assert_allclose(ours.score_samples(X), theirs.score_samples(X), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(ours.predict_proba(X), theirs.predict_proba(X), atol=1e-6)
    np.testing.assert_array_equal(ours.predict(X), theirs.predict(X))


def test_finds_as_good_a_fit_as_scikit_learn_does(random_mixture):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        X = samples_of(random_mixture(rng, 3, 2, spread=4.0), 300, rng)
        ours = GaussianMixture(3, random_state=seed, tol=1e-8).fit(X)
        theirs = sklearn.mixture.GaussianMixture(
            3, n_init=3, max_iter=1000, random_state=seed, tol=1e-6
        )
        with threadpool_limits(1):
            theirs.fit(X)
        assert ours.score(X) >= theirs.score(X) - 1e-3


# Weights


@may_stop_early
@given(seed=SEEDS, d=st.integers(1, 3), K=st.integers(1, 3), n=st.integers(12, 60))
def test_a_weight_counts_as_repetition(random_mixture, seed, d, K, n):
    rng = np.random.default_rng(seed)
    X = samples_of(random_mixture(rng, 2, d), n, rng)
    weight = rng.integers(0, 5, size=n)
    weight[:6] = 1
    repeated = np.repeat(X, weight, axis=0)
    shuffled = rng.permutation(n)

    def fit(samples, sample_weight=None):
        mixture = GaussianMixture(K, random_state=seed, n_init=3, max_iter=100)
        return mixture.fit(samples, sample_weight=sample_weight)

    by_repetition = fit(rng.permutation(repeated))
    for by_weight in (fit(X, weight), fit(X[shuffled], weight[shuffled]), fit(X, 4.0 * weight)):
        assert_same_parameters(by_weight, by_repetition, 1e-9)
        assert by_weight.lower_bound_ == pytest.approx(by_repetition.lower_bound_, rel=1e-9)
        assert by_weight.n_iter_ == by_repetition.n_iter_
    assert by_repetition.score(X, sample_weight=weight) == pytest.approx(
        by_repetition.score(repeated), rel=1e-12
    )


@may_stop_early
def test_weights_equal_repetition_from_a_given_start(random_mixture):
    rng = np.random.default_rng(3)
    X = samples_of(random_mixture(rng, 3, 2), 80, rng)
    weight = rng.integers(0, 4, size=80)
    weights, means, precisions = start_from(X, 3, rng)
    mixture = GaussianMixture(
        3, weights_init=weights, means_init=means, precisions_init=precisions, max_iter=30, tol=0.0
    )
    by_weight = mixture.fit(X, sample_weight=weight)
    parameters = by_weight.means_.copy(), by_weight.covariances_.copy()
    by_repetition = mixture.fit(np.repeat(X, weight, axis=0))
    np.testing.assert_allclose(parameters[0], by_repetition.means_, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(parameters[1], by_repetition.covariances_, rtol=1e-9, atol=1e-9)


def test_bic_with_weights_uses_kish_s_effective_size(random_mixture):
    rng = np.random.default_rng(5)
    X = samples_of(random_mixture(rng, 2, 2), 100, rng)
    weight = rng.random(100)
    mixture = GaussianMixture(2, random_state=0).fit(X, sample_weight=weight)
    size = weight.sum() ** 2 / (weight**2).sum()
    mean = np.average(mixture.score_samples(X), weights=weight)
    expected = -2 * size * mean + (2 * (1 + 2 + 3) - 1) * math.log(size)
    assert mixture.bic(X, sample_weight=weight) == pytest.approx(expected, rel=1e-12)
    assert mixture.bic(X, sample_weight=7 * weight) == pytest.approx(expected, rel=1e-12)
    assert mixture.bics_[2] == pytest.approx(expected, rel=1e-9)


# What a fitted mixture says


@given(seed=SEEDS, d=st.integers(1, 3), K=st.integers(1, 3))
def test_density_and_responsibilities_against_scipy(random_mixture, seed, d, K):
    rng = np.random.default_rng(seed)
    parameters = random_mixture(rng, K, d)
    mixture = GaussianMixture.from_parameters(*parameters)
    X = 3.0 * rng.normal(size=(20, d))
    joint = reference.log_joint(X, *parameters)
    np.testing.assert_allclose(mixture.score_samples(X), logsumexp(joint, axis=1), rtol=1e-9)
    p = mixture.predict_proba(X)
    np.testing.assert_allclose(p.sum(axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(
        p, np.exp(joint - logsumexp(joint, axis=1, keepdims=True)), atol=1e-9
    )


def test_density_is_exact_far_from_the_origin():
    # A narrow cloud a long way out: the deviations are exact, their whitened parts are not.
    deviation = np.array([[0.0, 0.0], [2.0, -1.0], [0.5, 3.0]])
    covariance = np.array([[[1.0, 0.9], [0.9, 1.0]]])
    near = GaussianMixture.from_parameters([1.0], [[0.0, 0.0]], covariance)
    far = GaussianMixture.from_parameters([1.0], [[2.0**40, -(2.0**40)]], covariance)
    np.testing.assert_allclose(
        far.score_samples(deviation + far.means_), near.score_samples(deviation), rtol=1e-12
    )


def test_samples_have_the_mixture_s_moments(random_mixture):
    rng = np.random.default_rng(0)
    weights, means, covariances = random_mixture(rng, 3, 2)
    mixture = GaussianMixture.from_parameters(weights, means, covariances)
    n = 200_000
    X, labels = mixture.sample(n, random_state=1)
    mean, variance = reference.moments(weights, means, covariances)
    error = np.sqrt(np.diag(variance) / n)
    assert np.all(np.abs(X.mean(axis=0) - mean) < 5 * error)
    np.testing.assert_allclose(np.cov(X.T), variance, atol=0.02 * np.trace(variance))
    share = np.bincount(labels, minlength=3) / n
    assert np.all(np.abs(share - weights) < 5 * np.sqrt(weights * (1 - weights) / n))
    for k in range(3):
        own = X[labels == k]
        assert np.all(
            np.abs(own.mean(axis=0) - means[k]) < 5 * np.sqrt(np.diag(covariances[k]) / len(own))
        )
    again, _ = mixture.sample(n, random_state=1)
    np.testing.assert_array_equal(again, X)


@given(seed=SEEDS, K=st.integers(1, 3), columns=st.sampled_from([(0,), (2, 0), (1, 2), (2, 1, 0)]))
def test_marginal_against_scipy(random_mixture, seed, K, columns):
    rng = np.random.default_rng(seed)
    weights, means, covariances = random_mixture(rng, K, 3)
    marginal = GaussianMixture.from_parameters(weights, means, covariances).marginal(columns)
    X = rng.normal(size=(5, len(columns)))
    block = np.array([c[np.ix_(columns, columns)] for c in covariances])
    expected = reference.log_joint(X, weights, means[:, columns], block)
    np.testing.assert_allclose(marginal.score_samples(X), logsumexp(expected, axis=1), rtol=1e-9)


@given(
    seed=SEEDS,
    n_std=st.floats(0.1, 5),
    columns=st.sampled_from([(0, 1), (1, 0), (2, 0), (1, 2)]),
)
def test_an_ellipse_lies_at_its_mahalanobis_distance(random_mixture, seed, n_std, columns):
    rng = np.random.default_rng(seed)
    weights, means, covariances = random_mixture(rng, 3, 3)
    mixture = GaussianMixture.from_parameters(weights, means, covariances)
    turn = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    for k, ellipse in enumerate(mixture.to_ellipse(n_std, columns)):
        c, s = np.cos(np.radians(ellipse.angle)), np.sin(np.radians(ellipse.angle))
        along = 0.5 * ellipse.width * np.cos(turn), 0.5 * ellipse.height * np.sin(turn)
        points = np.stack([c * along[0] - s * along[1], s * along[0] + c * along[1]], axis=1)
        np.testing.assert_allclose(ellipse.centre, means[k, columns], rtol=1e-12)
        block = covariances[k][np.ix_(columns, columns)]
        squared = np.einsum("ni,ij,nj->n", points, np.linalg.inv(block), points)
        np.testing.assert_allclose(np.sqrt(squared), n_std, rtol=1e-8)


# Choosing K


@pytest.mark.parametrize("d", [1, 2, 4])
@pytest.mark.parametrize("K", [1, 2, 3])
def test_bic_finds_the_number_of_clear_clusters(d, K):
    rng = np.random.default_rng(d + 10 * K)
    X = np.concatenate([rng.normal(10.0 * k, 1.0, size=(150, d)) for k in range(K)])
    mixture = GaussianMixture(random_state=0, max_components=5).fit(X)
    assert mixture.n_components_ == K
    assert set(mixture.bics_) == {1, 2, 3, 4, 5}
    assert min(mixture.bics_, key=mixture.bics_.get) == K
    assert mixture.bics_[K] == pytest.approx(mixture.bic(X), rel=1e-9)
    np.testing.assert_allclose(np.sort(mixture.means_[:, 0]), 10.0 * np.arange(K), atol=0.5)


def test_a_scan_gives_each_component_d_plus_one_samples():
    X = np.random.default_rng(0).normal(size=(11, 2))
    assert set(GaussianMixture(random_state=0).fit(X).bics_) == {1, 2, 3}


@given(seed=SEEDS, exponents=st.tuples(st.integers(-6, 6), st.integers(-6, 6)))
def test_units_do_not_matter(random_mixture, seed, exponents):
    rng = np.random.default_rng(seed)
    X = samples_of(random_mixture(rng, 2, 2), 60, rng)
    scale = 10.0 ** np.array(exponents)
    # One start: of several that end alike, rounding would choose.
    plain = GaussianMixture(2, n_init=1, random_state=0).fit(X)
    scaled = GaussianMixture(2, n_init=1, random_state=0).fit(X * scale + 100.0 * scale)
    np.testing.assert_allclose(scaled.means_, (plain.means_ + 100.0) * scale, rtol=1e-6)
    np.testing.assert_allclose(
        scaled.covariances_ / np.outer(scale, scale), plain.covariances_, rtol=1e-5, atol=1e-6
    )
    assert scaled.lower_bound_ == pytest.approx(
        plain.lower_bound_ - np.log(scale).sum(), rel=1e-6, abs=1e-6
    )


def test_same_seed_same_fit(random_mixture):
    rng = np.random.default_rng(0)
    X = samples_of(random_mixture(rng, 3, 2), 200, rng)
    one = GaussianMixture(random_state=np.random.default_rng(4)).fit(X)
    two = GaussianMixture(random_state=4).fit(X[rng.permutation(200)])
    np.testing.assert_array_equal(one.means_, two.means_)
    np.testing.assert_array_equal(one.covariances_, two.covariances_)
    assert one.bics_ == two.bics_


# Bad input


CLOUD = np.random.default_rng(0).normal(size=(20, 2))


def with_value(value):
    X = CLOUD.copy()
    X[3, 1] = value
    return X


@pytest.mark.parametrize(
    ("X", "message"),
    [
        (with_value(np.nan), "contains NaN"),
        (with_value(np.inf), "contains infinity"),
        (CLOUD[:1], "1 sample"),
        (np.empty((0, 2)), "0 sample"),
        (np.empty((20, 0)), "0 feature"),
        (CLOUD[:, 0], "Expected 2D array"),
        (CLOUD[None], "dim 3"),
    ],
)
def test_scikit_learn_s_own_refusals(X, message):
    with pytest.raises(ValueError, match=message):
        GaussianMixture().fit(X)


@pytest.mark.parametrize(
    ("settings", "X", "weight", "message"),
    [
        ({}, CLOUD * [1.0, 0.0] + 3.0, None, r"column 1 of X is constant \(3\)"),
        ({}, CLOUD * [1e-17, 1.0] + 1.0, None, "column 0 of X is constant"),
        ({}, np.ones((20, 2)), None, "constant"),
        ({"n_components": 21}, CLOUD, None, "n_components=21 but there are only 20"),
        ({"n_components": 3}, CLOUD, np.repeat([1, 0], [2, 18]), "there are only 2"),
        ({}, CLOUD, -np.ones(20), "nowhere negative"),
        ({}, CLOUD, np.full(20, np.nan), "finite"),
        ({}, CLOUD, np.zeros(20), "nothing is left to fit"),
        ({}, CLOUD, np.ones(19), r"has shape \(19,\), but 20 samples take \(20,\)"),
        ({}, CLOUD, np.ones((20, 1)), "sample_weight has shape"),
        ({"n_components": 0}, CLOUD, None, "n_components must be a whole number ≥ 1, got 0"),
        ({"n_components": 2.0}, CLOUD, None, "n_components must be a whole number"),
        ({"n_init": None}, CLOUD, None, "n_init must be a whole number ≥ 1, got None"),
        ({"max_components": None}, CLOUD, None, "max_components must be a whole number"),
        ({}, CLOUD * [1.0, 1e200], None, "column 1 of X ranges so far that its variance leaves"),
        ({"n_init": 0}, CLOUD, None, "n_init must be a whole number ≥ 1"),
        ({"max_iter": -1}, CLOUD, None, "max_iter must be a whole number ≥ 0"),
        ({"tol": -1.0}, CLOUD, None, "tol must be ≥ 0"),
        ({"tol": "small"}, CLOUD, None, "tol must be ≥ 0"),
        ({"covariance_floor": math.nan}, CLOUD, None, "covariance_floor must be ≥ 0"),
        ({"reg_covar": -1.0}, CLOUD, None, "reg_covar must be ≥ 0"),
        ({"covariance_type": "diag"}, CLOUD, None, "it is 'full', because conditioning"),
        ({"init_params": "best"}, CLOUD, None, "there are: k-means"),
        ({"verbose": 2}, CLOUD, None, "verbose cannot be set: the compiled loops"),
        ({"random_state": "x"}, CLOUD, None, "random_state is 'x': it is a whole number"),
        ({"random_state": 1.5}, CLOUD, None, "random_state is 1.5: it is a whole number"),
        ({"random_state": -1}, CLOUD, None, "random_state is -1: it is a whole number"),
        ({"means_init": "here"}, CLOUD, None, "means_init has to be an array of numbers"),
        ({"n_components": 2, "means_init": [[0.0, 1.0, 2.0]] * 2}, CLOUD, None, r"take \(2, 2\)"),
    ],
)
def test_one_line_of_refusal(refused, settings, X, weight, message):
    with refused(message):
        GaussianMixture(**settings).fit(X, sample_weight=weight)


@pytest.mark.parametrize("K", [1, 2])
def test_collinear_samples_need_a_floor(refused, K):
    x = np.random.default_rng(0).normal(size=50)
    X = np.stack([x, 2.0 * x], axis=1)
    with refused(f"{K}-component fit collapsed.*covariance_floor > 0 prevents it"):
        GaussianMixture(K, covariance_floor=0.0, random_state=0).fit(X)
    mixture = GaussianMixture(K, random_state=0).fit(X)
    assert np.all(np.linalg.eigvalsh(mixture.covariances_) > 0)


GOOD_START = {
    "n_components": 2,
    "weights_init": [0.5, 0.5],
    "means_init": [[0.0, 0.0], [1.0, 1.0]],
    "precisions_init": [np.eye(2), np.eye(2)],
}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"means_init": [[0.0, 0.0]]}, r"2 columns take \(2, 2\)"),
        ({"weights_init": [0.5, -0.5]}, "weights_init"),
        ({"weights_init": [0.5, math.nan]}, "weights_init"),
        ({"means_init": [[0.0, math.inf], [1.0, 1.0]]}, "means_init"),
        ({"precisions_init": [np.eye(2), np.zeros((2, 2))]}, "precisions_init"),
        ({"precisions_init": [np.eye(2), -np.eye(2)]}, "precisions_init"),
        ({"precisions_init": [np.eye(2), [[1.0, 0.5], [0.0, 1.0]]]}, "precisions_init"),
    ],
)
def test_a_start_is_checked(refused, change, message):
    assert GaussianMixture(**GOOD_START).fit(CLOUD).converged_
    with refused(message):
        GaussianMixture(**{**GOOD_START, **change}).fit(CLOUD)


@pytest.mark.parametrize(
    ("weights", "means", "covariances", "message"),
    [
        ([1.0], [0.0], [[1.0]], "a mixture takes"),
        ([0.5, 0.5], [[0.0]], [[[1.0]]], "a mixture takes"),
        ([0.0], [[0.0]], [[[1.0]]], "positive"),
        ([math.nan], [[0.0]], [[[1.0]]], "positive"),
        ([1.0], [[math.nan]], [[[1.0]]], "means"),
        ([1.0], [[0.0]], [[[0.0]]], "definite"),
        ([1.0], [[0.0]], [[[math.inf]]], "definite"),
        ([1.0], [[0.0, 0.0]], [[[1.0, 0.5], [-0.5, 1.0]]], "symmetric"),
        ([1.0], [[0.0, 0.0]], [[[1.0, 2.0], [2.0, 1.0]]], "definite"),
        ([], np.empty((0, 2)), np.empty((0, 2, 2)), "a mixture takes"),
    ],
)
def test_parameters_are_checked(refused, weights, means, covariances, message):
    with refused(message):
        GaussianMixture.from_parameters(weights, means, covariances)


def test_queries_are_checked(refused):
    mixture = GaussianMixture(2, random_state=0).fit(CLOUD)
    for columns in ([], [0, 0], [2], [-1]):
        with refused("columns are given as a list of distinct whole numbers from 0 to 1"):
            mixture.marginal(columns)
    with refused("n_samples must be at least 1"):
        mixture.sample(0)
    for query in (lambda m: m.sample(), lambda m: m.marginal([0]), lambda m: m.condition([0], [0])):
        with pytest.raises(NotFittedError):
            query(GaussianMixture())


def test_says_when_it_did_not_converge(random_mixture):
    rng = np.random.default_rng(0)
    X = samples_of(random_mixture(rng, 3, 2), 300, rng)
    with pytest.warns(match="did not converge in max_iter=2"):
        mixture = GaussianMixture(3, max_iter=2, random_state=0).fit(X)
    assert not mixture.converged_
    assert mixture.n_iter_ == 2


# The names of scikit-learn's own mixture


def two_blobs(n=120, seed=0):
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.normal(-3.0, 1.0, (n, 2)), rng.normal(3.0, 0.5, (n, 2))])


@pytest.mark.parametrize("start", ["k-means++", "kmeans", "random_from_data", "random"])
def test_every_kind_of_start_finds_what_is_there(start):
    fitted = GaussianMixture(2, init_params=start, random_state=0, max_iter=5000).fit(two_blobs())
    order = np.argsort(fitted.means_[:, 0])
    np.testing.assert_allclose(fitted.means_[order], [[-3.0, -3.0], [3.0, 3.0]], atol=0.3)
    np.testing.assert_allclose(fitted.weights_, 0.5, atol=0.01)


@pytest.mark.parametrize(
    "random_state",
    [3, np.int64(3), np.random.RandomState(3), np.random.default_rng(3), None],
)
def test_every_kind_of_random_state_is_taken(random_state):
    fitted = GaussianMixture(random_state=random_state).fit(two_blobs())
    assert fitted.n_components_ == 2
    X, _ = fitted.sample(5, random_state)
    assert X.shape == (5, 2)


def test_a_random_state_of_numpys_old_kind_gives_the_same_twice():
    one, other = (
        GaussianMixture(3, random_state=np.random.RandomState(7)).fit(two_blobs()) for _ in range(2)
    )
    np.testing.assert_array_equal(one.means_, other.means_)


def test_fit_predict_and_criteria():
    X = two_blobs()
    labels = GaussianMixture(2, random_state=0).fit_predict(X)
    fitted = GaussianMixture(2, random_state=0).fit(X)
    np.testing.assert_array_equal(labels, fitted.predict(X))
    assert len(set(labels[:120])) == len(set(labels[120:])) == 1
    log_likelihood = fitted.score_samples(X).sum()
    n_free = 2 * 2 + 2 * 3 + 1
    assert fitted.aic(X) == pytest.approx(2 * n_free - 2 * log_likelihood)
    assert fitted.bic(X) == pytest.approx(n_free * math.log(len(X)) - 2 * log_likelihood)


def test_precisions_are_the_inverses():
    fitted = GaussianMixture(3, random_state=0).fit(two_blobs())
    products = fitted.precisions_ @ fitted.covariances_
    np.testing.assert_allclose(products, np.tile(np.eye(2), (3, 1, 1)), atol=1e-9)
    upper = fitted.precisions_cholesky_
    np.testing.assert_array_equal(upper, np.triu(upper))
    np.testing.assert_allclose(upper @ upper.transpose(0, 2, 1), fitted.precisions_, rtol=1e-12)


def test_a_start_may_be_given_in_part():
    X = two_blobs()
    begun = {"max_iter": 0, "n_init": 1, "random_state": 0}
    with pytest.warns(ConvergenceWarning):
        whole = GaussianMixture(2, **begun).fit(X)
    parts = {
        "weights_init": [0.25, 0.75],
        "means_init": [[-2.0, -1.0], [1.0, 2.0]],
        "precisions_init": [np.eye(2), 2.0 * np.eye(2)],
    }
    for name, value in parts.items():
        with pytest.warns(ConvergenceWarning):
            made = GaussianMixture(**begun, **{name: value}).fit(X)
        assert made.n_components_ == 2  # as the part says
        for part, own in (
            ("weights_init", "weights_"),
            ("means_init", "means_"),
            ("precisions_init", "precisions_"),
        ):
            expected = value if part == name else getattr(whole, own)
            np.testing.assert_allclose(getattr(made, own), expected, rtol=1e-9, atol=1e-12)


def test_a_second_fit_may_begin_where_the_first_ended():
    X = two_blobs()
    warm = GaussianMixture(3, warm_start=True, tol=1e-9, random_state=0)
    first = warm.fit(X).n_iter_
    assert warm.fit(X).n_iter_ < first
    start = GaussianMixture(3, tol=1e-9, random_state=0).fit(X)
    again = GaussianMixture(3, tol=1e-9, random_state=0, start=start).fit(X)
    np.testing.assert_allclose(warm.means_, again.means_, rtol=1e-9)


def test_a_floor_may_be_in_the_data_s_own_unit():
    X = two_blobs() * [1.0, 1000.0]
    plain = GaussianMixture(1, covariance_floor=0.0).fit(X)
    raised = GaussianMixture(1, reg_covar=4.0).fit(X)
    np.testing.assert_allclose(
        raised.covariances_ - plain.covariances_, [4.0 * np.eye(2)], atol=1e-6
    )


def test_a_scan_says_whether_it_ended_at_its_largest():
    X = two_blobs()
    assert not GaussianMixture(random_state=0).fit(X).scan_ended_at_largest_
    assert GaussianMixture(max_components=2, random_state=0).fit(X).scan_ended_at_largest_
    assert not GaussianMixture(2, random_state=0).fit(X).scan_ended_at_largest_


def test_a_weight_counts_as_so_many_samples_for_a_given_number_of_components_alone():
    rng = np.random.default_rng(0)
    X = np.concatenate([rng.normal(-1.2, 1.0, (60, 1)), rng.normal(1.2, 1.0, (60, 1))])
    repeated = np.repeat(X, 4, axis=0)
    weight = np.full(len(X), 4.0)
    for K in (1, 2, 3):
        one = GaussianMixture(K, random_state=0).fit(X, sample_weight=weight)
        other = GaussianMixture(K, random_state=0).fit(repeated)
        np.testing.assert_allclose(one.means_, other.means_, rtol=1e-6)
    # The same spread over fewer samples is said with less certainty: by Kish's size, a quarter.
    scanned = GaussianMixture(random_state=0).fit(X, sample_weight=weight)
    assert scanned.bics_ == GaussianMixture(random_state=0).fit(X).bics_
    assert GaussianMixture(random_state=0).fit(repeated).n_components_ > scanned.n_components_
