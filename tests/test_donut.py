import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import minimize_scalar
from scipy.stats import multivariate_normal

from misstep.mixture import Donut, DonutShape, compiled, reference

SEEDS = st.integers(0, 2**32 - 1)
DIMENSIONS = st.integers(1, 3)
EXPLORATIONS = st.floats(0.0, 1.0)
KS = st.floats(1.2, 4.0)
REACHES = st.floats(1.0, 4.0)


def gaussian(seed, d):
    """Draw a mean (d,) and a covariance (d, d)."""
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(d, d))
    return rng.normal(size=d), factor @ factor.T + 0.2 * np.eye(d)


def grid(donut):
    """Return points (N, d) and their common volume, fine enough for the trapezoidal rule."""
    # The sum over a grid of a Gaussian is exact to rounding at steps of 0.8 of its deviation.
    d = donut.mean.size
    steps = np.arange(
        -8.0 / donut.shape.r_alpha, 8.0 / donut.shape.r_alpha, 0.8 / donut.shape.r_beta
    )
    axes = np.meshgrid(*[steps] * d, indexing="ij")
    lower = np.linalg.cholesky(donut.base_covariance)
    points = np.stack([axis.ravel() for axis in axes], axis=1) @ lower.T + donut.mean
    return points, (steps[1] - steps[0]) ** d * np.prod(np.diag(lower))


def rays(donut, seed, n=5):
    """Return steps (n, d) of Mahalanobis length 1 in random directions."""
    directions = np.random.default_rng(seed).normal(size=(n, donut.mean.size))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions @ np.linalg.cholesky(donut.base_covariance).T


# Fact 1: a density


@given(seed=SEEDS, d=DIMENSIONS, exploration=EXPLORATIONS, k=KS, reach=REACHES)
def test_integrates_to_one_over_shells(seed, d, exploration, k, reach):
    donut = Donut(*gaussian(seed, d), DonutShape.of(exploration, d, k, reach))
    ray = rays(donut, seed, n=1)
    area = 2 * math.pi ** (d / 2) / math.gamma(d / 2)
    volume = math.sqrt(np.linalg.det(donut.base_covariance))

    def shell(r):
        return area * volume * r ** (d - 1) * donut.pdf(donut.mean + r * ray)[0]

    far = 12.0 / donut.shape.r_alpha
    integral, _ = quad(shell, 0.0, far, points=[2.0 / donut.shape.r_beta], limit=200)
    assert integral == pytest.approx(1.0, rel=1e-7)


@given(seed=SEEDS, exploration=EXPLORATIONS, d=st.integers(1, 2), reach=REACHES)
def test_integral_and_covariance_over_a_grid(seed, exploration, d, reach):
    donut = Donut(*gaussian(seed, d), DonutShape.of(exploration, d, reach=reach))
    points, volume = grid(donut)
    p = volume * donut.pdf(points)
    deviations = points - donut.mean
    assert p.sum() == pytest.approx(1.0, rel=1e-9)
    np.testing.assert_allclose(p @ deviations, 0.0, atol=1e-9 * np.abs(deviations).max())
    np.testing.assert_allclose(
        (p * deviations.T) @ deviations, donut.covariance, rtol=1e-8, atol=1e-8
    )


@pytest.mark.parametrize("exploration", [0.0, 0.3, 1.0])
def test_integral_and_covariance_over_a_grid_in_space(exploration):
    donut = Donut(*gaussian(7, 3), DonutShape.of(exploration, 3))
    points, volume = grid(donut)
    p = volume * donut.pdf(points)
    deviations = points - donut.mean
    assert p.sum() == pytest.approx(1.0, rel=1e-9)
    np.testing.assert_allclose((p * deviations.T) @ deviations, donut.covariance, atol=1e-8)


