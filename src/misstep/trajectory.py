"""Trajectories and data sets: the one thing that flows through every room of misstep.

A trajectory is one recorded attempt. It is checked once, when it is made, and cannot change
afterwards; whoever receives one relies on its shapes, on finite values and on named columns, and
checks nothing again.
"""

import math
import operator
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from datetime import datetime
from enum import StrEnum
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError

FloatArray = NDArray[np.float64]

_SEED_BOUND = 2**128  # what numpy.random.SeedSequence draws when it is given no seed
_INTEGER_BOUND = 2**63


@dataclass(frozen=True, slots=True)
class Column:
    """Name and unit of one column of the observations or actions.

    Parameters
    ----------
    name : str
        Such as ``"theta"``; not empty.
    unit : str
        Such as ``"rad"`` or ``"m/s"``; empty where it has none or nobody knows it.

    Raises
    ------
    MisstepError
        If either is not printable text, or the name is empty.
    """

    name: str
    unit: str

    def __post_init__(self) -> None:
        _check_text(self.name, "the name of a column")
        if not self.name:
            raise MisstepError("the name of a column is empty: every column needs a name")
        _check_text(self.unit, f"the unit of column {self.name!r}")


class Outcome(StrEnum):
    """What became of an attempt."""

    SUCCESS = "success"
    FAILURE = "failure"
    UNKNOWN = "unknown"


class _ReadOnly(dict[str, float | int | bool | str]):
    """A dictionary that nobody can change, and so one that can be a key."""

    def _refuse(self, *arguments: Any, **named: Any) -> Any:
        raise TypeError("the parameters of a provenance cannot be changed")

    __setitem__ = __delitem__ = update = setdefault = pop = popitem = clear = __ior__ = _refuse

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(frozenset(self.items()))

    def __reduce__(self) -> tuple[Any, ...]:
        return _ReadOnly, (dict(self),)  # a pickle would fill it entry by entry


