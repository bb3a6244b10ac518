import math
from dataclasses import asdict

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from misstep import Outcome, demonstrate, rollout
from misstep.errors import MisstepError
from misstep.systems import CartPole, list_systems, make_system
from misstep.systems.cartpole import wrap_angle
from misstep.systems.rendering import frames

LONG = {"stop_at_fall": False, "duration": 1000.0}
FRICTIONLESS = {"hinge_damping": 0.0, "cart_damping": 0.0}


def textbook_accelerations(p, x_dot, theta, theta_dot, force):
    """Accelerations of cart and pole as in Florian (2007), with viscous friction."""
    total = p["cart_mass"] + p["pole_mass"]
    moment = p["pole_mass"] * p["half_length"]
    s, c = math.sin(theta), math.cos(theta)
    push = force - p["cart_damping"] * x_dot
    theta_acc = (
        p["gravity"] * s
        - c * (push + moment * theta_dot**2 * s) / total
        - p["hinge_damping"] * theta_dot / moment
    ) / (p["half_length"] * (4 / 3 - p["pole_mass"] * c**2 / total))
    x_acc = (push + moment * (theta_dot**2 * s - theta_acc * c)) / total
    return x_acc, theta_acc


def energy(p, state):
    """Kinetic and potential energy, summed over points of the rod (exactly, by Gauss)."""
    _, x_dot, theta, theta_dot = state
    nodes, weights = np.polynomial.legendre.leggauss(4)
    along = p["half_length"] * (1 + nodes)
    mass = p["pole_mass"] * weights / 2
    v_x = x_dot + along * np.cos(theta) * theta_dot
    v_z = -along * np.sin(theta) * theta_dot
    rod = mass @ (0.5 * (v_x**2 + v_z**2) + p["gravity"] * along * np.cos(theta))
    return 0.5 * p["cart_mass"] * x_dot**2 + rod


def drive(system, forces):
    """States after each force, shape (T + 1, 4), from wherever the system is."""
    states = [system.state]
    for force in forces:
        system.step(np.array([force]))
        states.append(system.state)
    return np.array(states)


# Gymnasium prefers normalised actions and bounded observations; here both are physical quantities.
@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space")
@pytest.mark.filterwarnings("ignore:.*A Box observation space (min|max)imum value is -?infinity")
@pytest.mark.parametrize("render_mode", [None, "rgb_array"])
@pytest.mark.parametrize("parameters", [{}, {"angle_noise": 0.01, "delay": 0.03}])
@pytest.mark.parametrize("name", ["CartPole", "CartPoleRail", "CartPoleSwingUp"])
def test_passes_gymnasium_checks(name, render_mode, parameters):
    env = gymnasium.make(f"misstep/{name}-v1", render_mode=render_mode, **parameters)
    check_env(env.unwrapped, skip_render_check=render_mode is None)
    defaults = asdict(env.unwrapped.parameters_type())
    assert env.unwrapped.parameters == {**defaults, **parameters}
    env.close()


@pytest.mark.parametrize(
    "parameters",
    [
        {},
        {"cart_mass": 1.16, "pole_mass": 0.244, "half_length": 0.594, "cart_damping": 8.84},
        {"pole_mass": 2.0, "half_length": 1.5, "hinge_damping": 0.5, "gravity": 1.62},
    ],
)
def test_accelerations_equal_the_textbook(parameters):
    system = CartPole(**parameters)
    rng = np.random.default_rng(1)
    for _ in range(50):
        state = rng.uniform((-5, -3, -math.pi, -8), (5, 3, math.pi, 8))
        force = rng.uniform(-20, 20)
        system.set_state(*state)
        system.data.ctrl[0] = force
        mujoco.mj_forward(system.model, system.data)
        expected = textbook_accelerations(system.parameters, *state[1:], force)
        np.testing.assert_allclose(system.data.qacc, expected, rtol=1e-9, atol=1e-9)


