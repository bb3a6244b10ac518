"""`segments` and `donut-incremental`: what counts as good and bad, and what is done about it."""

from dataclasses import replace

import numpy as np
import pytest

from misstep import demonstrate, learn, make_system
from misstep.errors import MisstepError
from misstep.learners import LEARNERS, DonutIncremental, Evidence, Segments, Task
from misstep.learners.donut_incremental import merits
from misstep.mixture import reference

STATE = ("theta", "theta_dot")


@pytest.fixture(scope="module")
def system():
    return make_system("cartpole")


@pytest.fixture(scope="module")
def shown(system):
    return demonstrate(system, "weak", seed=1)


@pytest.fixture(scope="module")
def evidence(shown):
    return Evidence(tuple(shown), ())


def test_badness_grows_towards_the_failure_and_is_one_there(shown):
    bad = Segments(blame=0.2).badness(shown[0])
    steps = np.arange(shown[0].n_steps)
    expected = np.exp(-(shown[0].failure_step - steps) * 0.02 / 0.2)
    np.testing.assert_allclose(bad, expected, rtol=1e-12)
    unfailed = replace(shown[0], failure_step=None)
    assert not Segments().badness(unfailed).any()
    early = replace(shown[0], failure_step=3)
    assert np.all(Segments().badness(early)[3:] == 1.0)


def test_segments_picks_the_best_of_its_grid(system, evidence):
    task = Task.of(system, STATE)
    policy = Segments(n_components=2).policy(task, evidence, np.random.default_rng(0))
    grid = np.linspace(-20, 20, 81)[:, None]
    for state in np.random.default_rng(1).normal(size=(5, 2)) * [0.1, 0.5]:
        action = policy(np.array([0.0, 0.0, *state]))
        bad = policy.bad.mixture
        h, m, S = reference.condition(state, bad.weights_, bad.means_, bad.covariances_)
        disliked = np.log(reference.donut_mixture_density(grid, h, m, S, 1.0, 1.0, 2.0) + 1e-300)
        good = policy.mixture
        h, m, S = reference.condition(state, good.weights_, good.means_, good.covariances_)
        spread = reference.moments(h, m, S)[1][0, 0] / policy.scale[0] ** 2
        epsilon = spread / (1 + spread)
        r = 1 / (1 + epsilon)
        liked = np.log(reference.donut_mixture_density(grid, h, m, S, 1 + epsilon, r, 2 * r))
        score = liked - 0.5 * np.maximum(disliked, disliked.max() - 20.0)
        chosen = int(np.argmin(np.abs(grid[:, 0] - action[0])))
        assert score[chosen] == pytest.approx(score.max(), abs=1e-6)


def test_merits_rank_by_what_followed(shown):
    outlook = 25
    found = merits(list(shown), outlook)
    worst = max(t.costs.max() for t in shown)
    following = []
    for t in shown:
        for step in range(t.n_steps):
            ahead = [t.costs[k] if k < t.n_steps else worst for k in range(step, step + outlook)]
            following.append(np.mean(ahead))
    order = np.argsort(following)
    assert np.all(np.diff(found[order]) <= 1e-12)
    assert found.max() == 1.0
    assert found.min() > 0.0
    with pytest.raises(MisstepError, match="needs the cost of each step"):
        merits([replace(shown[0], costs=None)], outlook)


def test_costs_that_tell_nothing_are_refused(refused, system, shown):
    alike = tuple(replace(t, costs=np.ones(t.n_steps)) for t in shown)
    with refused("all steps of all attempts cost the same"):
        DonutIncremental().policy(
            Task.of(system, STATE), Evidence(alike, ()), np.random.default_rng(0)
        )


def test_what_was_kept_is_explored_less(system, evidence):
    task = Task.of(system, STATE)
    policy = DonutIncremental().policy(task, evidence, np.random.default_rng(0))
    upright, falling = np.zeros(4), np.array([0.0, 0.0, 0.5, 2.0])
    merit = [policy._merit.at(policy.state_of(o)).mean[0] for o in (upright, falling)]
    assert merit[0] > merit[1]


@pytest.mark.parametrize("learner", ["segments", "donut-incremental"])
def test_policies_survive_a_file_and_stay_inside_the_limits(system, evidence, learner):
    task = Task.of(system, STATE)
    kind = LEARNERS[learner]
    policy = kind().policy(task, evidence, np.random.default_rng(0))
    again = kind.restore(task, policy.arrays())
    for observation in np.random.default_rng(2).normal(size=(20, 4)) * [1, 1, 2, 20]:
        action = policy(observation)
        np.testing.assert_array_equal(again(observation), action)
        assert np.isfinite(action).all()
        assert abs(action[0]) <= 20.0


def test_segments_finds_a_balance_from_weak_demonstrations(system, shown):
    run = learn(system, shown, "segments", state=STATE, max_trials=20, seed=1)
    assert run.succeeded


def test_segments_needs_a_failure_time(system, evidence):
    untimed = tuple(replace(t, failure_step=None) for t in evidence.demonstrations)
    with pytest.raises(MisstepError, match="segments needs the time of at least one failure"):
        Segments().policy(Task.of(system, STATE), Evidence(untimed, ()), np.random.default_rng(0))


@pytest.mark.parametrize(
    ("learner", "change", "message"),
    [
        ("segments", {"scale": np.zeros(1)}, "scale must be 1 positive numbers"),
        ("segments", {"repulsion": np.array(np.nan)}, "repulsion is nan"),
        ("donut-incremental", {"scale": np.ones(2)}, "scale must be 1 positive numbers"),
        (
            "donut-incremental",
            {"merit_means": np.zeros((1, 4)), "merit_covariances": np.eye(4)[None]},
            "merit has 4 columns, but the task has 2 of state",
        ),
    ],
)
def test_damaged_policies_are_refused(refused, system, learner, change, message):
    arrays = {"weights": np.ones(1), "means": np.zeros((1, 3)), "covariances": np.eye(3)[None]}
    second = "bad_{}" if learner == "segments" else "merit_{}"
    arrays |= {second.format(name): values for name, values in arrays.items()}
    arrays |= {"scale": np.ones(1), "repulsion": np.array(0.5)}
    task = Task.of(system, STATE)
    LEARNERS[learner].restore(task, arrays)
    with refused(message):
        LEARNERS[learner].restore(task, arrays | change)
