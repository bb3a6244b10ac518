import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    rule,
    run_state_machine_as_test,
)
from robots import NASTY, Actuator, PlainAdmission, plain_move

from misstep.errors import MisstepError
from misstep.robot.guard import Guard, Refusal, Safety, State
from misstep.robot.limiter import Limiter
from misstep.robot.limits import Limits, Reason
from misstep.systems import Judged

PERIOD = 0.02
SAFETY = Safety(watchdog=0.1)


@pytest.fixture(scope="module")
def limits(cartpole):
    return Limits.of(cartpole, ranges={"x": (-2.0, 2.0)})


def state(sequence, stamp, observation=(0.0, 0.0, 0.0, 0.0)):
    return State(sequence, stamp, tuple(observation))


# Limits


def test_limits_are_those_of_the_spaces_and_further_ones(cartpole):
    limits = Limits.of(cartpole, rate=3.0, jerk=[4.0], safe=1.0, ranges={"x": (-2.0, 9.0)})
    assert (limits.low, limits.high) == ((-20.0,), (20.0,))
    assert (limits.rate, limits.jerk, limits.safe) == ((3.0,), (4.0,), (1.0,))
    assert limits.observation_low == (-2.0, -math.inf, -np.pi, -math.inf)
    assert limits.period == cartpole.dt
    judged = Judged(cartpole, failure="x > 1m")
    assert Limits.of(judged) == Limits.of(cartpole)


@pytest.mark.parametrize(
    ("given_", "message"),
    [
        ({"rate": 0.0}, "rate limit of force is 0"),
        ({"jerk": math.nan}, "jerk limit of force is nan"),
        ({"safe": 21.0}, "safe action is 21 for force, outside its limits -20 .. 20 N"),
        ({"safe": math.nan}, "safe action is nan"),
        ({"rate": [1.0, 2.0]}, "rate limit has 2 numbers, but there are 1 actions"),
        ({"ranges": {"y": (0, 1)}}, "no observation column 'y'; there are: x, x_dot"),
        ({"ranges": {"x": (1, 1)}}, "range of x is 1 .. 1: it is empty"),
        ({"ranges": {"theta": (4, 5)}}, "range of theta is 4 .. 5: outside -3.14159 .. 3.14159"),
    ],
)
def test_limits_that_cannot_be_are_refused(cartpole, refused, given_, message):
    with refused(message):
        Limits.of(cartpole, **given_)


def test_an_actuator_without_an_end_is_refused(limits, refused):
    with refused("needs finite limits"):
        replace(limits, high=(math.inf,))
    with refused("needs finite limits"):  # its range is none, and braking would reckon with it
        replace(limits, low=(-1e308,), high=(1e308,), jerk=(10.0,))


# The limiter

SIZES = st.floats(0.1, 100.0)


@settings(max_examples=200)
@given(
    rate=SIZES | st.just(math.inf),
    jerk=st.floats(1.0, 1e5) | st.just(math.inf),
    moves=st.lists(
        st.tuples(st.floats(-1e3, 1e3), st.sampled_from([0.0, 1e-3, 0.013, PERIOD, 0.5, -1.0])),
        min_size=1,
        max_size=60,
    ),
)
def test_the_limiter_keeps_value_rate_and_jerk(limits, rate, jerk, moves):
    limits = replace(limits, rate=(rate,), jerk=(jerk,), safe=(3.0,))
    limiter = Limiter(limits)
    action, slope = 3.0, 0.0
    for wanted, elapsed in moves:
        limiter.move([wanted], elapsed)
        passed = min(max(elapsed, 0.0), PERIOD)
        change = limiter.action[0] - action
        assert -20.0 <= limiter.action[0] <= 20.0
        if passed == 0.0:
            assert change == 0.0 or (math.isinf(rate) and math.isinf(jerk))
        else:
            assert abs(change) <= rate * passed + 1e-9
            assert abs(change - slope * passed) <= jerk * passed**2 + 1e-9
            slope = change / passed
        action = limiter.action[0]


@settings(max_examples=200)
@given(
    rate=SIZES | st.just(math.inf),
    jerk=st.floats(1.0, 1e5) | st.just(math.inf),
    moves=st.lists(
        st.tuples(st.floats(-30.0, 30.0), st.sampled_from([0.0, 1e-3, 0.013, PERIOD])), max_size=40
    ),
)
def test_the_compiled_limiter_moves_as_the_plain_one(limits, rate, jerk, moves):
    limits = replace(limits, rate=(rate,), jerk=(jerk,), safe=(3.0,))
    limiter = Limiter(limits)
    action, slope = 3.0, 0.0
    for wanted, elapsed in moves:
        limiter.move([wanted], elapsed)
        action, slope = plain_move(limits, action, slope, wanted, elapsed)
        assert limiter.action[0] == pytest.approx(action, rel=1e-6, abs=1e-6)