def test_trajectory_equals_an_independent_integration():
    system = CartPole(**LONG)
    start = np.array([0.2, -0.1, 0.3, 0.5])
    forces = np.random.default_rng(2).uniform(-20, 20, 50)
    system.set_state(*start)
    simulated = drive(system, forces)
    state = start
    for t, force in enumerate(forces):

        def rate(_, s, force=force):
            x_acc, theta_acc = textbook_accelerations(system.parameters, *s[1:], force)
            return s[1], x_acc, s[3], theta_acc

        state = solve_ivp(rate, (0, system.dt), state, method="DOP853", rtol=1e-11, atol=1e-12).y[
            :, -1
        ]
        wrapped = [*state[:2], wrap_angle(state[2]), state[3]]
        # RK4 at 0.01 s errs by some 1e-8 a step, which the unstable pole multiplies in a second.
        np.testing.assert_allclose(simulated[t + 1], wrapped, rtol=0, atol=1e-4)


def test_energy_is_conserved_without_friction():
    system = CartPole(**LONG, **FRICTIONLESS)
    system.set_state(0.0, 0.3, 0.05, 0.0)
    states = drive(system, np.zeros(500))
    energies = np.array([energy(system.parameters, s) for s in states])
    assert np.ptp(states[:, 2]) > math.pi  # it does swing through
    assert np.abs(states[:, 0]).max() < 9.0  # and no stop takes energy away
    assert np.ptp(energies) < 1e-6


def test_work_of_the_force_is_the_energy_gained():
    system = CartPole(**LONG, **FRICTIONLESS)
    system.set_state(0.0, 0.0, 0.4, 0.0)
    forces = np.random.default_rng(3).uniform(-20, 20, 100)
    states = drive(system, forces)
    work = np.cumsum(forces * np.diff(states[:, 0]))
    gained = [energy(system.parameters, s) - energy(system.parameters, states[0]) for s in states]
    assert np.abs(work).max() > 1.0
    np.testing.assert_allclose(gained[1:], work, atol=1e-4)


@pytest.mark.parametrize("friction", ["hinge_damping", "cart_damping"])
def test_friction_only_takes_energy(friction):
    system = CartPole(**LONG, **{**FRICTIONLESS, friction: 0.05})
    system.set_state(0.0, 0.5, 0.5, 0.0)
    energies = [energy(system.parameters, s) for s in drive(system, np.zeros(250))]
    assert np.all(np.diff(energies) < 1e-7)
    assert energies[0] - energies[-1] > 0.01


HEAVY = {
    "cart_mass": 10.0,
    "pole_mass": 5.0,
    "half_length": 1.0,
    "pole_inertia": 1.0,
    "force_limit": 256.0,
    "rail": 15.0,
}


def test_a_pole_of_another_inertia_is_a_dumbbell():
    # Two points of half the mass, sqrt(I / m) to either side of the centre, have its inertia.
    system = CartPole(**{**LONG, **FRICTIONLESS, **HEAVY})
    p = system.parameters
    along = p["half_length"] + math.sqrt(p["pole_inertia"] / p["pole_mass"]) * np.array([-1, 1])

    def dumbbell_energy(state):
        _, x_dot, theta, theta_dot = state
        v_x = x_dot + along * math.cos(theta) * theta_dot
        v_z = -along * math.sin(theta) * theta_dot
        points = 0.5 * (v_x**2 + v_z**2) + p["gravity"] * along * math.cos(theta)
        return 0.5 * p["cart_mass"] * x_dot**2 + 0.5 * p["pole_mass"] * points.sum()

    system.set_state(0.0, 0.0, 0.4, 0.0)
    forces = np.random.default_rng(3).uniform(-100, 100, 100)
    states = drive(system, forces)
    work = np.cumsum(forces * np.diff(states[:, 0]))
    gained = [dumbbell_energy(state) - dumbbell_energy(states[0]) for state in states]
    assert np.abs(work).max() > 10.0
    assert np.ptp(np.unwrap(states[:, 2])) > math.pi / 2
    np.testing.assert_allclose(gained[1:], work, atol=1e-3)


def test_without_an_inertia_the_pole_is_a_uniform_rod():
    forces = np.random.default_rng(4).uniform(-20, 20, 100)
    states = []
    for inertia in (0.0, 0.1 * 0.5**2 / 3.0):
        system = CartPole(**LONG, pole_inertia=inertia)
        system.set_state(0.0, 0.0, 0.4, 0.0)
        states.append(drive(system, forces))
    np.testing.assert_array_equal(*states)


