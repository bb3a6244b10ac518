"""The baselines and searches: random-linear, hill-climbing, cma-es, power, and between failures."""

from dataclasses import replace

import numpy as np
import pytest

from misstep import demonstrate, learn, make_system
from misstep.errors import MisstepError
from misstep.learners import LEARNERS, Evidence, Task
from misstep.learners.linear import LinearPolicy, LinearSpace, time_lasted
from misstep.learners.search import excess_cost, worst_cost
from misstep.trajectory import Column, Outcome, Provenance, Trajectory

STATE = ("theta", "theta_dot")
BETWEEN = ["balanced-mean", "widest-gap", "random-scaling"]
SEARCHES = ["random-linear", "hill-climbing", "cma-es", "power"]


@pytest.fixture(scope="module")
def system():
    return make_system("cartpole")


@pytest.fixture(scope="module")
def shown(system):
    return demonstrate(system, "noisy", seed=5)


@pytest.fixture(scope="module")
def space(system, shown):
    return LinearSpace(Task.of(system, STATE), list(shown))


def test_vectors_and_policies_are_two_names_for_the_same(space):
    vector = np.random.default_rng(0).normal(size=3)
    np.testing.assert_allclose(space.vector(space.policy(vector)), vector, rtol=1e-12)
    # A gain of 1: full force at one standard deviation of that column.
    policy = space.policy(np.array([0.0, 1.0, 0.0]))
    observation = np.array([9.0, 9.0, 0.5 * space.spread[0], 9.0])
    assert policy(observation)[0] == pytest.approx(10.0)


def test_the_average_is_least_squares_without_its_bias(space, shown):
    states = np.concatenate([t.select(STATE)[:-1] for t in shown])
    forces = np.concatenate([t.actions for t in shown])
    design = np.column_stack([np.ones(len(states)), states])
    expected = np.linalg.solve(design.T @ design, design.T @ forces)[1:, 0]
    policy = space.policy(space.average())
    np.testing.assert_allclose(policy.gain[0], expected, rtol=1e-9)
    assert policy.bias[0] == 0.0


def test_perturbations_have_the_size_that_was_asked_for(space):
    rng = np.random.default_rng(1)
    draws = np.array([space.perturbed(np.ones(3), 0.3, rng) for _ in range(4000)])
    assert np.all(draws[:, 0] == 1.0)
    np.testing.assert_allclose(draws[:, 1:].std(axis=0), 0.3, rtol=0.05)


@pytest.mark.parametrize("learner", SEARCHES)
def test_a_search_balances_within_forty_trials(system, shown, learner):
    run = learn(system, shown, learner, state=STATE, max_trials=40, seed=1)
    assert run.succeeded


@pytest.mark.parametrize("learner", SEARCHES)
def test_a_search_that_is_resumed_goes_on_as_if_it_had_not_stopped(
    system, shown, learner, tmp_path
):
    from misstep import load_run, resume

    settings = {"state": STATE, "max_trials": 14, "seed": 3, "stop_on_success": False}
    whole = learn(system, shown, learner, **settings)
    learn(system, shown, learner, out=tmp_path / "run", **{**settings, "max_trials": 14})
    for path in sorted((tmp_path / "run" / "trials").iterdir())[9:]:
        path.unlink()
    again = resume(load_run(tmp_path / "run"))
    for ours, theirs in zip(whole.trials, again.trials, strict=True):
        np.testing.assert_array_equal(ours.actions, theirs.actions)


def test_hill_climbing_steps_from_the_trial_that_lasted_longest(system, shown, space):
    run = learn(
        system, shown, "hill-climbing", state=STATE, max_trials=6, stop_on_success=False, seed=2
    )
    vectors = [space.vector(p) for p in run.policies]
    for k in range(1, 6):
        best = max(range(k), key=lambda i: time_lasted(run.trials[i]))
        rng = np.random.default_rng(np.random.SeedSequence(2, spawn_key=(k,)).spawn(2)[0])
        np.testing.assert_allclose(
            vectors[k], space.perturbed(vectors[best], 0.5, rng), rtol=1e-9, atol=1e-12
        )