@dataclass(frozen=True)
class Provenance:
    """Where a trajectory comes from.

    Parameters
    ----------
    system : str
        Identifier of the system that was driven, such as ``"cartpole"``.
    parameters : mapping from str to float, int, bool or str
        The system's parameters, enough to build it again, each in the unit that the system
        documents. Infinite is allowed (no limit), NaN is not. Kept as a read-only copy.
    demonstrator : str
        Who acted: ``"noisy"``, ``"learner:donut"``, ``"person"``.
    seed : int or None
        Seed of the episode, 0 <= seed < 2**128, if it had one.
    time : str
        When it was recorded, ISO 8601, or empty.
    notes : tuple of str
        What was not recorded but inferred or changed since, a line each: ``"actions: inferred by
        inverse dynamics of cartpole"``. Empty for what is just as it was recorded.

    Raises
    ------
    MisstepError
        If a text is not printable, a parameter is of another type or NaN, the seed is out of
        range, or the time is not ISO 8601.
    """

    system: str
    parameters: Mapping[str, float | int | bool | str]
    demonstrator: str
    seed: int | None
    time: str
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _check_text(self.system, "the system of a provenance")
        _check_text(self.demonstrator, "the demonstrator of a provenance")
        object.__setattr__(self, "notes", _notes(self.notes))
        _check_time(self.time)
        if not isinstance(self.parameters, Mapping):
            raise MisstepError(f"parameters is {self.parameters!r}: it maps names to values")
        parameters = {_parameter_name(k): _parameter(k, v) for k, v in self.parameters.items()}
        object.__setattr__(self, "parameters", _ReadOnly(parameters))
        if self.seed is not None:
            seed = _integer(self.seed, "seed")
            if not 0 <= seed < _SEED_BOUND:
                raise MisstepError(f"seed is {seed}: it lies in 0 .. 2**128 - 1, or is None")
            object.__setattr__(self, "seed", seed)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One recorded attempt of T actions, and the T + 1 observations around them.

    Action t is applied at observation t and leads to observation t + 1.

    ===================  ==============================  ==========================================
    field                type, shape                     meaning, unit
    ===================  ==============================  ==========================================
    observations         float64, (T + 1, n), read-only  each column in the unit of its `Column`
    actions              float64, (T, m), read-only      each column in the unit of its `Column`
    dt                   float                           time between observations, s, > 0
    observation_columns  tuple of n Column               unique names, units
    action_columns       tuple of m Column               unique names, units
    provenance           Provenance                      system, demonstrator, seed, time
    outcome              Outcome                         success, failure or unknown
    costs                float64, (T,), or None          cost of each step, in the task's own unit
    failure_step         int in 0 .. T, or None          first observation at which the failure
                                                         predicate holds
    ===================  ==============================  ==========================================

    Arrays are copied. Two trajectories are equal when every field is, the arrays bit by bit.

    Raises
    ------
    MisstepError
        If a shape, a value or a name does not fit the table; the line says which.
    """

    observations: FloatArray
    actions: FloatArray
    dt: float
    observation_columns: tuple[Column, ...]
    action_columns: tuple[Column, ...]
    provenance: Provenance
    outcome: Outcome = Outcome.UNKNOWN
    costs: FloatArray | None = None
    failure_step: int | None = None

    def __post_init__(self) -> None:
        def keep(field: str, value: object) -> None:
            object.__setattr__(self, field, value)

        keep("observation_columns", _columns(self.observation_columns, "observation_columns"))
        keep("action_columns", _columns(self.action_columns, "action_columns"))
        keep("observations", _table(self.observations, "observations", self.observation_columns))
        keep("actions", _table(self.actions, "actions", self.action_columns))
        keep("dt", _time_step(self.dt))
        keep("outcome", _outcome(self.outcome))
        if not isinstance(self.provenance, Provenance):
            raise MisstepError(f"provenance is {self.provenance!r}: it has to be a Provenance")
        self._check_lengths()
        if self.costs is not None:
            keep("costs", _costs(self.costs, self.n_steps))
        if self.failure_step is not None:
            keep("failure_step", _failure_step(self.failure_step, self.n_steps))

    def _check_lengths(self) -> None:
        if len(self.actions) == 0:
            raise MisstepError("actions has no rows: a trajectory holds at least one action")
        if len(self.observations) != len(self.actions) + 1:
            raise MisstepError(
                f"observations has {len(self.observations)} rows but actions has "
                f"{len(self.actions)}: a trajectory of T actions holds T + 1 observations"
            )

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Trajectory):
            return NotImplemented
        return all(_same(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))

    def __reduce__(self) -> tuple[Any, ...]:
        # Arrays come out of a pickle writeable; building anew makes them read-only again.
        return Trajectory, tuple(getattr(self, field.name) for field in fields(self))

    @property
    def n_steps(self) -> int:
        """Number of actions, T."""
        return len(self.actions)

    @property
    def duration(self) -> float:
        """Time from the first to the last observation, s."""
        return self.n_steps * self.dt

    @property
    def mean_cost(self) -> float | None:
        """Mean cost of a step, in the task's own unit; None where no costs were recorded."""
        return None if self.costs is None else float(self.costs.mean())

    @property
    def failure_time(self) -> float | None:
        """When the failure predicate first held, s from the start; None if it never did."""
        return None if self.failure_step is None else self.failure_step * self.dt

    def cut(self, step: int) -> "Trajectory":
        """Return the first `step` actions and the observations around them.

        A failure that has happened by then remains one. What else came of the attempt came after,
        so of the part the outcome is unknown.

        Raises
        ------
        MisstepError
            If `step` is not from 1 to the number of actions.
        """
        if not 1 <= step <= self.n_steps:
            raise MisstepError(f"cannot cut at step {step}: there are {self.n_steps} actions")
        if step == self.n_steps:
            return self
        failed = self.failure_step is not None and self.failure_step <= step
        return replace(
            self,
            outcome=self.outcome if failed else Outcome.UNKNOWN,
            observations=self.observations[: step + 1],
            actions=self.actions[:step],
            costs=None if self.costs is None else self.costs[:step],
            failure_step=self.failure_step if failed else None,
        )

    def column(self, name: str) -> FloatArray:
        """Return one column of the observations.

        Parameters
        ----------
        name : str
            Name of an observation column.

        Returns
        -------
        column : ndarray, shape (T + 1,), in the column's unit
            A read-only view.

        Raises
        ------
        MisstepError
            If there is no such column.
        """
        return self.observations[:, self._position(name)]

    def select(self, names: Sequence[str]) -> FloatArray:
        """Return some columns of the observations, in the order asked for.

        Parameters
        ----------
        names : sequence of k str
            Names of observation columns.

        Returns
        -------
        columns : ndarray, shape (T + 1, k), each in its column's unit
            A copy.

        Raises
        ------
        MisstepError
            If there is no such column, or `names` is empty or a bare string.
        """
        if isinstance(names, str) or not names:
            raise MisstepError(f"names is {names!r}: give a list of at least one column name")
        return self.observations[:, [self._position(name) for name in names]]

    def _position(self, name: str) -> int:
        names = [column.name for column in self.observation_columns]
        if name not in names:
            raise MisstepError(
                f"there is no observation column {name!r}; there are: {', '.join(names)}"
            )
        return names.index(name)


