import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from misstep.mixture import (
    Conditional,
    Donut,
    DonutMixture,
    DonutShape,
    compiled,
    exploration_from_variance,
    reference,
)

SEEDS = st.integers(0, 2**32 - 1)
EXPLORATIONS = st.floats(0.0, 1.0)


def one_dimensional(rng, K, spread):
    """Draw a mixture over one action; deviations from 0.1 to 1.5."""
    deviations = rng.uniform(0.1, 1.5, size=(K, 1, 1))
    return Conditional(
        rng.dirichlet(np.full(K, 3.0)), spread * rng.normal(size=(K, 1)), deviations**2
    )


def hill(exploration, d=1, reach=2.0):
    """Return a single donut over a standard Gaussian."""
    return DonutMixture(
        Conditional(np.ones(1), np.zeros((1, d)), np.eye(d)[None]), exploration, reach=reach
    )


def slope(mixture, a):
    """Return |∇ log DMM| at a, per largest standard deviation of a component."""
    log_gradient = mixture.gradient([a])[0] / mixture.pdf([a])[0]
    variances = np.linalg.eigvalsh(mixture.conditional.covariances)
    return np.linalg.norm(log_gradient) * math.sqrt(variances.max())


def curvature(mixture, a):
    """Return log DMM(a), its gradient, its Hessian, and the metric of the climb."""
    K, d = mixture.conditional.means.shape
    whiteners, precisions, _, log_norms = mixture._components
    gradient, metric, hessian = np.empty(d), np.empty((d, d)), np.empty((d, d))
    value = compiled.mixture_curvature(
        np.array(a),
        np.log(mixture.conditional.weights),
        mixture.conditional.means,
        whiteners,
        precisions,
        log_norms,
        mixture.shape,
        gradient,
        metric,
        hessian,
        compiled.scratch_for(K, d),
    )
    whole = [np.tril(half) + np.tril(half, -1).T for half in (hessian, metric)]
    return value, gradient, *whole


def climb_from(mixture, start):
    """Return where a climb ends, and how many densities it took."""
    a = np.array(start, dtype=float)
    whiteners, precisions, _, log_norms = mixture._components
    with np.errstate(divide="ignore"):
        log_h = np.log(mixture.conditional.weights)
    means = mixture.conditional.means
    room = compiled.scratch_for(*means.shape)
    _, count = compiled.ascend(
        a, log_h, means, whiteners, precisions, log_norms, mixture.shape, room
    )
    return a, count


# The density


@given(
    seed=SEEDS,
    d=st.integers(1, 3),
    K=st.integers(1, 4),
    exploration=EXPLORATIONS,
    k=st.floats(1.2, 4.0),
    reach=st.floats(1.0, 4.0),
)
def test_density_and_gradient(random_mixture, seed, d, K, exploration, k, reach):
    rng = np.random.default_rng(seed)
    conditional = Conditional(*random_mixture(rng, K, d))
    mixture = DonutMixture(conditional, exploration, k, reach)
    points = 3.0 * rng.normal(size=(6, d))
    expected = reference.donut_mixture_density(points, *conditional, *mixture.shape)
    np.testing.assert_allclose(mixture.pdf(points), expected, rtol=1e-8, atol=1e-12)
    np.testing.assert_array_equal(np.exp(mixture.log_pdf(points)), mixture.pdf(points))
    donuts = [Donut(m, S, mixture.shape) for m, S in zip(*conditional[1:], strict=True)]
    gradients = sum(
        h * donut.gradient(points) for h, donut in zip(conditional.weights, donuts, strict=True)
    )
    np.testing.assert_allclose(mixture.gradient(points), gradients, rtol=1e-7, atol=1e-12)
    step = 1e-5 * np.eye(d)
    for point, ours in zip(points, mixture.gradient(points), strict=True):
        differences = (mixture.pdf(point + step) - mixture.pdf(point - step)) / 2e-5
        np.testing.assert_allclose(ours, differences, rtol=1e-5, atol=1e-6)


