from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are

from misstep import demonstrate, learn, make_system
from misstep.costs import EFFORT, FREE_SHARE, StateCost
from misstep.dynamics import (
    Circles,
    Encoding,
    ForwardModel,
    Kinematics,
    Planner,
    SparseGaussianProcess,
    compiled,
)
from misstep.dynamics.encoding import wrapped_differences
from misstep.dynamics.forward_model import outlier_weights, transitions
from misstep.dynamics.gaussian_process import (
    JITTER,
    Hyperparameters,
    negative_log_evidence,
    pivoted_centres,
    squared_exponential,
)
from misstep.learners import Dynamics, Evidence, Task
from misstep.rollout import rollout
from misstep.runs import load_run
from misstep.trajectory import Outcome

SEEDS = st.integers(0, 2**32 - 1)
ANGLES = np.array([False, False, True, False])
LIMIT = np.array([20.0])


def recordings(dataset):
    return [(t.observations, t.actions) for t in dataset]


@pytest.fixture(scope="module")
def shown(cartpole):
    return demonstrate(cartpole, by="noisy", n=4, seed=0)


@pytest.fixture(scope="module")
def model(shown):
    rng = np.random.default_rng(0)
    return ForwardModel.fit(recordings(shown), ANGLES, -LIMIT, LIMIT, rng)


@pytest.fixture(scope="module")
def policy(cartpole, shown):
    evidence = Evidence(tuple(shown), ())
    return Dynamics().policy(Task.of(cartpole), evidence, np.random.default_rng(0))


def made_up_model(rng, angles, m, n_centres=8):
    """A model of arbitrary numbers: the last column is the integral of the first."""
    n, ny = len(angles), len(angles) - 1
    nz = n + int(angles.sum())
    centres = rng.normal(size=(nz, n_centres))
    source = np.full(n, -1)
    source[-1] = 0
    return compiled.Model(
        angles=angles,
        mean=np.where(angles, 0.0, rng.normal(size=n)),
        inverse_scale=np.where(angles, 1.0, rng.uniform(0.5, 2.0, n)),
        inverse_lengths=rng.uniform(0.3, 2.0, nz),
        centres=centres,
        offsets=-0.5 * (centres**2).sum(axis=0),
        local=rng.normal(size=(1 + m, ny, n_centres)),
        linear=rng.normal(size=(1 + m, ny, nz)),
        constant=rng.normal(size=(1 + m, ny)),
        learned=np.arange(ny),
        source=source,
        alpha=np.where(source >= 0, 0.02, 0.0),
        beta=np.where(source >= 0, 0.01, 0.0),
        low=np.full(n, -np.inf),
        high=np.full(n, np.inf),
    )


def predict(model, states, actions):
    new = np.empty_like(states)
    compiled.predict(model, states, actions, new, compiled.Workspace.of(model, 1))
    return new


# Encoding


@given(seed=SEEDS)
def test_encoding_can_be_undone(seed):
    rng = np.random.default_rng(seed)
    angles = rng.random(4) < 0.5
    states = rng.normal(size=(20, 4)) * rng.uniform(0.01, 100.0, 4)
    states[:, angles] = rng.uniform(-np.pi, np.pi, (20, angles.sum()))
    low, high = -rng.uniform(0.1, 10.0, 2), rng.uniform(0.1, 10.0, 2)
    encoding = Encoding.of(states, angles, low, high)
    encoded = encoding.encode(states)
    sines = np.cumsum(1 + angles) - 1 - angles
    decoded = encoded[:, sines] * encoding.scale + encoding.mean
    turning = sines[angles]
    decoded[:, angles] = np.arctan2(encoded[:, turning], encoded[:, turning + 1])
    np.testing.assert_allclose(decoded, states, rtol=1e-9, atol=1e-12)
    assert encoded.shape == (20, 4 + angles.sum())
    actions = rng.uniform(low, high, (20, 2))
    assert np.all(np.abs(encoding.encode_actions(actions)) <= 1.0)
    np.testing.assert_allclose(encoding.decode_actions(encoding.encode_actions(actions)), actions)
    np.testing.assert_allclose(encoding.encode_actions(high), 1.0)


