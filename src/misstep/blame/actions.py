"""How strongly a system can be acted on: its actuators' limits, or what was seen of them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.systems import SYSTEMS, recorded_system
from misstep.systems.gymnasium_adapter import PREFIX
from misstep.trajectory import Dataset

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ActionLimits:
    """Smallest and largest action, and where they are known from.

    Parameters
    ----------
    low, high : ndarray, shape (m,)
        Each in its column's unit, low < high.
    source : str
        In words: ``"of the system cartpole"``.
    known : bool
        Whether they are the actuators' own; otherwise they are the largest actions seen, and what
        a stronger one could have saved counts as lost.

    Raises
    ------
    MisstepError
        If a limit is not finite or an action has no range.
    """

    low: Array
    high: Array
    source: str
    known: bool

    def __post_init__(self) -> None:
        if not (np.isfinite(self.low).all() and np.isfinite(self.high).all()) or np.any(
            self.low >= self.high
        ):
            raise MisstepError(
                f"actions are limited to {self.low} .. {self.high}: every limit has to be finite, "
                "and the low one below the high one"
            )

    @property
    def neutral(self) -> Array:
        """The action that does nothing, shape (m,): 0 where that is possible, else the middle."""
        possible = (self.low < 0) & (self.high > 0)
        return np.where(possible, 0.0, 0.5 * (self.low + self.high))

    def scaled(self, actions: Array) -> Array:
        """Return actions (..., m) in [-1, 1]: 0 is neutral, ±1 the limit on either side."""
        offset = actions - self.neutral
        up, down = self.high - self.neutral, self.neutral - self.low
        scaled: Array = np.where(offset > 0, offset / up, offset / down)
        return scaled


def action_limits(dataset: Dataset) -> ActionLimits:
    """Return the limits of the system that all trajectories drove, else the largest actions seen.

    Raises
    ------
    MisstepError
        If an action never varies: then nobody can tell what it does.
    """
    actions = np.concatenate([trajectory.actions for trajectory in dataset])
    for column, values in zip(dataset.action_columns, actions.T, strict=True):
        if np.all(values == values[0]):
            raise MisstepError(
                f"the action {column.name} is {values[0]:g} {column.unit} in all attempts".rstrip()
                + ": what it does cannot be learned from them"
            )
    known = _system_limits(dataset)
    if isinstance(known, ActionLimits):
        return known
    largest = np.abs(actions).max(axis=0)
    low, high = actions.min(axis=0), actions.max(axis=0)
    both = (low < 0) & (high > 0)
    source = f"the largest seen, because {known}"
    return ActionLimits(np.where(both, -largest, low), np.where(both, largest, high), source, False)


def _system_limits(dataset: Dataset) -> ActionLimits | str:
    """Return the limits of the system that was driven, or why they are not known."""
    origins = [trajectory.provenance for trajectory in dataset]
    name, parameters = origins[0].system, dict(origins[0].parameters)
    if any(o.system != name or dict(o.parameters) != parameters for o in origins):
        return "not all attempts drove the same system"
    if name not in SYSTEMS and not name.startswith(PREFIX):
        return f"the system {name!r} is not known here" if name else "the system is not named"
    try:
        system = recorded_system(name, parameters)
    except MisstepError as error:
        return f"the system cannot be built ({error})"
    try:
        low, high = (
            np.array(limit, dtype=np.float64).ravel()
            for limit in (system.action_space.low, system.action_space.high)  # type: ignore[attr-defined]
        )
        named = [column.name for column in system.action_columns]
    finally:
        system.close()
    if named != [column.name for column in dataset.action_columns]:
        return f"the actions are not those of {name}"
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return f"the actions of {name} have no limits"
    return ActionLimits(low, high, f"of the system {name}", True)