def test_swing_up_takes_a_heavy_pole_on_a_long_rail():
    system = make_system("cartpole-swingup", **HEAVY, track_limit=15.0)
    system.reset(seed=0)
    for _ in range(40):
        observation, _, terminated, _, info = system.step(np.array([256.0]))
        assert info["force"] == 256.0
        assert not terminated
    assert 2.4 < observation[0] < 15.0


def test_rail_stops_hold_and_do_not_throw_back():
    system = CartPole(**LONG, rail=1.0, pole_mass=0.001, physics_step=0.005)
    system.set_state(0.0, 0.0, math.pi, 0.0)
    states = drive(system, np.full(150, 20.0))
    x, x_dot = states[:, 0], states[:, 1]
    assert x_dot.max() > 5.0  # hits the stop hard
    assert x.max() < 1.05
    assert x_dot.min() > -0.1 * x_dot.max()
    np.testing.assert_allclose(x[-10:], 1.0, atol=0.01)
    back = drive(system, np.full(100, -20.0))
    assert back[:, 0].min() < -0.99  # and it is not glued to the stop


@given(st.floats(-1e3, 1e3))
@settings(max_examples=200, deadline=None)
def test_wrapped_angle_points_the_same_way(angle):
    wrapped = wrap_angle(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped - angle) == pytest.approx(1.0)


def test_observed_angle_is_wrapped_while_the_pole_turns_over():
    system = CartPole(**LONG, **FRICTIONLESS)
    system.set_state(0.0, 0.0, 3.0, 9.0)
    angles = drive(system, np.zeros(50))[:, 2]
    jumps = np.abs(np.diff(angles)) > math.pi
    assert jumps.any()
    assert np.all((angles > -math.pi) & (angles <= math.pi))
    assert wrap_angle(-math.pi) == math.pi


def test_positive_angle_leans_to_positive_x_and_positive_force_pushes_there():
    system = CartPole()
    system.set_state(0.0, 0.0, 0.2, 0.0)
    mujoco.mj_forward(system.model, system.data)
    assert system.data.body("pole").xipos[0] == pytest.approx(0.5 * math.sin(0.2))
    assert drive(system, [5.0] * 10)[-1, 0] > 0.0


@pytest.mark.parametrize("delay", [0.02, 0.03, 0.05, 0.06])
def test_delay_is_a_shift_of_the_forces(delay):
    forces = np.random.default_rng(4).uniform(-10, 10, 20)
    delayed = CartPole(**LONG, delay=delay)
    delayed.set_state(0.0, 0.0, 0.1, 0.0)
    # The same at twice the rate, every force sent twice, after zeros for the time of the delay.
    prompt = CartPole(**LONG, control_rate=100.0)
    prompt.set_state(0.0, 0.0, 0.1, 0.0)
    shifted = np.concatenate([np.zeros(round(delay / 0.01)), np.repeat(forces, 2)])
    np.testing.assert_allclose(
        drive(delayed, forces), drive(prompt, shifted[: 2 * len(forces)])[::2], atol=1e-12
    )


def test_force_is_clipped_and_reported():
    system = CartPole(force_limit=3.0)
    system.reset(seed=0)
    assert system.step(np.array([1e6]))[4]["force"] == 3.0
    assert system.step(np.array([-7.0]))[4]["force"] == -3.0
    assert system.step(np.array([1.5]))[4]["force"] == 1.5


