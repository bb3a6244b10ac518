import math
from itertools import product

import numpy as np
import pytest
from attempts import DT, attempt, heavy, recording

from misstep import demonstrate
from misstep.errors import MisstepError
from misstep.recordings.equations import check_equations
from misstep.systems import make_system

COLUMNS = heavy().observation_columns
DEGREE = math.pi / 180


@pytest.fixture(scope="module")
def attempts():
    return [np.round(attempt(40 + seed, 4.0)[0], 5) for seed in range(2)]


def shown(attempts, scales=(1, 1, 1, 1), *, hanging=False, columns=(0, 1, 2, 3), dt=DT):
    """What a person recorded who reads the columns otherwise; angles in (-π, π] times the scale."""
    recordings = []
    for observations in attempts:
        other = observations.copy()
        if hanging:
            other[:, 2] = other[:, 2] % (2 * math.pi) - math.pi
        other = (other * scales)[:, list(columns)]
        recordings.append(recording(other, tuple(COLUMNS[i] for i in columns), dt))
    return recordings


def test_a_true_recording_holds_and_nothing_fits_better(attempts):
    checks = check_equations(shown(attempts), heavy())
    assert [check.episode for check in checks] == [0, 1]
    for check in checks:
        assert check.holds
        assert (check.column, check.unit) == ("theta", "rad/s²")
        assert check.r_squared > 0.9999
        assert check.residual < 0.02
        assert not check.fits
        assert not check.findings


@pytest.mark.parametrize("digits", [3, 4])
@pytest.mark.parametrize("columns", [(0, 1, 2, 3), (0, 2), (0, 1, 2)])
def test_rounding_raises_no_alarm(attempts, columns, digits):
    coarse = [np.round(observations, digits) for observations in attempts]
    for check in check_equations(shown(coarse, columns=columns), heavy()):
        assert check.holds
        assert not check.fits
        assert not check.findings


def test_r_squared_and_residual_are_those_of_the_textbook(attempts):
    wrong = heavy(pole_inertia=2.0)
    for check, observations in zip(check_equations(shown(attempts), wrong), attempts, strict=True):
        middle = 0.5 * (observations[1:] + observations[:-1])
        x_acc, theta_acc = np.diff(observations[:, [1, 3]], axis=0).T / DT
        theta = np.arctan2(np.sin(middle[:, 2]), np.cos(middle[:, 2]))
        turn = np.abs(np.diff(observations[:, 2])) > 1
        expected = 5.0 / (2.0 + 5.0) * (9.81 * np.sin(theta) - x_acc * np.cos(theta))
        left = (theta_acc - expected)[~turn]
        assert check.residual == pytest.approx(np.sqrt(np.mean(left**2)), rel=0.03)
        r_squared = 1 - np.mean(left**2) / np.var(theta_acc[~turn])
        assert check.r_squared == pytest.approx(r_squared, abs=0.01)


@pytest.mark.parametrize(
    ("reading", "change"),
    [
        ({"scales": (1, 1, -1, -1)}, "theta or x with the opposite sign"),
        ({"scales": (-1, -1, 1, 1)}, "theta or x with the opposite sign"),
        ({"hanging": True}, "the zero of theta half a turn away"),
        (
            {"hanging": True, "scales": (1, 1, -1, -1)},
            "theta or x with the opposite sign and the zero of theta half a turn away",
        ),
        ({"scales": (1, 1, 1 / DEGREE, 1 / DEGREE)}, "theta in deg"),
        ({"scales": (1, 1, 1 / DEGREE, 1), "columns": (0, 2)}, "theta in deg"),
        ({"scales": (1000, 1000, 1, 1)}, "x in mm"),
        ({"scales": (1, 1, 1, 1 / DEGREE)}, "theta_dot times 0.01745"),
        ({"scales": (1, 1, 1, -1)}, "theta_dot times -1"),
        ({"dt": 2e-3}, "a rate of 1000 Hz instead of 500 Hz"),
    ],
)
def test_another_reading_of_the_columns_is_named(attempts, reading, change):
    checks = check_equations(shown(attempts, **reading), heavy())
    assert not any(check.holds for check in checks)
    for check in checks:
        (fit, *_) = check.fits
        assert fit.change == change
        assert fit.r_squared > 0.999
        assert change in check.sentences[0]


def test_a_wrong_rate_is_found_without_velocities(attempts):
    for check in check_equations(shown(attempts, dt=2e-3, columns=(0, 2)), heavy()):
        assert check.fits[0].kind == "rate"
        assert check.fits[0].value == pytest.approx(1000.0, rel=1e-3)


