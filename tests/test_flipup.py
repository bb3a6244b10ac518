import math

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from misstep.errors import MisstepError
from misstep.systems import FlipUp, FlipUpParameters, list_systems, make_system


def strike(system, speed, start=0.25, rise=0.35, seed=0):
    """Strike with a smoothly rising velocity; return the observations, the cost and the info."""
    observation, info = system.reset(seed=seed)
    observations, over = [observation], False
    while not over:
        assert not info["failed"]
        assert not info["success"]
        u = np.clip(observation[0] / (rise * system.stroke), 0.0, 1.0)
        velocity = speed * (start + (1.0 - start) * u * u * (3.0 - 2.0 * u))
        observation, reward, over, truncated, info = system.step(np.array([velocity]))
        assert not truncated
        observations.append(observation)
    return np.array(observations), -reward, info


@pytest.fixture(scope="module")
def system():
    return FlipUp()


# Gymnasium prefers normalised actions and bounded observations; here both are physical quantities.
@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space")
@pytest.mark.filterwarnings("ignore:.*A Box observation space (min|max)imum value is -?infinity")
@pytest.mark.parametrize("render_mode", [None, "rgb_array"])
def test_passes_gymnasium_checks(render_mode):
    env = gymnasium.make("misstep/FlipUp-v1", render_mode=render_mode, block_mass=0.25)
    check_env(env.unwrapped, skip_render_check=render_mode is None)
    assert env.unwrapped.parameters["block_mass"] == 0.25
    env.close()


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


def test_actions_are_clipped_to_the_speed_limit(system):
    np.testing.assert_array_equal(
        strike(system, 1e3, start=1.0)[0], strike(system, 1.5, start=1.0)[0]
    )


def test_same_seed_same_strike_other_seed_another():
    def episode(seed):
        return strike(FlipUp(start_spread=0.002), 1.0, seed=seed)[0]

    np.testing.assert_array_equal(episode(7), episode(7))
    assert not np.array_equal(episode(7), episode(8))
    np.testing.assert_array_equal(
        strike(FlipUp(), 1.0, seed=7)[0], strike(FlipUp(), 1.0, seed=8)[0]
    )


def test_an_episode_leaves_nothing_behind(system):
    first = strike(system, 1.04)[0]
    strike(system, 1.5)
    np.testing.assert_array_equal(strike(system, 1.04)[0], first)


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


def test_parameters_rebuild_the_system():
    first = FlipUp(block_mass=0.3, start_spread=0.001, v_max=2)
    again = make_system("flipup", **first.parameters)
    assert again.parameters == first.parameters
    np.testing.assert_array_equal(strike(first, 1.0)[0], strike(again, 1.0)[0])


def test_lists_every_parameter_with_unit_and_documents_it():
    rows = list_systems()["flipup"]
    assert {row.name: row.default for row in rows} == FlipUp().parameters
    for row in rows:
        line = next(line for line in FlipUp.__doc__.splitlines() if f"``{row.name}``  " in line)
        assert line.split()[1] == str(row.default)
        assert row.unit in line
        assert row.meaning


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


@pytest.mark.parametrize(
    ("action", "line"),
    [
        (np.array([math.nan]), "nan m/s, which is not a finite velocity"),
        (np.zeros(2), r"has shape \(2,\) but one velocity in m/s, shape \(1,\)"),
    ],
)
def test_wrong_actions_are_told(refused, system, action, line):
    system.reset(seed=0)
    with refused(line):
        system.step(action)


def test_defaults_are_the_parameters_of_the_dataclass():
    assert FlipUpParameters().v_max == FlipUp().action_space.high[0] == 1.5