def test_a_constant_column_is_encoded_as_zero():
    states = np.column_stack([np.full(5, 3.0), np.arange(5.0)])
    encoding = Encoding.of(states, np.zeros(2, bool), -LIMIT, LIMIT)
    assert np.all(encoding.encode(states)[:, 0] == 0.0)


def test_angles_change_the_short_way_round():
    before, after = np.array([[3.1, 3.1]]), np.array([[-3.1, -3.1]])
    change = wrapped_differences(before, after, np.array([True, False]))
    np.testing.assert_allclose(change, [[2 * np.pi - 6.2, -6.2]])


# Circles


def turning(rng, n=200):
    """States of x, cos θ, the rate, sin θ; and θ itself."""
    theta = np.cumsum(rng.normal(scale=0.3, size=n))
    columns = [rng.normal(size=n), np.cos(theta), np.gradient(theta), np.sin(theta)]
    return np.column_stack(columns), theta


def free_cost(goal, weights):
    return StateCost(goal, weights, (np.inf,) * len(goal))


def test_a_cosine_and_its_sine_are_found_and_unrolled():
    states, theta = turning(np.random.default_rng(0))
    circles = Circles.find(states, free_cost((0.0, 1.0, 0.0, 0.0), (1.0, 2.0, 0.1, 2.0)))
    np.testing.assert_array_equal(circles.pairs, [[1], [3]])
    np.testing.assert_array_equal(circles.angles, [False, True, False])
    unrolled = circles.unroll(states)
    np.testing.assert_array_equal(unrolled[:, [0, 2]], states[:, [0, 2]])
    off = unrolled[:, 1] - theta
    np.testing.assert_allclose(off, 2 * np.pi * np.round(off / (2 * np.pi)), atol=1e-12)
    np.testing.assert_array_equal(circles.unroll(states[3]), unrolled[3])


@given(seed=SEEDS)
def test_unrolled_states_cost_the_same_but_for_a_constant(seed):
    rng = np.random.default_rng(seed)
    states, _ = turning(rng)
    weight = rng.uniform(0.1, 10.0)
    cost = free_cost(tuple(rng.normal(size=4)), (1.0, weight, 0.1, weight))
    circles = Circles.find(states, cost)
    unrolled = circles.unroll_cost(cost)(circles.unroll(states), circles.angles)
    difference = unrolled - cost(states, np.zeros(4, bool))
    np.testing.assert_allclose(difference, difference[0], atol=1e-9)


def test_what_is_no_circle_is_left_alone():
    rng = np.random.default_rng(0)
    states, _ = turning(rng)
    cost = free_cost((0.0,) * 4, (1.0,) * 4)
    noisy = states + 0.01 * rng.normal(size=states.shape)
    still = np.column_stack([np.ones(50), 1e-4 * rng.normal(size=(50, 3))])
    unequal = free_cost((0.0,) * 4, (1.0, 2.0, 1.0, 1.0))
    walled = replace(cost, limits=(np.inf, 0.5, np.inf, np.inf))
    for case in ((noisy, cost), (still, cost), (states, unequal), (states, walled)):
        circles = Circles.find(*case)
        assert circles.pairs.size == 0
        np.testing.assert_array_equal(circles.unroll(case[0]), case[0])


# Gaussian process


@pytest.mark.parametrize("seed", range(5))
def test_evidence_gradient(seed):
    rng = np.random.default_rng(seed)
    z, u, y = rng.normal(size=(25, 3)), rng.uniform(-1, 1, (25, 2)), rng.normal(size=(25, 2))
    weights = rng.uniform(0.1, 1.0, (25, 2))
    p = np.concatenate([rng.uniform(-0.5, 2.0, 3), rng.uniform(-1.0, 1.0, 4), [-1.0, -2.0]])
    _, gradient = negative_log_evidence(p, z, u, y, weights)
    step = 1e-5
    for i, direction in enumerate(np.eye(len(p)) * step):
        above, below = (
            negative_log_evidence(q, z, u, y, weights)[0] for q in (p + direction, p - direction)
        )
        assert gradient[i] == pytest.approx((above - below) / (2 * step), rel=1e-4, abs=1e-4)


