from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from misstep import demonstrate
from misstep.learners import (
    LEARNERS,
    DonutCostLearner,
    DonutLearner,
    DonutPolicy,
    Evidence,
    Mean,
    Task,
)
from misstep.learners.donut import CLIMBS, DonutSettings
from misstep.learners.donut_cost import cost_shares
from misstep.mixture import DonutMixture, GaussianMixture, exploration_from_variance, reference
from misstep.mixture.donut_mixture import FORMULAS
from misstep.trajectory import Column, Dataset, Outcome, Provenance, Trajectory

NAMES = ["donut", "donut-cost", "fall", "mean"]
SEEDS = st.integers(0, 2**32 - 1)
SETTINGS = DonutSettings(2.0, 2.0, "warm", "prose")


def trajectory(rng, n_steps=40, n=2, m=1, **fields):
    """Record an attempt whose actions follow the state, more or less."""
    observations = np.cumsum(rng.normal(size=(n_steps + 1, n)), axis=0)
    gains = rng.normal(size=(n, m))
    return Trajectory(
        observations=observations,
        actions=observations[:-1] @ gains + rng.normal(size=(n_steps, m)),
        dt=0.02,
        observation_columns=tuple(Column(f"x{i}", "m") for i in range(n)),
        action_columns=tuple(Column(f"u{i}", "N") for i in range(m)),
        provenance=Provenance("test", {}, "noisy", 0, ""),
        **{
            "outcome": Outcome.FAILURE,
            "costs": rng.random(n_steps) + 0.5,
            "failure_step": n_steps,
            **fields,
        },
    )


def task_of(t, limit=5.0, state=None):
    m = len(t.action_columns)
    names = tuple(column.name for column in t.observation_columns)
    columns = t.observation_columns, t.action_columns
    return Task(*columns, np.full(m, -limit), np.full(m, limit), state or names, 0.02)


def learned(learner, attempts, seed=0, limit=5.0):
    """Let a learner see all that it may, and return its policy."""
    evidence = Evidence.seen_from(learner.rung, Dataset(attempts), [])
    return learner.policy(task_of(attempts[0], limit), evidence, np.random.default_rng(seed))


# The ladder


@pytest.mark.parametrize("rung", range(5))
def test_evidence_hides_what_a_rung_may_not_see(rung):
    rng = np.random.default_rng(0)
    failure = trajectory(rng)
    success = trajectory(rng, outcome=Outcome.SUCCESS, failure_step=None)
    evidence = Evidence.seen_from(rung, Dataset([failure]), [success])
    assert evidence.attempts == evidence.demonstrations + evidence.trials
    for seen, whole in zip(evidence.attempts, (failure, success), strict=True):
        np.testing.assert_array_equal(seen.observations, whole.observations)
        np.testing.assert_array_equal(seen.actions, whole.actions)
        assert seen.outcome is (whole.outcome if rung >= 1 else Outcome.UNKNOWN)
        assert seen.failure_step == (whole.failure_step if rung >= 2 else None)
        if rung >= 3:
            np.testing.assert_array_equal(seen.costs, whole.costs)
        else:
            assert seen.costs is None
    assert failure.costs is not None


def test_every_learner_states_its_rung():
    assert {name: LEARNERS[name].rung for name in NAMES} == {
        "donut": 1,
        "donut-cost": 3,
        "fall": 2,
        "mean": 0,
    }


@pytest.mark.parametrize("name", ["donut", "mean"])
def test_learners_below_rung_3_ignore_costs(name):
    rng = np.random.default_rng(1)
    attempts = [trajectory(rng) for _ in range(3)]
    free = [replace(t, costs=None) for t in attempts]
    one, two = (learned(LEARNERS[name](), a) for a in (attempts, free))
    np.testing.assert_array_equal(one(np.zeros(2)), two(np.zeros(2)))


# Tasks


def test_a_task_sees_the_system_through_its_state(cartpole):
    whole, part = Task.of(cartpole), Task.of(cartpole, ["theta_dot", "x"])
    assert whole.state == ("x", "x_dot", "theta", "theta_dot")
    np.testing.assert_array_equal(part.state_indices, [3, 0])
    np.testing.assert_array_equal(part.action_low, [-20.0])
    np.testing.assert_array_equal(part.action_high, [20.0])
    attempt = demonstrate(cartpole, by="weak", n=1, seed=0)[0]
    joint = part.joint(attempt)
    np.testing.assert_array_equal(joint[:, 0], attempt.column("theta_dot")[:-1])
    np.testing.assert_array_equal(joint[:, 1], attempt.column("x")[:-1])
    np.testing.assert_array_equal(joint[:, 2], attempt.actions[:, 0])


