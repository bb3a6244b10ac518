import math

import numpy as np
import pytest

from misstep.demonstrators import demonstrate, list_demonstrators
from misstep.errors import MisstepError
from misstep.systems import CartPole
from misstep.trajectory import Column, Outcome

KINDS = ["bang-bang", "delayed", "noisy", "random", "reversed", "weak"]


@pytest.fixture
def system():
    return CartPole()


@pytest.mark.parametrize("kind", KINDS)
def test_every_demonstration_failed(system, kind):
    demonstrations = demonstrate(system, kind, n=5, seed=1)
    assert len(demonstrations) == 5
    for trajectory in demonstrations:
        assert trajectory.outcome is Outcome.FAILURE
        assert trajectory.failure_step == trajectory.n_steps
        assert abs(trajectory.column("theta")[-1]) > math.radians(30)
        assert np.abs(trajectory.actions).max() <= 20.0
        assert trajectory.provenance.demonstrator == kind


def test_all_kinds_are_listed_with_units():
    table = list_demonstrators()
    assert sorted(table) == KINDS
    rows = {row.name: row for row in table["noisy"]}
    assert (rows["gain"].default, rows["gain"].unit) == (20.0, "N/rad")
    assert (rows["noise"].default, rows["noise"].unit) == (5.0, "N")
    assert all(row.unit and row.meaning for rows in table.values() for row in rows)


@pytest.mark.parametrize("kind", KINDS)
def test_attempts_of_a_seed_do_not_depend_on_how_many_are_asked_for(system, kind):
    two = demonstrate(system, kind, n=2, seed=4)
    three = demonstrate(system, kind, n=3, seed=4)
    other = demonstrate(system, kind, n=2, seed=5)
    for short, long in zip(two, three, strict=False):
        np.testing.assert_array_equal(short.observations, long.observations)
        np.testing.assert_array_equal(short.actions, long.actions)
    assert not np.array_equal(two[0].observations[0], other[0].observations[0])
    assert not np.array_equal(two[0].observations[0], two[1].observations[0])


@pytest.mark.parametrize(("kind", "gain"), [("noisy", 20), ("weak", 10), ("reversed", -10)])
def test_proportional_kinds_push_in_proportion(kind, gain):
    # What is left of the force without gain · theta is noise, the same for 0.1 s = 5 steps.
    trajectory = demonstrate(CartPole(force_limit=1000.0), kind, n=1, seed=0)[0]
    theta = trajectory.column("theta")[:-1]
    rest = trajectory.actions[:, 0] - gain * theta
    held = rest[: len(rest) // 5 * 5].reshape(-1, 5)
    assert np.std(held[:, 0]) > 0.5
    np.testing.assert_allclose(held, held[:, :1].repeat(5, axis=1), atol=1e-9)


def test_noise_has_its_deviation_and_its_hold():
    system = CartPole(force_limit=1000.0, stop_at_fall=False)
    demonstrations = demonstrate(system, "noisy", n=20, seed=0, noise=3.0, hold=0.2)
    rest = np.concatenate(
        [t.actions[::10, 0] - 20.0 * t.column("theta")[:-1:10] for t in demonstrations]
    )
    assert len(rest) == 20 * 150
    assert np.std(rest) == pytest.approx(3.0, rel=4 / math.sqrt(2 * len(rest)))


def test_delayed_acts_on_the_past():
    trajectory = demonstrate(CartPole(force_limit=1000.0), "delayed", n=1, seed=2, noise=0.0)[0]
    theta, force = trajectory.column("theta"), trajectory.actions[:, 0]
    np.testing.assert_array_equal(force[:5], 0.0)
    np.testing.assert_allclose(force[5:], 20.0 * theta[: len(force) - 5], rtol=1e-12)


def test_random_covers_the_limits_and_holds(system):
    demonstrations = demonstrate(system, "random", n=60, seed=0)
    forces = np.concatenate([t.actions[::5, 0] for t in demonstrations])
    assert forces.min() < -18.0
    assert forces.max() > 18.0
    assert np.std(forces) == pytest.approx(40.0 / math.sqrt(12.0), rel=0.15)
    for trajectory in demonstrations:
        changes = np.flatnonzero(np.diff(trajectory.actions[:, 0])) + 1
        assert np.all(changes % 5 == 0)


def test_bang_bang_reacts_late_to_what_it_saw(system):
    reactions = set()
    for trajectory in demonstrate(system, "bang-bang", n=20, seed=0):
        theta, force = trajectory.column("theta"), trajectory.actions[:, 0]
        pressed = np.where(np.abs(theta) > math.radians(1.0), 10.0 * np.sign(theta), 0.0)
        fits = [
            d
            for d in range(10, 16)
            if np.array_equal(force, np.concatenate([np.zeros(d), pressed])[: len(force)])
        ]
        assert fits
        reactions.update(fits)
    assert len(reactions) > 1


def test_recorded_parameters_of_the_demonstrator(system):
    trajectory = demonstrate(system, "weak", n=1, gain=5)[0]
    assert trajectory.provenance.demonstrator == "weak(gain=5)"


def test_recorded_seed_is_the_systems(system):
    trajectory = demonstrate(system, "noisy", n=1, seed=6)[0]
    start, _ = system.reset(seed=trajectory.provenance.seed)
    np.testing.assert_array_equal(start, trajectory.observations[0])


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ({"by": "clumsy"}, "no demonstrator named 'clumsy'; there are: bang-bang, delayed"),
        ({"n": 0}, "n is 0: at least 1"),
        ({"seed": -1}, "seed is -1: it must not be negative"),
        ({"gian": 3.0}, r"demonstrator noisy has no parameter 'gian'; it has: gain \[N/rad\]"),
        ({"noise": -1.0}, "demonstrator noisy: noise is -1 N but must be at least 0 N"),
        ({"by": "bang-bang", "reaction_min": 0.5}, "reaction_min is 0.5 s, above reaction_max"),
    ],
)
def test_wrong_arguments_are_told_in_one_line(system, arguments, line):
    with pytest.raises(MisstepError, match=line):
        demonstrate(system, **arguments)


def test_who_does_not_fail_is_told():
    short = CartPole(duration=0.1, start_spread=0.0)
    with pytest.raises(MisstepError, match="noisy failed in 0 of 50 attempts, but 1 failures"):
        demonstrate(short, "noisy", n=1, noise=0.0)


@pytest.mark.parametrize("kind", KINDS)
def test_a_system_without_theta_is_told(kind):
    class Headless(CartPole):
        observation_columns = (
            *CartPole.observation_columns[:2],
            Column("phi", "rad"),
            Column("w", ""),
        )

    with pytest.raises(MisstepError, match="it must observe theta and take one action"):
        demonstrate(Headless(), kind)
