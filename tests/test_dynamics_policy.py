import numpy as np
import pytest

from misstep import demonstrate, learn, make_system
from misstep.costs import EFFORT, StateCost
from misstep.dynamics import ForwardModel
from misstep.dynamics.imagination import Imagination, search_network
from misstep.learners import DynamicsPolicySearch, Evidence, Task
from misstep.learners.dynamics import learn_dynamics
from misstep.learners.dynamics_policy import starts_and_noise
from misstep.runs import load_run

ANGLES = np.array([False, False, True, False])
LIMIT = np.array([20.0])
COST = StateCost((0.1, 0.0, 0.0, 0.0), (0.5, 0.05, 10.0, 0.1), (0.2, np.inf, np.inf, np.inf))
QUICK = {"generations": 60, "population": 20, "horizon": 100, "units": 4}


@pytest.fixture(scope="module")
def shown(cartpole):
    return demonstrate(cartpole, by="noisy", n=4, seed=0)


@pytest.fixture(scope="module")
def model(shown):
    recordings = [(t.observations, t.actions) for t in shown]
    return ForwardModel.fit(recordings, ANGLES, -LIMIT, LIMIT, np.random.default_rng(0))


def imagination(model, rng, rollouts=2, horizon=30):
    starts = 0.1 * rng.normal(size=(rollouts, 4))
    noise = 0.01 * rng.normal(size=(rollouts, horizon, 4))
    return Imagination(model.compiled(), COST, starts, noise)


@pytest.fixture(scope="module")
def policy(cartpole, shown):
    learner = DynamicsPolicySearch(**QUICK)
    return learner.policy(Task.of(cartpole), Evidence(tuple(shown), ()), np.random.default_rng(0))


def test_the_imagined_cost_is_that_of_the_model_and_the_network_in_numpy(model):
    rng = np.random.default_rng(0)
    tried = imagination(model, rng)
    inner, outer = rng.normal(size=(3, 7, 6)), rng.normal(size=(3, 1, 8))
    expected = np.zeros(3)
    for p in range(3):
        for start, noise in zip(tried.starts, tried.noise, strict=True):
            state = start[None]
            for added in noise:
                z = np.append(model.encoding.encode(state)[0], 1.0)
                u = np.tanh(outer[p] @ np.append(np.tanh(inner[p] @ z), 1.0))
                state = model.predict(state, model.encoding.decode_actions(u)[None]) + added
                expected[p] += COST(state, ANGLES)[0] + EFFORT * (u**2).sum()
    np.testing.assert_allclose(tried.costs(inner, outer), expected / 60, rtol=1e-6)


def test_the_search_finds_what_balances_in_the_model(model):
    tried = imagination(model, np.random.default_rng(1), horizon=100)
    idle = tried.costs(np.zeros((1, 4, 6)), np.zeros((1, 1, 5)))[0]
    inner, outer = search_network(tried, 4, 60, 20, np.random.default_rng(0))
    assert tried.costs(inner[None], outer[None])[0] < 0.1 * idle


def test_the_search_draws_from_its_own_generator_alone(model):
    tried = imagination(model, np.random.default_rng(1))
    found = []
    for seed, of_all in ((0, 1), (0, 2), (3, 1)):
        np.random.seed(of_all)  # noqa: NPY002
        before = np.random.get_state()[1].copy()  # noqa: NPY002
        found.append(search_network(tried, 2, 5, 8, np.random.default_rng(seed))[0])
        np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002
    np.testing.assert_array_equal(found[0], found[1])
    assert np.any(found[0] != found[2])


def test_the_policy_is_the_network(policy):
    rng = np.random.default_rng(0)
    for observation in rng.normal(size=(10, 4)):
        z = np.append(policy.encoding.encode(observation[None])[0], 1.0)
        u = np.tanh(policy.outer @ np.append(np.tanh(policy.inner @ z), 1.0))
        np.testing.assert_allclose(policy(observation), LIMIT * u, rtol=1e-12)
        assert np.abs(policy(1e6 * observation)) <= LIMIT