def test_each_action_has_limits_of_its_own(limits):
    column = limits.action_columns[0]
    both = replace(
        limits, action_columns=(column, replace(column, name="other")), low=(-20.0, -1.0),
        high=(20.0, 1.0), rate=(50.0, math.inf), jerk=(math.inf, 1e3), safe=(0.0, 0.5),
    )  # fmt: skip
    limiter, ones = Limiter(both), [Limiter(_only(both, i)) for i in range(2)]
    for row in np.random.default_rng(1).normal(0.0, [20.0, 1.0], (100, 2)):
        reason = limiter.move(row, PERIOD)
        alone = [one.move([wanted], PERIOD) for one, wanted in zip(ones, row, strict=True)]
        assert limiter.action == ones[0].action + ones[1].action
        assert reason == alone[0] | alone[1]


def _only(limits, i):
    names = ("action_columns", "low", "high", "rate", "jerk", "safe")
    return replace(limits, **{name: (getattr(limits, name)[i],) for name in names})


@settings(max_examples=50)
@given(rate=st.floats(10.0, 100.0), jerk=st.floats(10.0, 1e4), wanted=st.floats(-20.0, 20.0))
def test_the_limiter_arrives_and_stays(limits, rate, jerk, wanted):
    limiter = Limiter(replace(limits, rate=(rate,), jerk=(jerk,)))
    # At full rate, with speeding up and slowing down at full jerk, and some periods of rounding up.
    longest = abs(wanted) / rate + 2 * math.sqrt(abs(wanted) / jerk) + rate / jerk
    n_steps = math.ceil(longest / PERIOD) + 20
    for _ in range(n_steps):
        limiter.move([wanted], PERIOD)
    assert limiter.action[0] == pytest.approx(wanted, abs=1e-6)
    assert limiter.move([wanted], PERIOD) & Reason.RATE == 0
    assert limiter.action[0] == pytest.approx(wanted, abs=1e-6)


@pytest.mark.parametrize("jerk", [500.0, 3e3, 2e4, 1e5])
def test_near_an_end_there_is_room_to_brake_in_steps_of_any_length(limits, jerk):
    limits = replace(limits, jerk=(jerk,))
    for n_long in range(1, 40):
        limiter, action, slope = Limiter(limits), 0.0, 0.0
        for step in [PERIOD] * n_long + [1e-3] * 40:
            limiter.move([20.0], step)
            change, action = limiter.action[0] - action, limiter.action[0]
            assert action <= 20.0
            assert abs(change - slope * step) <= jerk * step**2 + 1e-9
            slope = change / step


def test_the_limiter_without_limits_is_a_clip(limits):
    limiter = Limiter(limits)
    for wanted in np.random.default_rng(0).normal(0.0, 30.0, 200):
        reason = limiter.move([wanted], 0.0)
        assert limiter.action[0] == np.clip(wanted, -20.0, 20.0)
        assert bool(reason & Reason.VALUE) == (abs(wanted) > 20.0)


def test_the_reason_names_what_held_the_action_up(limits):
    limiter = Limiter(replace(limits, rate=(10.0,)))
    assert limiter.move([0.1], PERIOD) == 0
    assert limiter.move([25.0], PERIOD) == Reason.VALUE | Reason.RATE
    assert limiter.action[0] == pytest.approx(0.1 + 10.0 * PERIOD)
    smooth = Limiter(replace(limits, jerk=(100.0,)))
    assert smooth.move([5.0], PERIOD) == Reason.JERK
    assert smooth.action[0] == pytest.approx(100.0 * PERIOD**2)


# States that are refused


@pytest.mark.parametrize(
    ("observation", "why"),
    [
        ((0.0, 0.0, 0.0), Refusal.LENGTH),
        ((0.0,) * 5, Refusal.LENGTH),
        ((), Refusal.LENGTH),
        ((0.0, math.nan, 0.0, 0.0), Refusal.NOT_FINITE),
        ((0.0, 0.0, 0.0, math.inf), Refusal.NOT_FINITE),
        ((2.1, 0.0, 0.0, 0.0), Refusal.RANGE),
        ((0.0, 0.0, 3.2, 0.0), Refusal.RANGE),
        ((0.0, 1e9, 0.0, 0.0), None),
    ],
)
def test_a_state_that_cannot_be_is_refused_and_counted(limits, observation, why):
    guard = Guard(limits, SAFETY)
    guard.begin(0.0)
    assert guard.check(state(1, 0.0, observation), 0.0) == why
    assert guard.refused == ({} if why is None else {why: 1})
    # What was refused has left no trace: the next state is judged as the first.
    assert guard.check(state(1, -5.0), 0.0) is (None if why is not None else Refusal.ORDER)