@given(seed=SEEDS, d=st.integers(1, 2), exploration=EXPLORATIONS)
def test_integrates_to_one(random_mixture, seed, d, exploration):
    rng = np.random.default_rng(seed)
    weights, means, _ = random_mixture(rng, 2, d, spread=1.0)
    deviations = rng.uniform(0.5, 1.0, size=(2, d))
    conditional = Conditional(weights, means, np.array([np.diag(s**2) for s in deviations]))
    mixture = DonutMixture(conditional, exploration)
    # The narrowest Gaussian has a deviation of 0.25; the trapezoidal rule is exact to rounding
    # at 0.8 of that. The widest has 2.
    steps, step = np.linspace(-16.0, 16.0, 161, retstep=True)
    axes = np.meshgrid(*[steps] * d, indexing="ij")
    points = np.stack([axis.ravel() for axis in axes], axis=1)
    assert mixture.pdf(points).sum() * step**d == pytest.approx(1.0, rel=1e-7)


@given(seed=SEEDS, d=st.integers(1, 3), K=st.integers(1, 3))
def test_no_exploration_is_the_conditional_mixture(random_mixture, seed, d, K):
    rng = np.random.default_rng(seed)
    conditional = Conditional(*random_mixture(rng, K, d))
    points = 3.0 * rng.normal(size=(6, d))
    expected = np.exp(reference.log_joint(points, *conditional)).sum(axis=1)
    np.testing.assert_allclose(DonutMixture(conditional, 0.0).pdf(points), expected, rtol=1e-9)


def test_zero_density_has_no_slope():
    mixture = hill(1.0, d=2)
    assert mixture.log_pdf([[0.0, 0.0]])[0] == -math.inf
    np.testing.assert_array_equal(mixture.gradient([[0.0, 0.0]]), [[0.0, 0.0]])


def test_two_threads_may_ask_one_mixture(random_mixture):
    # The compiled loops let go of the interpreter, so two of them really run side by side.
    rng = np.random.default_rng(0)
    mixture = DonutMixture(Conditional(*random_mixture(rng, 6, 2)), 0.7)
    points = 3.0 * rng.normal(size=(4000, 2))
    alone = mixture.log_pdf(points), mixture.gradient(points), mixture.mode([1.0, 1.0])

    def differing(_):
        answers = mixture.log_pdf(points), mixture.gradient(points), mixture.mode([1.0, 1.0])
        return sum(np.sum(a != b) for a, b in zip(answers, alone, strict=True))

    with ThreadPoolExecutor(2) as pool:
        assert sum(pool.map(differing, range(120))) == 0  # of 480,000 densities