def test_noise_enters_positions_through_velocities_only(cartpole, shown):
    rng = np.random.default_rng(0)
    learned = learn_dynamics(Task.of(cartpole), Evidence(tuple(shown), ()), rng, 50, 5.0)
    starts, noise = starts_and_noise(learned, 3, 2000, rng)
    assert any(np.array_equal(starts[0], t.observations[0]) for t in shown)
    assert np.all(starts[1:] != starts[0])
    assert np.all(noise[0] == 0.0)
    beta = learned.model.kinematics.beta
    np.testing.assert_allclose(noise[:, :, [0, 2]], beta[[0, 2]] * noise[:, :, [1, 3]])
    states = np.concatenate([t.observations[:-1] for t in shown])
    actions = np.concatenate([t.actions for t in shown])
    typical = np.sqrt(np.median(learned.model.variance(states, actions), axis=0))
    np.testing.assert_allclose(noise[1:].std(axis=(0, 1)), typical, rtol=0.1)


@pytest.mark.parametrize("seed", range(2))
def test_even_a_short_search_balances_in_a_few_trials(tmp_path, seed):
    system = make_system("cartpole", duration=10.0)
    shown = demonstrate(system, "noisy", n=4, seed=seed)
    out = tmp_path / "run"
    run = learn(system, shown, "dynamics-policy", seed=seed, max_trials=3, out=out, **QUICK)
    assert run.trials_to_success is not None
    loaded = load_run(tmp_path / "run")
    for observation in run.trials[-1].observations[:20]:
        np.testing.assert_array_equal(run.policy(observation), loaded.policy(observation))


def test_a_policy_of_cosine_and_sine_acts_on_the_angle():
    system = make_system("gym:Pendulum-v1", duration=5.0)
    shown = demonstrate(system, "random", n=2, seed=0)
    learner = DynamicsPolicySearch(generations=2, population=4, units=2, horizon=10)
    task = Task.of(system)
    policy = learner.policy(task, Evidence(tuple(shown), ()), np.random.default_rng(0))
    np.testing.assert_array_equal(policy.circles.pairs, [[0], [1]])
    restored = learner.restore(task, policy.arrays())
    for observation in shown[0].observations[:5]:
        np.testing.assert_array_equal(policy(observation), restored(observation))
        # Off the circle the direction alone counts.
        far = observation * [2.0, 2.0, 1.0]
        np.testing.assert_allclose(policy(far), policy(observation), rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("inner", lambda a: a[:, 1:], "inner has shape"),
        ("outer", lambda a: a[:, 1:], "outer has shape"),
        ("outer", lambda a: a * np.nan, "finite numbers"),
        ("mean", lambda a: a[1:], "mean has shape"),
        ("scale", lambda a: a * 0, "not all positive"),
        ("angles", lambda a: a[1:], "angles has shape"),
        ("circles", lambda a: np.array([[0.0], [7.0]]), "distinct columns"),
    ],
)
def test_damaged_policies_are_refused(refused, policy, cartpole, name, change, message):
    arrays = policy.arrays()
    arrays[name] = change(arrays[name])
    with refused(message):
        DynamicsPolicySearch.restore(Task.of(cartpole), arrays)


def test_parameters_are_checked(refused):
    with refused("learner dynamics-policy: population is 3"):
        DynamicsPolicySearch(population=3)


def test_networks_share_one_workspace(model):
    """The order of candidates makes no difference: nothing is left over from one to the next."""
    rng = np.random.default_rng(2)
    tried = imagination(model, rng)
    inner, outer = rng.normal(size=(4, 3, 6)), rng.normal(size=(4, 1, 4))
    costs = tried.costs(inner, outer)
    np.testing.assert_array_equal(
        tried.costs(np.ascontiguousarray(inner[::-1]), np.ascontiguousarray(outer[::-1])),
        costs[::-1],
    )