def test_sensor_noise_has_its_deviation_and_spares_the_judgement():
    noise = {
        "position_noise": 0.01,
        "velocity_noise": 0.3,
        "angle_noise": 0.05,
        "angular_velocity_noise": 1.0,
    }
    system = CartPole(stop_at_fall=False, fall_angle_deg=10.0, **noise)
    system.reset(seed=5)
    errors, fallen = [], False
    for _ in range(1000):
        observation, reward, _, _, info = system.step(np.zeros(1))
        error = observation - info["state"]
        error[2] = wrap_angle(error[2])
        errors.append(error)
        degrees = math.degrees(abs(info["state"][2]))
        fallen = fallen or degrees > 10.0
        assert reward == pytest.approx(-degrees)
        assert info["failed"] == fallen
    # Standard error of a standard deviation from 1,000 draws is 2.2 %.
    np.testing.assert_allclose(np.std(errors, axis=0), list(noise.values()), rtol=0.1)
    np.testing.assert_allclose(
        np.mean(errors, axis=0) / list(noise.values()), 0, atol=4 / math.sqrt(1000)
    )


def test_same_seed_same_episode_other_seed_another():
    def episode(seed):
        system = CartPole(angle_noise=0.01)
        observation, _ = system.reset(seed=seed)
        return np.array([observation, *(system.step(np.ones(1))[0] for _ in range(20))])

    np.testing.assert_array_equal(episode(7), episode(7))
    assert not np.array_equal(episode(7), episode(8))


def test_starts_are_distributed_as_said():
    system = CartPole(start_angle=0.3, start_spread=0.1)
    system.reset(seed=0)
    angles = [system.reset()[0][2] for _ in range(1000)]
    assert np.mean(angles) == pytest.approx(0.3, abs=4 * 0.1 / math.sqrt(1000))
    assert np.std(angles) == pytest.approx(0.1, rel=0.1)


def test_stops_at_the_fall():
    system = CartPole(start_angle=0.4, start_spread=0.0)
    _, info = system.reset()
    assert not info["failed"]
    terminated = False
    while not terminated:
        observation, _, terminated, truncated, info = system.step(np.zeros(1))
        assert terminated == (abs(observation[2]) > math.radians(30))
        assert not truncated
    assert info["failed"]
    assert not info["success"]
    with pytest.raises(MisstepError, match=r"call reset\(\) before step\(\)"):
        system.step(np.zeros(1))


def test_without_stopping_the_failure_is_remembered_to_the_end():
    system = CartPole(start_angle=0.4, stop_at_fall=False, duration=8.0, **FRICTIONLESS)
    system.reset(seed=0)
    steps = [system.step(np.zeros(1)) for _ in range(400)]
    failed = [step[4]["failed"] for step in steps]
    upright_again = [abs(step[0][2]) < math.radians(30) for step in steps]
    first = failed.index(True)
    assert all(failed[first:])
    assert any(upright_again[first:])
    assert [step[3] for step in steps] == [False] * 399 + [True]
    assert not any(step[2] for step in steps)
    assert not steps[-1][4]["success"]


def test_lasting_to_the_end_is_a_success():
    # Exactly upright, nothing makes the pole fall.
    system = CartPole(start_angle=0.0, start_spread=0.0, duration=1.0)
    system.reset(seed=0)
    infos = [system.step(np.zeros(1))[4] for _ in range(50)]
    assert [info["success"] for info in infos] == [False] * 49 + [True]


@pytest.mark.parametrize("stop_at_fall", [True, False])
def test_leaving_the_track_is_a_failure(stop_at_fall):
    system = CartPole(track_limit=0.3, stop_at_fall=stop_at_fall, fall_angle_deg=180.0, duration=2)
    _, info = system.reset(seed=0)
    assert not info["failed"]
    left, over = False, False
    while not over:
        observation, _, terminated, truncated, info = system.step(np.array([-3.0]))
        left = left or observation[0] < -0.3
        assert info["failed"] == left
        assert terminated == (left and stop_at_fall)
        over = terminated or truncated
    assert left
    assert not info["success"]
    assert not info["timed_out"]
    system.set_state(0.31, 0.0, 0.0, 0.0)
    assert system.step(np.zeros(1))[4]["failed"]


def test_without_a_track_limit_the_cart_may_go_anywhere():
    system = CartPole(fall_angle_deg=180.0, duration=2.0)
    system.reset(seed=0)
    steps = [system.step(np.array([15.0])) for _ in range(100)]
    assert steps[-1][0][0] > 3.0
    assert steps[-1][4]["success"]


class Proportional:
    """The linear feedback that keeps the pole upright."""

    def reset(self):
        pass

    def __call__(self, observation):
        return np.array([observation @ (1.0, 2.5, 40.0, 10.0)])