def exact_process(h, z, u, y, weights, z_new, u_new):
    """Mean and variance of the full Gaussian process, by the textbook's formula."""
    f, g, line, direct = h.amplitudes**2

    def kernel(z1, u1, z2, u2):
        difference = (z1[:, None] - z2[None]) / h.lengths
        local = np.exp(-0.5 * (difference**2).sum(axis=-1))
        return (f + g * u1 @ u2.T) * local + (line + direct * u1 @ u2.T) * (z1 @ z2.T + 1.0)

    across, own = kernel(z_new, u_new, z, u), np.diag(kernel(z_new, u_new, z_new, u_new))
    means, variances = [], []
    for j in range(y.shape[1]):
        gram = kernel(z, u, z, u) + np.diag(h.noise[j] ** 2 / weights[:, j])
        means.append(across @ np.linalg.solve(gram, y[:, j]))
        explained = (across * np.linalg.solve(gram, across.T).T).sum(axis=1)
        variances.append(own - explained + h.noise[j] ** 2)
    return np.stack(means, axis=1), np.stack(variances, axis=1)


def test_the_sparse_process_is_exact_with_a_centre_at_every_row():
    rng = np.random.default_rng(3)
    z, u = rng.normal(size=(30, 2)), rng.uniform(-1, 1, (30, 2))
    y = np.stack([np.sin(z[:, 0]) + u[:, 0], z[:, 1] * u[:, 1]], axis=1)
    weights = rng.uniform(0.2, 1.0, y.shape)
    h = Hyperparameters(np.array([0.7, 1.1]), np.array([0.8, 0.6, 0.3, 0.4]), np.array([0.1, 0.2]))
    process = SparseGaussianProcess.fit(
        z, u, y, rng, n_centres=30, weights=weights, hyperparameters=h
    )
    assert len(process.centres) == 30
    # At the centres themselves the projection of the kernel is the kernel.
    mean, variance = process.predict(z, u)
    standard = (y - y.mean(axis=0)) / y.std(axis=0)
    exact_mean, exact_variance = exact_process(h, z, u, standard, weights, z, u)
    np.testing.assert_allclose(mean, exact_mean * y.std(axis=0) + y.mean(axis=0), atol=1e3 * JITTER)
    np.testing.assert_allclose(variance, exact_variance * y.var(axis=0), atol=1e3 * JITTER)


def test_the_process_learns_a_function_and_knows_where():
    rng = np.random.default_rng(0)
    z, u = rng.uniform(-2, 2, (400, 2)), rng.uniform(-1, 1, (400, 1))

    def function(z, u):
        return np.stack([np.sin(z[:, 0]) * z[:, 1] + np.cos(z[:, 1]) * u[:, 0]], axis=1)

    y = function(z, u) + 0.05 * rng.normal(size=(400, 1))
    process = SparseGaussianProcess.fit(z, u, y, rng, n_centres=100)
    z_new, u_new = rng.uniform(-2, 2, (200, 2)), rng.uniform(-1, 1, (200, 1))
    mean, variance = process.predict(z_new, u_new)
    error = function(z_new, u_new) + 0.05 * rng.normal(size=(200, 1)) - mean
    assert error.std() < 0.08
    assert 0.7 < np.sqrt(np.mean(error**2 / variance)) < 1.4


def test_centres_explain_the_other_rows():
    rng = np.random.default_rng(1)
    z, lengths = rng.normal(size=(200, 2)), np.array([2.0, 3.0])
    centres = pivoted_centres(z, lengths, 100)
    across = squared_exponential(z, centres, lengths)
    gram = squared_exponential(centres, centres, lengths)
    left = 1.0 - (across * np.linalg.solve(gram, across.T).T).sum(axis=1)
    assert len(centres) < 100
    assert np.abs(left).max() < 1e-4
    assert len(np.unique(centres, axis=0)) == len(centres)


# Forward model


