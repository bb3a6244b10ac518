"""The one compiled call that answers a state, against the pieces it is made of."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from misstep.mixture import (
    Conditioner,
    DonutMixture,
    DonutQuery,
    GaussianMixture,
    exploration_from_variance,
    reference,
)

SEEDS = st.integers(0, 2**32 - 1)


def conditioner_of(mixture, n):
    return Conditioner(GaussianMixture.from_parameters(*mixture), range(n))


@given(
    seed=SEEDS,
    K=st.integers(1, 10),
    n=st.integers(1, 3),
    d=st.integers(1, 2),
    formula=st.sampled_from(["prose", "printed"]),
)
def test_against_its_pieces(random_mixture, seed, K, n, d, formula):
    rng = np.random.default_rng(seed)
    conditioner = conditioner_of(random_mixture(rng, K, n + d, spread=4.0), n)
    scale = rng.uniform(0.3, 3.0, d)
    query = DonutQuery(conditioner, scale, k=2.5, reach=1.5, formula=formula)
    states = 4.0 * rng.normal(size=(3, n))
    actions, explorations = query.modes(states)
    for state, action, exploration in zip(states, actions, explorations, strict=True):
        conditional = conditioner.at(state)
        expected = exploration_from_variance(conditional.variance, scale, formula)
        assert exploration == pytest.approx(expected, rel=1e-9, abs=1e-12)
        donuts = DonutMixture(conditional, exploration, k=2.5, reach=1.5)
        at_mode = donuts.log_pdf([action])[0]
        assert at_mode == pytest.approx(donuts.log_pdf([donuts.mode()])[0], rel=1e-9, abs=1e-9)
        # Warm: from where it stands it stays, and from elsewhere it climbs.
        stays = action.copy()
        query.explore(state, stays, warm=True)
        assert donuts.log_pdf([stays])[0] >= at_mode - 1e-9
        start = action + scale
        climbed = start.copy()
        query.explore(state, climbed, warm=True)
        assert donuts.log_pdf([climbed])[0] >= donuts.log_pdf([start])[0] - 1e-9


@given(seed=SEEDS, K=st.integers(2, 10), d=st.integers(1, 3), exploration=st.floats(0.0, 1.0))
def test_components_passed_over_change_no_density(random_mixture, seed, K, d, exploration):
    # Far apart, most components are passed over at most points.
    rng = np.random.default_rng(seed)
    weights, means, covariances = random_mixture(rng, K, d + 1, spread=30.0)
    conditional = conditioner_of((weights, means, covariances), 1).at(rng.normal(size=1))
    donuts = DonutMixture(conditional, exploration)
    points = conditional.means[rng.integers(K, size=4)] + rng.normal(size=(4, d))
    for point in points:
        expected = reference.donut_mixture_density(point, *conditional, *donuts.shape)
        assert donuts.pdf([point])[0] == pytest.approx(expected, rel=1e-9, abs=1e-250)


def test_a_flat_start_stays_where_asked(random_mixture):
    rng = np.random.default_rng(0)
    conditioner = conditioner_of(random_mixture(rng, 3, 2), 1)
    query = DonutQuery(conditioner, [1.0])
    far = np.array([1e5])
    assert math.exp(DonutMixture(conditioner.at([0.0]), 0.5).log_pdf([far])[0]) == 0.0
    action = far.copy()
    query.explore(np.zeros(1), action, warm=True, flat_stays=True)
    assert action == far
    query.explore(np.zeros(1), action, warm=True)
    assert abs(action[0]) < 100.0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"scale": [1.0, 1.0]}, "the scale must be 1 positive numbers"),
        ({"scale": [0.0]}, "the scale must be 1 positive numbers"),
        ({"scale": [math.nan]}, "the scale must be 1 positive numbers"),
        ({"scale": [1.0], "k": 1.0}, "k > 1"),
        ({"scale": [1.0], "reach": 0.5}, "reach ≥ 1"),
        ({"scale": [1.0], "formula": "verse"}, "'prose' or 'printed', got 'verse'"),
    ],
)
def test_settings_are_checked(refused, random_mixture, settings, message):
    conditioner = conditioner_of(random_mixture(np.random.default_rng(0), 2, 2), 1)
    with refused(message):
        DonutQuery(conditioner, **settings)


def test_states_are_checked(refused, random_mixture):
    query = DonutQuery(conditioner_of(random_mixture(np.random.default_rng(0), 2, 2), 1), [1.0])
    for states in ([0.0], [[0.0, 1.0]], [[math.nan]]):
        with refused(r"points are finite and have shape \(N, 1\)"):
            query.modes(states)


@pytest.mark.parametrize(("formula", "expected"), [("prose", 1.0), ("printed", 0.0)])
@pytest.mark.parametrize("state", [1e300, -1.7e308])
def test_exploration_is_a_number_where_the_actions_are_none(formula, expected, state):
    covariances = [[[1.0, 0.9], [0.9, 1.0]], [[1.0, -50.0], [-50.0, 3000.0]]]
    mixture = GaussianMixture.from_parameters([0.5, 0.5], [[0.0, 0.0], [1.0, 5.0]], covariances)
    query = DonutQuery(Conditioner(mixture, [0]), [1.0], formula=formula)
    assert query.explore(np.array([state]), np.zeros(1), warm=False) == expected