@given(seed=SEEDS, d=DIMENSIONS, k=KS, r_alpha=st.floats(0.2, 3.0), share=st.floats(0.0, 1.0))
def test_is_nowhere_negative_exactly_up_to_the_largest_gamma(seed, d, k, r_alpha, share):
    most = 1.0 / (1.0 - k**-d)
    mean, covariance = gaussian(seed, d)
    donut = Donut(mean, covariance, DonutShape(1.0 + share * (most - 1.0), r_alpha, k * r_alpha))
    radii = np.concatenate([[0.0], np.logspace(-6, 2, 50)])[:, None]
    points = mean + radii * rays(donut, seed, n=1)
    assert np.all(donut.pdf(points) >= 0.0)
    direct = reference.donut_density(points, mean, covariance, *donut.shape)
    rounding = 1e-13 * donut.shape.gamma * multivariate_normal(mean, covariance).pdf(mean)
    assert np.all(direct >= -rounding * r_alpha**d)

    too_much = most * 1.001
    assert reference.donut_density(mean, mean, covariance, too_much, r_alpha, k * r_alpha) < 0.0
    with pytest.raises(ValueError, match="gamma must be from 1 to"):
        Donut(mean, covariance, DonutShape(too_much, r_alpha, k * r_alpha))


@given(seed=SEEDS, d=DIMENSIONS, exploration=EXPLORATIONS, k=KS, reach=REACHES)
def test_is_the_difference_of_two_gaussians(seed, d, exploration, k, reach):
    mean, covariance = gaussian(seed, d)
    donut = Donut(mean, covariance, DonutShape.of(exploration, d, k, reach))
    points = mean + 3.0 * np.random.default_rng(seed).normal(size=(20, d))
    expected = reference.donut_density(points, mean, covariance, *donut.shape)
    height = multivariate_normal(mean, covariance).pdf(mean) * donut.shape.gamma
    np.testing.assert_allclose(donut.pdf(points), expected, rtol=1e-9, atol=1e-13 * height * k**d)
    np.testing.assert_array_equal(np.exp(donut.log_pdf(points)), donut.pdf(points))


# Fact 2: the centre and the two ends of the family


@given(seed=SEEDS, d=DIMENSIONS, exploration=EXPLORATIONS, k=KS, reach=REACHES)
def test_the_centre_drops_to_one_minus_exploration(seed, d, exploration, k, reach):
    mean, covariance = gaussian(seed, d)
    shape = DonutShape.of(exploration, d, k, reach)
    assert shape.r_alpha == pytest.approx(1.0 / (1.0 + (reach - 1.0) * exploration))
    assert shape.r_beta == pytest.approx(k * shape.r_alpha)
    assert 1.0 <= shape.gamma <= (1.0 + 1e-12) / (1.0 - k**-d)
    at_mean = multivariate_normal(mean, covariance).pdf(mean) * shape.r_alpha**d
    centre = Donut(mean, covariance, shape).pdf([mean])[0]
    assert centre == pytest.approx((1.0 - exploration) * at_mean, rel=1e-9, abs=1e-13 * at_mean)