def test_positions_are_found_to_be_integrals_of_velocities(model, cartpole):
    np.testing.assert_array_equal(model.kinematics.source, [1, -1, 3, -1])
    np.testing.assert_allclose(model.kinematics.alpha[[0, 2]], cartpole.dt, rtol=0.02)


def test_a_column_that_only_resembles_an_integral_is_learned():
    rng = np.random.default_rng(0)
    states, changes = rng.normal(size=(300, 2)), rng.normal(size=(300, 2))
    changes[:, 0] = 0.02 * states[:, 1] + 0.002 * rng.normal(size=300)
    assert np.all(Kinematics.find(states, changes, np.zeros(2, bool)).source == -1)


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_an_angle_may_count_against_its_velocity(sense):
    rate = np.random.default_rng(0).normal(size=300)
    angle = np.cumsum(0.02 * sense * rate)
    states, changes = np.column_stack([angle, rate])[:-1], np.diff([angle, rate]).T
    for turns, found in ((True, 1), (False, 1 if sense > 0 else -1)):
        kinematics = Kinematics.find(states, changes, np.array([turns, False]))
        np.testing.assert_array_equal(kinematics.source, [found, -1])


def test_a_last_step_that_lasts_longer_is_left_out():
    system = make_system("flipup")
    dataset = demonstrate(system, "bracket", n=4, seed=0)
    angles = np.array([column.unit == "rad" for column in system.observation_columns])
    states, actions, changes = transitions(recordings(dataset), angles)
    assert len(states) == len(actions) == len(changes) == sum(t.n_steps - 1 for t in dataset)
    np.testing.assert_array_equal(states[: dataset[0].n_steps - 1], dataset[0].observations[:-2])


@pytest.mark.parametrize("by", ["noisy", "weak", "delayed", "reversed", "random", "bang-bang"])
def test_the_last_step_of_a_fall_is_kept(cartpole, by):
    dataset = demonstrate(cartpole, by, n=4, seed=1)
    states, _, changes = transitions(recordings(dataset), ANGLES)
    assert len(states) == sum(t.n_steps for t in dataset)
    np.testing.assert_allclose(states[-1] + changes[-1], dataset[-1].observations[-1])


def test_single_steps_are_all_kept():
    one = (np.zeros((2, 2)), np.zeros((1, 1)))
    other = (np.array([[0.0, 0.0], [9.0, 0.0]]), np.ones((1, 1)))
    assert len(transitions([one, other], np.zeros(2, bool))[0]) == 2


def test_prediction_of_a_swing_that_was_not_shown(model, cartpole):
    (unseen,) = demonstrate(cartpole, by="noisy", n=1, seed=77)
    predicted = model.predict(unseen.observations[:-1], unseen.actions)
    error = wrapped_differences(unseen.observations[1:], predicted, ANGLES)
    moved = wrapped_differences(unseen.observations[:-1], unseen.observations[1:], ANGLES)
    assert np.all(error.std(axis=0) < 0.02 * moved.std(axis=0))
    deviation = np.sqrt(model.variance(unseen.observations[:-1], unseen.actions))
    assert np.all(deviation > 0)
    assert np.all(deviation < moved.std(axis=0))


def test_bad_samples_do_not_spoil_the_model(cartpole, shown):
    longer = demonstrate(cartpole, by="noisy", n=12, seed=5)
    damaged = [(o.copy(), a) for o, a in recordings(longer)]
    rng = np.random.default_rng(0)
    for observations, _ in damaged[::3]:
        observations[rng.integers(5, len(observations) - 5), 3] += 3.0
    fits = [
        ForwardModel.fit(r, ANGLES, -LIMIT, LIMIT, np.random.default_rng(1))
        for r in (recordings(longer), damaged)
    ]
    states = np.concatenate([o[:-1] for o, _ in recordings(shown)])
    actions = np.concatenate([a for _, a in recordings(shown)])
    after = np.concatenate([o[1:] for o, _ in recordings(shown)])
    clean, robust = (np.abs(m.predict(states, actions) - after)[:, 3].mean() for m in fits)
    assert sum(len(a) for _, a in damaged) > 200
    assert robust < 3.0 * clean