@pytest.mark.parametrize("flaw", [{"stamp": math.nan}, {"stamp": math.inf}, {"cost": math.inf}])
def test_a_stamp_or_cost_that_is_no_number_is_refused(limits, flaw):
    guard = Guard(limits, SAFETY)
    assert guard.check(state(1, 0.0)._replace(**flaw), 0.0) is Refusal.NOT_FINITE


def test_states_have_to_be_in_order_and_fresh(limits):
    guard = Guard(limits, SAFETY)
    guard.begin(1000.0)
    assert guard.check(state(5, 7.0), 1000.0) is None  # sets the robot's clock
    assert guard.check(state(5, 7.02), 1000.02) is Refusal.ORDER
    assert guard.check(state(4, 7.02), 1000.02) is Refusal.ORDER
    assert guard.check(state(6, 7.0), 1000.02) is Refusal.STALE  # measured no later
    assert guard.check(state(6, 7.02), 1000.13) is Refusal.STALE  # on its way for 110 ms
    assert guard.check(state(6, 7.25), 1000.13) is Refusal.CLOCK  # 120 ms ahead
    assert guard.check(state(6, 7.12), 1000.13) is None
    assert guard.refused == {Refusal.ORDER: 2, Refusal.STALE: 2, Refusal.CLOCK: 1}
    guard.begin(2000.0)  # a new trial sets the robot's clock anew, but goes on counting
    assert guard.check(state(6, 3.0), 2000.0) is Refusal.ORDER
    assert guard.check(state(7, 3.0), 2000.0) is None
    guard.connect()
    assert guard.check(state(1, -9.0), 2000.1) is None


def test_the_watchdog_waits_for_the_first_state_and_then_for_each(limits):
    guard = Guard(limits, SAFETY)
    guard.begin(10.0)
    assert not guard.is_silent(99.0)
    guard.check(state(1, 0.0), 100.0)
    assert not guard.is_silent(100.099)
    assert guard.is_silent(100.101)
    guard.check(state(2, 0.101), 100.101)
    assert not guard.is_silent(100.2)
    guard.check(state(2, 0.3), 100.2)  # refused: not a sign of life
    assert guard.is_silent(100.21)


def test_a_clock_that_jumps_back_stands_still(limits):
    guard = Guard(limits, SAFETY)
    guard.begin(1000.0)
    guard.check(state(1, 0.0), 1000.0)
    assert not guard.is_silent(1000.06)
    assert not guard.is_silent(0.0)
    assert not guard.is_silent(0.03)
    assert guard.is_silent(0.05)  # 60 ms before the jump, 50 ms after it


# What leaves


def test_a_late_action_is_not_sent(limits):
    guard = Guard(limits, Safety(deadline=0.01))
    guard.begin(0.0)
    assert guard.send((5.0,), 0.009, asked=0.0).action == (5.0,)
    late = guard.send((6.0,), 0.031, asked=0.02)
    assert late.action == (0.0,)
    assert late.reason == Reason.LATE
    assert guard.late == 1
    assert guard.send((7.0,), 0.041, asked=0.04).action == (7.0,)


def test_an_emergency_stop_is_immediate_and_latched(limits):
    slow = replace(limits, rate=(1.0,), jerk=(10.0,), safe=(-1.0,))
    guard = Guard(slow, SAFETY)
    guard.begin(0.0)
    for step in range(200):
        command = guard.send((9.0,), PERIOD * step, asked=PERIOD * step)
    assert command.action[0] > 1.0
    guard.stop()
    for step in range(200, 400):
        assert guard.send((9.0,), PERIOD * step, asked=PERIOD * step).action == (-1.0,)
        assert guard.keep_on(PERIOD * step).reason & Reason.STOP
    guard.clear()
    assert guard.keep_on(9.0).action == (-1.0,)
    assert -1.0 < guard.send((9.0,), 9.02, asked=9.02).action[0] < -0.99


def test_a_dry_run_sends_the_safe_action_and_tells_the_other(limits):
    guard = Guard(replace(limits, safe=(2.0,)), Safety(dry_run=True))
    guard.begin(0.0)
    command = guard.send((30.0,), 0.0, asked=0.0)
    assert command.action == (2.0,)
    assert command.intended == (20.0,)
    assert command.reason == Reason.POLICY | Reason.VALUE | Reason.DRY_RUN


# Whatever comes, in whatever order

