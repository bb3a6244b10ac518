import math

import numpy as np
import pytest

from misstep.errors import MisstepError
from misstep.rollout import rollout
from misstep.systems import CartPole
from misstep.trajectory import Outcome


class Linear:
    """A policy force = gains · observation that notes whether it was reset."""

    def __init__(self, *gains):
        self.gains = np.array(gains)
        self.resets = 0

    def reset(self):
        self.resets += 1

    def __call__(self, observation):
        return np.array([self.gains @ observation])


BALANCE = (1.0, 2.5, 40.0, 8.0)


def test_success_lasts_to_the_end():
    policy = Linear(*BALANCE)
    system = CartPole(duration=5.0)
    trajectory = rollout(system, policy, seed=3, demonstrator="test")
    assert policy.resets == 1
    assert trajectory.outcome is Outcome.SUCCESS
    assert trajectory.failure_step is None
    assert trajectory.n_steps == 250
    assert trajectory.dt == system.dt
    assert trajectory.observation_columns == system.observation_columns
    np.testing.assert_allclose(
        trajectory.actions[:, 0], trajectory.observations[:-1] @ np.array(BALANCE)
    )


def test_failure_step_is_the_first_fallen_observation():
    system = CartPole(stop_at_fall=False, duration=5.0)
    trajectory = rollout(system, Linear(0, 0, -5.0, 0), seed=0, demonstrator="test")
    fallen = np.abs(trajectory.column("theta")) > math.radians(30)
    assert trajectory.outcome is Outcome.FAILURE
    assert trajectory.failure_step == fallen.argmax()
    assert trajectory.n_steps == 250


def test_failure_at_the_start_is_step_zero():
    system = CartPole(start_angle=1.0, stop_at_fall=False, duration=1.0)
    assert rollout(system, Linear(0, 0, 0, 0), seed=0, demonstrator="test").failure_step == 0


def test_costs_are_degrees_of_the_state_reached():
    trajectory = rollout(CartPole(), Linear(0, 0, 10.0, 0), seed=1, demonstrator="test")
    np.testing.assert_allclose(
        trajectory.costs, np.degrees(np.abs(trajectory.column("theta")[1:])), rtol=1e-12
    )


def test_actions_are_recorded_as_clipped():
    system = CartPole(force_limit=2.0)
    trajectory = rollout(system, Linear(0, 0, 1e4, 0), seed=1, demonstrator="test")
    wished = 1e4 * trajectory.column("theta")[:-1, None]
    assert np.abs(wished).max() > 2.0
    np.testing.assert_array_equal(trajectory.actions, np.clip(wished, -2.0, 2.0))


def test_replaying_the_actions_gives_the_observations():
    system = CartPole(delay=0.04)
    trajectory = rollout(system, Linear(0, 0, 20.0, 0), seed=5, demonstrator="test")
    replay = CartPole(**trajectory.provenance.parameters)
    replay.set_state(*trajectory.observations[0])
    observations = [replay.step(action)[0] for action in trajectory.actions]
    np.testing.assert_array_equal(observations, trajectory.observations[1:])


def test_provenance_says_what_is_needed_to_repeat():
    system = CartPole(pole_mass=0.2)
    first, again = (
        rollout(
            system, Linear(0, 0, 20.0, 0), seed=9, demonstrator="me", time="2026-01-01T00:00:00"
        )
        for _ in range(2)
    )
    np.testing.assert_array_equal(first.observations, again.observations)
    assert first.provenance == again.provenance
    assert first.provenance.system == "cartpole"
    assert dict(first.provenance.parameters) == system.parameters
    assert (first.provenance.demonstrator, first.provenance.seed) == ("me", 9)
    assert first.provenance.time == "2026-01-01T00:00:00"


@pytest.mark.parametrize(
    ("action", "line"),
    [
        ([math.nan], "action at step 0 is .*: it must be finite"),
        ([1.0, 2.0], r"action at step 0 has shape \(2,\) but cartpole takes \(1,\)"),
    ],
)
def test_wrong_actions_are_told(action, line):
    class Wrong(Linear):
        def __call__(self, observation):
            return np.array(action)

    with pytest.raises(MisstepError, match=line):
        rollout(CartPole(), Wrong(), seed=0, demonstrator="test")