def test_only_outliers_lose_weight():
    residuals = 0.01 * np.random.default_rng(0).normal(size=(500, 2))
    residuals[3, 1] = 1.0
    weights = outlier_weights(residuals)
    assert weights[3, 1] < 1e-4
    weights[3, 1] = 1.0
    assert np.all(weights == 1.0)


def test_too_few_transitions_are_refused(refused, shown):
    few = [(shown[0].observations[:4], shown[0].actions[:3])]
    with refused("3 transitions: a forward model needs at least 8"):
        ForwardModel.fit(few, ANGLES, -LIMIT, LIMIT, np.random.default_rng(0))


def test_actions_without_limits_are_refused(refused, shown):
    with refused("finite limits"):
        ForwardModel.fit(
            recordings(shown), ANGLES, -LIMIT, np.array([np.inf]), np.random.default_rng(0)
        )


# Compiled loops


@given(seed=SEEDS, m=st.integers(1, 3))
def test_jacobians(seed, m):
    rng = np.random.default_rng(seed)
    angles = np.array([False, True, False, False])
    model = made_up_model(rng, angles, m)
    state, action = rng.normal(size=4), rng.uniform(-1, 1, m)
    a, b = np.empty((4, 4)), np.empty((4, m))
    compiled.linearise(model, state, action, a, b, compiled.Workspace.of(model, 1))
    step = 1e-6
    for jacobian, of_state in ((a, True), (b, False)):
        moves = np.eye(jacobian.shape[1]) * step
        states = state + moves if of_state else np.tile(state, (m, 1))
        actions = np.tile(action, (4, 1)) if of_state else action + moves
        lower = (state - moves, actions) if of_state else (states, action - moves)
        slope = (predict(model, states, actions) - predict(model, *lower)) / (2 * step)
        np.testing.assert_allclose(jacobian, slope.T, rtol=1e-5, atol=1e-6)


def test_the_compiled_step_is_the_process(model, shown):
    """The multiplied-out, padded model against the process in plain NumPy."""
    states, actions = shown[0].observations[:-1], shown[0].actions
    encoding, learned = model.encoding, model.kinematics.learned
    mean, _ = model.process.predict(encoding.encode(states), encoding.encode_actions(actions))
    predicted = model.predict(states, actions) - states
    np.testing.assert_allclose(predicted[:, learned], mean, rtol=1e-7, atol=1e-9)
    for i, j in ((0, 1), (2, 3)):
        a, b = model.kinematics.alpha[i], model.kinematics.beta[i]
        expected = a * states[:, j] + b * predicted[:, j]
        np.testing.assert_allclose(predicted[:, i], expected, rtol=1e-7, atol=1e-12)


def test_the_planner_counts_the_cost_that_is_documented():
    rng = np.random.default_rng(0)
    angles = np.array([False, True, False])
    model = made_up_model(rng, angles, 1)
    cost = StateCost((0.3, 0.1, -0.2), (1.0, 2.0, 0.5), (1.0, np.inf, 0.5))
    planner = Planner(model, cost, horizon=3)
    plan, state = rng.uniform(-1, 1, (1, 3, 1)), np.array([0.1, 2.0, 0.4])
    costs = np.empty(1)
    compiled.rank(model, planner.cost, state, plan, costs, planner._work)
    states = [state]
    for action in plan[0]:
        states.append(predict(model, states[-1][None], action[None])[0])
    assert np.any(np.abs(np.array(states[1:])) > FREE_SHARE * np.array(cost.limits))
    per_step = cost(np.array(states[1:]), angles) * [1.0, 1.0, compiled.FINAL_WEIGHT]
    assert costs[0] == pytest.approx(per_step.sum() + EFFORT * (plan**2).sum())


