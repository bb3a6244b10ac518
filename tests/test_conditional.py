import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import logsumexp

from misstep.mixture import Conditional, Conditioner, GaussianMixture, compiled, reference

SEEDS = st.integers(0, 2**32 - 1)


def density(conditional, a):
    """Return the density of the conditional mixture at actions (N, d)."""
    return np.exp(logsumexp(reference.log_joint(a, *conditional), axis=1))


@given(seed=SEEDS, K=st.integers(1, 4), n=st.integers(1, 3), d=st.integers(1, 2))
def test_against_the_reference(random_mixture, seed, K, n, d):
    rng = np.random.default_rng(seed)
    parameters = random_mixture(rng, K, n + d)
    mixture = GaussianMixture.from_parameters(*parameters)
    state = 3.0 * rng.normal(size=n)
    conditional = mixture.condition(range(n), state)
    expected = reference.condition(state, *parameters)
    for ours, theirs in zip(conditional, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-8, atol=1e-8)
    mean, variance = reference.moments(*expected)
    np.testing.assert_allclose(conditional.mean, mean, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(conditional.variance, variance, rtol=1e-7, atol=1e-7)


@given(seed=SEEDS, K=st.integers(1, 3), order=st.permutations([0, 1, 2]))
def test_against_quadrature_of_the_joint_density(random_mixture, seed, K, order):
    rng = np.random.default_rng(seed)
    mixture = GaussianMixture.from_parameters(*random_mixture(rng, K, 3))
    *known, other = order
    values = rng.normal(size=2)
    conditional = mixture.condition(known, values)

    # For Gaussians no narrower than 0.3 the trapezoidal rule at steps of 0.1 is exact to rounding.
    a, step = np.linspace(-100.0, 100.0, 2001, retstep=True)
    x = np.empty((len(a), 3))
    x[:, known], x[:, other] = values, a
    p = np.exp(mixture.score_samples(x))
    p /= p.sum() * step
    np.testing.assert_allclose(density(conditional, a[:, None]), p, rtol=1e-6, atol=1e-12)
    mean = step * p @ a
    assert conditional.mean[0] == pytest.approx(mean, rel=1e-9, abs=1e-9)
    variance = step * p @ (a - mean) ** 2
    assert conditional.variance[0, 0] == pytest.approx(variance, rel=1e-9)


@given(seed=SEEDS, K=st.integers(1, 4))
def test_several_columns_in_any_order(random_mixture, seed, K):
    rng = np.random.default_rng(seed)
    mixture = GaussianMixture.from_parameters(*random_mixture(rng, K, 4))
    x = rng.normal(size=4)
    one, two = mixture.condition([3, 1], x[[3, 1]]), mixture.condition([1, 3], x[[1, 3]])
    for ours, theirs in zip(one, two, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)
    # p(a, b) = p(b) p(a | b), whichever columns a and b are.
    joint = mixture.score_samples(x[None])[0]
    for known, others in (([3, 1], [0, 2]), ([0], [1, 2, 3]), ([2, 3, 0], [1])):
        marginal = mixture.marginal(known).score_samples(x[None, known])[0]
        conditional = density(mixture.condition(known, x[known]), x[None, others])[0]
        assert marginal + np.log(conditional) == pytest.approx(joint, rel=1e-8, abs=1e-8)


@given(
    seed=SEEDS,
    K=st.integers(1, 4),
    n=st.integers(1, 3),
    exponent=st.floats(2, 100),
)
def test_far_states_stay_finite(random_mixture, seed, K, n, exponent):
    rng = np.random.default_rng(seed)
    mixture = GaussianMixture.from_parameters(*random_mixture(rng, K, n + 1))
    state = 10.0**exponent * rng.normal(size=n)
    weights, means, covariances = mixture.condition(range(n), state)
    assert np.all(weights >= 0)
    assert weights.sum() == pytest.approx(1.0, rel=1e-12)
    assert np.all(np.isfinite(means))
    assert np.all(np.linalg.eigvalsh(covariances) > 0)


def test_far_from_the_data_the_widest_component_speaks():
    mixture = GaussianMixture.from_parameters(
        [0.5, 0.5], [[0.0, 1.0], [0.0, -1.0]], [np.diag([1.0, 1.0]), np.diag([4.0, 1.0])]
    )
    near, far = mixture.condition([0], [0.0]), mixture.condition([0], [1e6])
    np.testing.assert_allclose(near.weights, [2 / 3, 1 / 3], rtol=1e-12)
    np.testing.assert_allclose(far.weights, [0.0, 1.0], atol=1e-300)
    np.testing.assert_allclose(far.mean, [-1.0], rtol=1e-12)
    np.testing.assert_allclose(far.variance, [[1.0]], rtol=1e-12)


def test_moments_against_samples(random_mixture):
    rng = np.random.default_rng(2)
    mixture = GaussianMixture.from_parameters(*random_mixture(rng, 3, 3))
    conditional = mixture.condition([1], [0.3])
    n = 200_000
    actions, _ = GaussianMixture.from_parameters(*conditional).sample(n, random_state=0)
    error = np.sqrt(np.diag(conditional.variance) / n)
    assert np.all(np.abs(actions.mean(axis=0) - conditional.mean) < 5 * error)
    tolerance = 0.02 * np.trace(conditional.variance)
    np.testing.assert_allclose(np.cov(actions.T), conditional.variance, atol=tolerance)


def test_variance_keeps_its_digits_far_from_zero():
    # Components 1 apart around 10⁹: E[a²] − E[a]² would leave nothing of the variance.
    mixture = GaussianMixture.from_parameters(
        [0.5, 0.5], [[0.0, 1e9 - 1], [0.0, 1e9 + 1]], [np.eye(2), np.eye(2)]
    )
    assert mixture.condition([0], [0.0]).variance[0, 0] == pytest.approx(2.0, rel=1e-12)


@given(seed=SEEDS, K=st.integers(1, 4), d=st.integers(1, 3))
def test_scaled_variance_is_the_mean_of_the_scaled_diagonal(random_mixture, seed, K, d):
    rng = np.random.default_rng(seed)
    mixture = GaussianMixture.from_parameters(*random_mixture(rng, K, 1 + d))
    scale = rng.uniform(0.1, 10.0, size=d)
    conditional = mixture.condition([0], rng.normal(size=1))
    expected = np.mean(np.diag(conditional.variance) / scale**2)
    spread = compiled.scaled_variance(*conditional, scale)
    assert spread == pytest.approx(expected, rel=1e-10)


@given(seed=SEEDS, exponents=st.tuples(*[st.integers(-6, 6)] * 3))
def test_units_do_not_matter(random_mixture, seed, exponents):
    rng = np.random.default_rng(seed)
    weights, means, covariances = random_mixture(rng, 3, 3)
    scale = 10.0 ** np.array(exponents)
    state = rng.normal(size=2)
    plain = GaussianMixture.from_parameters(weights, means, covariances).condition([0, 1], state)
    scaled = GaussianMixture.from_parameters(
        weights, means * scale, covariances * np.outer(scale, scale)
    ).condition([0, 1], state * scale[:2])
    np.testing.assert_allclose(scaled.weights, plain.weights, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(
        scaled.means, plain.means * scale[2], rtol=1e-6, atol=1e-9 * scale[2]
    )
    np.testing.assert_allclose(scaled.covariances, plain.covariances * scale[2] ** 2, rtol=1e-6)


@pytest.mark.parametrize(
    "given_columns", [[], [0, 0], [3], [-1], [0, 7], [1.7], 1, ["0"], None, [[0]]]
)
def test_refuses_columns_that_are_not_of_the_mixture(refused, given_columns):
    mixture = GaussianMixture.from_parameters([1.0], np.zeros((1, 3)), [np.eye(3)])
    line = "columns are given as a list of distinct whole numbers from 0 to 2"
    with refused(line):
        Conditioner(mixture, given_columns)
    with refused(line):
        mixture.condition(given_columns, [0.0])


def test_refuses_to_condition_on_all_columns(refused):
    mixture = GaussianMixture.from_parameters([1.0], np.zeros((1, 3)), [np.eye(3)])
    with refused("condition on some, not all, of the columns 0 to 2"):
        Conditioner(mixture, [0, 1, 2])
    assert Conditioner(mixture, np.array([2, 0])).at([0.0, 0.0]).means.shape == (1, 1)


@pytest.mark.parametrize(
    "state", [[0.0], [0.0, 1.0, 2.0], 0.0, [[0.0, 1.0]], [0.0, np.nan], [0.0, np.inf]]
)
def test_refuses_a_state_of_another_kind(refused, state):
    mixture = GaussianMixture.from_parameters([1.0], np.zeros((1, 3)), [np.eye(3)])
    with refused("a state here is 2 finite numbers, got"):
        mixture.condition([0, 1], state)


@given(seed=SEEDS, K=st.integers(1, 4), n=st.integers(1, 3), d=st.integers(1, 2))
def test_many_states_are_one_after_the_other(random_mixture, seed, K, n, d):
    rng = np.random.default_rng(seed)
    mixture = GaussianMixture.from_parameters(*random_mixture(rng, K, n + d))
    conditioner = Conditioner(mixture, range(n))
    states = 3.0 * rng.normal(size=(6, n))
    h, m = conditioner.at_each(states)
    for i, state in enumerate(states):
        one = conditioner.at(state)
        np.testing.assert_array_equal(h[i], one.weights)
        np.testing.assert_array_equal(m[i], one.means)


def test_many_states_are_checked(refused):
    mixture = GaussianMixture.from_parameters([1.0], [[0.0, 0.0]], [np.eye(2)])
    for states in ([0.0], [[0.0, 0.0]], [[np.nan]]):
        with refused(r"points are finite and have shape \(N, 1\)"):
            Conditioner(mixture, [0]).at_each(states)


def test_a_variance_beyond_the_range_of_numbers_is_infinite():
    means = np.array([[1.7e308], [-1.7e308]])
    far = Conditional(np.array([0.9, 0.1]), means, np.ones((2, 1, 1)))
    assert far.variance.tolist() == [[np.inf]]
