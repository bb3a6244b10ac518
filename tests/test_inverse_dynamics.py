import math

import numpy as np
import pytest
from attempts import DT, HEAVY, attempt, heavy, recording
from scipy.integrate import solve_ivp

from misstep.errors import MisstepError
from misstep.formats.format import Block, Episode, Header
from misstep.learning import learn
from misstep.recordings.inverse_dynamics import (
    inferring_actions,
    inferring_velocities,
    inverse_dynamics,
)
from misstep.systems import make_system
from misstep.systems.cartpole import wrap_angle
from misstep.trajectory import Column, Dataset, Outcome, Provenance

COLUMNS = heavy().observation_columns
POSITIONS = (COLUMNS[0], COLUMNS[2])


@pytest.fixture(scope="module")
def pushed():
    return attempt(3)


def with_actions(trajectory, system):
    return inferring_actions(Episode.of(trajectory), system).trajectory()


def with_velocities(trajectory, names=None):
    return inferring_velocities(Episode.of(trajectory), names).trajectory()


def at_50_hz(forces):
    return forces[: len(forces) // 20 * 20].reshape(-1, 20).mean(axis=1)


def relative_error(inferred, true):
    return np.sqrt(np.mean((inferred - true) ** 2) / np.mean(true**2))


def textbook(p, force, seconds, start):
    """States (N, 4) every ms under force(t), from the Lagrangian; no MuJoCo in it."""
    m, length = p["pole_mass"], p["half_length"]
    hinge = (p["pole_inertia"] or m * length**2 / 3) + m * length**2

    def rate(t, s):
        _, x_dot, theta, theta_dot = s
        coupling = m * length * math.cos(theta)
        inertia = [[p["cart_mass"] + m, coupling], [coupling, hinge]]
        forces = [
            force(t) - p["cart_damping"] * x_dot + m * length * theta_dot**2 * math.sin(theta),
            m * p["gravity"] * length * math.sin(theta) - p["hinge_damping"] * theta_dot,
        ]
        x_acc, theta_acc = np.linalg.solve(inertia, forces)
        return [x_dot, x_acc, theta_dot, theta_acc]

    times = np.arange(round(seconds / DT) + 1) * DT
    solution = solve_ivp(rate, (0, seconds), start, "DOP853", times, rtol=1e-10, atol=1e-10)
    return solution.y.T


@pytest.mark.parametrize(
    "parameters",
    [
        {},
        {"cart_damping": 8.0, "hinge_damping": 0.3, "pole_mass": 0.4, "force_limit": 100.0},
        HEAVY,
    ],
)
def test_finds_the_force_of_an_independent_integration(parameters):
    system = make_system("cartpole", **parameters)
    limit = system.parameters["force_limit"]

    def force(t):
        return limit * (0.5 * math.sin(3 * t) + 0.3 * math.sin(17 * t))

    states = textbook(system.parameters, force, 2.0, [0.1, 0.0, 2.5, 0.3])
    found = inverse_dynamics(states, COLUMNS, DT, system)
    true = np.array([force((t + 0.5) * DT) for t in range(2000)])
    np.testing.assert_allclose(found.actions[:, 0], true, atol=1e-4 * limit)
    assert not found.findings


@pytest.mark.parametrize(
    ("columns", "digits", "largest"),
    [(COLUMNS, 6, 2e-4), (COLUMNS, 4, 3e-3), (COLUMNS, 3, 1e-2), (POSITIONS, 6, 5e-3)],
)
def test_rounded_sensors_leave_little_error(pushed, columns, digits, largest):
    observations, forces = pushed
    seen = np.round(observations[:, [COLUMNS.index(column) for column in columns]], digits)
    found = inverse_dynamics(seen, columns, DT, heavy())
    assert relative_error(at_50_hz(found.actions[:, 0]), at_50_hz(forces)) < largest


def test_smooths_as_much_as_the_noise_needs(pushed):
    observations, forces = pushed
    noise = np.random.default_rng(0).standard_normal(observations.shape)
    widths, errors, raw = [], [], []
    for size in (0.0, 1e-4, 1e-3):
        seen = observations + size * noise
        found = inverse_dynamics(seen, COLUMNS, DT, heavy())
        not_smoothed = inverse_dynamics(seen, COLUMNS, DT, heavy(), half_width=0)
        widths.append(found.motion.half_width)
        errors.append(relative_error(found.actions[:, 0], forces))
        raw.append(relative_error(not_smoothed.forces[:, 0], forces))
        if size:
            # The noise that it states is the noise that there is.
            exact = inverse_dynamics(
                observations, COLUMNS, DT, heavy(), half_width=found.motion.half_width
            ).motion.accelerations
            np.testing.assert_allclose(
                np.std(found.motion.accelerations - exact, axis=0), found.motion.noise, rtol=0.2
            )
    assert widths[0] == 0 < widths[1] < widths[2]
    assert errors[1] < 0.2 * raw[1]
    assert errors[2] < 0.05 * raw[2]


def test_replaying_inferred_forces_repeats_the_motion(pushed):
    observations = pushed[0][:1001]
    actions = inverse_dynamics(observations, COLUMNS, DT, heavy()).actions
    system = heavy(control_rate=1000.0, physics_step=DT)
    system.reset(seed=0)
    system.set_state(*observations[0])
    for action in actions:
        system.step(action)
    np.testing.assert_allclose(system.state, observations[-1], atol=2e-3)


def test_neither_order_nor_wrapping_nor_other_columns_matter(pushed):
    observations, _ = pushed
    expected = inverse_dynamics(observations, COLUMNS, DT, heavy()).actions
    turned = observations.copy()
    turned[:, 2] = np.unwrap(turned[:, 2]) + 6 * math.pi
    assert np.abs(np.diff(observations[:, 2])).max() > math.pi
    clock = np.arange(len(turned)) * DT
    more = np.column_stack([clock, turned[:, ::-1]])
    names = (Column("clock", "s"), *COLUMNS[::-1])
    found = inverse_dynamics(more, names, DT, heavy()).actions
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_a_judged_system_is_the_system(pushed):
    judged = heavy(failure="abs(x) > 9")
    expected = inverse_dynamics(pushed[0], COLUMNS, DT, heavy()).actions
    np.testing.assert_array_equal(
        inverse_dynamics(pushed[0], COLUMNS, DT, judged).actions, expected
    )


def test_with_a_delay_an_action_comes_before_its_force(pushed):
    prompt = inverse_dynamics(pushed[0], COLUMNS, DT, heavy()).actions
    delayed = inverse_dynamics(pushed[0], COLUMNS, DT, heavy(delay=0.05)).actions
    np.testing.assert_array_equal(delayed[:-50], prompt[50:])
    assert np.all(delayed[-50:] == prompt[-1])


def test_spikes_are_named_and_bridged(pushed):
    observations, forces = pushed
    bad = observations.copy()
    bad[2000, 3] += 4.0
    bad[3000:3003, 0] = 0.0
    found = inverse_dynamics(bad, COLUMNS, DT, heavy())
    spikes = {f.sentence.split()[0]: f for f in found.findings if f.kind == "spike"}
    assert set(spikes) == {"theta_dot", "x"}
    assert spikes["theta_dot"].time == pytest.approx(2.0)
    assert spikes["theta_dot"].size == pytest.approx(4.0, abs=0.05)
    assert spikes["x"].time == pytest.approx(3.001, abs=0.0015)
    assert spikes["x"].size == pytest.approx(-observations[3000, 0], rel=0.02)
    assert "of 3 samples" in spikes["x"].sentence
    assert relative_error(at_50_hz(found.actions[:, 0]), at_50_hz(forces)) < 0.01


@pytest.mark.parametrize("digits", [3, 4, 6, 15])
@pytest.mark.parametrize("seed", range(4))
def test_a_clean_recording_has_no_spikes(seed, digits):
    observations = np.round(attempt(20 + seed, 3.0)[0], digits)
    kinds = {f.kind for f in inverse_dynamics(observations, COLUMNS, DT, heavy()).findings}
    assert "spike" not in kinds


def test_bang_bang_has_no_spikes():
    system = heavy(control_rate=1000.0, physics_step=DT)
    observations = [system.reset(seed=0)[0]]
    for t in range(3000):
        force = 200.0 if (t // 137) % 2 else -200.0
        observations.append(system.step(np.array([force]))[0])
    found = inverse_dynamics(np.array(observations), COLUMNS, DT, heavy())
    assert not found.findings
    true = np.where((np.arange(3000) // 137) % 2, 200.0, -200.0)
    np.testing.assert_allclose(found.actions[:, 0], true, atol=0.5)


def run_into_the_stop():
    system = heavy(
        control_rate=1000.0, physics_step=DT, rail=2.0, track_limit=0.0, stop_at_fall=False
    )
    observations = [system.reset(seed=0)[0]]
    observations += [system.step(np.array([100.0]))[0] for _ in range(1500)]
    return np.array(observations)


def test_the_stop_is_named_once_with_time_and_speed():
    observations = run_into_the_stop()
    hit = int(np.argmax(observations[:, 0] > 2.0))
    found = inverse_dynamics(observations, COLUMNS, DT, heavy(rail=2.0))
    (stop,) = [f for f in found.findings if f.kind in ("stop", "jolt")]
    assert stop.kind == "stop"
    assert stop.time == pytest.approx(hit * DT, abs=0.01)
    assert stop.size == pytest.approx(observations[hit - 5, 1], rel=0.05)
    assert np.abs(found.forces).max() > 1e3 > 256.0 >= np.abs(found.actions).max()


def test_a_stop_that_nobody_told_of_is_a_jolt_and_one_passed_is_elsewhere():
    observations = run_into_the_stop()
    hit = int(np.argmax(observations[:, 0] > 2.0))
    found = inverse_dynamics(observations, COLUMNS, DT, heavy())
    jolts = [f for f in found.findings if f.kind == "jolt"]
    assert jolts[0].time == pytest.approx(hit * DT, abs=0.02)
    assert jolts[0].size < -256.0
    (passed,) = [
        f
        for f in inverse_dynamics(observations, COLUMNS, DT, heavy(rail=1.5)).findings
        if f.kind == "stop"
    ]
    assert "the stop is somewhere else" in passed.sentence


def test_the_provenance_says_what_was_inferred(pushed):
    bad = pushed[0].copy()
    bad[2000, 3] += 4.0
    shown = recording(bad, COLUMNS)
    inferred = with_actions(shown, heavy(force_limit=30.0))
    assert inferred.provenance.system == "cartpole-swingup"
    assert inferred.provenance.parameters["cart_mass"] == 10.0
    assert inferred.provenance.demonstrator == "person"
    assert inferred.outcome is Outcome.FAILURE
    assert inferred.action_columns == (Column("force", "N"),)
    np.testing.assert_array_equal(inferred.observations, shown.observations)
    assert np.abs(inferred.actions).max() == 30.0
    first, clipped, *others = inferred.provenance.notes
    assert "inferred by inverse dynamics of cartpole-swingup" in first
    share = np.mean(np.abs(inferred.actions) == 30.0)
    assert f"in {100 * share:.2g} % of the steps" in clipped
    assert any("theta_dot has a spike of +4 rad/s at 2.000 s" in note for note in others)


def test_a_long_recording_in_blocks_gives_the_same_as_all_at_once():
    t = np.arange(205_000) * DT
    x, theta = 3.0 * np.sin(0.9 * t), 2.9 + 0.8 * np.sin(2.1 * t)
    observations = np.column_stack([x, 2.7 * np.cos(0.9 * t), theta, 1.68 * np.cos(2.1 * t)]).round(
        4
    )
    observations[:, 2] = (observations[:, 2] + math.pi) % (2 * math.pi) - math.pi
    observations[150_000, 1] += 5.0
    header = Header(DT, COLUMNS, (), Provenance("", {}, "person", None, ""))
    none = np.empty((0, 0))
    blocks = (Block(rows, none) for rows in np.array_split(observations, 40))
    episode = inferring_actions(Episode(header, blocks), heavy())
    sizes, rows, actions = [], [], []
    for block in episode.blocks:
        sizes.append(len(block.observations))
        rows.append(block.observations)
        actions.append(block.actions)
    assert len(sizes) > 1
    np.testing.assert_array_equal(np.concatenate(rows), observations)
    whole = inverse_dynamics(observations, COLUMNS, DT, heavy())
    assert whole.motion.half_width > 0
    np.testing.assert_allclose(np.concatenate(actions), whole.actions, rtol=0, atol=1e-6)
    assert "x_dot has a spike of +5 m/s at 150.000 s" in " ".join(episode.ending().notes)


def test_velocities_lead_from_one_observation_to_the_next(pushed):
    shown = recording(pushed[0], COLUMNS)
    inferred = with_velocities(shown, ["x", "theta"])
    assert inferred.action_columns == (Column("x_dot", "m/s"), Column("theta_dot", "rad/s"))
    reached = shown.select(["x", "theta"])[:-1] + DT * inferred.actions
    reached[:, 1] = [wrap_angle(angle) for angle in reached[:, 1]]
    np.testing.assert_allclose(reached, shown.select(["x", "theta"])[1:], atol=1e-12)
    np.testing.assert_allclose(inferred.actions[:, 1], shown.column("theta_dot")[:-1], atol=0.1)
    assert inferred.provenance.notes == ("actions: not recorded, the velocities of x, theta",)
    blocks = (Block(rows, np.empty((0, 0))) for rows in np.array_split(pushed[0], 7))
    header = Header(DT, COLUMNS, (), shown.provenance)
    streamed = inferring_velocities(Episode(header, blocks), ["x", "theta"]).trajectory()
    np.testing.assert_array_equal(streamed.actions, inferred.actions)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"columns": COLUMNS[:2]}, "has no column 'theta'; it has: x, x_dot"),
        ({"columns": (*COLUMNS[:2], Column("theta", "deg"), COLUMNS[3])}, "'theta' is in deg"),
        ({"rows": 5}, "a recording of 5 rows is too short"),
        ({"system": "flipup"}, "flipup has no inverse dynamics.*the cart-poles have"),
        ({"nan": True}, "column 'theta' is nan in row 7"),
        ({"dt": 0.0}, "dt is 0.0"),
    ],
)
def test_bad_input_is_named(pushed, change, message):
    columns = change.get("columns", COLUMNS)
    observations = pushed[0][: change.get("rows", 100), : len(columns)].copy()
    if change.get("nan"):
        observations[7, 2] = np.nan
    system = make_system(change["system"]) if "system" in change else heavy()
    with pytest.raises(MisstepError, match=message):
        inverse_dynamics(observations, columns, change.get("dt", DT), system)
    with pytest.raises(MisstepError, match="there is no observation column 'y'"):
        with_velocities(recording(pushed[0], COLUMNS), ["y"])


def test_failed_attempts_without_actions_teach_a_heavy_cart_pole_to_swing_up():
    system, shown = heavy(), []
    for seed in range(4):
        observations = np.round(attempt(30 + seed)[0], 4)
        fast = with_actions(recording(observations, COLUMNS), system)
        steps = fast.n_steps // 20
        shown.append(
            type(fast)(
                observations=fast.observations[: 20 * steps + 1 : 20],
                actions=at_50_hz(fast.actions[:, 0])[:, None],
                dt=0.02,
                observation_columns=fast.observation_columns,
                action_columns=fast.action_columns,
                provenance=fast.provenance,
                outcome=fast.outcome,
            )
        )
    run = learn(system, Dataset(shown), "dynamics", max_trials=3, seed=0)
    assert run.trials[-1].outcome is Outcome.SUCCESS
    assert np.abs(run.trials[-1].column("theta")[-250:]).max() < math.radians(12)