@pytest.mark.parametrize(
    ("wrong", "name", "value"),
    [
        ({"pole_mass": 10.0}, "pole_mass", 5.0),
        ({"pole_mass": 4.5}, "pole_mass", 5.0),
        ({"half_length": 0.8}, "half_length", 1.0),
        ({"pole_inertia": 0.0}, "pole_inertia", 1.0),
        ({"gravity": 1.62}, "gravity", 9.81),
        ({"hinge_damping": 1.0}, "hinge_damping", 0.0),
    ],
)
def test_a_wrong_parameter_is_found(attempts, wrong, name, value):
    for check in check_equations(shown(attempts), heavy(**wrong)):
        values = {fit.change.split()[0]: fit.value for fit in check.fits}
        assert values[name] == pytest.approx(value, rel=0.01)
        assert all(fit.kind == "parameter" and fit.r_squared > 0.999 for fit in check.fits)


def test_a_reading_and_a_parameter_are_found_together(attempts):
    checks = check_equations(shown(attempts, (1, 1, -1, -1)), heavy(gravity=3.0))
    for check in checks:
        assert check.fits[0].change == (
            "theta or x with the opposite sign and gravity 9.81 m/s² instead of 3 m/s²"
        )


def test_velocities_that_are_not_the_change_of_their_positions_are_named(attempts):
    (check, *_) = check_equations(shown(attempts, (1, 1, 1 / DEGREE, 1)), heavy())
    (finding,) = check.findings
    assert finding.kind == "units"
    assert finding.size == pytest.approx(1 / DEGREE, rel=0.01)
    assert "theta_dot says: one is in degrees, the other in radians" in finding.sentence


def test_spikes_and_stops_are_named_and_do_not_spoil_the_check(attempts):
    bad = attempts[0].copy()
    bad[1500, 3] += 4.0
    (check,) = check_equations(shown([bad]), heavy())
    assert check.holds
    assert check.r_squared > 0.9999
    (spike,) = check.findings
    assert (spike.kind, spike.time) == ("spike", pytest.approx(1.5))

    system = heavy(
        rail=2.0, track_limit=0.0, stop_at_fall=False, control_rate=1000.0, physics_step=DT
    )
    observations = [system.reset(seed=0)[0]]
    observations += [system.step(np.array([100.0]))[0] for _ in range(1500)]
    hit = DT * int(np.argmax(np.array(observations)[:, 0] > 2.0))
    (check,) = check_equations(shown([np.array(observations)]), heavy(rail=2.0))
    assert check.holds
    assert [(f.kind, f.time) for f in check.findings] == [("stop", pytest.approx(hit, abs=0.01))]


def test_what_no_free_joint_feels_is_not_judged(attempts):
    for check in check_equations(shown(attempts), heavy(cart_mass=20.0)):
        assert check.holds
        assert not check.fits


def test_another_motion_is_not_explained(attempts):
    rng = np.random.default_rng(0)
    t = np.arange(4000) * DT
    theta = sum(rng.normal() * np.sin(w * t + rng.uniform(0, 6)) for w in (2.0, 3.3, 7.1))
    x = sum(rng.normal() * np.sin(w * t + rng.uniform(0, 6)) for w in (1.0, 4.7, 5.9))
    (check,) = check_equations([recording(np.stack([x, theta], 1), COLUMNS[::2])], heavy())
    assert not check.holds
    assert all(fit.r_squared < 0.95 for fit in check.fits)


def test_what_does_not_move_cannot_be_checked():
    still = np.tile([0.3, 0.0, math.pi, 0.0], (500, 1))
    (check,) = check_equations([recording(still, COLUMNS)], heavy())
    assert check.r_squared is None
    assert not check.holds
    sentence = "theta does not accelerate where nothing is hit: its equation cannot be checked"
    assert check.sentences == (sentence,)


def test_what_lies_beyond_the_stops_cannot_be_checked(attempts):
    far = [observations + np.array([500.0, 0.0, 0.0, 0.0]) for observations in attempts]
    for check in check_equations(shown(far), heavy(rail=2.0)):
        assert check.r_squared is None
        assert not check.holds
        assert not check.fits
        assert "where nothing is hit" in check.sentences[0]


def test_only_systems_that_can_be_run_backwards(attempts):
    with pytest.raises(MisstepError, match="basket has no inverse dynamics"):
        check_equations(shown(attempts), make_system("basket"))


def test_turns_at_a_low_rate_are_no_spikes():
    # A hand that jerks: at 50 Hz the velocity turns within one row.
    system = make_system("cartpole")
    for by, seed in product(("weak", "delayed", "reversed", "random", "noisy"), range(2)):
        for check in check_equations(demonstrate(system, by=by, n=3, seed=seed), system):
            assert check.holds
            assert not check.findings
            assert not check.fits