@given(seed=SEEDS, d=st.integers(1, 5), K=st.integers(1, 4), exploration=EXPLORATIONS)
def test_curvature(random_mixture, seed, d, K, exploration):
    rng = np.random.default_rng(seed)
    mixture = DonutMixture(Conditional(*random_mixture(rng, K, d)), exploration)
    a = 2.0 * rng.normal(size=d)
    value, gradient, hessian, metric = curvature(mixture, a)
    expected = reference.log_donut_mixture(a, *mixture.conditional, *mixture.shape)
    scale = 1.0 + np.abs(expected[1]).max() ** 2
    assert value == pytest.approx(expected[0], rel=1e-8)
    np.testing.assert_allclose(gradient, expected[1], rtol=1e-6, atol=1e-8 * scale)
    np.testing.assert_allclose(hessian, expected[2], rtol=1e-6, atol=1e-7 * scale)
    np.testing.assert_allclose(metric, expected[3], rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("d", [1, 2, 5, 14])
def test_curvature_is_the_slope_of_the_slope(random_mixture, d):
    rng = np.random.default_rng(d)
    mixture = DonutMixture(Conditional(*random_mixture(rng, 3, d)), 0.9)
    a, step = mixture.mode() + 0.3 * rng.normal(size=d), 1e-6
    differences = [
        (curvature(mixture, a + step * axis)[1] - curvature(mixture, a - step * axis)[1])
        / (2.0 * step)
        for axis in np.eye(d)
    ]
    hessian = curvature(mixture, a)[2]
    np.testing.assert_allclose(hessian, differences, atol=1e-6 * np.abs(hessian).max())


# The mode


@given(
    seed=SEEDS,
    d=st.integers(1, 3),
    K=st.integers(1, 4),
    exploration=EXPLORATIONS,
    warm=st.booleans(),
)
def test_a_mode_lies_above_its_start(random_mixture, seed, d, K, exploration, warm):
    rng = np.random.default_rng(seed)
    mixture = DonutMixture(Conditional(*random_mixture(rng, K, d)), exploration)
    start = 3.0 * rng.normal(size=d) if warm else None
    mode = mixture.mode(start)
    if warm:
        assert mixture.pdf([mode])[0] >= mixture.pdf([start])[0]
    if d == 1:
        assert slope(mixture, mode) < 1e-5
        assert np.all(mixture.pdf([mode - 1e-3, mode + 1e-3]) <= mixture.pdf([mode]))
    np.testing.assert_array_equal(mixture.mode(start), mode)


def test_a_climb_takes_few_steps(random_mixture):
    counts, n_out = [], 0
    for seed in range(1000):
        rng = np.random.default_rng(seed)
        d, K = int(rng.integers(1, 15)), int(rng.integers(1, 11))
        mixture = DonutMixture(Conditional(*random_mixture(rng, K, d)), rng.random())
        starts = mixture.mode(), mixture.mode() + 0.3 * rng.normal(size=d)
        for start in starts:
            end, count = climb_from(mixture, start)
            counts.append(count)
            n_out += slope(mixture, end) > 1e-3
    assert np.median(counts) <= 6
    assert max(counts) <= compiled.MAX_ASCENT == 30
    assert n_out <= 0.005 * len(counts)


def test_a_level_ridge_is_not_walked_along():
    # A ring whose height changes by less than a double can tell.
    conditional = Conditional(
        np.array([1.0 - 1e-14, 1e-14]),
        np.array([[0.0, 0.0], [9.0, 0.0]]),
        np.tile(np.eye(2), (2, 1, 1)),
    )
    mixture = DonutMixture(conditional, 0.9)
    start = np.array([-mixture.ridge_radius, 0.5])
    end, count = climb_from(mixture, start)
    assert count < 10
    assert np.linalg.norm(end) == pytest.approx(mixture.ridge_radius, abs=1e-5)
    assert end[0] < -1.5


def test_a_tilted_ridge_is_walked_along_to_its_top():
    # The heavier neighbour lies to the right, the climb begins on the left.
    conditional = Conditional(
        np.array([0.8, 0.2]), np.array([[0.0, 0.0], [4.0, 0.0]]), np.tile(np.eye(2), (2, 1, 1))
    )
    mixture = DonutMixture(conditional, 0.9)
    end, count = climb_from(mixture, [-1.9, 0.1])
    assert end[0] > 1.0
    assert slope(mixture, end) < 1e-4
    assert count <= 25


@pytest.mark.parametrize("d", [1, 2, 3, 6])
def test_the_compiled_climb_ends_where_the_reference_does(random_mixture, d):
    n, same, lower = 60, 0, 0
    for seed in range(n):
        rng = np.random.default_rng([seed, d])
        conditional = Conditional(*random_mixture(rng, int(rng.integers(1, 4)), d))
        mixture = DonutMixture(conditional, rng.random())
        start = mixture.mode() + 0.3 * rng.normal(size=d)
        ours, _ = climb_from(mixture, start)
        theirs = reference.climb(start, *conditional, *mixture.shape)
        metric = curvature(mixture, theirs)[3]
        same += math.sqrt((ours - theirs) @ metric @ (ours - theirs)) < 0.05
        lower += mixture.log_pdf([ours])[0] < mixture.log_pdf([theirs])[0] - 1e-6
    assert same >= 0.9 * n
    assert lower <= 0.05 * n


def test_a_climb_leaves_a_hill_that_has_lost_its_weight():
    means, covariances = np.array([[0.0], [1000.0]]), np.ones((2, 1, 1))
    for weight in (0.0, 2e-86, 1e-9):
        conditional = Conditional(np.array([1.0 - weight, weight]), means, covariances)
        mixture = DonutMixture(conditional, 0.5)
        assert abs(mixture.mode([1001.0])[0]) == pytest.approx(mixture.ridge_radius, abs=1e-5)
    # A hill that the demonstrators do go to is stayed on, however small it is.
    mixture = DonutMixture(Conditional(np.array([0.999, 0.001]), means, covariances), 0.5)
    assert mixture.mode([1001.0])[0] == pytest.approx(1000.0 + mixture.ridge_radius, abs=1e-5)


@pytest.mark.parametrize("d", [2, 3])
def test_nearly_every_mode_of_a_vector_is_a_local_maximum(random_mixture, d):
    n, maxima = 200, 0
    for seed in range(n):
        rng = np.random.default_rng(seed)
        conditional = Conditional(*random_mixture(rng, rng.integers(1, 5), d))
        mixture = DonutMixture(conditional, rng.random())
        mode = mixture.mode(3.0 * rng.normal(size=d))
        steps = rng.normal(size=(20, d))
        steps *= 1e-2 / np.linalg.norm(steps, axis=1, keepdims=True)
        is_top = np.all(mixture.pdf(mode + steps) <= mixture.pdf([mode]) * (1.0 + 1e-7))
        maxima += slope(mixture, mode) < 1e-4 and is_top
    assert maxima >= 0.99 * n


@given(exploration=st.floats(0.2, 1.0), reach=st.floats(1.0, 4.0), start=st.floats(0.01, 10.0))
def test_a_climb_stays_on_its_side_of_the_hole(exploration, reach, start):
    mixture = hill(exploration, reach=reach)
    assert mixture.ridge_radius > 0.0
    assert mixture.mode([start])[0] == pytest.approx(mixture.ridge_radius, abs=1e-5)
    assert mixture.mode([-start])[0] == pytest.approx(-mixture.ridge_radius, abs=1e-5)


def test_a_climb_stays_on_the_hill_it_starts_on():
    # Narrow hills, one sixth of a deviation wide, on the flank of a wide one.
    conditional = Conditional(
        np.array([0.8, 0.1, 0.1]),
        np.array([[0.0], [4.0], [8.0]]),
        np.array([[[9.0]], [[0.25]], [[0.25]]]),
    )
    mixture = DonutMixture(conditional, 0.0)
    for centre in (4.0, 8.0):
        for offset in (-0.5, 0.0, 0.5):
            assert mixture.mode([centre + offset])[0] == pytest.approx(centre, abs=0.2)
    assert mixture.mode([0.5])[0] == pytest.approx(0.0, abs=0.1)
    assert mixture.mode()[0] == pytest.approx(4.0, abs=0.2)


@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("offset", [0.0, 1e-12, 1e-9, 1e-7])
@pytest.mark.parametrize("exploration", [0.5, 0.99])
def test_a_climb_leaves_a_pit(d, offset, exploration):
    mixture = hill(exploration, d)
    mode = mixture.mode(np.full(d, offset))
    assert np.linalg.norm(mode) == pytest.approx(mixture.ridge_radius, abs=1e-5)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_a_climb_leaves_an_exact_zero(d):
    mixture = hill(1.0, d)
    assert np.linalg.norm(mixture.mode(np.zeros(d))) == pytest.approx(
        mixture.ridge_radius, abs=1e-5
    )


@pytest.mark.parametrize("centre", [0, 1])
def test_a_climb_from_a_centre_of_several_leaves_it(centre):
    conditional = Conditional(
        np.array([0.5, 0.5]), np.array([[-6.0, 0.0], [6.0, 0.0]]), np.tile(np.eye(2), (2, 1, 1))
    )
    mixture = DonutMixture(conditional, 0.9)
    mode = mixture.mode(conditional.means[centre])
    distance = np.linalg.norm(mode - conditional.means[centre])
    assert distance == pytest.approx(mixture.ridge_radius, rel=0.05)


def test_a_climb_leaves_a_saddle():
    # Half-way between two equal hills the gradient is exactly zero.
    conditional = Conditional(
        np.array([0.5, 0.5]), np.array([[0.0, -3.0], [0.0, 3.0]]), np.tile(np.eye(2), (2, 1, 1))
    )
    mode = DonutMixture(conditional, 0.0).mode([0.0, 0.0])
    assert abs(mode[1]) == pytest.approx(3.0, abs=0.01)


@pytest.mark.parametrize("distance", [20.0, 1e3, 1e6, 1e9])
def test_a_climb_comes_back_from_far_away(random_mixture, distance):
    mixture = DonutMixture(Conditional(*random_mixture(np.random.default_rng(0), 3, 2)), 0.7)
    mode = mixture.mode([distance, -distance])
    assert slope(mixture, mode) < 1e-4


def test_modes_against_a_dense_grid():
    rng = np.random.default_rng(0)
    n, missed = 150, 0
    for _ in range(n):
        spread = rng.choice([1.0, 3.0])
        conditional = one_dimensional(rng, rng.integers(1, 6), spread)
        mixture = DonutMixture(conditional, rng.random())
        low, high = conditional.means.min() - 6.0, conditional.means.max() + 6.0
        highest = mixture.log_pdf(np.linspace(low, high, 2001)[:, None]).max()
        found = mixture.log_pdf([mixture.mode()])[0]
        # The candidates are analytic for one donut, so another's flank may hide the best top.
        assert found >= highest - 0.1
        missed += found < highest - 1e-3
        for start in rng.uniform(low, high, size=(5, 1)):
            warm = mixture.mode(start)
            assert low <= warm[0] <= high
            assert mixture.log_pdf([warm])[0] <= max(highest + 1e-3, found + 1e-9)
    assert missed <= 0.05 * n


@given(seed=SEEDS, K=st.integers(1, 4), exponent=st.integers(-6, 6), exploration=EXPLORATIONS)
def test_units_do_not_matter(random_mixture, seed, K, exponent, exploration):
    rng = np.random.default_rng(seed)
    weights, means, covariances = random_mixture(rng, K, 1)
    scale = 10.0**exponent
    start = rng.normal(size=1)
    plain = DonutMixture(Conditional(weights, means, covariances), exploration)
    scaled = DonutMixture(Conditional(weights, means * scale, covariances * scale**2), exploration)
    np.testing.assert_allclose(scaled.mode(start * scale) / scale, plain.mode(start), atol=1e-5)


def test_components_that_nobody_hears_do_no_harm():
    # Far from the data all but one weight underflow to zero.
    conditional = Conditional(
        np.array([0.0, 1.0]), np.array([[1e12], [2.0]]), np.array([[[1.0]], [[0.25]]])
    )
    mixture = DonutMixture(conditional, 0.8)
    assert abs(mixture.mode()[0] - 2.0) == pytest.approx(0.5 * mixture.ridge_radius, abs=1e-5)


# How much to explore


@pytest.mark.parametrize(("spread", "prose"), [(0.1, 0.0099), (1.0, 0.5), (10.0, 0.9901)])
def test_exploration_at_a_scale_of_one_newton(spread, prose):
    variance = [[spread**2]]
    assert exploration_from_variance(variance, [1.0]) == pytest.approx(prose, abs=1e-4)
    printed = exploration_from_variance(variance, [1.0], "printed")
    assert printed == pytest.approx(1.0 - prose, abs=1e-4)


@given(
    variances=st.lists(st.floats(0.0, 1e6), min_size=1, max_size=3),
    unit=st.floats(1e-3, 1e3),
    seed=SEEDS,
)
def test_exploration_is_the_same_in_any_unit(variances, unit, seed):
    scale = np.random.default_rng(seed).uniform(0.1, 10.0, size=len(variances))
    variance = np.diag(variances)
    exploration = exploration_from_variance(variance, scale)
    spread = np.mean(np.array(variances) / scale**2)
    assert exploration == pytest.approx(1.0 - 1.0 / (1.0 + spread), abs=1e-12)
    assert 0.0 <= exploration <= 1.0
    assert exploration_from_variance(variance * unit**2, scale * unit) == pytest.approx(exploration)
    printed = exploration_from_variance(variance, scale, "printed")
    assert printed == pytest.approx(1.0 - exploration, abs=1e-12)


def test_disagreement_explores_and_agreement_repeats():
    def at(spread):
        means = np.array([[-spread], [spread]])
        conditional = Conditional(np.full(2, 0.5), means, np.full((2, 1, 1), 1e-4))
        return exploration_from_variance(conditional.variance, [1.0])

    assert at(0.0) < 1e-3
    assert at(10.0) > 0.98


# Bad input


@pytest.mark.parametrize(
    ("variance", "scale", "formula"),
    [
        ([1.0], [1.0], "prose"),
        ([[1.0]], [1.0, 2.0], "prose"),
        ([[1.0, 0.0]], [1.0], "prose"),
        ([[1.0]], [0.0], "prose"),
        ([[1.0]], [-1.0], "prose"),
        ([[1.0]], [math.nan], "prose"),
        ([[1.0]], [math.inf], "prose"),
        ([[math.nan]], [1.0], "prose"),
        ([[-1.0]], [1.0], "prose"),
    ],
)
def test_exploration_is_checked(refused, variance, scale, formula):
    with refused("exploration takes a variance"):
        exploration_from_variance(variance, scale, formula)


def test_a_formula_is_checked(refused):
    with refused("'prose' or 'printed', got 'verse'"):
        exploration_from_variance([[1.0]], [1.0], "verse")


ONE = Conditional(np.ones(1), np.zeros((1, 2)), np.eye(2)[None])


@pytest.mark.parametrize(
    ("conditional", "settings", "message"),
    [
        (ONE, {"exploration": 1.5}, "exploration must be from 0 to 1"),
        (ONE, {"exploration": math.nan}, "exploration must be from 0 to 1"),
        (ONE, {"exploration": 0.5, "k": 1.0}, "k > 1"),
        (ONE, {"exploration": 0.5, "reach": 0.5}, "reach ≥ 1"),
        (ONE._replace(covariances=np.zeros((1, 2, 2))), {"exploration": 0.5}, "definite"),
        (ONE._replace(covariances=-np.eye(2)[None]), {"exploration": 0.5}, "definite"),
    ],
)
def test_a_mixture_is_checked(refused, conditional, settings, message):
    with refused(message):
        DonutMixture(conditional, **settings)


@pytest.mark.parametrize("point", [[0.0], [0.0, 0.0, 0.0], [0.0, math.nan], [math.inf, 0.0]])
def test_points_are_checked(refused, point):
    mixture = DonutMixture(ONE, 0.5)
    for query in (mixture.pdf, mixture.log_pdf, mixture.gradient):
        with refused(r"points are finite and have shape \(N, 2\)"):
            query([point])
    with refused(r"points are finite and have shape \(N, 2\)"):
        mixture.mode(point)


def test_the_family_is_that_of_a_single_donut():
    shape, ridge = compiled.donut_shape(0.7, 2, 2.0, 3.0)
    assert DonutShape.of(0.7, 2, 2.0, 3.0) == shape
    donut = Donut([0.0, 0.0], np.eye(2), DonutShape(*shape))
    assert ridge == pytest.approx(donut.ridge_radius, rel=1e-12)
