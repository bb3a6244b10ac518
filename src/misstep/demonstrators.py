"""Ways to fail: demonstrators that cannot balance the pole, each in a way of its own.

Every kind is a frozen dataclass of parameters whose `policy` drives a system that observes an
angle ``theta`` [rad] and takes one force [N]. `demonstrate` collects their failed attempts; the
few that succeed by luck are thrown away, because nobody who can do the task needs misstep.
"""

from collections import deque
from dataclasses import asdict, dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.parameters import (
    ParameterRow,
    ParameterValue,
    build_parameters,
    check_parameters,
    parameter,
    parameter_table,
)
from misstep.registry import Registry
from misstep.rollout import Policy, rollout
from misstep.systems.system import System
from misstep.trajectory import Dataset, Outcome, Trajectory

_ATTEMPTS_PER_FAILURE = 50


class Demonstrator(Protocol):
    """A dataclass of parameters that can make a policy."""

    def policy(self, system: System, rng: np.random.Generator) -> Policy:
        """Return a policy for `system` that draws all its randomness from `rng`."""


DEMONSTRATORS: Registry[type[Demonstrator]] = Registry("demonstrator", "misstep.demonstrators")


def demonstrate(
    system: System,
    by: str = "noisy",
    n: int = 4,
    seed: int = 0,
    *,
    time: str | None = None,
    **parameters: ParameterValue,
) -> Dataset:
    """Record failed demonstrations.

    Parameters
    ----------
    system : System
        Must observe a column ``theta`` and take one action.
    by : str
        Kind of demonstrator, one of `list_demonstrators`.
    n : int
        Number of failed attempts to record.
    seed : int
        Attempt i of a seed is always the same, whatever `n`.
    time : str, optional
        When, ISO 8601, for the provenance alone; now if left out.
    **parameters
        The demonstrator's own, in the units that `list_demonstrators` states.

    Returns
    -------
    Dataset
        `n` trajectories whose outcome is a failure.

    Raises
    ------
    MisstepError
        If there is no such demonstrator or parameter, `n` is below 1, the system has no column
        ``theta`` or several actions, or the demonstrator fails less than once in 50 attempts.
    """
    kind = DEMONSTRATORS[by]
    demonstrator = build_parameters(kind, f"demonstrator {by}", parameters)
    if n < 1:
        raise MisstepError(f"n is {n}: at least 1 demonstration must be asked for")
    who = _signature(by, demonstrator)
    failures: list[Trajectory] = []
    attempts = _ATTEMPTS_PER_FAILURE * n
    for attempt in range(attempts):
        trajectory = _attempt(system, demonstrator, who, _attempt_seed(seed, attempt), time)
        if trajectory.outcome is Outcome.FAILURE:
            failures.append(trajectory)
        if len(failures) == n:
            return Dataset(failures)
    raise MisstepError(
        f"demonstrator {by} failed in {len(failures)} of {attempts} attempts, but {n} failures "
        "are wanted: choose one that fails more often, for example 'reversed', or a longer duration"
    )


def list_demonstrators() -> dict[str, list[ParameterRow]]:
    """Return the table of parameters (name, default, unit, meaning) of every demonstrator."""
    return {name: parameter_table(DEMONSTRATORS[name]) for name in DEMONSTRATORS}


def _attempt_seed(seed: int, attempt: int) -> int:
    if seed < 0:
        raise MisstepError(f"seed is {seed}: it must not be negative")
    return int(np.random.SeedSequence(seed, spawn_key=(attempt,)).generate_state(1)[0])


def _attempt(
    system: System, demonstrator: Demonstrator, who: str, seed: int, time: str | None
) -> Trajectory:
    # The system draws from `seed` itself; the spawn key keeps the demonstrator's noise
    # independent of it, and the one recorded seed still repeats the whole attempt.
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0,)))
    policy = demonstrator.policy(system, rng)
    return rollout(system, policy, seed=seed, demonstrator=who, time=time)


def _signature(by: str, demonstrator: Demonstrator) -> str:
    """Return the kind's name, followed by the parameters that are not at their defaults."""
    values = asdict(demonstrator)  # type: ignore[call-overload]
    changed = [
        f"{row.name}={values[row.name]:g}"
        for row in parameter_table(type(demonstrator))
        if values[row.name] != row.default
    ]
    return f"{by}({', '.join(changed)})" if changed else by


@dataclass(frozen=True)
class _Proportional:
    """A force proportional to the angle seen, and noise that is held for a while."""

    gain: float = parameter(20.0, "N/rad", "force per angle of the pole")
    noise: float = parameter(5.0, "N", "standard deviation of the noise on the force", at_least=0)
    hold: float = parameter(0.1, "s", "for how long one draw of the noise is held", above=0)
    delay: float = parameter(0.0, "s", "how late the angle is seen", at_least=0)

    def __post_init__(self) -> None:
        check_parameters(self, f"demonstrator {type(self).__name__.lower()}")

    def policy(self, system: System, rng: np.random.Generator) -> Policy:
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

    delay: float = parameter(0.1, "s", "how late the angle is seen", at_least=0)


@DEMONSTRATORS.register("reversed")
@dataclass(frozen=True)
class Reversed(_Proportional):
    """Pushes the wrong way."""

    gain: float = parameter(-10.0, "N/rad", "force per angle of the pole")


@DEMONSTRATORS.register("random")
@dataclass(frozen=True)
class Random:
    """Pushes at random, over everything that the actuator can do."""

    hold: float = parameter(0.1, "s", "for how long one draw of the force is held", above=0)

    def __post_init__(self) -> None:
        check_parameters(self, "demonstrator random")

    def policy(self, system: System, rng: np.random.Generator) -> Policy:
        """Return the policy force ~ uniform over the action space, held."""
        return _RandomPolicy(self, system, rng)


@DEMONSTRATORS.register("bang-bang")
@dataclass(frozen=True)
class BangBang:
    """A person on two keys: full push to either side, seen with a human's reaction time."""

    force: float = parameter(10.0, "N", "force of a key", above=0)
    dead_zone_deg: float = parameter(1.0, "deg", "angle below which no key is pressed", at_least=0)
    reaction_min: float = parameter(0.2, "s", "shortest reaction time", at_least=0)
    reaction_max: float = parameter(0.3, "s", "longest reaction time", at_least=0)

    def __post_init__(self) -> None:
        check_parameters(self, "demonstrator bang-bang")
        if self.reaction_min > self.reaction_max:
            raise MisstepError(
                f"demonstrator bang-bang: reaction_min is {self.reaction_min:g} s, above "
                f"reaction_max, {self.reaction_max:g} s"
            )

    def policy(self, system: System, rng: np.random.Generator) -> Policy:
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
        _theta_index(system)
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
    names = [column.name for column in system.observation_columns]
    if "theta" not in names or len(system.action_columns) != 1:
        raise MisstepError(
            f"demonstrators watch one angle and push with one force, but {system.system_id} "
            f"observes {', '.join(names)} and takes "
            f"{', '.join(column.name for column in system.action_columns)}: "
            "it must observe theta and take one action"
        )
    return names.index("theta")


def _held_steps(hold: float, system: System) -> int:
    return max(1, round(hold / system.dt))