@given(seed=SEEDS, d=DIMENSIONS, k=KS, reach=REACHES)
def test_no_exploration_is_the_gaussian_to_the_last_bit(seed, d, k, reach):
    mean, covariance = gaussian(seed, d)
    donut = Donut(mean, covariance, DonutShape.of(0.0, d, k, reach))
    points = mean + 3.0 * np.random.default_rng(seed).normal(size=(20, d))
    whitener = np.empty((d, d))
    log_det = compiled.cholesky_whitener(covariance, whitener)
    for point, value in zip(points, donut.log_pdf(points), strict=True):
        y = whitener @ (point - mean)
        assert value == (log_det - 0.5 * d * compiled.LOG_2PI) - 0.5 * float(y @ y)
    expected = multivariate_normal(mean, covariance).logpdf(points)
    np.testing.assert_allclose(donut.log_pdf(points), expected, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(donut.covariance, covariance, rtol=1e-15)
    assert donut.ridge_radius == 0.0


def test_no_exploration_agrees_with_scipy_closely():
    points = np.linspace(-4.0, 6.0, 101)[:, None]
    donut = Donut([1.0], [[2.25]], DonutShape.of(0.0, 1))
    expected = multivariate_normal([1.0], [[2.25]]).pdf(points)
    np.testing.assert_allclose(donut.pdf(points), expected, rtol=1e-13)


@given(seed=SEEDS, d=DIMENSIONS, k=st.floats(1.001, 10.0), reach=REACHES)
def test_full_exploration_has_an_exact_zero_at_the_centre_and_nowhere_else(seed, d, k, reach):
    mean, covariance = gaussian(seed, d)
    donut = Donut(mean, covariance, DonutShape.of(1.0, d, k, reach))
    assert donut.pdf([mean])[0] == 0.0
    assert donut.log_pdf([mean])[0] == -math.inf
    np.testing.assert_array_equal(donut.gradient([mean]), np.zeros((1, d)))
    # At a small distance m from the centre D = γ r_αᵈ N(μ) (k² − 1) r_α² m²/2.
    near = mean + 1e-4 * rays(donut, seed)
    gamma, r_alpha, _ = donut.shape
    at_mean = multivariate_normal(mean, covariance).pdf(mean) * r_alpha**d
    expected = gamma * at_mean * 0.5 * (k * k - 1.0) * r_alpha**2 * 1e-8
    np.testing.assert_allclose(donut.pdf(near), expected, rtol=1e-5)


# Facts 3 and 4: the ridge


@given(seed=SEEDS, d=DIMENSIONS, exploration=EXPLORATIONS, k=KS, reach=REACHES)
def test_the_ridge(seed, d, exploration, k, reach):
    onset = (k**d - 1.0) / (k ** (d + 2) - 1.0)
    donut = Donut(*gaussian(seed, d), DonutShape.of(exploration, d, k, reach))
    radius = donut.ridge_radius
    if abs(exploration - onset) > 1e-9:
        assert (radius > 0.0) == (exploration > onset)
    gamma, r_alpha, r_beta = donut.shape
    if radius > 0.0:
        q = (gamma - 1.0) / gamma
        squared = 2.0 * math.log(q * k ** (d + 2)) / (r_beta**2 - r_alpha**2)
        assert radius**2 == pytest.approx(squared, rel=1e-6, abs=1e-9)
    # Brute force: along any ray the density has its one maximum there.
    far = 6.0 / r_alpha
    for ray in rays(donut, seed, n=2):
        radii = np.linspace(0.0, far, 601)
        p = donut.pdf(donut.mean + radii[:, None] * ray)
        top = np.argmax(p)
        assert abs(radii[top] - radius) <= 1.01 * (radii[1] - radii[0]) or p[top] < p[0] * (
            1 + 1e-6
        )
        rising = np.diff(p[: top + 1]) >= -1e-12 * p[top]
        falling = np.diff(p[top:]) <= 1e-12 * p[top]
        assert rising.all()
        assert falling.all()


@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("exploration", [0.4, 0.7, 1.0])
def test_the_ridge_against_an_optimiser(d, exploration):
    donut = Donut(*gaussian(d, d), DonutShape.of(exploration, d))
    for ray in rays(donut, 0):
        found = minimize_scalar(
            lambda r, ray=ray: -donut.log_pdf([donut.mean + r * ray])[0],
            bounds=(0.1, 8.0),
            method="bounded",
            options={"xatol": 1e-9},
        )
        assert found.x == pytest.approx(donut.ridge_radius, rel=1e-6)


@pytest.mark.parametrize(("d", "onset"), [(1, 0.143), (2, 0.200), (3, 0.226)])
def test_where_the_ridge_leaves_the_centre(d, onset):
    def radius(exploration):
        return Donut(np.zeros(d), np.eye(d), DonutShape.of(exploration, d, k=2.0)).ridge_radius

    assert radius(onset - 0.001) == 0.0
    assert radius(onset + 0.001) > 0.0


@given(d=DIMENSIONS, exploration=EXPLORATIONS, k=st.floats(1.0001, 20.0), reach=REACHES)
def test_reach_multiplies_a_ridge_that_never_lies_beyond_root_two(d, exploration, k, reach):
    near = Donut(np.zeros(d), np.eye(d), DonutShape.of(exploration, d, k, reach=1.0))
    far = Donut(np.zeros(d), np.eye(d), DonutShape.of(exploration, d, k, reach))
    assert near.ridge_radius <= math.sqrt(2.0) * (1.0 + 1e-6)
    widening = 1.0 + (reach - 1.0) * exploration
    assert far.ridge_radius == pytest.approx(near.ridge_radius * widening, rel=1e-5, abs=1e-5)


def test_the_ridge_at_k_2_lies_at_0_96_deviations():
    ridge = Donut([0.0], [[1.0]], DonutShape.of(1.0, 1, k=2.0, reach=1.0)).ridge_radius
    assert ridge == pytest.approx(0.96, abs=0.005)


# Fact 5: the gradient


@given(seed=SEEDS, d=DIMENSIONS, exploration=EXPLORATIONS, k=KS, reach=REACHES)
def test_gradient(seed, d, exploration, k, reach):
    mean, covariance = gaussian(seed, d)
    donut = Donut(mean, covariance, DonutShape.of(exploration, d, k, reach))
    points = mean + np.random.default_rng(seed).normal(size=(5, d))
    gradient = donut.gradient(points)
    gamma, r_alpha, r_beta = donut.shape
    precision = np.linalg.inv(covariance)
    for point, ours in zip(points, gradient, strict=True):
        wide = multivariate_normal(mean, covariance / r_alpha**2).pdf(point)
        narrow = multivariate_normal(mean, covariance / r_beta**2).pdf(point)
        closed = precision @ (point - mean)
        closed = closed * ((gamma - 1.0) * r_beta**2 * narrow - gamma * r_alpha**2 * wide)
        np.testing.assert_allclose(ours, closed, rtol=1e-7, atol=1e-10)
        step = 1e-5 * np.eye(d)
        differences = (donut.pdf(point + step) - donut.pdf(point - step)) / 2e-5
        np.testing.assert_allclose(ours, differences, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(donut.gradient([mean]), np.zeros((1, d)))


# Bad input


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((-0.1, 1), "exploration must be from 0 to 1, got -0.1"),
        ((1.1, 1), "exploration must be from 0 to 1"),
        ((math.nan, 1), "exploration must be from 0 to 1"),
        ((0.5, 0), "at least one dimension"),
        ((0.5, 1, 1.0), "k > 1"),
        ((0.5, 1, math.inf), "k > 1"),
        ((0.5, 1, math.nan), "k > 1"),
        ((0.5, 1, 2.0, 0.9), "reach ≥ 1"),
        ((0.5, 1, 2.0, math.inf), "reach ≥ 1"),
    ],
)
def test_a_shape_is_checked(refused, arguments, message):
    with refused(message):
        DonutShape.of(*arguments)


