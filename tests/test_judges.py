import math
import re

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import assume, given
from hypothesis import strategies as st

from misstep import Outcome, demonstrate, learn, load_run, make_system, rollout
from misstep.errors import MisstepError
from misstep.formats.format import Episode
from misstep.judges import DEEPEST, FLAGS, LONGEST, parse_cost, parse_predicate
from misstep.recordings.outcomes import judged
from misstep.systems import CartPole, Judged
from misstep.trajectory import Column

COLUMNS = (
    Column("x", "m"),
    Column("theta", "rad"),
    Column("tilt", "deg"),
    Column("o0", ""),
    Column("arm.speed", "rad/s"),
)


def observe(x=0.0, theta=0.0, tilt=0.0, o0=0.0, speed=0.0):
    return np.array([x, theta, tilt, o0, speed])


# Formulas

PLAIN = (Column("a", ""), Column("b", ""), Column("c", ""))
NUMBERS = st.floats(-10, 10, allow_subnormal=False).map(lambda v: round(v, 3))


def _extended(numbers, truths):
    """Return larger numbers and conditions made of these, as texts that Python reads too."""
    join = "({} {} {})".format
    number = st.one_of(
        st.builds(join, numbers, st.sampled_from("+-*/"), numbers),
        st.builds(
            "{} {} {} {} {}".format, numbers, st.sampled_from("+-"), numbers, st.just("*"), numbers
        ).map("({})".format),
        st.builds("{}({})".format, st.sampled_from(["abs", "sin", "cos", "-", "+", ""]), numbers),
        st.builds("sqrt(abs({}))".format, numbers),
        st.builds("{}({}, {})".format, st.sampled_from(["min", "max"]), numbers, numbers),
    )
    comparison = st.sampled_from(["<", "<=", ">", ">=", "==", "!="])
    truth = st.one_of(
        st.builds("{} {} {}".format, numbers, comparison, numbers),
        st.builds("{} {} {} {} {}".format, numbers, comparison, numbers, comparison, numbers),
        st.builds("{} {} {}".format, truths, st.sampled_from(["and", "or"]), truths),
        st.builds("not {}".format, truths),
        st.builds("({})".format, truths),
    )
    return number, truth


def _grown(levels):
    numbers = st.one_of(st.sampled_from("abc"), NUMBERS.map(abs).map(str))
    truths = st.builds("{} < {}".format, numbers, numbers)
    for _ in range(levels):
        numbers, truths = _extended(numbers, truths)
    return numbers, truths


SOME_NUMBERS, SOME_TRUTHS = _grown(3)


def by_python(text, values):
    names = {
        "sin": math.sin,
        "cos": math.cos,
        "sqrt": math.sqrt,
        "abs": abs,
        "min": min,
        "max": max,
        **dict(zip("abc", values, strict=True)),
    }
    return eval(text, {"__builtins__": {}}, names)  # noqa: S307


@given(SOME_NUMBERS, st.tuples(NUMBERS, NUMBERS, NUMBERS))
def test_numbers_are_those_of_python(text, values):
    assume(len(text) <= LONGEST)
    found = parse_cost(text, PLAIN)(np.array(values))
    try:
        expected = by_python(text, values)
    except ZeroDivisionError:
        return  # Python refuses where floating-point arithmetic goes on; tested below
    except ValueError:
        assert math.isnan(found)  # the sine of infinity
        return
    assert found == expected or (math.isnan(found) and math.isnan(expected))


@given(SOME_TRUTHS, st.tuples(NUMBERS, NUMBERS, NUMBERS))
def test_conditions_are_those_of_python(text, values):
    assume(len(text) <= LONGEST)
    found = parse_predicate(text, PLAIN)(np.array(values))
    assert isinstance(found, bool)
    try:
        expected = by_python(text, values)
    except (ZeroDivisionError, ValueError):
        return
    assert found == expected


