"""Gazebo's own physics against MuJoCo's: two engines that share nothing but the equations."""

import mujoco
import numpy as np
import pytest

import misstep
from misstep.errors import MisstepError
from misstep.paper.experiments import EXPLORATIONS, VARIANTS, demonstrations_of, run_cell
from misstep.robot.gazebo.build import PACKAGES, build, library_path
from misstep.robot.gazebo.cart_pole import CartPoleGazebo
from misstep.robot.gazebo.world import World
from misstep.systems import CartPole
from misstep.systems.rendering import Painter

try:
    build()
    MISSING = ""
except MisstepError as error:
    MISSING = f"{error} (Debian packages: {PACKAGES})"
pytestmark = pytest.mark.skipif(bool(MISSING), reason=MISSING)

FREE = {"duration": 100.0, "stop_at_fall": False}
HEAVY = {
    "cart_mass": 10.0,
    "pole_mass": 5.0,
    "half_length": 1.0,
    "pole_inertia": 1.0,
    "force_limit": 300.0,
    "hinge_damping": 0.3,
    "cart_damping": 7.0,
    "gravity": 3.7,
}


def euler(**parameters):
    """MuJoCo's cart-pole with the integrator that DART has."""
    system = CartPole(**parameters)
    system.model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    return system


def push_both(one, other, n, seed=0):
    """Push two systems alike at random; return their states, each (n, 4)."""
    rng = np.random.default_rng(seed)
    limit = 0.3 * one.action_space.high
    states = []
    for system in (one, other):
        system.set_state(0.1, -0.2, 0.3, 0.4)
    for _ in range(n):
        push = rng.uniform(-limit, limit)
        states.append([system.step(push)[0] for system in (one, other)])
    return np.moveaxis(np.array(states), 1, 0)


def apart(first, second):
    """Largest difference of two sequences of states; angles by the shorter way."""
    difference = first - second
    difference[:, 2] = (difference[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    return np.abs(difference).max()


@pytest.mark.parametrize(
    "parameters",
    [
        {"control_rate": 1000.0, "physics_step": 0.001},
        {"control_rate": 1000.0, "physics_step": 0.001, **HEAVY},
        {"control_rate": 50.0, "physics_step": 0.004, "delay": 0.008},
    ],
)
def test_5000_random_pushes_move_it_as_in_mujoco(parameters):
    parameters = {**FREE, **parameters}
    gazebo, own = push_both(CartPoleGazebo(**parameters), euler(**parameters), 5000)
    assert np.ptp(own[:, 2]) > 3.0  # the pole swung all round
    assert apart(gazebo, own) < 1e-9


def test_another_integrator_is_another_motion_and_shorter_steps_bring_them_together():
    errors = []
    for step in (0.005, 0.0005):
        parameters = {**FREE, "control_rate": 50.0}
        gazebo = CartPoleGazebo(**parameters, physics_step=step)
        errors.append(apart(*push_both(gazebo, CartPole(**parameters, physics_step=0.001), 50)))
    assert errors[0] > 1e-4
    assert errors[1] == pytest.approx(errors[0] / 10.0, rel=0.2)  # Euler is of first order


def test_the_cart_stops_at_the_end_of_the_rail():
    system = CartPoleGazebo(**FREE, rail=0.5, physics_step=0.001)
    system.set_state(0.0, 0.0, 0.0, 0.0)
    positions = [system.step(np.array([10.0]))[0][0] for _ in range(200)]
    assert max(positions) == pytest.approx(0.5, abs=0.01)


def test_it_is_failed_on_and_learned_as_any_system():
    system = CartPoleGazebo(duration=4.0, physics_step=0.002)
    shown = misstep.demonstrate(system, "weak", n=3, seed=0, time="")
    assert shown == misstep.demonstrate(system, "weak", n=3, seed=0, time="")
    own = misstep.demonstrate(misstep.make_system("cartpole", duration=4.0), "weak", n=3, seed=0)
    for ours, theirs in zip(shown, own, strict=True):
        assert abs(ours.failure_step - theirs.failure_step) <= 2
        assert ours.provenance.system == "cartpole-gazebo"
    run = misstep.learn(system, shown, "fall", state=("theta", "theta_dot"), seed=1)
    assert run.succeeded


def test_the_paper_s_experiment_runs_on_it(tmp_path):
    run = run_cell(tmp_path, VARIANTS["mean"], seed=0, index=0, physics="gazebo")
    own = demonstrations_of("A", seed=0, index=0)
    assert len(run.trials) == EXPLORATIONS
    assert {t.provenance.system for t in (*run.demonstrations, *run.trials)} == {"cartpole-gazebo"}
    for ours, theirs in zip(run.demonstrations, own, strict=True):
        # The same person, the same noise: they part only as two integrators do.
        assert np.abs(ours.observations - theirs.observations)[:20].max() < 0.01
        assert not np.array_equal(ours.observations, theirs.observations)
    pictures = []
    for system in ("cartpole-gazebo", "cartpole"):
        with Painter(system, own[0].provenance.parameters, width=128, height=64) as painter:
            seen = dict.fromkeys(("x", "x_dot", "theta", "theta_dot"), 0.2)
            pictures.append(painter.paint(seen, {"force": 1.0}, 0.0))
    assert np.array_equal(*pictures)


def test_what_gazebo_cannot_do_is_said(refused):
    with refused(r"Gazebo steps whole nanoseconds, and 0\.00833\d+ s is none"):
        CartPoleGazebo(control_rate=60.0)
    with refused("Gazebo's physics: "):
        World("<sdf version='1.9'><world name='none'/></sdf>", 0.001)
    with refused("Gazebo's physics: "):
        World("no SDF at all", 0.001)


def test_an_engine_that_is_not_there_is_said(monkeypatch, refused):
    monkeypatch.setenv("MISSTEP_GAZEBO_ENGINE", "libno-such-engine.so")
    with refused(r"Gazebo's physics: cannot load libno-such-engine\.so"):
        CartPoleGazebo()


def test_the_bridge_is_built_once():
    before = library_path().stat().st_mtime_ns
    assert build() == library_path()
    assert library_path().stat().st_mtime_ns == before