SHAPE = DonutShape.of(0.5, 2)


@pytest.mark.parametrize(
    ("mean", "covariance", "shape", "message"),
    [
        ([0.0], np.eye(2), SHAPE, r"got \(1,\) and \(2, 2\)"),
        (0.0, np.eye(1), SHAPE, "a mean"),
        ([[0.0, 0.0]], np.eye(2), SHAPE, "a mean"),
        ([0.0, math.nan], np.eye(2), SHAPE, "finite"),
        ([0.0, 0.0], np.zeros((2, 2)), SHAPE, "definite"),
        ([0.0, 0.0], [[1.0, 2.0], [2.0, 1.0]], SHAPE, "definite"),
        ([0.0, 0.0], [[1.0, 0.5], [-0.5, 1.0]], SHAPE, "symmetric"),
        ([0.0, 0.0], np.full((2, 2), math.nan), SHAPE, "definite"),
        ([0.0, 0.0], np.eye(2), DonutShape(1.0, 2.0, 1.0), "r_alpha < r_beta"),
        ([0.0, 0.0], np.eye(2), DonutShape(1.0, 0.0, 1.0), "0 < r_alpha"),
        ([0.0, 0.0], np.eye(2), DonutShape(0.9, 1.0, 2.0), "gamma must be from 1"),
        ([0.0, 0.0], np.eye(2), DonutShape(math.nan, 1.0, 2.0), "gamma must be from 1"),
    ],
)
def test_a_donut_is_checked(refused, mean, covariance, shape, message):
    with refused(message):
        Donut(mean, covariance, shape)


@pytest.mark.parametrize(
    "points", [[0.0, 0.0], [[0.0]], [[0.0, 0.0, 0.0]], 0.0, [[0.0, math.nan]], [[math.inf, 0.0]]]
)
def test_points_are_checked(refused, points):
    donut = Donut([0.0, 0.0], np.eye(2), SHAPE)
    for query in (donut.pdf, donut.log_pdf, donut.gradient):
        with refused(r"points are finite and have shape \(N, 2\), got"):
            query(points)