@given(st.text("abc()<>=!+-*/.,0123456789e degmnotradx", max_size=40))
def test_any_text_is_read_or_refused_in_one_line(text):
    message, value = "", None
    try:
        value = parse_predicate(text, COLUMNS)(observe(1, 2, 3, 4, 5))
    except MisstepError as error:
        message = str(error)
    assert (value is None) == bool(message)
    assert value in (None, True, False)
    assert "\n" not in message


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1 / 0", math.inf),
        ("-1 / 0", -math.inf),
        ("0 / 0", math.nan),
        ("sqrt(-1)", math.nan),
        ("sin(1 / 0)", math.nan),
        ("2 - 3 - 4", -5.0),
        ("8 / 4 / 2", 1.0),
        ("-2 * -3", 6.0),
        ("2 + 3 * 4", 14.0),
        ("abs(0 - 3)", 3.0),
        ("1.5e1 + .5", 15.5),
    ],
)
def test_arithmetic(text, value):
    np.testing.assert_equal(parse_cost(text, COLUMNS)(observe()), value)


def test_a_comparison_with_no_number_is_false():
    for sign in ("<", "<=", ">", ">=", "=="):
        assert parse_predicate(f"0 / 0 {sign} 1", COLUMNS)(observe()) is False


@pytest.mark.parametrize(
    ("text", "true", "false"),
    [
        ("abs(theta) > 30deg", {"theta": -0.53}, {"theta": 0.52}),
        ("abs(theta) > 0.5", {"theta": 0.51}, {"theta": 0.49}),
        ("tilt > 30deg", {"tilt": 31}, {"tilt": 29}),
        ("tilt > 0.5rad", {"tilt": 29}, {"tilt": 28}),  # 28.65 deg
        ("tilt > 30", {"tilt": 31}, {"tilt": 29}),
        ("30deg < tilt", {"tilt": 31}, {"tilt": 29}),
        ("tilt > theta", {"tilt": 58, "theta": 1.0}, {"tilt": 57, "theta": 1.0}),
        ("theta + 10deg > 20 deg", {"theta": 0.18}, {"theta": 0.17}),
        ("max(theta, 10deg) > 0.2", {"theta": 0.21}, {"theta": 0.19}),
        ("abs(theta - 90deg) < 2 * 3deg", {"theta": 1.5}, {"theta": 1.4}),
        ("x > 5cm", {"x": 0.06}, {"x": 0.04}),
        ("-50 mm < x < 5cm", {"x": -0.04}, {"x": -0.06}),
        ("arm.speed > 90deg/s", {"speed": 1.6}, {"speed": 1.5}),
        ("x / 5cm > 2", {"x": 0.11}, {"x": 0.09}),
        ("x + 0.5 * sin(theta) > 1m", {"x": 0.6, "theta": 1.5}, {"x": 0.4, "theta": 1.5}),
        ("sin(tilt) > 0.5", {"tilt": 31}, {"tilt": 29}),
        ("o0 > cos(60deg)", {"o0": 0.51}, {"o0": 0.49}),
        ("sqrt(x * x) > 3", {"x": -4}, {"x": 2}),
        ("not (x > 1 or theta > 1)", {}, {"theta": 2}),
        ("x > 0 and not theta > 1 or o0 == 3", {"o0": 3}, {"x": 1, "theta": 2}),
    ],
)
def test_units_are_converted_where_they_meet(text, true, false):
    predicate = parse_predicate(text, COLUMNS)
    assert predicate(observe(**true)) is True
    assert predicate(observe(**false)) is False


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", r"character 1: a value is missing before the end"),
        ("abs(theta > 3", r"character 14: '\)' is missing .* the '\(' at character 4"),
        ("x > ", "character 5: a value is missing before the end: 'x > .here.'"),
        ("x = 3", r"character 3: '=' is no part of a formula: 'x \[here\] = 3'"),
        ("x > 1 2", "character 7: '2' does not belong here"),
        ("(x > 1))", r"character 8: '\)' does not belong here"),
        ("phi > 1", r"no column 'phi'; there are: x \[m\], theta \[rad\], tilt \[deg\], o0, arm"),
        ("tan(x) > 1", "no function 'tan'; there are: abs, sin, cos, sqrt, min, max"),
        ("__import__(x)", "no function '__import__'"),
        ("x.real > 1", r"no column 'x\.real'"),
        ("x ** 2 > 1", r"character 4: a value is missing before '\*'"),
        ("theta > 30grad", "'grad' is no unit; there are: m, cm"),
        ("x > 3deg", "this is in rad and cannot be set against what is in m: 'x > .here. 3deg'"),
        ("o0 > 3cm", "this is in m and cannot be set against what is without a unit"),
        ("x > theta", "this is in rad and cannot be set against what is in m"),
        ("sin(x) > 0", "sin takes an angle, but this is in m"),
        ("abs(x, x) > 1", "abs takes one value, not 2"),
        ("theta", "a condition is wanted here, such as x > 1, not a number"),
        ("not x", "a condition is wanted"),
        ("x and theta > 1", "character 1: a condition is wanted"),
        ("1 + (x > 1) > 0", "a number is wanted here, not a condition"),
        ("abs(x > 1) > 0", "a number is wanted here"),
        ("x > 1e999", "1e999 is too large a number"),
        ("x > '1'", r"character 5: \"'\" is no part"),
        ("(" * 100 + "x", f"more than {DEEPEST} levels"),
        ("not " * 100 + "x > 1", f"more than {DEEPEST} levels"),
        ("-" * 100 + "x > 1", f"more than {DEEPEST} levels"),
        ("x > 1" + " " * LONGEST, f"has 505 characters; at most {LONGEST}"),
        ("python:tipped", "the Python function 'tipped', which a file cannot hold"),
        (3.0, "the predicate is 3.0: give a formula or a function"),
    ],
)
def test_what_cannot_be_read_is_told_in_one_line(refused, text, line):
    with refused(line):
        parse_predicate(text, COLUMNS)