class Dataset(Sequence[Trajectory]):
    """An immutable sequence of trajectories of one kind: the same columns and the same dt.

    Parameters
    ----------
    trajectories : iterable of Trajectory
        At least one.

    Raises
    ------
    MisstepError
        If there is none, or one differs from the first in its columns or dt.
    """

    def __init__(self, trajectories: Iterable[Trajectory]) -> None:
        self._trajectories = tuple(trajectories)
        if not self._trajectories:
            raise MisstepError("the data set is empty: it needs at least one trajectory")
        for index, trajectory in enumerate(self._trajectories):
            if not isinstance(trajectory, Trajectory):
                raise MisstepError(f"item {index} is {trajectory!r}: it has to be a Trajectory")
            _check_same_kind(index, trajectory, self._trajectories[0])

    def __len__(self) -> int:
        return len(self._trajectories)

    def __iter__(self) -> Iterator[Trajectory]:
        return iter(self._trajectories)

    @overload
    def __getitem__(self, index: int) -> Trajectory: ...

    @overload
    def __getitem__(self, index: slice) -> "Dataset": ...

    def __getitem__(self, index: int | slice) -> "Trajectory | Dataset":
        if isinstance(index, slice):
            return Dataset(self._trajectories[index])
        return self._trajectories[index]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Dataset):
            return NotImplemented
        return self._trajectories == other._trajectories

    def __repr__(self) -> str:
        names = ", ".join(column.name for column in self.observation_columns)
        return f"<Dataset of {len(self)} trajectories, dt {self.dt} s, columns {names}>"

    def append(self, trajectory: Trajectory) -> "Dataset":
        """Return a data set with one more trajectory at the end; this one stays as it is.

        Raises
        ------
        MisstepError
            If `trajectory` differs in its columns or dt.
        """
        return Dataset((*self._trajectories, trajectory))

    @property
    def observation_columns(self) -> tuple[Column, ...]:
        """Names and units of the n observation columns."""
        return self._trajectories[0].observation_columns

    @property
    def action_columns(self) -> tuple[Column, ...]:
        """Names and units of the m action columns."""
        return self._trajectories[0].action_columns

    @property
    def dt(self) -> float:
        """Time between observations, s."""
        return self._trajectories[0].dt


def _check_text(text: object, what: str) -> None:
    # Printable also means without control characters and halves of surrogate pairs, which
    # neither a table on a terminal nor a file could hold.
    if not isinstance(text, str) or not text.isprintable():
        raise MisstepError(f"{what} is {text!r}: it has to be printable text on one line")


def _notes(notes: object) -> tuple[str, ...]:
    if isinstance(notes, str) or not isinstance(notes, Iterable):
        raise MisstepError(f"notes is {notes!r}: it lists texts")
    listed = tuple(notes)
    for note in listed:
        _check_text(note, "a note of a provenance")
    return listed


def _check_time(time: object) -> None:
    _check_text(time, "the time of a provenance")
    if time == "":
        return
    try:
        datetime.fromisoformat(str(time))
    except ValueError as error:
        raise MisstepError(
            f"time is {time!r}: it has to be ISO 8601, such as 2024-05-31T12:00:00, or empty"
        ) from error


def _parameter_name(name: object) -> str:
    _check_text(name, "the name of a parameter")
    return str(name)


def _parameter(name: str, value: object) -> float | int | bool | str:
    plain = value.item() if isinstance(value, np.generic) else value
    if isinstance(plain, bool):
        return plain
    if isinstance(plain, int) and -_INTEGER_BOUND <= plain < _INTEGER_BOUND:
        return plain
    if isinstance(plain, float) and not math.isnan(plain):
        return plain
    if isinstance(plain, str):
        _check_text(plain, f"parameter {name!r}")
        return plain
    raise MisstepError(
        f"parameter {name!r} is {value!r}: it has to be a float that is not NaN, "
        "an int of 64 bits, a bool or a str"
    )


