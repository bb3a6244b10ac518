import math

import mujoco
import numpy as np
import pytest
from strikes import strike

from misstep.errors import MisstepError
from misstep.systems import FlipUp, FlipUpParameters


@pytest.fixture(scope="module")
def system():
    return FlipUp()


@pytest.mark.parametrize(("start", "rise"), [(0.25, 0.35), (0.45, 0.2), (0.15, 0.6), (0.45, 0.6)])
def test_success_is_a_band_of_speeds(system, start, rise):
    # At the ends of the band, and at some speeds above it, trifles decide.
    for speed in (0.3, 0.5, 0.7, 0.8):
        observations, cost, info = strike(system, speed, start, rise)
        assert (info["failed"], info["success"]) == (True, False)
        assert observations[-1, 2] == pytest.approx(0.0, abs=0.05)  # fallen back
        assert cost == pytest.approx(90.0, abs=3.0)
    successes = 0
    for speed in np.arange(0.95, 1.08, 0.02):
        observations, cost, info = strike(system, speed, start, rise)
        assert info["failed"] != info["success"]
        assert info["success"] == (abs(observations[-1, 2] - math.pi / 2) < math.radians(3.0))
        assert info["success"] == (cost < 3.0)
        successes += info["success"]
    assert successes >= 6
    for speed in (1.42, 1.46, 1.5):
        observations, cost, info = strike(system, speed, start, rise)
        assert (info["failed"], info["success"]) == (True, False)
        assert observations[-1, 2] == pytest.approx(math.pi, abs=0.05)  # tipped over
        assert cost == pytest.approx(90.0, abs=3.0)


def test_band_is_a_fifth_of_the_speeds(system):
    speeds = np.arange(0.005, 1.5, 0.01)
    stands = np.array([strike(system, speed)[2]["success"] for speed in speeds])
    assert 0.16 < np.mean(stands) < 0.26
    assert np.mean(stands[(speeds > 0.95) & (speeds < 1.1)]) > 0.9
    assert not stands[speeds < 0.8].any()
    # Up to here, in a ragged patch above the band, the block can rock back from its far edge.
    assert not stands[speeds > 1.42].any()


def test_a_lasting_stand_is_what_counts():
    # The block stands for a while only where it stands for good.
    brief, long = FlipUp(upright_time=0.2), FlipUp(upright_time=2.0)
    for speed in (0.7, 1.04, 1.46):
        assert strike(brief, speed)[2] == strike(long, speed)[2]


def test_block_stays_where_it_is_until_it_is_struck(system):
    observation, _ = system.reset(seed=0)
    for _ in range(5):
        observation, *_ = system.step(np.array([0.0101]))  # 0.25 mm of the gap's 1 mm
    np.testing.assert_allclose(observation[2:], [0.0, 0.0, -0.018, 0.03], atol=5e-4)


def test_nothing_penetrates_and_no_energy_appears(system):
    for speed in (0.7, 1.04, 1.5):
        heights, deepest = [], 0.0
        system.reset(seed=0)
        over = False
        while not over:
            _, _, over, _, _ = system.step(np.array([speed]))
            if not over:
                contacts = system.data.contact.dist[: system.data.ncon]
                deepest = min(deepest, float(np.min(contacts, initial=0.0)))
                heights.append(system.data.body("block").xpos[2])
        assert deepest > -0.003
        # The block is never faster than twice the effector at its struck end, nor thrown up.
        assert max(heights) < 0.03 + system.stroke + speed**2 / (2 * 9.81)
        assert abs(system.data.qvel).max() < 1e-2  # at rest at the verdict
        assert abs(system.data.body("block").xpos[1]) == 0.0


def test_servo_follows_the_command(system):
    system.reset(seed=0)
    observations = [system.step(np.array([0.2]))[0] for _ in range(30)]
    velocity = np.array(observations)[10:, 1]
    np.testing.assert_allclose(velocity, 0.2, atol=0.02)
    np.testing.assert_allclose(np.diff(np.array(observations)[10:, 0]), 0.2 * system.dt, rtol=0.1)