@pytest.mark.parametrize("state", [[], ["theta", "theta"], ["phi"], ["theta", "phi"], [""]])
def test_a_state_is_checked(refused, cartpole, state):
    with refused("choose distinct columns among x, x_dot, theta, theta_dot"):
        Task.of(cartpole, state)


@pytest.mark.parametrize("name", ["fall", "hill-climbing", "random-linear", "segments"])
def test_learners_that_measure_actions_by_their_limits_want_some(refused, name):
    attempt = trajectory(np.random.default_rng(0))
    with refused("the action u0 has no limits"):
        learned(LEARNERS[name](), [attempt], limit=np.inf)


# What the policies do


@given(
    seed=SEEDS,
    n=st.integers(1, 3),
    m=st.integers(1, 2),
    formula=st.sampled_from(FORMULAS),
    climb=st.sampled_from(CLIMBS),
)
def test_the_donut_policy_is_the_composition_of_its_parts(
    random_mixture, seed, n, m, formula, climb
):
    rng = np.random.default_rng(seed)
    attempt = trajectory(rng, 2, n, m)
    mixture = GaussianMixture.from_parameters(*random_mixture(rng, 3, n + m))
    scale = rng.uniform(0.1, 3.0, size=m)
    settings = DonutSettings(rng.uniform(1.5, 3.0), rng.uniform(1.0, 3.0), climb, formula)
    policy = DonutPolicy(task_of(attempt), mixture, scale, settings)
    policy.reset()
    previous = None
    for observation in 2.0 * rng.normal(size=(4, n)):
        conditional = mixture.condition(range(n), observation)
        exploration = exploration_from_variance(conditional.variance, scale, formula)
        donuts = DonutMixture(conditional, exploration, settings.k, settings.reach)
        start = None if climb == "global" else previous
        flat = climb == "density" and start is not None and donuts.pdf([start])[0] == 0.0
        expected = start if flat else donuts.mode(start)
        if start is None and np.any(np.abs(expected) > 5.0):
            expected = donuts.mode(best_start_within(5.0, conditional, donuts))
        expected = np.clip(expected, -5.0, 5.0)
        action = policy(observation)
        np.testing.assert_allclose(action, expected, atol=1e-5)
        assert policy.exploration == pytest.approx(exploration, rel=1e-9)
        shown = policy.donut_at(observation)
        assert shown.exploration == pytest.approx(exploration, rel=1e-12)
        previous = action


def best_start_within(limit, conditional, donuts):
    """Return the densest centre or ridge point that lies within ±limit; if none does, clipped."""
    candidates = []
    for mean, covariance in zip(conditional.means, conditional.covariances, strict=True):
        candidates.append(mean)
        for arm in donuts.ridge_radius * np.linalg.cholesky(covariance).T:
            candidates += [mean + arm, mean - arm]
    possible = [c for c in candidates if np.all(np.abs(c) <= limit)]
    possible = possible or [np.clip(c, -limit, limit) for c in candidates]
    return max(possible, key=lambda c: donuts.log_pdf([c])[0])


def test_the_first_action_is_a_mode_that_the_actuators_can_do():
    # A ridge at 7.1 and one at 0.9, equally high: the first is out of reach.
    mixture = GaussianMixture.from_parameters([1.0], [[0.0, 4.0]], [np.diag([1.0, 1.2])])
    attempt = trajectory(np.random.default_rng(0), 2, 1, 1)
    policy = DonutPolicy(
        task_of(attempt, limit=5.0), mixture, np.ones(1), DonutSettings(2.0, 3.0, "warm", "prose")
    )
    action = policy(np.zeros(1))
    donuts = policy.donut_at([0.0])
    free = donuts.mode()
    assert abs(free[0]) > 5.0
    grid = np.linspace(-5.0, 5.0, 4001)[:, None]
    density = donuts.pdf(grid)
    inner = np.flatnonzero((density[1:-1] > density[:-2]) & (density[1:-1] > density[2:])) + 1
    assert np.min(np.abs(grid[inner] - action)) < 0.003
    assert abs(action[0]) < 4.99