def _integer(value: object, what: str) -> int:
    try:
        if isinstance(value, bool | np.bool_):
            raise TypeError("a truth value counts nothing")
        return operator.index(value)  # type: ignore[arg-type]
    except TypeError as error:
        raise MisstepError(f"{what} is {value!r}: it has to be a whole number") from error


def _columns(columns: object, field: str) -> tuple[Column, ...]:
    if isinstance(columns, str) or not isinstance(columns, Iterable):
        raise MisstepError(f"{field} is {columns!r}: it has to be a tuple of Column")
    kept = tuple(columns)
    if not kept:
        raise MisstepError(f"{field} is empty: it names every column, and there is at least one")
    names = set()
    for column in kept:
        if not isinstance(column, Column):
            raise MisstepError(f"{field} holds {column!r}: every item has to be a Column")
        if column.name in names:
            raise MisstepError(f"{field} names {column.name!r} twice: names have to be unique")
        names.add(column.name)
    return kept


def _numbers(values: object, field: str) -> FloatArray:
    """Return a read-only copy of `values` in float64 and C order."""
    try:
        raw = np.asarray(values)
    except ValueError as error:
        raise MisstepError(f"{field} is ragged: all its rows have to be equally long") from error
    if raw.dtype.kind not in "fiub":
        raise MisstepError(f"{field} has dtype {raw.dtype}: it has to hold real numbers")
    with np.errstate(over="ignore"):  # too large a long double becomes infinite: refused below
        numbers = np.array(raw, dtype=np.float64, order="C")
    numbers.setflags(write=False)
    return numbers


def _table(values: object, field: str, columns: tuple[Column, ...]) -> FloatArray:
    table = _numbers(values, field)
    if table.ndim != 2 or table.shape[1] != len(columns):
        raise MisstepError(
            f"{field} has shape {table.shape} but there are {len(columns)} columns "
            f"({', '.join(c.name for c in columns)}): it has to be (rows, {len(columns)})"
        )
    if not np.isfinite(table).all():
        row, column = np.argwhere(~np.isfinite(table))[0]
        raise MisstepError(
            f"{field} row {row}, column {columns[column].name!r} is {table[row, column]}: "
            "every value has to be finite"
        )
    return table


def _costs(values: object, n_steps: int) -> FloatArray:
    costs = _numbers(values, "costs")
    if costs.shape != (n_steps,):
        raise MisstepError(
            f"costs has shape {costs.shape} but there are {n_steps} actions: "
            f"it has to be ({n_steps},), one cost a step"
        )
    if not np.isfinite(costs).all():
        row = np.flatnonzero(~np.isfinite(costs))[0]
        raise MisstepError(f"costs row {row} is {costs[row]}: every value has to be finite")
    return costs


def _time_step(dt: object) -> float:
    number = _numbers(dt, "dt")
    if number.ndim != 0 or not 0 < number < math.inf:
        found = f"is {number}" if number.ndim == 0 else f"has shape {number.shape}"
        raise MisstepError(f"dt {found}: it has to be one positive number of seconds")
    return float(number)


def _outcome(outcome: object) -> Outcome:
    try:
        return Outcome(outcome)  # type: ignore[arg-type]
    except ValueError as error:
        raise MisstepError(f"outcome is {outcome!r}; there are: {', '.join(Outcome)}") from error


def _failure_step(value: object, n_steps: int) -> int:
    step = _integer(value, "failure_step")
    if not 0 <= step <= n_steps:
        raise MisstepError(
            f"failure_step is {step} but there are {n_steps} actions: "
            f"it numbers an observation, 0 .. {n_steps}"
        )
    return step


def _same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return False  # one has costs, the other none
    return a == b


def _check_same_kind(index: int, trajectory: Trajectory, first: Trajectory) -> None:
    if trajectory.dt != first.dt:
        raise MisstepError(
            f"trajectory {index} has dt {trajectory.dt} s but trajectory 0 has {first.dt} s: "
            "all trajectories of a data set have the same dt"
        )
    for field in ("observation_columns", "action_columns"):
        here, there = (
            column_listing(getattr(trajectory, field)),
            column_listing(getattr(first, field)),
        )
        if here != there:
            raise MisstepError(
                f"trajectory {index} has {field} {here} but trajectory 0 has {there}: "
                "all trajectories of a data set have the same columns"
            )


def column_listing(columns: Sequence[Column]) -> str:
    """Return names and units in one line: ``x [m], theta [rad]``."""
    return ", ".join(f"{column.name} [{column.unit}]" for column in columns)