def linear_model(a, b):
    """s′ = A s + B u as a model without centres that matter."""
    n, m = b.shape
    slopes = np.zeros((1 + m, n, n))
    slopes[0] = a - np.eye(n)
    constant = np.zeros((1 + m, n))
    constant[1:] = b.T
    unused = np.zeros((n, 8))
    return compiled.Model(
        np.zeros(n, bool), np.zeros(n), np.ones(n), np.ones(n), unused, np.zeros(8),
        np.zeros((1 + m, n, 8)), slopes, constant, np.arange(n), np.full(n, -1),
        np.zeros(n), np.zeros(n), np.full(n, -np.inf), np.full(n, np.inf),
    )  # fmt: skip


@pytest.mark.parametrize("m", [1, 2])
def test_planning_in_a_linear_model_reaches_the_cost_of_lqr(m):
    a = np.array([[1.0, 0.1], [0.0, 1.0]])
    b = np.array([[0.0, 0.02], [0.1, 0.05]])[:, :m]
    weights = np.array([1.0, 0.1])
    model = linear_model(a, b)
    cost = StateCost((0.0, 0.0), tuple(weights), (np.inf, np.inf))
    # Long enough that the weight of the last step no longer matters.
    planner = Planner(model, cost, horizon=300)
    value = solve_discrete_are(a, b, np.diag(weights), 2 * EFFORT * np.eye(m))
    start = np.array([0.01, 0.0])
    # V counts the cost of the start too; the planner's sum begins after it.
    best = 0.5 * start @ (value - np.diag(weights)) @ start
    plan = np.zeros((300, m))
    assert planner._optimise(start, plan, 20, 0.0) == pytest.approx(best, rel=1e-6)
    gain = np.linalg.solve(2 * EFFORT * np.eye(m) + b.T @ value @ b, b.T @ value @ a)
    np.testing.assert_allclose(plan[0], -gain @ start, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(planner._gain, gain, rtol=0.05)
    np.testing.assert_allclose(planner(start), plan[0], rtol=0.01, atol=1e-6)


def test_planned_actions_stay_within_the_limits():
    model = linear_model(np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.0], [0.1]]))
    cost = StateCost((0.0, 0.0), (100.0, 0.1), (np.inf, np.inf))
    planner = Planner(model, cost, horizon=50)
    state = np.array([5.0, 0.0])
    assert planner(state) == -1.0
    for _ in range(120):
        action = planner(state)
        assert abs(action[0]) <= 1.0
        state = predict(model, state[None], action[None])[0]
    assert abs(state[0]) < 0.05


def test_an_uncontrollable_model_still_plans():
    model = linear_model(np.array([[1.5]]), np.array([[0.0]]))
    planner = Planner(model, StateCost((0.0,), (1.0,), (np.inf,)), horizon=20)
    assert np.all(planner._gain == 0.0)
    assert np.isfinite(planner(np.array([1.0]))).all()


# Learner


def test_the_planner_is_deterministic(policy, cartpole):
    runs = [
        rollout(cartpole.__class__(duration=1.0), policy, seed=3, demonstrator="") for _ in "ab"
    ]
    np.testing.assert_array_equal(runs[0].actions, runs[1].actions)
    assert np.ptp(runs[0].actions) > 0


def test_restored_policies_act_the_same(policy, cartpole):
    task = Task.of(cartpole)
    restored = Dynamics.restore(task, policy.arrays())
    for p in (policy, restored):
        p.reset()
    rng = np.random.default_rng(0)
    for observation in 0.1 * rng.normal(size=(12, 4)):
        np.testing.assert_array_equal(policy(observation), restored(observation))


@pytest.mark.parametrize("seed", range(3))
def test_the_first_trial_balances(seed):
    system = make_system("cartpole", duration=10.0)
    run = learn(system, demonstrate(system, "noisy", n=4, seed=seed), "dynamics", seed=seed)
    assert run.trials_to_success == 1
    assert np.abs(run.trials[0].column("theta")[-250:]).max() < 0.05


def test_a_run_is_loaded_with_the_same_policy(tmp_path):
    short = make_system("cartpole", duration=0.5)
    run = learn(short, demonstrate(short, "noisy", n=4, gain=-30.0), "dynamics", out=tmp_path / "r")
    loaded = load_run(tmp_path / "r")
    for p in (run.policy, loaded.policy):
        p.reset()
    for observation in run.trials[0].observations[:5]:
        np.testing.assert_array_equal(run.policy(observation), loaded.policy(observation))