def test_rail_is_balanced_for_a_minute_on_its_track():
    system = make_system("cartpole-rail")
    assert system.parameters["rail"] > system.parameters["track_limit"] == 2.4
    trajectory = rollout(system, Proportional(), seed=0, demonstrator="test")
    assert trajectory.outcome is Outcome.SUCCESS
    assert trajectory.duration == pytest.approx(60.0)
    assert trajectory.provenance.system == "cartpole-rail"
    system.reset(seed=0)
    system.set_state(2.3, 1.0, 0.3, 0.0)
    failed = [system.step(np.zeros(1))[4]["failed"] for _ in range(6)]
    assert not failed[0]
    assert failed[-1], "the track ends after 0.1 s at 1 m/s"


def test_swing_up_starts_hanging_and_does_not_fail_by_that():
    system = make_system("cartpole-swingup", duration=6.0)
    observation, info = system.reset(seed=0)
    assert abs(abs(observation[2]) - math.pi) < 0.2
    assert not info["failed"]
    steps = [system.step(np.zeros(1)) for _ in range(300)]
    assert [step[2] for step in steps] == [False] * 300
    assert [step[4]["failed"] for step in steps] == [False] * 299 + [True]
    assert [step[4]["timed_out"] for step in steps] == [False] * 299 + [True]


@pytest.mark.parametrize("force", [2.0, 5.0, 10.0])
def test_swing_up_fails_at_the_stops(force):
    system = make_system("cartpole-swingup")
    system.reset(seed=0)
    over = False
    while not over:
        observation, _, terminated, truncated, info = system.step(np.array([force]))
        over = terminated or truncated
    assert terminated
    assert info["failed"]
    assert not info["timed_out"]
    assert observation[0] == pytest.approx(2.4, abs=0.1)


@pytest.mark.parametrize(
    ("kick", "success"),
    [(None, True), (2.0, True), (5.2, False), (9.8, False)],
)
def test_swing_up_is_upright_during_the_whole_last_five_seconds(kick, success):
    system = make_system("cartpole-swingup")
    system.reset(seed=0)
    system.set_state(0.0, 0.0, 0.02, 0.0)
    hold = Proportional()
    angles = [0.02]
    for step in range(500):
        kicked = kick is not None and 0 <= step - round(50 * kick) < 6  # brings it to some 13°
        action = np.array([-10.0]) if kicked else hold(system.state)
        observation, _, _, _, info = system.step(action)
        angles.append(observation[2])
    upright = np.abs(angles) < math.radians(12.0)
    assert (kick is None) == upright.all()
    assert upright[-251:].all() == success
    assert (info["success"], info["failed"]) == (success, not success)


@pytest.mark.parametrize("name", ["cartpole-rail", "cartpole-swingup"])
def test_variants_are_cart_poles_with_other_defaults(name):
    system = make_system(name, pole_mass=0.2)
    same = make_system("cartpole", **system.parameters)
    assert same.parameters == system.parameters
    assert system.system_id == name
    assert system.cost.limits[0] == 2.4
    for one in (system, same):
        one.set_state(0.0, 0.0, 0.1, 0.0)
    np.testing.assert_array_equal(drive(system, [1.0] * 10), drive(same, [1.0] * 10))
    rows = {row.name: row for row in list_systems()[name]}
    for row in list_systems()["cartpole"]:
        mine = rows[row.name]
        assert (mine.unit, mine.meaning) == (row.unit, row.meaning)
        if mine.default != row.default:
            line = next(n for n in type(system).__doc__.splitlines() if f"``{row.name}``  " in n)
            assert line.split()[1] in (str(mine.default), "π")


def test_variants_are_drawn():
    for name in ("cartpole-rail", "cartpole-swingup"):
        trajectory = demonstrate(make_system(name, failure="abs(x) > 1m"), "random", n=1)[0]
        pictures = list(frames(trajectory, fps=2, width=320, height=180))
        assert len({picture.tobytes() for picture in pictures}) == len(pictures)


