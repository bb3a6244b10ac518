"""What is true of every system with an effector that strikes."""

import math

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from strikes import strike

from misstep.systems import list_systems, make_system

GYM_IDS = {"flipup": "misstep/FlipUp-v1", "basket": "misstep/Basket-v1"}
SPEEDS = {"flipup": (0.7, 1.04, 1.5), "basket": (0.8, 1.3, 2.0)}
OTHERS = {
    "flipup": {"block_mass": 0.3, "start_spread": 0.001, "v_max": 2},
    "basket": {"ball_mass": 0.03, "bend_deg": 25, "basket_distance": 1},
}


@pytest.fixture(scope="module", params=sorted(GYM_IDS))
def system(request):
    return make_system(request.param)


# Gymnasium prefers normalised actions and bounded observations; here both are physical quantities.
@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space")
@pytest.mark.filterwarnings("ignore:.*A Box observation space (min|max)imum value is -?infinity")
@pytest.mark.parametrize("render_mode", [None, "rgb_array"])
@pytest.mark.parametrize("name", sorted(GYM_IDS))
def test_passes_gymnasium_checks(name, render_mode):
    env = gymnasium.make(GYM_IDS[name], render_mode=render_mode, servo_gain=300.0)
    check_env(env.unwrapped, skip_render_check=render_mode is None)
    assert env.unwrapped.parameters["servo_gain"] == 300.0
    env.close()


def test_an_episode_leaves_nothing_behind(system):
    low, middle, high = SPEEDS[system.system_id]
    first = strike(system, middle)[0]
    strike(system, high)
    strike(system, low)
    np.testing.assert_array_equal(strike(system, middle)[0], first)


def test_same_seed_same_strike_other_seed_another(system):
    name, speed = system.system_id, SPEEDS[system.system_id][1]

    def episode(seed):
        return strike(make_system(name, start_spread=0.002), speed, seed=seed)[0]

    np.testing.assert_array_equal(episode(7), episode(7))
    assert not np.array_equal(episode(7), episode(8))
    # Without a spread there is nothing to draw.
    np.testing.assert_array_equal(
        strike(system, speed, seed=7)[0], strike(system, speed, seed=8)[0]
    )


def test_parameters_rebuild_the_system(system):
    name, speed = system.system_id, SPEEDS[system.system_id][1]
    first = make_system(name, **OTHERS[name])
    again = make_system(name, **first.parameters)
    assert again.parameters == first.parameters
    np.testing.assert_array_equal(strike(first, speed)[0], strike(again, speed)[0])


def test_actions_are_clipped_to_the_speed_limit(system):
    limit = system.parameters["v_max"]
    np.testing.assert_array_equal(
        strike(system, 1e3, start=1.0)[0], strike(system, limit, start=1.0)[0]
    )


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


def test_the_docstring_lists_every_parameter_with_its_unit(system):
    rows = list_systems()[system.system_id]
    doc = type(system).__doc__
    assert {row.name: row.default for row in rows} == system.parameters
    for row in rows:
        line = next(line for line in doc.splitlines() if f"``{row.name}``  " in line)
        assert line.split()[1] == str(row.default)
        assert row.unit in line
        assert row.meaning in line


def test_the_docstring_is_whole(system):
    doc = type(system).__doc__
    assert "<" not in doc
    for part in ("**Observation**", "**Action**", "clipped to", "render_mode : {None, ", "Raises"):
        assert doc.count(part) == 1
    for column in system.observation_columns:
        assert f"``{column.name}``" in doc
