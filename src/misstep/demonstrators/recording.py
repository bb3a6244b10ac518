"""Recording failed demonstrations: who can, and how their attempts become a data set.

A demonstrator is a frozen dataclass of parameters that makes policies. The few attempts that
succeed by luck are thrown away, because nobody who can do the task needs misstep.
"""

from dataclasses import asdict
from typing import ClassVar, Protocol

import numpy as np

from misstep.errors import MisstepError
from misstep.parameters import (
    ParameterRow,
    ParameterValue,
    build_parameters,
    parameter_table,
)
from misstep.registry import Registry
from misstep.rollout import Policy, rollout
from misstep.systems.system import System
from misstep.trajectory import Dataset, Outcome, Trajectory

_ATTEMPTS_PER_FAILURE = 50


class Demonstrator(Protocol):
    """A dataclass of parameters that can make a policy.

    Attributes
    ----------
    needs : str
        What a system must have, for messages: ``"it must observe theta and take one action"``.
    """

    needs: ClassVar[str]

    @classmethod
    def fits(cls, system: System) -> bool:
        """Return whether it can drive `system`."""

    def policy(self, system: System, rng: np.random.Generator, attempt: int) -> Policy:
        """Return a policy for `system` that draws all its randomness from `rng`.

        `attempt` counts from 0, for kinds that do not fail in the same way every time.
        """


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
        One that the kind fits: the cart-pole's watch ``theta`` and push with one force, those of
        flip-up and basket strike; anything whose actions have limits can be driven at random.
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
        If there is no such demonstrator or parameter, `n` is below 1, the demonstrator does not
        fit the system, or it fails less than once in 50 attempts.
    """
    kind = DEMONSTRATORS[by]
    demonstrator = build_parameters(kind, f"demonstrator {by}", parameters)
    if n < 1:
        raise MisstepError(f"n is {n}: at least 1 demonstration must be asked for")
    driven = system.unwrapped  # whoever judges, it is the same to drive
    if not kind.fits(driven):
        kinds = DEMONSTRATORS.loaded()[0]
        fitting = [name for name, other in kinds.items() if other.fits(driven)]
        raise MisstepError(
            f"demonstrator {by} does not fit {system.system_id}: {kind.needs}; "
            f"these kinds fit: {', '.join(fitting) or 'none'}"
        )
    who = _signature(by, demonstrator)
    failures: list[Trajectory] = []
    attempts = _ATTEMPTS_PER_FAILURE * n
    for attempt in range(attempts):
        trajectory = _attempt(system, demonstrator, who, attempt, seed, time)
        if trajectory.outcome is Outcome.FAILURE:
            failures.append(trajectory)
        if len(failures) == n:
            return Dataset(failures)
    raise MisstepError(
        f"demonstrator {by} failed in {len(failures)} of {attempts} attempts, but {n} failures "
        "are wanted: choose a kind that fails more often, or parameters that make the task harder"
    )


def list_demonstrators() -> dict[str, list[ParameterRow]]:
    """Return the table of parameters (name, default, unit, meaning) of every demonstrator."""
    kinds = DEMONSTRATORS.loaded()[0]
    return {name: parameter_table(kind) for name, kind in kinds.items()}


def _attempt_seed(seed: int, attempt: int) -> int:
    if seed < 0:
        raise MisstepError(f"seed is {seed}: it must not be negative")
    return int(np.random.SeedSequence(seed, spawn_key=(attempt,)).generate_state(1)[0])


def _attempt(
    system: System,
    demonstrator: Demonstrator,
    who: str,
    attempt: int,
    first_seed: int,
    time: str | None,
) -> Trajectory:
    seed = _attempt_seed(first_seed, attempt)
    # The system draws from `seed` itself; the spawn key keeps the demonstrator's noise
    # independent of it, and the one recorded seed still repeats the whole attempt.
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0,)))
    policy = demonstrator.policy(system.unwrapped, rng, attempt)
    return rollout(system, policy, seed=seed, demonstrator=who, time=time)


def _signature(by: str, demonstrator: Demonstrator) -> str:
    """Return the kind's name, followed by the parameters that are not at their defaults."""
    values = asdict(demonstrator)  # type: ignore[call-overload]
    changed = [
        f"{row.name}={_printed(values[row.name])}"
        for row in parameter_table(type(demonstrator))
        if values[row.name] != row.default
    ]
    return f"{by}({', '.join(changed)})" if changed else by


def _printed(value: ParameterValue) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