NUMBERS = st.sampled_from(NASTY) | st.floats(-3.0, 3.0)
ROWS = st.lists(NUMBERS, min_size=0, max_size=5) | st.just([0.0] * 4)
WAITS = st.sampled_from([0.0, 1e-3, 0.007, PERIOD, 0.025, 0.09, 0.11, 3600.0, -0.01, -3600.0])


class AnyOrder(RuleBasedStateMachine):
    """A guard under anything; a fresh state is one that a second reckoning finds fresh too."""

    made = None

    @initialize(
        rate=st.sampled_from([5.0, 50.0, math.inf]),
        jerk=st.sampled_from([30.0, 1e4, math.inf]),
        safe=st.sampled_from([0.0, 20.0, -3.0]),
        dry_run=st.booleans(),
    )
    def begin_with(self, rate, jerk, safe, dry_run):
        limits = replace(self.made, rate=(rate,), jerk=(jerk,), safe=(safe,))
        self.guard = Guard(limits, Safety(dry_run=dry_run))
        self.actuator = Actuator(limits, dry_run)
        self.plain = PlainAdmission(limits, SAFETY.watchdog)
        self.now, self.sequence, self.stopped = 100.0, 0, False

    @rule(wait=WAITS)
    def wait(self, wait):
        self.now += wait
        self.actuator.look_at(self.now)

    @rule(wanted=st.sampled_from([math.nan, math.inf, -math.inf]), took=WAITS)
    def policy_answers_nonsense(self, wanted, took):
        asked = self.now
        self.now += took
        if self.stopped:
            self.check(self.guard.send((wanted,), self.now, asked))
            return
        with pytest.raises(MisstepError, match="its action is"):
            self.guard.send((wanted,), self.now, asked)
        command = self.guard.keep_on(self.now)  # and goes on
        assert not command.reason & Reason.POLICY
        self.check(command)

    @rule()
    def begin_trial(self):
        self.guard.begin(self.now)
        self.plain.begin(self.now)

    @rule()
    def connect(self):
        self.guard.connect()
        self.plain.connect()
        self.sequence = 0

    @rule(row=ROWS, ahead=st.integers(-2, 3), stamp=NUMBERS | st.just(None))
    def state_comes(self, row, ahead, stamp):
        self.sequence += ahead
        stamp = self.now if stamp is None else stamp
        state = State(self.sequence, stamp, tuple(row))
        silent, refusal = self.plain.check(state, self.now)
        assert self.guard.check(state, self.now) == refusal
        assert self.guard.was_silent == silent
        if refusal is None:
            np.testing.assert_array_equal(self.guard.observation, row)
            assert np.isfinite([*row, stamp]).all()
            assert abs(row[0]) <= 2.0
            assert abs(row[2]) <= np.pi

    @rule()
    def somebody_looks_at_the_watchdog(self):
        assert self.guard.is_silent(self.now) == self.plain.is_silent(self.now)

    @rule(wanted=st.floats(allow_nan=False, allow_infinity=False), took=WAITS)
    def policy_answers(self, wanted, took):
        asked = self.now
        self.now += took
        self.plain.look_at(self.now)
        command = self.guard.send((wanted,), self.now, asked)
        if took > PERIOD:
            assert not command.reason & Reason.POLICY
        self.check(command)

    @rule()
    def nothing_new(self):
        self.check(self.guard.keep_on(self.now))

    @rule(why=st.sampled_from([Reason.IDLE, Reason.WATCHDOG]))
    def retreat(self, why):
        self.guard.retreat(why)
        command = self.guard.keep_on(self.now)
        assert not command.reason & Reason.POLICY
        self.check(command)

    @rule()
    def stop(self):
        self.guard.stop()
        self.stopped = True

    @rule()
    def clear(self):
        self.guard.clear()
        self.stopped = False

    @rule()
    def retreat_arrives(self):
        self.guard.retreat(Reason.IDLE)
        for _ in range(600):  # 40 N at 5 N/s take 400
            self.now += PERIOD
            self.check(self.guard.keep_on(self.now))
            if self.actuator.is_safe:
                return
        raise AssertionError("the safe action was never reached")

    def check(self, command):
        self.plain.look_at(self.now)
        self.actuator.obey(command, self.now)
        assert bool(command.reason & Reason.STOP) == self.stopped

    @invariant()
    def is_told_safe_only_when_it_is(self):
        if hasattr(self, "actuator") and self.guard.is_safe:
            assert self.actuator.is_safe


def test_whatever_comes_what_leaves_is_within_the_limits(limits):
    machine = type("Machine", (AnyOrder,), {"made": limits})
    run_state_machine_as_test(
        machine, settings=settings(max_examples=40, stateful_step_count=40, deadline=None)
    )
