"""Judging states that arrive one by one, by the rules of the system that the robot stands for.

A topic carries joint states and no verdict: neither Gazebo nor a robot knows what a fall is. The
cart-poles say it with their parameters (see `misstep.systems.CartPole`); for every other system the
formulas of a `Judged` one decide, or a person.
"""

import math
from typing import NamedTuple

from misstep.robot.limits import Row
from misstep.systems import System


class Verdict(NamedTuple):
    """What is to be said of a state."""

    failed: bool
    """There has been a failure in this trial."""
    succeeded: bool
    """The trial ends here, and is a success."""
    ended: bool
    """The failure ends the trial."""
    cost: float | None
    """Of the step that led here."""


class Referee:
    """Judges the states of one trial after another.

    Parameters
    ----------
    system : System
        Of which parameters and columns are read.
    """

    def __init__(self, system: System) -> None:
        p = system.parameters
        self._knows = {"fall_angle_deg", "track_limit", "upright_time"} <= set(p)
        if not self._knows:
            return
        self._n_steps = round(float(p["duration"]) / system.dt)
        names = [column.name for column in system.observation_columns]
        self._x, self._theta = names.index("x"), names.index("theta")
        self._fall_angle = math.radians(float(p["fall_angle_deg"]))
        self._track_limit = float(p["track_limit"]) or math.inf
        self._stop_at_fall = bool(p["stop_at_fall"])
        self._upright_steps = round(float(p["upright_time"]) / system.dt)
        self._upright_angle = math.radians(float(p["upright_angle_deg"]))
        self.reset()

    def reset(self) -> None:
        """Begin a trial."""
        self._t = self._held = -1
        self._failed = False

    def judge(self, observation: Row) -> Verdict:
        """Judge the next state of the trial, (n,)."""
        if not self._knows:
            return Verdict(False, False, False, None)
        x, theta = observation[self._x], observation[self._theta]
        self._t += 1
        self._failed |= abs(theta) > self._fall_angle or abs(x) > self._track_limit
        upright = self._upright_steps == 0 or abs(theta) < self._upright_angle
        self._held = self._held + 1 if upright else -1
        lasted = self._t >= self._n_steps and not self._failed
        succeeded = lasted and self._held >= self._upright_steps
        return Verdict(
            self._failed or (lasted and not succeeded),
            succeeded,
            self._failed and self._stop_at_fall,
            math.degrees(abs(theta)),
        )