def test_reach_varies_over_the_trials():
    rng = np.random.default_rng(0)
    attempts = [trajectory(rng) for _ in range(2)]
    learner = DonutLearner(reach=2.5, variation=0.2)
    reaches = []
    for n_trials in range(6):
        evidence = Evidence.seen_from(1, Dataset(attempts), attempts[:1] * n_trials)
        policy = learner.policy(task_of(attempts[0]), evidence, np.random.default_rng(0))
        reaches.append(policy.settings.reach)
    np.testing.assert_allclose(reaches, [2.5, 2.0, 3.0] * 2)


def test_only_the_climb_up_the_density_stays_where_it_is_flat():
    attempt = trajectory(np.random.default_rng(0), 2, 1, 1)
    mixture = GaussianMixture.from_parameters([1.0], [[0.0, 0.0]], [[[1.0, 0.999], [0.999, 1.0]]])
    last = {}
    for climb in CLIMBS:
        policy = DonutPolicy(
            task_of(attempt), mixture, np.ones(1), DonutSettings(2.0, 2.0, climb, "prose")
        )
        last[climb] = [policy(np.array([x]))[0] for x in (0.0, 4.0)][-1]
    # From the mean at 0 to that at 4 it is 89 standard deviations: no double holds that density.
    assert last["density"] == pytest.approx(0.0, abs=0.1)
    assert last["warm"] == pytest.approx(4.0, abs=0.1)
    assert last["global"] == pytest.approx(4.0, abs=0.1)


def test_reset_forgets_the_previous_action(random_mixture):
    rng = np.random.default_rng(3)
    attempt = trajectory(rng)
    mixture = GaussianMixture.from_parameters(*random_mixture(rng, 3, 3))
    policy = DonutPolicy(task_of(attempt), mixture, np.ones(1), SETTINGS)
    observations = 3.0 * rng.normal(size=(20, 2))
    first = [policy(o) for o in observations]
    assert not np.array_equal(policy(observations[0]), first[0])
    policy.reset()
    np.testing.assert_array_equal([policy(o) for o in observations], first)