def test_longer_balance_costs_less():
    system = make_system("cartpole")
    trial = demonstrate(system, "weak", n=1, seed=0)[0]
    longer = replace(
        trial,
        observations=np.vstack([trial.observations[:1]] * 50 + [trial.observations]),
        actions=np.vstack([trial.actions[:1]] * 50 + [trial.actions]),
        costs=np.concatenate([np.full(50, trial.costs[0]), trial.costs]),
        failure_step=trial.failure_step + 50,
    )
    worst = worst_cost([trial])
    assert excess_cost(longer, worst) < excess_cost(trial, worst)
    with pytest.raises(MisstepError, match="needs the cost of each step"):
        excess_cost(replace(trial, costs=None), worst)


def test_a_success_costs_less_than_the_falls_it_came_from(system, shown):
    # Also a success that wavers: against its own worst step it would cost more than a fall.
    run = learn(system, shown, "fall", state=STATE, max_trials=5)
    success = run.trials[-1]
    assert success.outcome is Outcome.SUCCESS
    worst = worst_cost(shown)
    assert excess_cost(success, worst) < min(excess_cost(fall, worst) for fall in shown)
    assert worst > success.costs.max()


@pytest.mark.parametrize("learner", ["cma-es", "dynamics-policy"])
def test_a_search_leaves_numpys_own_generator_alone(system, shown, learner):
    settings = {"generations": 2} if learner == "dynamics-policy" else {}
    np.random.seed(5)  # noqa: NPY002
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    learn(system, shown, learner, state=STATE, max_trials=1, **settings)
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002


# Between the failures: the action is a speed along a stroke, s(p) = strength · (1 + p).


def stroke(strength, who="d", outcome=Outcome.FAILURE):
    p = np.linspace(0, 1, 41)
    noise = 0.01 * np.random.default_rng(int(1000 * strength)).normal(size=(40, 1))
    return Trajectory(
        observations=p[:, None],
        actions=strength * (1 + p[:-1, None]) + noise,
        dt=0.005,
        observation_columns=(Column("position", "m"),),
        action_columns=(Column("velocity", "m/s"),),
        provenance=Provenance("stroke", {}, who, None, ""),
        outcome=outcome,
    )


TASK = Task(
    (Column("position", "m"),),
    (Column("velocity", "m/s"),),
    np.array([0.0]),
    np.array([10.0]),
    ("position",),
    0.005,
)


def strength_of(learner, shown, trials=(), seed=0, **parameters):
    policy = LEARNERS[learner](**parameters).policy(
        TASK, Evidence(tuple(shown), tuple(trials)), np.random.default_rng(seed)
    )
    return float(np.mean([policy(np.array([p]))[0] / (1 + p) for p in (0.1, 0.5, 0.9)]))


def test_widest_gap_halves_it_and_goes_on_to_the_next():
    shown = [stroke(s) for s in (1.0, 1.2, 2.4, 2.6)]
    first = strength_of("widest-gap", shown)
    assert first == pytest.approx(1.8, abs=0.05)
    # Of success 0.8 is expected in the gap, most of it in the middle, and 0.2 anywhere.
    grid = np.linspace(1.2, 1.8, 60_001)
    u = (grid - 1.2) / 1.2
    mass = np.cumsum(0.8 * 6 * u * (1 - u) / 1.2 + 0.2 / 1.6)
    halving = grid[np.searchsorted(mass, mass[-1] / 2)]
    assert 1.55 < halving < 1.6
    second = strength_of("widest-gap", shown, [stroke(first)])
    mirrored = 3.6 - halving
    assert min(abs(second - halving), abs(second - mirrored)) < 0.05
    third = strength_of("widest-gap", shown, [stroke(first), stroke(second)])
    assert abs(third - first) == pytest.approx(1.8 - halving, abs=0.05)
    assert (third - first) * (second - first) < 0


def test_widest_gap_makes_do_with_one_demonstration_and_with_equal_ones():
    assert strength_of("widest-gap", [stroke(1.0)]) == pytest.approx(1.0, abs=0.05)
    same = stroke(1.0)
    assert strength_of("widest-gap", [same, same]) == pytest.approx(1.0, abs=0.05)
    assert 1.0 < strength_of("widest-gap", [stroke(1.0)], [stroke(2.0)]) < 2.0


def test_widest_gap_repeats_what_has_succeeded():
    shown = [stroke(s) for s in (1.0, 2.0)]
    success = stroke(1.7, outcome=Outcome.SUCCESS)
    assert strength_of("widest-gap", shown, [success]) == pytest.approx(1.7, abs=0.05)
    assert strength_of("widest-gap", [success]) == pytest.approx(1.7, abs=0.05)


