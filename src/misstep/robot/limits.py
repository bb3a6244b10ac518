"""What a robot may be told, what it can have measured, and why an action is what it is."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntFlag
from typing import Any, Self

from misstep.errors import MisstepError
from misstep.systems import System
from misstep.trajectory import Column

Row = tuple[float, ...]
PerColumn = float | Sequence[float]
"""One number for all columns, or one for each."""


class Reason(IntFlag):
    """Why an action is what it is; several can hold at once."""

    POLICY = 1
    """The policy of the trial asked for it."""
    VALUE = 2
    """Moved into the limits of the value."""
    RATE = 4
    """Slowed down by the limit of the rate."""
    JERK = 8
    """Slowed down by the limit of the jerk, or braking before a limit."""
    REFUSED = 16
    """The state was refused: it goes on towards what was wanted before."""
    LATE = 32
    """The policy missed the deadline: towards the safe action."""
    WATCHDOG = 64
    """No fresh state for too long: towards the safe action."""
    IDLE = 128
    """No trial is running: towards the safe action."""
    STOP = 256
    """Emergency stop: the safe action at once."""
    DRY_RUN = 512
    """The safe action, in place of what would have been sent."""
    SILENT = 1024
    """Said by a client to itself: the service did not answer in time."""


@dataclass(frozen=True)
class Limits:
    """Limits of the action, the safe action, and the range of states that can be.

    Parameters
    ----------
    observation_columns : tuple of n Column
    action_columns : tuple of m Column
    period : float, s
        Control period.
    low, high : tuple of m float
        Of the action, in its columns' units; finite.
    rate : tuple of m float
        Largest change of the action in a second, unit/s; infinite where there is none.
    jerk : tuple of m float
        Largest change of that rate in a second, unit/s²; infinite where there is none.
    safe : tuple of m float
        Where the action goes when in doubt, and where it is taken to be at the beginning.
    observation_low, observation_high : tuple of n float
        What lies outside cannot have been measured; infinite where anything can.

    Raises
    ------
    MisstepError
        If a limit is missing, empty or not positive, or the safe action lies outside.
    """

    observation_columns: tuple[Column, ...]
    action_columns: tuple[Column, ...]
    period: float
    low: Row
    high: Row
    rate: Row
    jerk: Row
    safe: Row
    observation_low: Row
    observation_high: Row

    def __post_init__(self) -> None:
        columns = zip(self.action_columns, self.low, self.high, strict=True)
        for i, (column, low, high) in enumerate(columns):
            # Twice the range is reckoned with, and has to be a number too.
            if not (math.isfinite(2.0 * (high - low)) and low < high):
                raise MisstepError(
                    f"action {column.name} goes from {low:g} to {high:g} {column.unit}: a robot "
                    "needs finite limits, the smaller first"
                )
            if not low <= self.safe[i] <= high:
                raise MisstepError(
                    f"the safe action is {self.safe[i]:g} for {column.name}, outside its limits "
                    f"{low:g} .. {high:g} {column.unit}: give one inside"
                )
            for name, bound in (("rate", self.rate[i]), ("jerk", self.jerk[i])):
                if not bound > 0:
                    raise MisstepError(
                        f"the {name} limit of {column.name} is {bound:g}: it has to be positive"
                    )

    @classmethod
    def of(
        cls,
        system: System,
        *,
        rate: PerColumn = math.inf,
        jerk: PerColumn = math.inf,
        safe: PerColumn = 0.0,
        ranges: Mapping[str, tuple[float, float]] | None = None,
    ) -> Self:
        """Return the limits of a system's own spaces, and further ones.

        Parameters
        ----------
        system : System
        rate, jerk, safe : float or sequence of m float
            See the class.
        ranges : mapping from str to (float, float)
            Narrower ranges of observation columns.

        Raises
        ------
        MisstepError
            If there is no such column, a sequence has another length than the action, or as the
            class.
        """
        actions: Any = system.action_space
        observations: Any = system.observation_space
        names = [column.name for column in system.observation_columns]
        low, high = observations.low.tolist(), observations.high.tolist()
        for name, (least, most) in (ranges or {}).items():
            if name not in names:
                raise MisstepError(f"no observation column {name!r}; there are: {', '.join(names)}")
            if not least < most:
                raise MisstepError(f"the range of {name} is {least:g} .. {most:g}: it is empty")
            i = names.index(name)
            if not (least < high[i] and most > low[i]):
                raise MisstepError(
                    f"the range of {name} is {least:g} .. {most:g}: outside {low[i]:g} .. "
                    f"{high[i]:g}, so that every state would be refused"
                )
            low[i], high[i] = max(low[i], least), min(high[i], most)
        m = len(system.action_columns)
        return cls(
            system.observation_columns,
            system.action_columns,
            system.dt,
            tuple(actions.low.tolist()),
            tuple(actions.high.tolist()),
            _row(rate, m, "rate limit"),
            _row(jerk, m, "jerk limit"),
            _row(safe, m, "safe action"),
            tuple(low),
            tuple(high),
        )


def _row(values: PerColumn, m: int, what: str) -> Row:
    row = (float(values),) * m if isinstance(values, int | float) else tuple(map(float, values))
    if len(row) != m:
        raise MisstepError(f"the {what} has {len(row)} numbers, but there are {m} actions")
    return row