@given(seed=SEEDS, n=st.integers(1, 3), m=st.integers(1, 2))
def test_the_mean_is_gaussian_mixture_regression(random_mixture, seed, n, m):
    rng = np.random.default_rng(seed)
    parameters = random_mixture(rng, 3, n + m)
    names = ("weights", "means", "covariances")
    arrays = dict(zip(names, parameters, strict=True))
    policy = Mean.restore(task_of(trajectory(rng, 2, n, m), limit=1e9), arrays)
    for observation in 3.0 * rng.normal(size=(5, n)):
        mean, _ = reference.moments(*reference.condition(observation, *parameters))
        np.testing.assert_allclose(policy(observation), mean, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("m", [1, 2])
def test_actions_stay_inside_the_limits_however_far_the_state(name, m):
    rng = np.random.default_rng(m)
    attempts = [trajectory(rng, m=m) for _ in range(2)]
    policy = learned(LEARNERS[name](), attempts, limit=1.5)
    policy.reset()
    for distance in (0.0, 1.0, 1e2, 1e4, 1e6, 1e9, 0.0):
        action = policy(distance * np.array([1.0, -1.0]))
        assert action.shape == (m,)
        assert np.all(np.abs(action) <= 1.5)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("m", [1, 2])
def test_a_policy_restored_from_its_arrays_acts_the_same(name, m):
    rng = np.random.default_rng(m)
    attempts = [trajectory(rng, m=m) for _ in range(2)]
    learner = LEARNERS[name]()
    policy = learned(learner, attempts)
    arrays = {key: np.array(value) for key, value in policy.arrays().items()}
    restored = type(learner).restore(task_of(attempts[0]), arrays)
    policy.reset()
    for observation in 3.0 * rng.normal(size=(30, 2)):
        np.testing.assert_array_equal(restored(observation), policy(observation))


@pytest.mark.parametrize("name", NAMES)
def test_learning_is_deterministic(name):
    attempts = [trajectory(np.random.default_rng(i)) for i in range(3)]
    one, two, other = (learned(LEARNERS[name](), attempts, seed) for seed in (0, 0, 1))
    for key, value in one.arrays().items():
        np.testing.assert_array_equal(value, two.arrays()[key])
    if name == "donut-cost":  # whose samples are drawn
        assert not np.array_equal(one.arrays()["means"], other.arrays()["means"])


def test_the_scale_is_a_share_of_the_demonstrated_spread():
    rng = np.random.default_rng(0)
    attempts = [trajectory(rng, m=2) for _ in range(3)]
    spread = np.concatenate([t.actions for t in attempts]).std(axis=0)
    np.testing.assert_allclose(learned(DonutLearner(), attempts).scale, 0.3 * spread, rtol=1e-12)
    np.testing.assert_array_equal(learned(DonutLearner(scale=10.0), attempts).scale, [10.0, 10.0])
    # Frozen after the demonstrations: a trial does not change it.
    evidence = Evidence.seen_from(1, Dataset(attempts), [trajectory(rng, m=2)])
    policy = DonutLearner().policy(task_of(attempts[0]), evidence, rng)
    np.testing.assert_allclose(policy.scale, 0.3 * spread, rtol=1e-12)


# Costs


def test_cost_shares_are_shares_of_mean_cost():
    rng = np.random.default_rng(0)
    short = trajectory(rng, 10, costs=np.full(10, 1.0))
    long = trajectory(rng, 30, costs=np.full(30, 3.0))
    np.testing.assert_allclose(cost_shares([short, long]), [0.25, 0.75], rtol=1e-12)


def test_equal_costs_by_weights_are_the_plain_donut():
    rng = np.random.default_rng(4)
    attempts = [trajectory(rng, costs=np.full(40, 2.0)) for _ in range(3)]
    plain = learned(DonutLearner(), attempts)
    weighted = learned(DonutCostLearner(method="weights"), attempts)
    for key, value in plain.arrays().items():
        np.testing.assert_allclose(weighted.arrays()[key], value, rtol=1e-9, atol=1e-12)


def test_by_weights_an_attempt_counts_by_its_mean_cost_and_not_by_its_length():
    rng = np.random.default_rng(4)
    attempts = [
        trajectory(rng, 20, costs=np.full(20, 3.0)),
        trajectory(rng, 50, costs=np.full(50, 1.0)),
    ]
    policy = learned(DonutCostLearner(method="weights", n_components=1), attempts)
    means = [task_of(t).joint(t).mean(axis=0) for t in attempts]
    np.testing.assert_allclose(policy.mixture.means_[0], 0.75 * means[0] + 0.25 * means[1])


def test_samples_are_drawn_in_proportion_to_cost():
    # Two attempts far apart: the weight of the component on one of them is its share of the cost.
    rng = np.random.default_rng(0)
    near, far = trajectory(rng, 400), trajectory(rng, 200)
    near = replace(near, observations=rng.normal(size=(401, 2)), costs=np.full(400, 1.0))
    far = replace(far, observations=rng.normal(size=(201, 2)) + 100.0, costs=np.full(200, 4.0))
    for method in ("samples", "weights"):
        policy = learned(DonutCostLearner(method=method, n_components=2), [near, far])
        on_far = policy.mixture.means_[:, 0] > 50.0
        assert policy.mixture.weights_[on_far].sum() == pytest.approx(0.8, abs=0.002)
        centre = policy.mixture.weights_[on_far] @ policy.mixture.means_[on_far, 0] / 0.8
        assert centre == pytest.approx(100.0, abs=0.5)


def test_an_attempt_that_costs_nothing_counts_nothing():
    rng = np.random.default_rng(2)
    bad, good = trajectory(rng), trajectory(rng, costs=np.zeros(40))
    for method in ("samples", "weights"):
        learner = DonutCostLearner(method=method, n_components=1)
        means = learned(learner, [bad, good]).mixture.means_[0]
        samples = task_of(bad).joint(bad)
        # Of the drawn samples there are 80, of the weighted ones 40 with no noise.
        error = samples.std(axis=0) / np.sqrt(80) if method == "samples" else 1e-9
        assert np.all(np.abs(means - samples.mean(axis=0)) < 5 * error)


@pytest.mark.parametrize("method", ["samples", "weights"])
@pytest.mark.parametrize("n_steps", [1, 2, 40])
def test_an_action_may_be_constant_within_one_attempt(method, n_steps):
    # A learned policy that pushes against its limit from start to end records just that.
    rng = np.random.default_rng(0)
    varied = trajectory(rng, 60)
    stuck = replace(trajectory(rng, n_steps), actions=np.full((n_steps, 1), 5.0))
    policy = learned(DonutCostLearner(method=method), [varied, stuck])
    assert abs(policy(np.zeros(2))[0]) <= 5.0


# Bad input


@pytest.mark.parametrize("name", NAMES)
def test_a_constant_column_is_named(refused, name):
    attempt = trajectory(np.random.default_rng(0))
    still = replace(attempt, observations=attempt.observations * [1.0, 0.0] + [0.0, 3.0])
    pushing = replace(attempt, actions=np.full((40, 1), 2.0))
    for constant, column in ((still, r"x1 is constant \(3\)"), (pushing, r"u0 is constant \(2\)")):
        with refused(f"column {column} in all attempts"):
            learned(LEARNERS[name](), [constant])


@pytest.mark.parametrize(
    ("name", "parameters", "message"),
    [
        ("donut-cost", {"method": "guess"}, "method is 'guess'; there are: samples, weights"),
        ("donut", {"climb": "hot"}, "climb is 'hot'; there are: warm, density, global"),
        ("donut", {"formula": "verse"}, "formula is 'verse'; there are: prose, printed"),
        ("donut", {"k": 1.0}, "k is 1 but must be greater than 1"),
        ("donut", {"k": float("inf")}, "k is inf but must be a finite number"),
        ("donut", {"reach": 0.5}, "reach is 0.5 but must be at least 1"),
        ("donut", {"variation": 0.6}, r"variation is 0.6, but reach · \(1 − variation\) must be"),
        ("donut", {"spacing": "even"}, "spacing is 'even'; there are: time, path"),
        ("mean", {"spacing": "even"}, "spacing is 'even'; there are: time, path"),
        ("mean", {"resolution": 0.0}, "resolution is 0 but must be greater than 0"),
        ("donut", {"scale": -1.0}, "scale is -1 action's unit but must be at least 0"),
        ("mean", {"n_components": -1}, "n_components is -1 but must be at least 0"),
        ("mean", {"n_components": 1.5}, "n_components is 1.5 but must be a whole number"),
        ("mean", {"max_components": 0}, "max_components is 0 but must be at least 1"),
    ],
)
def test_parameters_are_checked(refused, name, parameters, message):
    with refused(f"learner {name}: {message}"):
        LEARNERS[name](**parameters)


def test_an_unknown_learner_is_named(refused):
    with refused("no learner named 'doughnut'; there are: balanced-mean, "):
        LEARNERS["doughnut"]


@pytest.mark.parametrize(
    ("costs", "message"),
    [
        (None, "attempt 1 has no costs: donut-cost needs the cost of each step"),
        (np.full(40, -1.0), "nowhere negative"),
    ],
)
def test_costs_are_needed(refused, costs, message):
    rng = np.random.default_rng(0)
    with refused(message):
        learned(DonutCostLearner(), [trajectory(rng), trajectory(rng, costs=costs)])
    with refused("somewhere positive"):
        learned(DonutCostLearner(), [trajectory(rng, costs=np.zeros(40))])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": np.ones(5)}, "a mixture takes"),
        ({"means": np.full((1, 3), np.nan)}, "finite"),
        ({"covariances": -np.eye(3)[None]}, "definite"),
        (
            {"means": np.zeros((1, 2)), "covariances": np.eye(2)[None]},
            "mixture has 2 columns, but the task has 2 of state and 1 of action",
        ),
        ({"scale": np.ones(2)}, "scale must be 1 positive numbers"),
        ({"scale": np.zeros(1)}, "scale must be 1 positive numbers"),
        ({"settings": np.array([0.5, 2.0, 1.0, 0.0])}, "k > 1"),
        ({"settings": np.array([2.0, 2.0, 3.0, 0.0])}, "no climb 3"),
        ({"settings": np.array([2.0, 2.0, 0.0, -1.0])}, "no formula -1"),
        ({"settings": np.array([2.0, 2.0, np.inf, 0.0])}, "no climb inf"),
    ],
)
def test_the_arrays_of_a_policy_are_checked(refused, change, message):
    arrays = {
        "weights": np.ones(1),
        "means": np.zeros((1, 3)),
        "covariances": np.eye(3)[None],
        "scale": np.ones(1),
        "settings": np.array([2.0, 2.0, 1.0, 0.0]),
    }
    task = task_of(trajectory(np.random.default_rng(0)))
    assert np.all(np.isfinite(DonutLearner.restore(task, arrays)(np.zeros(2))))
    with refused(message):
        DonutLearner.restore(task, {**arrays, **change})
