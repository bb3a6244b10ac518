"""What tests of the robot's room share: a clock, a watchful actuator, wild policies."""

import math
from dataclasses import dataclass

import numpy as np

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