def test_a_cost_is_a_number(refused):
    with refused("the cost, character 1: a number is wanted"):
        parse_cost("x > 1", COLUMNS)


def test_a_formula_of_greatest_length_is_read():
    text = "x" + "+x" * ((LONGEST - 1) // 2)
    assert parse_cost(text, COLUMNS)(observe(x=1.0)) == (LONGEST - 1) // 2 + 1


def test_predicates_are_combined():
    def tipped(observation):
        return observation[1] > 1.0

    far = parse_predicate("x > 2", COLUMNS)
    slow = parse_predicate("arm.speed < 1", COLUMNS)
    here, there = observe(x=3.0, speed=2.0), observe(x=1.0, theta=2.0)
    for combined, text, truths in (
        (far & slow, "(x > 2) and (arm.speed < 1)", (False, False)),
        (far | slow, "(x > 2) or (arm.speed < 1)", (True, True)),
        (~far, "not (x > 2)", (False, True)),
        (far | tipped, "python:(x > 2) or (tipped)", (True, True)),
        (~(far | tipped), "python:not ((x > 2) or (tipped))", (False, False)),
    ):
        assert combined.text == text
        assert (combined(here), combined(there)) == truths
        if not text.startswith("python:"):
            again = parse_predicate(text, COLUMNS)
            assert (again(here), again(there)) == truths


# Systems


class Idle:
    def reset(self):
        pass

    def __call__(self, observation):
        return np.zeros(1)


def test_a_formula_fails_when_the_same_parameter_does():
    built_in = make_system("cartpole", fall_angle_deg=20.0, track_limit=0.3)
    judged = make_system("cartpole", failure="abs(theta) > 20deg or abs(x) > 30cm")
    assert isinstance(judged, Judged)
    reasons = set()
    for seed, by in enumerate(["weak", "random", "random", "random"]):
        expected, found = (demonstrate(s, by, n=3, seed=seed, time="") for s in (built_in, judged))
        for one, other in zip(expected, found, strict=True):
            np.testing.assert_array_equal(one.observations, other.observations)
            np.testing.assert_array_equal(one.costs, other.costs)
            assert one.failure_step == other.failure_step == other.n_steps
            reasons.add(bool(abs(one.column("x")[-1]) > 0.3))
    assert reasons == {True, False}


def test_the_systems_own_failure_remains_one():
    judged = make_system("cartpole", failure="abs(x) > 1m", start_angle=0.4)
    trajectory = rollout(judged, Idle(), seed=0, demonstrator="test")
    assert trajectory.outcome is Outcome.FAILURE
    assert abs(trajectory.column("theta")[-1]) > math.radians(30)
    assert abs(trajectory.column("x")).max() < 1.0


def test_an_episode_can_start_in_a_failure():
    judged = make_system("cartpole", failure="theta > 5deg", start_angle=0.2, start_spread=0.0)
    _, info = judged.reset(seed=0)
    assert info["failed"]
    assert rollout(judged, Idle(), seed=0, demonstrator="test").failure_step == 0


def swinging(**parameters):
    """Return a rollout of a frictionless pendulum that swings through the bottom and back."""
    system = make_system(
        "cartpole",
        start_angle=2.0,
        start_spread=0.0,
        fall_angle_deg=180.0,
        hinge_damping=0.0,
        **parameters,
    )
    return rollout(system, Idle(), seed=0, demonstrator="test")


@pytest.mark.parametrize("hold", [0.0, 0.1, 0.5])
def test_success_must_hold_to_the_end(hold):
    successes = []
    for steps in range(20, 120, 3):
        trajectory = swinging(duration=steps / 50, success="abs(theta) > 150deg", hold=hold)
        last = np.abs(trajectory.column("theta"))[-1 - round(hold * 50) :]
        expected = len(last) == round(hold * 50) + 1 and bool((last > math.radians(150)).all())
        assert (trajectory.outcome is Outcome.SUCCESS) == expected
        assert trajectory.failure_step == (None if expected else steps)
        successes.append(expected)
    assert len(set(successes)) == (1 if hold == 0.5 else 2)


def test_a_success_replaces_that_the_system_timed_out():
    judged = make_system("cartpole-swingup", duration=6.0, success="abs(theta) > 90deg", hold=1.0)
    trajectory = rollout(judged, Idle(), seed=0, demonstrator="test")
    assert trajectory.outcome is Outcome.SUCCESS
    unjudged = rollout(judged.unwrapped, Idle(), seed=0, demonstrator="test")
    assert unjudged.outcome is Outcome.FAILURE
    watched = make_system("cartpole-swingup", duration=6.0, cost="abs(x)")
    observed = rollout(watched, Idle(), seed=0, demonstrator="test")
    assert observed.failure_step == observed.n_steps == 300


def test_without_a_success_the_systems_own_counts():
    quiet = make_system("cartpole", failure="abs(x) > 1m", duration=0.2)
    assert rollout(quiet, Idle(), seed=0, demonstrator="test").outcome is Outcome.SUCCESS


def test_cost_is_minus_the_reward():
    trajectory = swinging(duration=1.0, cost="abs(theta) * 57.3 + x * x")
    after = trajectory.observations[1:]
    np.testing.assert_allclose(
        trajectory.costs, np.abs(after[:, 2]) * 57.3 + after[:, 0] ** 2, rtol=1e-12
    )
    assert make_system("cartpole", cost="abs(theta)").cost is None, "it would be another one"
    assert make_system("cartpole", failure="x > 1").cost == CartPole().cost


def test_a_cost_must_be_finite(refused):
    system = make_system("cartpole", cost="1 / (x - x)")
    with refused(r"cartpole: the cost '1 / \(x - x\)' is inf at x = .*, theta = .* finite"):
        rollout(system, Idle(), seed=0, demonstrator="test")


def test_python_functions_judge_too(refused):
    def far_left(observation):
        return observation[0] < -0.1

    system = make_system("cartpole", failure=far_left, cost=lambda o: o[0] ** 2)
    for trajectory in demonstrate(system, "random", n=5, seed=1):
        x = trajectory.column("x")
        assert trajectory.failure_step == trajectory.n_steps
        assert (x[:-1] >= -0.1).all()
        np.testing.assert_allclose(trajectory.costs, x[1:] ** 2)
    assert system.parameters["failure"] == "python:far_left"
    with refused("cartpole, failure was the Python function 'far_left'"):
        make_system("cartpole", **system.parameters)


def test_provenance_rebuilds_the_judge(tmp_path):
    system = make_system(
        "cartpole",
        pole_mass=0.2,
        success="abs(theta) <\n 25deg",
        failure="abs(x) > 40cm",
        hold=1,
        cost="abs(x)",
        duration=3.0,
    )
    trajectory = demonstrate(system, "random", n=1, seed=3, time="")[0]
    assert trajectory.provenance.system == "cartpole"
    again = make_system("cartpole", **trajectory.provenance.parameters)
    assert again.parameters == system.parameters
    assert again.parameters["success"] == "abs(theta) < 25deg"
    assert again.parameters["hold"] == 1.0
    assert demonstrate(again, "random", n=1, seed=3, time="")[0] == trajectory
    learn(system, demonstrate(system, "weak", n=2), "mean", max_trials=1, out=tmp_path / "run")
    assert load_run(tmp_path / "run").config.make_system().parameters == system.parameters


def test_demonstrators_see_the_system_inside():
    strict = make_system("flipup", failure="velocity > 1")
    trajectories = demonstrate(strict, "bracket", n=4, seed=0)
    assert {t.outcome for t in trajectories} == {Outcome.FAILURE}
    assert strict.unwrapped.system_id == strict.system_id == "flipup"


@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space")
@pytest.mark.filterwarnings("ignore:.*A Box observation space (min|max)imum value is -?infinity")
@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
def test_passes_gymnasium_checks():
    check_env(
        make_system("cartpole", success="x > 0", hold=1.0, cost="abs(x)"), skip_render_check=True
    )


def test_renders_what_is_inside():
    system = make_system("cartpole", render_mode="rgb_array", failure="x > 1")
    system.reset(seed=0)
    assert system.render().shape == (360, 640, 3)
    system.close()


def test_an_episode_that_is_over_is_told():
    system = make_system("cartpole", failure="x > -1")
    with pytest.raises(MisstepError, match=r"cartpole: no episode is running; call reset\(\)"):
        system.step(np.zeros(1))
    system.reset(seed=0)
    assert system.step(np.zeros(1))[2]
    with pytest.raises(MisstepError, match=r"call reset\(\)"):
        system.step(np.zeros(1))


@pytest.mark.parametrize(
    ("judge", "line"),
    [
        ({"failure": "tilt > 1"}, r"cartpole, failure, character 1: no column 'tilt'; .*x \[m\]"),
        ({"success": "theta"}, "cartpole, success, character 1: a condition is wanted"),
        ({"cost": "x < 1"}, "cartpole, cost, character 1: a number is wanted"),
        ({"hold": 2.0}, "cartpole: hold needs a success to hold"),
        ({"hold": 2.0, "failure": "x > 1"}, "hold is 2 s but there is no success to hold"),
        ({"hold": -1, "success": "x > 1"}, "hold is -1 but must be a time in s, at least 0"),
        ({"hold": "long", "success": "x > 1"}, "hold is 'long' but must be a time"),
        ({"failure": 3}, "cartpole, failure is 3: give a formula or a function"),
    ],
)
def test_wrong_judges_are_told_in_one_line(refused, judge, line):
    with refused(line):
        make_system("cartpole", **judge)


# Units


@pytest.mark.parametrize(
    ("text", "row", "expected"),
    [
        ("sqrt(x*x + y*y) > 1m", [2.0, 0.0, 0.0, 0.0], False),  # mm
        ("sqrt(x*x + y*y) > 1m", [999.0, 100.0, 0.0, 0.0], True),
        ("x*x + y*y > 1", [1001.0, 0.0, 0.0, 0.0], True),  # in m², as products are
        ("a*a > 30deg*30deg", [0.0, 0.0, 1.0, 0.0], False),  # deg
        ("a*a > 30deg*30deg", [0.0, 0.0, 31.0, 0.0], True),
        ("a > 30", [0.0, 0.0, 31.0, 0.0], True),  # a plain number is in the column's own unit
        ("a > 30", [0.0, 0.0, 29.0, 0.0], False),
        ("abs(2 * a) > 60 - 1", [0.0, 0.0, -29.6, 0.0], True),
        ("a > 0.5rad", [0.0, 0.0, 29.0, 0.0], True),
        ("a > b", [0.0, 0.0, 60.0, 1.0], True),  # deg against rad: 1.05 > 1
        ("a > b", [0.0, 0.0, 57.0, 1.0], False),
        ("a + 0.5rad > 58", [0.0, 0.0, 30.0, 0.0], True),
        ("min(x, 3mm) < 0.002m", [1.0, 0.0, 0.0, 0.0], True),
        ("sin(a) > 0.5", [0.0, 0.0, 31.0, 0.0], True),
        ("x / 2 > 500", [1001.0, 0.0, 0.0, 0.0], True),
    ],
)
def test_units_are_the_same_in_products_and_in_any_column(text, row, expected):
    columns = (Column("x", "mm"), Column("y", "mm"), Column("a", "deg"), Column("b", "rad"))
    assert parse_predicate(text, columns)(np.array(row)) is expected
    # The same in the units without prefixes.
    si = (Column("x", "m"), Column("y", "m"), Column("a", "rad"), Column("b", "rad"))
    factors = np.array([1e-3, 1e-3, math.pi / 180, 1.0])
    if not re.search(r"(a > 30|> 58|> 60|> 500)", text):  # plain numbers are in other units there
        assert parse_predicate(text, si)(np.array(row) * factors) is expected


def test_what_the_environment_says_of_a_step_is_a_condition():
    system = make_system("cartpole", fall_angle_deg=10.0)
    fails = Judged(system, failure="terminated or x > 100")
    trajectory = rollout(fails, Idle(), seed=0, demonstrator="test")
    assert trajectory.outcome is Outcome.FAILURE
    assert trajectory.failure_step == trajectory.n_steps
    ends = Judged(make_system("cartpole", duration=0.1), success="truncated and not terminated")
    assert rollout(ends, Idle(), seed=0, demonstrator="test").outcome is Outcome.SUCCESS
    with pytest.raises(MisstepError, match="no column 'terminated'"):
        parse_predicate("terminated", system.observation_columns)


@pytest.mark.parametrize("x", [0.0, 2.0])
@pytest.mark.parametrize("over", [False, True])
def test_conditions_on_flags_can_be_joined_with_others(x, over):
    columns = make_system("cartpole").observation_columns
    ended = parse_predicate("terminated", columns, flags=FLAGS)
    row = np.concatenate([[x], np.zeros(len(columns) - 1), [over, False]])
    width = len(columns)

    def far(observation):
        assert len(observation) == width
        return observation[0] > 1

    for formula, expected in [
        (ended & far, over and x > 1),
        (ended | far, over or x > 1),
        (~ended & far, not over and x > 1),
        (parse_predicate("x > 1", columns) | ended, over or x > 1),
        (ended & ended, over),
    ]:
        assert formula.reads_flags
        assert formula(row) is expected


@pytest.mark.parametrize("seconds", [0.2, 0.98, 1.0, 1.5])
def test_a_recording_is_judged_as_it_would_be_live(seconds):
    # Success all along, and hold longer than some of them last.
    judge = {"success": "abs(x) < 1", "hold": 1.0}
    driven = make_system("cartpole", duration=seconds, fall_angle_deg=180.0, **judge)
    live = rollout(driven, Idle(), seed=0, demonstrator="test")
    plain = rollout(driven.unwrapped, Idle(), seed=0, demonstrator="test")
    recorded = judged(Episode.of(plain), failure=None, **judge)
    list(recorded.blocks)
    assert recorded.ending().outcome == live.outcome
    assert (live.outcome is Outcome.SUCCESS) == (seconds >= 1.0)
