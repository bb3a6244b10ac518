"""Weights by the way travelled: what they must not depend on, and what they must."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from misstep.learners import DonutLearner, Evidence, Mean, Task
from misstep.learners.spacing import path_weights
from misstep.trajectory import Column, Outcome, Provenance, Trajectory

ANGLE, PLACE, SPEED = Column("theta", "rad"), Column("position", "m"), Column("velocity", "m/s")


def attempt(states, actions, columns=(PLACE,)):
    """Record an attempt; the observation after the last action is far off, as after a strike."""
    states = np.asarray(states, dtype=np.float64).reshape(len(actions), -1)
    return Trajectory(
        observations=np.concatenate([states, states[-1:] + 100.0]),
        actions=np.asarray(actions, dtype=np.float64).reshape(-1, 1),
        dt=0.01,
        observation_columns=columns,
        action_columns=(SPEED,),
        provenance=Provenance("test", {}, "test", 0, ""),
        outcome=Outcome.FAILURE,
    )


def task_of(columns=(PLACE,)):
    names = tuple(column.name for column in columns)
    return Task(columns, (SPEED,), np.array([-9.0]), np.array([9.0]), names, 0.01)


def policy_of(learner, attempts):
    return learner.policy(task_of(), Evidence(tuple(attempts), ()), np.random.default_rng(0))


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 80), m=st.integers(2, 80))
def test_the_weight_of_an_attempt_is_its_way_and_not_its_time(seed, n, m):
    rng = np.random.default_rng(seed)
    slow, fast = np.sort(rng.uniform(0.0, 2.0, n)), np.sort(rng.uniform(0.0, 1.0, m))
    attempts = [attempt(slow, slow), attempt(fast, fast)]
    weights = path_weights(task_of(), attempts)
    assert weights.shape == (n + m,)
    # By hand, for one column: half the gaps on either side, ends with the whole of their one.
    ways = []
    for states in (slow, fast):
        padded = np.concatenate(
            [[2 * states[0] - states[1]], states, [2 * states[-1] - states[-2]]]
        )
        ways.append((padded[2:] - padded[:-2]) / 2)
    expected = np.concatenate(ways)
    np.testing.assert_allclose(weights, np.maximum(expected / expected.mean(), 0.01), rtol=1e-9)


def test_lingering_changes_nothing():
    # The same way from 0 to 1, evenly and with nine tenths of the time spent in its first tenth.
    even = np.linspace(0.0, 1.0, 2001)
    lingering = np.concatenate([np.linspace(0.0, 0.1, 1801), np.linspace(0.1, 1.0, 201)[1:]])
    means = {}
    for spacing in ("time", "path"):
        learner = Mean(spacing=spacing, n_components=1)
        means[spacing] = [
            policy_of(learner, [attempt(p, p**2)]).mixture.means_[0] for p in (even, lingering)
        ]
    # Along the path the mean of p is 1/2 and that of p² is 1/3, however long it took.
    for mean in means["path"]:
        np.testing.assert_allclose(mean, [1 / 2, 1 / 3], atol=0.005)
    assert means["time"][1][0] < 0.2


def test_a_slow_strike_outweighs_a_fast_one_in_time_only():
    slow, fast = np.linspace(0.0, 1.0, 300), np.linspace(0.0, 1.0, 30)
    rng = np.random.default_rng(0)
    attempts = [
        attempt(p, level + 0.01 * rng.normal(size=len(p))) for p, level in ((slow, 1), (fast, 5))
    ]
    shares = {}
    for spacing in ("time", "path"):
        mixture = policy_of(DonutLearner(spacing=spacing, n_components=2), attempts).mixture
        shares[spacing] = mixture.weights_[np.argmax(mixture.means_[:, 1])]
    assert shares["time"] == pytest.approx(30 / 330, abs=1e-3)
    assert shares["path"] == pytest.approx(0.5, abs=0.02)


def test_columns_are_in_units_of_their_spread():
    rng = np.random.default_rng(1)
    states = rng.normal(size=(50, 2))
    columns = (PLACE, SPEED)
    one = path_weights(task_of(columns), [attempt(states, states[:, 0], columns)])
    other = path_weights(task_of(columns), [attempt(states * [1e3, 1.0], states[:, 0], columns)])
    np.testing.assert_allclose(one, other, rtol=1e-9)


def test_an_angle_goes_the_shorter_way_round():
    turning = np.linspace(0.0, 4 * np.pi, 101)
    wrapped = (turning + np.pi) % (2 * np.pi) - np.pi
    weights = path_weights(task_of((ANGLE,)), [attempt(wrapped, turning, (ANGLE,))])
    np.testing.assert_allclose(weights, 1.0, rtol=1e-9)


def test_an_attempt_that_stands_still_is_known_a_little():
    moving, one_step = attempt(np.linspace(0, 1, 20), np.ones(20)), attempt([0.3], [2.0])
    still = attempt(np.full(10, 0.5), np.zeros(10))
    weights = path_weights(task_of(), [moving, one_step, still])
    np.testing.assert_array_equal(weights[20:], 0.01)
    assert weights[:20].min() > 1.0
    np.testing.assert_array_equal(path_weights(task_of(), [one_step, one_step]), 1.0)
