import math

import mujoco
import numpy as np
import pytest
from strikes import strike

from misstep.systems import Basket


@pytest.fixture(scope="module")
def system():
    return Basket()


@pytest.mark.parametrize(("start", "rise"), [(0.25, 0.35), (0.45, 0.2), (0.15, 0.6), (0.45, 0.6)])
def test_success_is_a_band_of_speeds(system, start, rise):
    for speed in (0.5, 0.8, 1.0, 1.1):
        observations, cost, info = strike(system, speed, start, rise)
        assert (info["failed"], info["success"]) == (True, False)
        assert observations[-1, 3] < 0.7  # short
        assert cost == pytest.approx(0.8 - observations[-1, 3])
    successes = 0
    for speed in np.arange(1.22, 1.33, 0.02):
        observations, cost, info = strike(system, speed, start, rise)
        assert info["failed"] != info["success"]
        assert info["success"] == (abs(observations[-1, 3] - 0.8) < 0.1)
        assert cost == pytest.approx(abs(observations[-1, 3] - 0.8))
        successes += info["success"]
    assert successes >= 5
    for speed in (1.45, 1.7, 2.0):
        observations, cost, info = strike(system, speed, start, rise)
        assert (info["failed"], info["success"]) == (True, False)
        assert observations[-1, 3] > 0.9  # past
        assert cost == pytest.approx(observations[-1, 3] - 0.8)


def test_band_lies_where_it_is_said(system):
    speeds = np.arange(1.0, 1.6, 0.01)
    lands = np.array([strike(system, speed)[2]["success"] for speed in speeds])
    band = (speeds > 1.205) & (speeds < 1.355)
    assert np.mean(lands[band]) > 0.9
    assert np.mean(lands[~band]) < 0.1
    assert not lands[(speeds < 1.12) | (speeds > 1.42)].any()


def test_faster_throws_land_farther(system):
    speeds = np.array([0.9, 1.1, 1.4, 1.6, 1.8, 2.0])
    landings = [strike(system, speed)[0][-1, 3] for speed in speeds]
    assert np.all(np.diff(landings) > 0.05)


def test_flight_is_a_parabola():
    # No basket in reach: the ball flies freely from where it leaves the cup.
    system = Basket(basket_distance=5.0)
    path = []
    advance = system._advance

    def watched(velocity):
        advance(velocity)
        path.append((system.data.time, *system.data.body("ball").xpos[[0, 2]], system.data.ncon))

    system._advance = watched
    strike(system, 1.6)
    time, x, z, _ = np.array(path).T
    flying = (x > 0.1) & (z > 0.03)
    assert np.sum(flying) > 30
    np.testing.assert_allclose(np.diff(x[flying], 2), 0.0, atol=1e-9)
    fall = np.diff(z[flying], 2) / np.diff(time[flying])[:-1] ** 2
    np.testing.assert_allclose(fall, -9.81, rtol=1e-6)


def test_everything_rests_at_the_start(system):
    observation, _ = system.reset(seed=0)
    assert observation[2] == pytest.approx(-math.radians(25.0), abs=5e-3)
    assert np.abs(system.data.qvel).max() < 1e-4
    cup = system.data.body("cup").xpos
    assert math.dist(observation[3:], (cup[0], cup[2])) < 0.03
    for _ in range(200):
        mujoco.mj_step(system.model, system.data)
    assert np.abs(system.data.qvel).max() < 1e-4
    np.testing.assert_allclose(system.data.body("ball").xpos[[0, 2]], observation[3:], atol=1e-5)


def test_ball_starts_in_the_cup_as_spread_as_said():
    system = Basket(start_spread=0.002)
    system.reset(seed=0)
    places = np.array([system.reset()[0][3:] for _ in range(300)])
    inward = np.linalg.norm(places - Basket().reset()[0][3:], axis=1)
    assert inward.max() <= 0.008 + 1e-6  # the lips are 48 mm apart, the ball measures 40 mm
    assert np.mean(inward) == pytest.approx(0.002 * math.sqrt(2 / math.pi), rel=0.2)


def test_nothing_penetrates(system):
    for speed in (0.8, 1.3, 2.0):
        system.reset(seed=0)
        over, deepest = False, 0.0
        while not over:
            _, _, over, _, _ = system.step(np.array([speed]))
            contacts = system.data.contact.dist[: system.data.ncon]
            deepest = min(deepest, float(np.min(contacts, initial=0.0)))
        assert deepest > -0.004
        assert np.abs(system.data.qvel).max() < 1e3


def test_stroke_stops_short_of_the_stop_of_the_lever(system):
    observations, _, _ = strike(system, 1.0)
    assert np.all(np.diff(observations[:-1, 0]) >= 0.0)
    assert np.all(observations[:-1, 0] < system.stroke)
    assert observations[-1, 0] - system.stroke < 1.0 * system.dt + 1e-3
    assert system.stroke == pytest.approx(0.112, abs=5e-4)
    np.testing.assert_array_less(np.abs(observations[:-1, 2]), math.radians(26.5))


def test_a_ball_that_never_leaves_the_cup_is_a_failure():
    system = Basket(longest_wait=0.5)
    system.reset(seed=0)
    _, reward, over, _, info = system.step(np.zeros(1))
    assert over
    assert info == {"failed": True, "success": False}
    assert -reward > 1.0


def test_walls_keep_the_ball_out_as_well_as_in():
    # With walls higher than the ball flies there is no way in.
    assert strike(Basket(), 1.3)[2]["success"]
    assert strike(Basket(basket_height=0.7), 1.3)[2]["failed"]


@pytest.mark.parametrize(
    ("parameters", "line"),
    [
        ({"balls": 2}, r"basket has no parameter 'balls'; it has: v_max \[m/s\]"),
        ({"ball_radius": 0.1}, "ball_radius is 0.1 m, but must be below 0.024 m"),
        ({"inside_time": 3}, "inside_time is 3 s, but must be below longest_wait, 3 s"),
        ({"pivot_height": 0.03}, r"pivot_height is 0.03 m, but must be above 0.038\d* m"),
        ({"swing_deg": 80}, "swing_deg is 80 deg but must be at most 60 deg"),
    ],
)
def test_wrong_parameters_are_told_in_one_line(refused, parameters, line):
    with refused(line):
        Basket(**parameters)
