"""A person drives: the settings, the hand, and the attempt that is being made."""

import math
from dataclasses import dataclass

import numpy as np

from misstep.live.attempt import Attempt, action_of, is_one_way
from misstep.systems import System
from misstep.trajectory import Trajectory

_STROKE_SPEED = 0.05  # a strike lasts a tenth of a second


@dataclass(frozen=True)
class Settings:
    """How a person drives."""

    strength: float = 0.5
    """Share of the actuator's range that a full push is."""
    speed: float = 0.35
    """Seconds of the system in a second."""
    start_angle: float | None = None
    """Where an attempt starts, deg; None: where the system says."""
    countdown: int = 2


class Driving:
    """One attempt after another at a system.

    Parameters
    ----------
    system : System
        Driven by nobody else.
    rng : numpy.random.Generator
        For the seeds of the attempts.
    """

    def __init__(self, system: System, rng: np.random.Generator) -> None:
        self.system = system
        self._rng = rng
        self.settings = Settings(speed=_STROKE_SPEED) if is_one_way(system) else Settings()
        self.hand: list[float] = []
        """How far each action is pushed, from −1 to 1, as the page said last."""
        self.rest()

    def rest(self) -> None:
        """Have the system stand at a start, to be looked at."""
        self.attempt = Attempt(self.system, int(self._rng.integers(2**31)))
        self.let_go()

    def let_go(self) -> None:
        """Show no action, whatever the hand does."""
        self.action = np.zeros(len(self.system.action_columns))

    def begin(self) -> None:
        """Begin another attempt."""
        angle = self.settings.start_angle
        start = None if angle is None else math.radians(angle)
        self.attempt = Attempt(self.system, int(self._rng.integers(2**31)), start)
        self.let_go()

    @property
    def period(self) -> float:
        """Wall-clock time of a step, s."""
        return self.system.dt / self.settings.speed

    def step(self) -> None:
        """Let one control period pass."""
        self.action = action_of(self.system, self.hand, self.settings.strength)
        # A stroke begins with the first push: standing still would be its end.
        idle = is_one_way(self.system) and not self.attempt.n_steps and not np.any(self.action)
        if not idle:
            self.attempt.step(self.action)

    def recorded(self, *notes: str) -> Trajectory | None:
        """Return what has been recorded of the attempt; None if nothing was done."""
        speed = self.settings.speed
        slow = () if speed == 1.0 else (f"time: driven by hand at {speed:g} of real time",)
        return self.attempt.trajectory((*slow, *notes))