def test_a_policy_depends_on_the_state_alone(cartpole, shown):
    task = Task.of(cartpole, ["theta", "theta_dot"])
    policy = Dynamics().policy(task, Evidence(tuple(shown), ()), np.random.default_rng(0))
    actions = []
    for x in (0.0, 3.0):
        policy.reset()
        actions.append(policy(np.array([x, -x, 0.1, 0.0])))
    np.testing.assert_array_equal(*actions)
    short = make_system("cartpole", duration=5.0)
    assert rollout(short, policy, seed=0, demonstrator="").outcome is Outcome.SUCCESS


@pytest.mark.parametrize("seed", range(3))
def test_a_pendulum_seen_as_cosine_and_sine_swings_up(seed):
    system = make_system("gym:Pendulum-v1")
    run = learn(system, demonstrate(system, "random", n=4, seed=seed), "dynamics", seed=seed)
    assert run.trials_to_success == 1
    np.testing.assert_array_equal(run.policy.known.circles.pairs, [[0], [1]])
    restored = Dynamics.restore(Task.of(system), run.policy.arrays())
    for p in (run.policy, restored):
        p.reset()
    for observation in run.trials[0].observations[:5]:
        np.testing.assert_array_equal(run.policy(observation), restored(observation))


def test_a_failed_trial_is_learned_from_at_its_start_only(cartpole, shown):
    learner, task = Dynamics(trial_seconds=0.5, centres=10), Task.of(cartpole)
    failed = demonstrate(make_system("cartpole", stop_at_fall=False), "weak", n=1)[0].cut(60)
    trials = {
        "whole": failed,
        "cut": failed.cut(25),
        "success": replace(failed, outcome=Outcome.SUCCESS, failure_step=None),
    }
    constants = {}
    for name, trial in trials.items():
        evidence = Evidence((shown[0],), (trial,))
        arrays = learner.policy(task, evidence, np.random.default_rng(0)).arrays()
        constants[name] = arrays["model_constant"]
    np.testing.assert_array_equal(constants["whole"], constants["cut"])
    assert np.any(constants["whole"] != constants["success"])


def test_a_cost_is_needed(refused, cartpole, shown):
    task = replace(Task.of(cartpole), cost=None)
    with refused("learning the dynamics needs a cost as a function"):
        Dynamics().policy(task, Evidence(tuple(shown), ()), np.random.default_rng(0))


def test_a_cost_of_other_columns_is_refused(refused, cartpole, shown):
    task = replace(Task.of(cartpole), cost=StateCost((0.0,), (1.0,), (1.0,)))
    with refused("1 goals, 1 weights and 1 limits, but the system observes 4"):
        Dynamics().policy(task, Evidence(tuple(shown), ()), np.random.default_rng(0))


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("model_centres", lambda a: a[:, 1:], "forward model's centres has shape"),
        ("model_constant", lambda a: a[:1], "forward model's local has shape"),
        ("model_source", lambda a: a + 100, "each integral needs a learned source"),
        ("goal", lambda a: a[1:], "a cost has one goal, weight and limit for each column"),
        ("circles", lambda a: np.array([[0], [4]]), "two rows of distinct columns, from 0 to 3"),
        ("circles", lambda a: np.array([[1], [1]]), "two rows of distinct columns, from 0 to 3"),
        ("settings", lambda a: a * [0, 1], "horizon is 0 steps"),
        ("settings", lambda a: a * np.inf, r"horizon and seed are \[inf, inf\]"),
    ],
)
def test_damaged_policies_are_refused(refused, policy, cartpole, name, change, message):
    arrays = policy.arrays()
    arrays[name] = change(arrays[name])
    with refused(message):
        Dynamics.restore(Task.of(cartpole), arrays)


def test_parameters_are_checked(refused):
    with refused("learner dynamics: horizon is 1 control periods"):
        Dynamics(horizon=1)
