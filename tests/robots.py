"""What tests of the robot's room share: a clock, a watchful actuator, wild policies."""

import math
from dataclasses import dataclass

import numpy as np

from misstep.robot.guard import Refusal
from misstep.robot.limits import Reason


class Clock:
    """A clock that a test sets."""

    def __init__(self, now=100.0):
        self.now = now

    def __call__(self):
        return self.now


class Actuator:
    """Obeys commands, and checks each by itself, from nothing but the stated limits and the time.

    Value, rate and jerk are checked anew here, in the units of the action, not in the terms of the
    code that is tested.
    """

    def __init__(self, limits, dry_run=False):
        self.limits, self.dry_run = limits, dry_run
        self.action, self.slope = np.array(limits.safe), np.zeros(len(limits.safe))
        self.intended = self.action
        self.at = None
        self.number = 0
        self.time = 0.0
        self.clock = None

    def look_at(self, now):
        """Follow a clock; steps back are no time."""
        if self.clock is not None:
            self.time += max(0.0, now - self.clock)
        self.clock = now

    def obey(self, command, now):
        """Check a command that was sent at `now`, and take it."""
        self.look_at(now)
        limits = self.limits
        low, high, safe = map(np.array, (limits.low, limits.high, limits.safe))
        assert command.number == self.number + 1
        self.number = command.number
        intended = np.array(command.intended)
        assert np.isfinite(intended).all()
        assert (low <= intended).all()
        assert (intended <= high).all()
        passed = limits.period if self.at is None else min(self.time - self.at, limits.period)
        change = intended - self.intended
        slack = 1e-9 * (high - low)
        if command.reason & Reason.STOP:
            np.testing.assert_array_equal(intended, safe)
            self.slope = np.zeros_like(self.slope)
        elif passed == 0.0:
            fixed = np.isfinite(limits.rate) | np.isfinite(limits.jerk)
            np.testing.assert_array_equal(change[fixed], 0.0)
        else:
            assert (np.abs(change) <= np.array(limits.rate) * passed + slack).all()
            bend = np.abs(change - self.slope * passed)
            assert (bend <= np.array(limits.jerk) * passed**2 + slack).all()
            self.slope = change / passed
        self.intended, self.at = intended, self.time
        self.action = np.array(command.action)
        if self.dry_run:
            np.testing.assert_array_equal(self.action, safe)
            assert command.reason & Reason.DRY_RUN
        else:
            assert command.action == command.intended

    @property
    def is_safe(self):
        safe = np.array(self.limits.safe)
        reach = np.array(self.limits.high) - np.array(self.limits.low)
        return bool((np.abs(self.action - safe) <= 1e-8 * reach).all())


class PlainAdmission:
    """What the compiled guard says of states, a second time: word by word, with None for none."""

    def __init__(self, limits, watchdog):
        self.limits, self.watchdog = limits, watchdog
        self.clock, self.time = None, 0.0
        self.last = self.offset = self.fresh_at = None

    def look_at(self, now):
        """Follow a clock; steps back are no time."""
        if self.clock is not None:
            self.time += max(0.0, now - self.clock)
        self.clock = now

    def begin(self, now):
        self.look_at(now)
        self.offset = self.fresh_at = None

    def connect(self):
        self.last = self.offset = None

    def is_silent(self, now):
        self.look_at(now)
        return self.fresh_at is not None and self.time - self.fresh_at > self.watchdog

    def check(self, state, now):
        """Return whether the robot was silent before, and why the state is refused."""
        silent = self.is_silent(now)
        refusal = self.flaw(state) or self.lag(state)
        if refusal is None:
            self.last, self.fresh_at = state, self.time
            if self.offset is None:
                self.offset = self.time - state.stamp
        return silent, refusal

    def flaw(self, state):
        bounds = list(zip(self.limits.observation_low, self.limits.observation_high, strict=True))
        if len(state.observation) != len(bounds):
            return Refusal.LENGTH
        if not all(map(math.isfinite, (state.stamp, state.cost or 0.0, *state.observation))):
            return Refusal.NOT_FINITE
        inside = [
            low <= x <= high for x, (low, high) in zip(state.observation, bounds, strict=True)
        ]
        return None if all(inside) else Refusal.RANGE

    def lag(self, state):
        if self.last is not None and state.sequence <= self.last.sequence:
            return Refusal.ORDER
        if self.offset is None:
            return None
        age = self.time - state.stamp - self.offset
        if state.stamp <= self.last.stamp or age > self.watchdog:
            return Refusal.STALE
        return Refusal.CLOCK if age < -self.watchdog else None


def plain_move(limits, action, slope, wanted, step):
    """Return the next action and slope: of all slopes that the limits allow, the one nearest to
    what would arrive. How fast one may be with so much room left is found by bisection."""
    low, high, rate, jerk = limits.low[0], limits.high[0], limits.rate[0], limits.jerk[0]
    target = min(max(wanted, low), high)
    if math.isinf(jerk):
        reach = rate * step if math.isfinite(rate) else math.inf
        return min(max(target, action - reach), action + reach), slope
    if step == 0.0:
        return action, slope

    def fastest(room):
        slow, fast = 0.0, room / step
        for _ in range(200):
            middle = 0.5 * (slow + fast)
            can_stop = middle * step + middle**2 / (2.0 * jerk) <= room
            slow, fast = (middle, fast) if can_stop else (slow, middle)
        return slow

    way = target - action
    ideal = way / step
    if abs(way) > jerk * step * step:
        ideal = math.copysign(fastest(abs(way)), way)
    most = min(slope + jerk * step, fastest(high - action))
    least = max(slope - jerk * step, -fastest(action - low))
    now = max(min(max(min(ideal, rate), -rate), most), least)
    return min(max(action + now * step, low), high), now


class Scripted:
    """A policy that does what it is told: returns a value, or raises it."""

    def __init__(self):
        self.answer = np.zeros(1)
        self.before = None

    def reset(self):
        self.answer = np.zeros(1)

    def __call__(self, observation):
        if self.before is not None:
            self.before()
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer

    def arrays(self):
        return {"nothing": np.zeros(1)}


def scripted_learner():
    """Return a learner whose every policy is the one scripted policy that it holds."""

    @dataclass(frozen=True)
    class ScriptedLearner:
        rung = 1
        scripted = Scripted()

        def policy(self, task, evidence, rng):
            return self.scripted

        @staticmethod
        def restore(task, arrays):
            return Scripted()

    return ScriptedLearner


NASTY = [math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 0.0, -0.0]
