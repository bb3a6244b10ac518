import math
from dataclasses import dataclass

import numpy as np
import pytest

from misstep.demonstrators import DEMONSTRATORS, demonstrate, list_demonstrators
from misstep.errors import MisstepError
from misstep.parameters import parameter
from misstep.systems import CartPole, make_system
from misstep.trajectory import Column, Outcome

KINDS = ["bang-bang", "delayed", "noisy", "random", "reversed", "weak"]
STRIKING = ["bracket", "lopsided", "strong", "timid"]


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
    assert sorted(table) == sorted(KINDS + STRIKING)
    rows = {row.name: row for row in table["noisy"]}
    assert (rows["gain"].default, rows["gain"].unit) == (20.0, "N/rad")
    assert (rows["noise"].default, rows["noise"].unit) == (5.0, "N")
    assert all(row.meaning for rows in table.values() for row in rows)
    unitless = {row.name for rows in table.values() for row in rows if not row.unit}
    assert unitless == {"far_every"}


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


def test_parameters_of_any_type_are_recorded(system, monkeypatch):
    @dataclass(frozen=True)
    class Still:
        """Does nothing, in a manner of its own; as a third party may write it."""

        needs = "nothing"
        manner: str = parameter("calm", "", "how it stands by")
        count: int = parameter(1, "", "of nothing")

        @classmethod
        def fits(cls, system):
            return True

        def policy(self, system, rng, attempt):
            return Standing()

    class Standing:
        def reset(self):
            pass

        def __call__(self, observation):
            return np.zeros(1)

    monkeypatch.setitem(DEMONSTRATORS._own, "still", Still)
    trajectory = demonstrate(system, "still", n=1, manner="tense", count=3)[0]
    assert trajectory.provenance.demonstrator == "still(manner=tense, count=3)"


def test_recorded_seed_is_the_systems(system):
    trajectory = demonstrate(system, "noisy", n=1, seed=6)[0]
    start, _ = system.reset(seed=trajectory.provenance.seed)
    np.testing.assert_array_equal(start, trajectory.observations[0])


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (
            {"by": "clumsy"},
            "no demonstrator named 'clumsy'; there are: bang-bang, bracket, delayed",
        ),
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


@pytest.fixture(scope="module", params=["flipup", "basket"])
def struck(request):
    return make_system(request.param)


def sides(demonstrations):
    """Return for each attempt -1 if its outcome is that of too little, 1 of too much."""
    sides = []
    for trajectory in demonstrations:
        assert trajectory.outcome is Outcome.FAILURE
        assert trajectory.failure_step == trajectory.n_steps
        if trajectory.provenance.system == "flipup":
            angle = trajectory.column("block_angle")[-1]
            assert min(abs(angle), abs(angle - math.pi)) < 0.5
            sides.append(-1 if angle < math.pi / 2 else 1)
        else:
            ball_x = trajectory.column("ball_x")[-1]
            assert not 0.7 < ball_x < 0.9
            sides.append(-1 if ball_x < 0.8 else 1)
    return sides


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("timid", [-1] * 12),
        ("strong", [1] * 12),
        ("bracket", [-1, 1] * 6),
        ("lopsided", [-1, -1, -1, 1] * 3),
    ],
)
def test_strikes_fail_in_the_way_their_name_says(struck, kind, expected):
    demonstrations = demonstrate(struck, kind, n=12, seed=0)
    assert sides(demonstrations) == expected
    for trajectory in demonstrations:
        position, actions = trajectory.column("position"), trajectory.actions
        assert np.all(np.diff(position[:-1]) >= 0.0)
        assert np.all(position[:-1] < struck.stroke)
        assert np.all(actions > struck.parameters["stop_speed"])
        assert np.all(actions <= struck.parameters["v_max"])
        assert trajectory.provenance.demonstrator == kind


def test_strikes_follow_a_rising_profile_of_the_position(struck):
    for trajectory in demonstrate(struck, "timid", n=5, seed=1, slowest=0.4, fastest=0.4):
        share = trajectory.column("position")[:-1] / struck.stroke
        velocity = trajectory.actions[:, 0] / struck.parameters["v_max"]
        assert 0.15 * 0.4 * 0.75 < velocity[0] < 0.45 * 0.4 * 1.25  # within 4 tremors
        plateau = velocity[share > 0.6]
        assert np.mean(plateau) == pytest.approx(0.4, rel=4 * 0.06 / math.sqrt(len(plateau)))


def test_the_halves_of_a_bracket_are_equally_far_from_its_centre(struck):
    demonstrations = demonstrate(struck, "bracket", n=40, seed=2)
    tops = np.array([t.actions[-3:].mean() for t in demonstrations]) / struck.parameters["v_max"]
    slow, fast = tops[::2], tops[1::2]
    # Tremor averages out but where it is clipped, at 1: that costs less than a hundredth.
    assert np.mean(slow) + np.mean(fast) == pytest.approx(2 * 0.66, abs=0.03)
    assert np.all(slow < 0.45)
    assert np.all(fast > 0.85)


@pytest.mark.parametrize("kind", STRIKING)
def test_same_seed_same_strikes(struck, kind):
    two, three = (demonstrate(struck, kind, n=n, seed=4) for n in (2, 3))
    for short, long in zip(two, three, strict=False):
        np.testing.assert_array_equal(short.observations, long.observations)
        np.testing.assert_array_equal(short.actions, long.actions)
    assert not np.array_equal(two[0].actions, two[1].actions)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ({"by": "noisy"}, "noisy does not fit flipup: it must observe theta and take one action; "),
        ({"by": "noisy"}, "these kinds fit: bracket, lopsided, random, strong, timid$"),
        ({"by": "timid", "fastest": 0.1}, "timid: slowest is 0.2 v_max, above fastest, 0.1 v_max"),
        ({"by": "strong", "fastest": 1.1}, "strong: fastest is 1.1 v_max but must be at most 1"),
        ({"by": "bracket", "nearest": 0.5}, "nearest is 0.5 v_max, above farthest, 0.34 v_max"),
        ({"by": "bracket", "centre": 0.8}, r"farthest is 0.34 v_max, but centre, 0\.8 v_max, must"),
        ({"by": "lopsided", "far_every": 0}, "far_every is 0 but must be at least 1"),
        ({"by": "timid", "n": 1, "slowest": 0.66, "fastest": 0.66}, "timid failed in 0 of 50"),
    ],
)
def test_wrong_strikes_are_told_in_one_line(arguments, line):
    with pytest.raises(MisstepError, match=line):
        demonstrate(make_system("flipup"), **arguments)


def test_strikes_do_not_fit_a_pole(system):
    with pytest.raises(MisstepError, match=r"an effector .*; these kinds fit: bang-bang, delayed"):
        demonstrate(system, "timid")


@pytest.mark.parametrize("kind", sorted({*KINDS} - {"random"}))
def test_a_system_without_theta_is_told(kind):
    class Headless(CartPole):
        observation_columns = (
            *CartPole.observation_columns[:2],
            Column("phi", "rad"),
            Column("w", ""),
        )

    with pytest.raises(MisstepError, match="it must observe theta and take one action"):
        demonstrate(Headless(), kind)
