"""Ways to fail at striking: too slow, too fast, or both.

Every attempt follows a speed profile over the position p along the stroke,
A · (v0 + (1 − v0) · smoothstep(p / (r · stroke))), with a trembling hand. Start v0, rise r and
tremor are drawn once per attempt; the speed A says in which way it fails. Speeds are stated as
shares of the largest that can be commanded, ``v_max``. With the default parameters of flip-up and
of basket strikes succeed between shares of 0.53 and 0.94 only.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from misstep.demonstrators.recording import DEMONSTRATORS
from misstep.errors import MisstepError
from misstep.parameters import check_parameters, parameter
from misstep.rollout import Policy
from misstep.systems.striking import StrikingSystem
from misstep.systems.system import System

# Ranges from which an attempt draws.
_STARTS = (0.15, 0.45)  # speed at the start of the stroke, as a share of A
_RISES = (0.2, 0.6)  # share of the stroke over which the speed rises to A
_TREMORS = (0.02, 0.06)  # standard deviation of the velocity, as a share of it


def _share(default: float, meaning: str) -> float:
    value: float = parameter(default, "v_max", meaning, at_least=0, at_most=1)
    return value


class _Striking:
    """Drives the effector of a `StrikingSystem` at a speed A that differs between attempts."""

    needs: ClassVar[str] = "it must have an effector that strikes along a stroke"

    @classmethod
    def fits(cls, system: System) -> bool:
        """Return whether there is an effector to strike with."""
        return isinstance(system, StrikingSystem)

    def policy(self, system: System, rng: np.random.Generator, attempt: int) -> Policy:
        """Return the policy velocity = profile(position) · (1 + tremor)."""
        return _ProfilePolicy(self._speed(rng, attempt), system, rng)

    def _speed(self, rng: np.random.Generator, attempt: int) -> float:
        """Return A as a share of v_max."""
        raise NotImplementedError


@dataclass(frozen=True)
class _OneSided(_Striking):
    slowest: float = _share(0.0, "slowest strike")
    fastest: float = _share(1.0, "fastest strike")

    def __post_init__(self) -> None:
        owner = f"demonstrator {type(self).__name__.lower()}"
        check_parameters(self, owner)
        _check_order(owner, slowest=self.slowest, fastest=self.fastest)

    def _speed(self, rng: np.random.Generator, attempt: int) -> float:
        return rng.uniform(self.slowest, self.fastest)


@DEMONSTRATORS.register("timid")
@dataclass(frozen=True)
class Timid(_OneSided):
    """Strikes too slowly: the block falls back, the ball falls short."""

    slowest: float = _share(0.2, "slowest strike")
    fastest: float = _share(0.52, "fastest strike")


@DEMONSTRATORS.register("strong")
@dataclass(frozen=True)
class Strong(_OneSided):
    """Strikes too fast: the block tips over, the ball flies past."""

    slowest: float = _share(0.95, "slowest strike")
    fastest: float = _share(1.0, "fastest strike")


@DEMONSTRATORS.register("bracket")
@dataclass(frozen=True)
class Bracket(_Striking):
    """Strikes too slowly and too fast in turn, at equal distances from what would succeed."""

    centre: float = _share(0.66, "speed between too slow and too fast")
    nearest: float = _share(0.3, "smallest distance from the centre")
    farthest: float = _share(0.34, "largest distance from the centre")

    def __post_init__(self) -> None:
        check_parameters(self, "demonstrator bracket")
        _check_order("demonstrator bracket", nearest=self.nearest, farthest=self.farthest)
        if not self.farthest <= min(self.centre, 1.0 - self.centre) + 1e-12:
            raise MisstepError(
                f"demonstrator bracket: farthest is {self.farthest:g} v_max, but centre, "
                f"{self.centre:g} v_max, must be at least that far from 0 and from 1 v_max"
            )

    def _speed(self, rng: np.random.Generator, attempt: int) -> float:
        side = -1.0 if attempt % 2 == 0 else 1.0
        return self.centre + side * rng.uniform(self.nearest, self.farthest)


@DEMONSTRATORS.register("lopsided")
@dataclass(frozen=True)
class Lopsided(_Striking):
    """Strikes a little too slowly most of the time, and now and then far too fast."""

    near_slowest: float = _share(0.42, "slowest of the strikes near success")
    near_fastest: float = _share(0.52, "fastest of the strikes near success")
    far_slowest: float = _share(0.95, "slowest of the strikes far from success")
    far_fastest: float = _share(1.0, "fastest of the strikes far from success")
    far_every: int = parameter(4, "", "one attempt in so many is far from success", at_least=1)

    def __post_init__(self) -> None:
        owner = "demonstrator lopsided"
        check_parameters(self, owner)
        _check_order(owner, near_slowest=self.near_slowest, near_fastest=self.near_fastest)
        _check_order(owner, far_slowest=self.far_slowest, far_fastest=self.far_fastest)

    def _speed(self, rng: np.random.Generator, attempt: int) -> float:
        if attempt % self.far_every == self.far_every - 1:
            return rng.uniform(self.far_slowest, self.far_fastest)
        return rng.uniform(self.near_slowest, self.near_fastest)


class _ProfilePolicy:
    def __init__(self, share: float, system: System, rng: np.random.Generator) -> None:
        self._position = [c.name for c in system.observation_columns].index("position")
        self._stroke: float = system.stroke  # type: ignore[attr-defined]
        self._speed = share * float(system.action_space.high[0])  # type: ignore[attr-defined]
        self._rng = rng

    def reset(self) -> None:
        self._start = self._rng.uniform(*_STARTS)
        self._rise = self._rng.uniform(*_RISES)
        self._tremor = self._rng.uniform(*_TREMORS)

    def __call__(self, observation: NDArray[np.float64], /) -> NDArray[np.float64]:
        share = observation[self._position] / (self._rise * self._stroke)
        u = min(max(share, 0.0), 1.0)
        profile = self._start + (1.0 - self._start) * u * u * (3.0 - 2.0 * u)
        tremble = 1.0 + self._tremor * self._rng.standard_normal()
        return np.array([self._speed * profile * tremble])


def _check_order(owner: str, **bounds: float) -> None:
    """Raise unless the first of two named bounds is at most the second."""
    (lower, low), (upper, high) = bounds.items()
    if low > high:
        raise MisstepError(f"{owner}: {lower} is {low:g} v_max, above {upper}, {high:g} v_max")