@pytest.mark.parametrize("learner", ["widest-gap", "balanced-mean"])
def test_one_success_with_a_constant_action_is_repeated(learner):
    # A key that is held down: the same velocity all along.
    shown = [stroke(1.0), stroke(2.0)]
    held = stroke(1.0, outcome=Outcome.SUCCESS)
    held = replace(held, actions=np.full_like(held.actions, 0.9))
    policy = LEARNERS[learner]().policy(
        TASK, Evidence((*shown, held), ()), np.random.default_rng(0)
    )
    for position in (0.0, 0.3, 0.9):
        assert policy(np.array([position]))[0] == pytest.approx(0.9, abs=0.02)


@pytest.mark.parametrize("learner", ["donut", "balanced-mean", "widest-gap"])
def test_a_demonstration_that_succeeded_is_repeated_among_failures(learner):
    shown = [stroke(s) for s in (1.0, 1.3, 2.5)]
    success = stroke(1.7, outcome=Outcome.SUCCESS)
    assert abs(strength_of(learner, shown) - 1.7) > 0.05
    assert strength_of(learner, [*shown, success]) == pytest.approx(1.7, abs=0.05)


@pytest.mark.parametrize("learner", BETWEEN)
def test_an_attempt_may_push_against_a_limit_or_stop_at_once(learner):
    # A strike that is told to stop at its first step, and one at full speed all along.
    stopped = stroke(1.0)
    stopped = replace(
        stopped, observations=stopped.observations[:2], actions=stopped.actions[:1] * 0.0
    )
    full = replace(stroke(1.0), actions=np.full((40, 1), 10.0))
    strength = strength_of(learner, [stroke(2.0), stopped, full])
    assert 0.0 <= strength <= 10.0
    if learner == "widest-gap":  # between 2 (1 + p) and 10 at p = 0.1, 0.5, 0.9
        middle = np.mean([0.5 * (2.0 + 10.0 / (1 + p)) for p in (0.1, 0.5, 0.9)])
        assert strength == pytest.approx(middle, abs=0.1)


@pytest.mark.parametrize("learner", BETWEEN)
def test_messages_name_a_learner_as_it_is_registered(refused, learner):
    with refused(f"learner {learner}: max_components is 0 but must be at least 1"):
        LEARNERS[learner](max_components=0)


def test_balanced_mean_gives_every_demonstrator_one_say():
    shown = [stroke(1.0, "a"), stroke(1.1, "a"), stroke(1.2, "a"), stroke(3.1, "b")]
    assert strength_of("balanced-mean", shown) == pytest.approx(2.1, abs=0.05)
    later = [strength_of("balanced-mean", shown, [stroke(2.1)], seed) for seed in range(20)]
    assert np.std(later) > 0.1
    assert min(later) >= 0.95
    assert max(later) <= 3.15


def test_random_scaling_scales_the_mean_after_the_first_trial():
    shown = [stroke(1.0), stroke(2.0)]
    assert strength_of("random-scaling", shown) == pytest.approx(1.5, abs=0.05)
    factors = np.array(
        [strength_of("random-scaling", shown, [stroke(1.5)], s, widest=1.5) for s in range(60)]
    )
    assert np.all((factors >= 0.97) & (factors <= 2.3))
    assert np.std(np.log(factors)) == pytest.approx(np.log(1.5) / np.sqrt(3), rel=0.3)


@pytest.mark.parametrize("learner", BETWEEN)
def test_a_blend_survives_a_file(learner):
    shown = [stroke(s) for s in (1.0, 1.5, 2.5)]
    kind = LEARNERS[learner]
    policy = kind().policy(TASK, Evidence(tuple(shown), ()), np.random.default_rng(0))
    again = kind.restore(TASK, policy.arrays())
    for p in np.linspace(0, 1, 7):
        np.testing.assert_array_equal(again(np.array([p])), policy(np.array([p])))


def test_arrays_that_do_not_fit_are_refused():
    with pytest.raises(MisstepError, match=r"has a bias \(1,\) and a gain \(1, 1\)"):
        LinearPolicy.restore(TASK, {"bias": np.zeros(1), "gain": np.zeros((1, 3))})
    with pytest.raises(MisstepError, match="must be finite"):
        LinearPolicy.restore(TASK, {"bias": np.zeros(1), "gain": np.full((1, 1), np.nan)})
    with pytest.raises(MisstepError, match="at least one finite share"):
        LEARNERS["widest-gap"].restore(TASK, {"shares": np.zeros(0)})
