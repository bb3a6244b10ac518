"""Ways to fail at balancing: the pole falls, for each kind in a way of its own.

Every kind is a frozen dataclass of parameters whose `policy` drives a system that observes an
angle ``theta`` [rad] and takes one force [N]; `Random` drives any system.
"""

from collections import deque
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from misstep.demonstrators.recording import DEMONSTRATORS
from misstep.errors import MisstepError
from misstep.parameters import check_parameters, parameter
from misstep.rollout import Policy
from misstep.systems.simulated import LONGEST_TIME
from misstep.systems.system import System


class _Balancing:
    """Watches one angle and pushes with one force."""

    needs: ClassVar[str] = "it must observe theta and take one action"

    @classmethod
    def fits(cls, system: System) -> bool:
        """Return whether there is an angle to watch and one force to push with."""
        observed = {column.name for column in system.observation_columns}
        return "theta" in observed and len(system.action_columns) == 1


@dataclass(frozen=True)
class _Proportional(_Balancing):
    """A force proportional to the angle seen, and noise that is held for a while."""

    gain: float = parameter(20.0, "N/rad", "force per angle of the pole")
    noise: float = parameter(5.0, "N", "standard deviation of the noise on the force", at_least=0)
    hold: float = parameter(
        0.1, "s", "for how long one draw of the noise is held", above=0, at_most=LONGEST_TIME
    )
    delay: float = parameter(0.0, "s", "how late the angle is seen", at_least=0, at_most=60)

    def __post_init__(self) -> None:
        check_parameters(self, f"demonstrator {type(self).__name__.lower()}")

    def policy(self, system: System, rng: np.random.Generator, attempt: int) -> Policy:
        """Return the policy force = gain · theta + noise."""
        return _ProportionalPolicy(self, system, rng)


@DEMONSTRATORS.register("noisy")
@dataclass(frozen=True)
class Noisy(_Proportional):
    """The paper's demonstrator: right on average, F = gain·θ, and too noisy to last."""


@DEMONSTRATORS.register("weak")
@dataclass(frozen=True)
class Weak(_Proportional):
    """Pushes the right way, and too little to catch the pole."""

    gain: float = parameter(10.0, "N/rad", "force per angle of the pole")


@DEMONSTRATORS.register("delayed")
@dataclass(frozen=True)
class Delayed(_Proportional):
    """Pushes hard enough, and too late."""

    delay: float = parameter(0.1, "s", "how late the angle is seen", at_least=0, at_most=60)


@DEMONSTRATORS.register("reversed")
@dataclass(frozen=True)
class Reversed(_Proportional):
    """Pushes the wrong way."""

    gain: float = parameter(-10.0, "N/rad", "force per angle of the pole")


@DEMONSTRATORS.register("random")
@dataclass(frozen=True)
class Random:
    """Acts at random, over everything that the actuators can do, on any system."""

    hold: float = parameter(
        0.1, "s", "for how long one draw of the action is held", above=0, at_most=LONGEST_TIME
    )

    def __post_init__(self) -> None:
        check_parameters(self, "demonstrator random")

    needs: ClassVar[str] = "its actions must have limits"

    @classmethod
    def fits(cls, system: System) -> bool:
        """Return whether every action has limits to draw between."""
        space: Any = system.action_space
        return bool(np.isfinite(space.low).all() and np.isfinite(space.high).all())

    def policy(self, system: System, rng: np.random.Generator, attempt: int) -> Policy:
        """Return the policy action ~ uniform over the action space, held."""
        return _RandomPolicy(self, system, rng)


@DEMONSTRATORS.register("bang-bang")
@dataclass(frozen=True)
class BangBang(_Balancing):
    """A person on two keys: full push to either side, seen with a human's reaction time."""

    force: float = parameter(10.0, "N", "force of a key", above=0)
    dead_zone_deg: float = parameter(1.0, "deg", "angle below which no key is pressed", at_least=0)
    reaction_min: float = parameter(0.2, "s", "shortest reaction time", at_least=0)
    reaction_max: float = parameter(0.3, "s", "longest reaction time", at_least=0, at_most=60)

    def __post_init__(self) -> None:
        check_parameters(self, "demonstrator bang-bang")
        if self.reaction_min > self.reaction_max:
            raise MisstepError(
                f"demonstrator bang-bang: reaction_min is {self.reaction_min:g} s, above "
                f"reaction_max, {self.reaction_max:g} s"
            )

    def policy(self, system: System, rng: np.random.Generator, attempt: int) -> Policy:
        """Return the policy ±force by the sign of theta; one reaction time is drawn an attempt."""
        return _BangBangPolicy(self, system, rng)


class _ProportionalPolicy:
    def __init__(self, kind: _Proportional, system: System, rng: np.random.Generator) -> None:
        self._theta = _theta_index(system)
        self._gain, self._noise = kind.gain, kind.noise
        self._hold = _held_steps(kind.hold, system)
        self._delay = round(kind.delay / system.dt)
        self._rng = rng

    def reset(self) -> None:
        self._seen = _DelayedView(self._delay)
        self._t = 0

    def __call__(self, observation: NDArray[np.float64], /) -> NDArray[np.float64]:
        if self._t % self._hold == 0:
            self._push = self._noise * self._rng.standard_normal()
        self._t += 1
        theta = self._seen(float(observation[self._theta]))
        return np.array([self._gain * theta + self._push])


class _RandomPolicy:
    def __init__(self, kind: Random, system: System, rng: np.random.Generator) -> None:
        self._low, self._high = system.action_space.low, system.action_space.high  # type: ignore[attr-defined]
        self._hold = _held_steps(kind.hold, system)
        self._rng = rng

    def reset(self) -> None:
        self._t = 0

    def __call__(self, observation: NDArray[np.float64], /) -> NDArray[np.float64]:
        if self._t % self._hold == 0:
            self._push = self._rng.uniform(self._low, self._high)
        self._t += 1
        return self._push


class _BangBangPolicy:
    def __init__(self, kind: BangBang, system: System, rng: np.random.Generator) -> None:
        self._theta = _theta_index(system)
        self._force = kind.force
        self._dead_zone = np.radians(kind.dead_zone_deg)
        self._reaction = (kind.reaction_min, kind.reaction_max)
        self._dt = system.dt
        self._rng = rng

    def reset(self) -> None:
        self._seen = _DelayedView(round(self._rng.uniform(*self._reaction) / self._dt))

    def __call__(self, observation: NDArray[np.float64], /) -> NDArray[np.float64]:
        theta = self._seen(float(observation[self._theta]))
        pressed = abs(theta) > self._dead_zone
        return np.array([self._force * np.sign(theta) if pressed else 0.0])


class _DelayedView:
    """Shows each value a number of steps late; 0 before the first has arrived."""

    def __init__(self, steps: int) -> None:
        self._on_the_way = deque([0.0] * steps)

    def __call__(self, value: float) -> float:
        self._on_the_way.append(value)
        return self._on_the_way.popleft()


def _theta_index(system: System) -> int:
    return [column.name for column in system.observation_columns].index("theta")


def _held_steps(hold: float, system: System) -> int:
    return max(1, round(hold / system.dt))