def test_parameters_rebuild_the_system():
    first = CartPole(pole_mass=0.3, duration=5, stop_at_fall=False, delay=0.02)
    again = make_system("cartpole", **first.parameters)
    assert again.parameters == first.parameters
    assert first.parameters["duration"] == 5.0
    assert isinstance(first.parameters["duration"], float)
    for system in (first, again):
        system.set_state(0.0, 0.0, 0.1, 0.0)
    np.testing.assert_array_equal(drive(first, [1.0] * 50), drive(again, [1.0] * 50))


def test_lists_every_parameter_with_unit_and_documents_it():
    rows = list_systems()["cartpole"]
    assert {row.name: row.default for row in rows} == CartPole().parameters
    for row in rows:
        line = next(line for line in CartPole.__doc__.splitlines() if f"``{row.name}``  " in line)
        assert line.split()[1] == str(row.default)
        assert row.unit in line
        assert row.meaning
        assert row.unit or isinstance(row.default, bool)


@pytest.mark.parametrize(
    ("parameters", "line"),
    [
        ({"mass": 1.0}, r"cartpole has no parameter 'mass'; it has: cart_mass \[kg\], pole_mass"),
        ({"cart_mass": "heavy"}, "cart_mass is 'heavy' but must be a number in kg"),
        ({"cart_mass": True}, "cart_mass is True but must be a number in kg"),
        ({"cart_mass": 0}, "cart_mass is 0 kg but must be greater than 0 kg"),
        ({"rail": math.inf}, "rail is inf but must be a finite number in m"),
        ({"start_angle": math.nan}, "start_angle is nan but must be a finite number in rad"),
        ({"delay": -0.1}, "delay is -0.1 s but must be at least 0 s"),
        ({"fall_angle_deg": 181}, "fall_angle_deg is 181 deg but must be at most 180 deg"),
        ({"stop_at_fall": 1}, "stop_at_fall is 1 but must be true or false"),
        ({"duration": 0.001}, "duration is 0.001 s, shorter than one control period of 0.02 s"),
        ({"hinge_damping": 50.0}, "physics_step is 0.01 s, too long .* at most"),
        ({"hinge_damping": 1e308}, "damping of .* is too strong for such small masses"),
        ({"track_limit": -1.0}, "track_limit is -1 m but must be at least 0 m"),
        ({"upright_time": 31.0}, "upright_time is 31 s but must be at most the duration, 30 s"),
        ({"render_mode": "human"}, "render_mode is 'human'; there is: 'rgb_array'"),
    ],
)
def test_wrong_parameters_are_told_in_one_line(parameters, line):
    with pytest.raises(MisstepError, match=line) as caught:
        make_system("cartpole", **parameters)
    assert "\n" not in str(caught.value)


def test_a_wrong_parameter_of_a_variant_names_the_variant(refused):
    with refused("cartpole-swingup: duration is 0 s but must be greater than 0 s"):
        make_system("cartpole-swingup", duration=0)


def test_unknown_system_lists_the_known():
    with pytest.raises(MisstepError, match="no system named 'cart'; there are: "):
        make_system("cart")


@pytest.mark.parametrize(
    ("action", "line"),
    [
        (np.array([math.nan]), "nan N, which is not a finite force"),
        (np.array([math.inf]), "inf N, which is not a finite force"),
        (np.zeros(2), r"has shape \(2,\) but one force in N, shape \(1,\)"),
        (np.float64(1.0), r"has shape \(\) but one force"),
    ],
)
def test_wrong_actions_are_told(action, line):
    system = CartPole()
    system.reset(seed=0)
    with pytest.raises(MisstepError, match=line):
        system.step(action)


def test_a_simulation_too_coarse_to_mean_anything_is_told():
    system = CartPole(force_limit=1e5, stop_at_fall=False, rail=10.0)
    system.reset(seed=0)
    with pytest.raises(
        MisstepError, match=r"after 0\.02 s the pole turns at .* physics_step of 0\.01"
    ):
        system.step(np.array([1e5]))


def test_state_must_be_finite():
    with pytest.raises(MisstepError, match="not finite"):
        CartPole().set_state(0.0, math.inf, 0.0, 0.0)