def test_stroke_ends_at_its_length_when_stopped_or_when_its_time_is_over():
    observations, _, _ = strike(FlipUp(), 1.0)
    assert np.all(np.diff(observations[:-1, 0]) >= 0.0)
    assert np.all(observations[:-1, 0] < 0.05)
    assert observations[-1, 0] == pytest.approx(0.0, abs=2e-3)  # retracted
    stopped = FlipUp()
    stopped.reset(seed=0)
    assert not stopped.step(np.array([1.0]))[2]
    assert stopped.step(np.array([0.009]))[2]
    slow = FlipUp(longest_stroke=0.1)
    slow.reset(seed=0)
    assert [slow.step(np.array([0.1]))[2] for _ in range(20)] == [False] * 19 + [True]
    with pytest.raises(MisstepError, match=r"flipup: no episode is running; call reset\(\)"):
        slow.step(np.array([0.1]))


def test_a_verdict_that_takes_too_long_is_a_failure():
    _, _, info = strike(FlipUp(longest_wait=0.5, upright_time=0.45), 1.04)
    assert info == {"failed": True, "success": False}


def test_starts_are_distributed_as_said():
    system = FlipUp(start_spread=0.001)
    system.reset(seed=0)
    places = np.array([system.reset()[0][4] for _ in range(500)]) + 0.018
    assert np.mean(places) == pytest.approx(0.0, abs=4 * 0.001 / math.sqrt(500))
    assert np.std(places) == pytest.approx(0.001, rel=0.2)
    assert np.abs(places).max() <= 0.002 + 1e-12


def test_model_has_the_dimensions_and_masses_asked_for():
    system = FlipUp(block_length=0.2, block_mass=0.5, overhang=0.06, effector_offset=0.05)
    system.reset(seed=0)
    mujoco.mj_forward(system.model, system.data)
    assert system.model.body("block").mass[0] == pytest.approx(0.5)
    right_end = system.data.geom("block").xpos[0] + system.model.geom("block").size[0]
    assert right_end == pytest.approx(0.06)
    assert system.data.body("effector").xpos[0] == pytest.approx(0.05)
    # Pushed with the reaction of table and gravity alone, the block weighs what it should.
    for _ in range(400):
        mujoco.mj_step(system.model, system.data)
    force = np.zeros(6)
    total = 0.0
    for i in range(system.data.ncon):
        mujoco.mj_contactForce(system.model, system.data, i, force)
        total += force[0]
    assert total == pytest.approx(0.5 * 9.81, rel=1e-3)


@pytest.mark.parametrize(
    ("parameters", "line"),
    [
        ({"mass": 1.0}, r"flipup has no parameter 'mass'; it has: v_max \[m/s\], stop_speed"),
        ({"overhang": 0.06}, "overhang is 0.06 m, but must be below half of block_length, 0.06 m"),
        ({"effector_offset": 0.05}, "effector_offset is 0.05 m, but must lie between"),
        ({"effector_offset": 0.005}, "effector_offset is 0.005 m, but must lie between"),
        ({"upright_time": 3}, "upright_time is 3 s, but must be below longest_wait, 3 s"),
        ({"stop_speed": 2}, "stop_speed is 2 m/s but must be below v_max, 1.5 m/s"),
        ({"block_mass": 0}, "block_mass is 0 kg but must be greater than 0 kg"),
        ({"render_mode": "human"}, "render_mode is 'human'; there is: 'rgb_array'"),
    ],
)
def test_wrong_parameters_are_told_in_one_line(refused, parameters, line):
    with refused(line):
        FlipUp(**parameters)


def test_defaults_are_the_parameters_of_the_dataclass():
    assert FlipUpParameters().v_max == FlipUp().action_space.high[0] == 1.5
