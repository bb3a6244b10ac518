"""A system whose success, failure or cost somebody else says: a formula, or a Python function."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.judges import FLAGS, Formula, Judge, parse_cost, parse_predicate
from misstep.parameters import ParameterRow, ParameterValue
from misstep.systems.mechanics import Mechanics
from misstep.systems.simulated import LONGEST_TIME
from misstep.systems.system import System

JUDGE_PARAMETERS = (
    ParameterRow("success", "", "", "condition on the columns for a success at the end"),
    ParameterRow("failure", "", "", "condition on the columns that is a failure and ends it"),
    ParameterRow("hold", 0.0, "s", "success must have held this long at the end"),
    ParameterRow("cost", "", "", "cost of a step, a number from the columns"),
)
"""What `make_system` takes for every system, beside the system's own parameters."""


class Judged(System):
    """A system around a system, with a success, a failure or a cost of its own.

    Everything is judged by what is *observed*, sensor noise included.

    **Failure**: where the predicate holds, the episode has failed and is *terminated*. What the
    system itself takes for a failure remains one.

    **Success**: at the end of an episode that has not failed, the predicate must have held at
    every observation of the last `hold` seconds; with 0, at the last one. Without a predicate the
    system's own success counts. Where either predicate is given, an episode that ends without
    success has failed, at its last observation.

    **Cost**: minus the reward, of the observation after the step. The system's cost as a function
    (`System.cost`) is then gone, because it would be another one.

    **Info**: as of the system, with

    - ``failed``, ``success`` (bool): as above;
    - ``timed_out`` (bool): failed for no other reason than that it ended without success.

    Parameters
    ----------
    system : System
    success, failure : str or callable, optional
        A formula (`misstep.judges`), or a function of the observation (n,).
    hold : float, s
        Of the success, from 0 to 10⁹.
    cost : str or callable, optional
        A formula for a number, or a function of the observation.

    Attributes
    ----------
    system : System
        The one inside.

    Raises
    ------
    MisstepError
        If nothing is given to judge by, a formula cannot be read, or `hold` is out of its range
        or comes without a success.
    """

    def __init__(
        self,
        system: System,
        *,
        success: Judge | None = None,
        failure: Judge | None = None,
        hold: float = 0.0,
        cost: Judge | None = None,
    ) -> None:
        name = system.system_id
        if success is None and failure is None and cost is None:
            reason = "hold needs a success to hold" if hold else "there is nothing to judge by"
            raise MisstepError(f"{name}: {reason}: give success, failure or cost")
        self.system = system
        columns = system.observation_columns
        self._success = _read(parse_predicate, success, columns, f"{name}, success")
        self._failure = _read(parse_predicate, failure, columns, f"{name}, failure")
        self._cost = _read(parse_cost, cost, columns, f"{name}, cost")
        self._flags = False, False
        self._needed = _steps_to_hold(name, hold, self._success, system.dt)

        self._take_after(system)
        self.metadata, self.render_mode = system.metadata, system.render_mode
        self.cost = system.cost if self._cost is None else None
        own: dict[str, ParameterValue] = {
            key: judge.text
            for key, judge in zip(
                ("success", "failure", "cost"),
                (self._success, self._failure, self._cost),
                strict=True,
            )
            if judge is not None
        }
        if self._success is not None:
            own["hold"] = float(hold)
        self.parameters = {**system.parameters, **own}
        self._over = True
        self._failed = False
        self._held = 0

    @property
    def unwrapped(self) -> System:
        """The system without any judge around it."""
        return self.system.unwrapped

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """Start an episode; the arguments are the system's."""
        super().reset(seed=seed)
        observation, info = self.system.reset(seed=seed, options=options)
        self._over, self._flags = False, (False, False)
        self._held = 0
        self._failed = bool(info.get("failed", False)) or self._fails(observation)
        self._watch(observation)
        return observation, {**info, "failed": self._failed, "success": False}

    def step(
        self, action: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """Apply one action; see the class for what is returned.

        Raises
        ------
        MisstepError
            If the episode is over, the system refuses the action, or the cost is not finite.
        """
        if self._over:
            raise self.no_episode()
        observation, reward, terminated, truncated, info = self.system.step(action)
        self._flags = bool(terminated), bool(truncated)
        self._watch(observation)
        fails = self._fails(observation)
        # That its own time is over without its own success is not for the system to say.
        replaced = self._success is not None and info.get("timed_out", False)
        self._failed |= fails or (bool(info.get("failed", False)) and not replaced)
        terminated = terminated or fails
        self._over = terminated or truncated
        success = self._over and not self._failed and self._succeeds(info)
        judged = self._success is not None or self._failure is not None
        timed_out = judged and self._over and not success and not self._failed
        info = {
            **info,
            "failed": self._failed or timed_out,
            "success": success,
            "timed_out": timed_out or (self._success is None and bool(info.get("timed_out"))),
        }
        if self._cost is not None:
            reward = -self._cost_of(self._cost, observation)
        return observation, float(reward), terminated, truncated, info

    def _watch(self, observation: NDArray[np.float64]) -> None:
        """Count at how many observations in a row the success has held."""
        if self._success is not None:
            self._held = self._held + 1 if self._says(self._success, observation) else 0

    def _fails(self, observation: NDArray[np.float64]) -> bool:
        return self._failure is not None and bool(self._says(self._failure, observation))

    def _says(self, formula: Formula, observation: NDArray[np.float64]) -> Any:
        if formula.reads_flags:
            return formula(np.append(observation, self._flags))
        return formula(observation)

    def _succeeds(self, info: dict[str, Any]) -> bool:
        if self._success is None:
            return bool(info.get("success", False))
        return self._held >= self._needed

    def _cost_of(self, cost: Formula, observation: NDArray[np.float64]) -> float:
        value = float(self._says(cost, observation))
        if not math.isfinite(value):
            seen = ", ".join(
                f"{column.name} = {number:g}"
                for column, number in zip(self.observation_columns, observation, strict=True)
            )
            raise MisstepError(
                f"{self.system_id}: the cost {cost.text!r} is {value} at {seen}: it must be finite"
            )
        return value

    def mechanics(self, **parameters: ParameterValue) -> Mechanics:
        """Return the joints and forces of the system inside; see `System.mechanics`."""
        return self.system.mechanics(**parameters)

    def render(self) -> Any:
        """Return what the system renders."""
        return self.system.render()

    def close(self) -> None:
        """Close the system."""
        self.system.close()


def _read(
    parse: Callable[..., Formula], judge: Judge | None, columns: Any, what: str
) -> Formula | None:
    return None if judge is None else parse(judge, columns, what, FLAGS)


def _steps_to_hold(name: str, hold: float, success: Formula | None, dt: float) -> int:
    """Return at how many observations in a row the success must hold."""
    number = isinstance(hold, int | float) and not isinstance(hold, bool)
    if not (number and 0 <= hold <= LONGEST_TIME):
        raise MisstepError(
            f"{name}: hold is {hold!r} but must be a time in s, at least 0 and at most "
            f"{LONGEST_TIME:g}"
        )
    if hold and success is None:
        raise MisstepError(f"{name}: hold is {hold:g} s but there is no success to hold")
    return round(hold / dt) + 1
