"""A robot elsewhere as a system here: `learn` drives it as it drives a simulation."""

import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.parameters import ParameterValue, build_parameters, check_parameters, parameter
from misstep.robot.addresses import TOKEN
from misstep.robot.link import Link, open_link, remaining
from misstep.robot.protocol import (
    VERSION,
    Kind,
    Observed,
    decode,
    decode_observed,
    encode,
    encode_action,
    kind_of,
)
from misstep.systems import System
from misstep.trajectory import Column

_TIMEOUT = 10.0  # s, for a connection; a reset may take a person a while


@dataclass(frozen=True)
class RemoteParameters:
    """What describes a robot; what is left out is asked of the robot."""

    address: str = parameter("", "", "where it listens: host:port, unix:PATH or ws://host:port")
    observations: str = parameter("", "", 'columns and units, such as "x m, theta rad"')
    actions: str = parameter("", "", 'columns and units, such as "force N"')
    low: str = parameter("", "", "smallest action, numbers separated by commas")
    high: str = parameter("", "", "largest action")
    observation_low: str = parameter("", "", "smallest observation; nothing: no limit")
    observation_high: str = parameter("", "", "largest observation; nothing: no limit")
    dt: float = parameter(0.0, "s", "control period", at_least=0)
    duration: float = parameter(60.0, "s", "length of a trial on `misstep serve`", above=0)
    patience: float = parameter(60.0, "s", "longest time for a step or a reset", above=0)

    def __post_init__(self) -> None:
        check_parameters(self, "remote")


class RemoteSystem(System):
    """A system that some `SystemHub` offers, on a robot or in another program.

    **Observation**, **action**, **reward**, **end**, **info**: the robot's.

    **Address**: none is needed where the robot itself asks a `misstep serve` for its actions; then
    the other parameters describe it. With an address, what they leave out is asked of the robot;
    the connection is made when it is first needed, with the token in MISSTEP_TOKEN.

    Parameters
    ----------
    render_mode : None
        A robot is looked at.
    **parameters
        Fields of `RemoteParameters`.

    Raises
    ------
    MisstepError
        If the parameters do not describe a robot, or nobody answers at the address.

    Notes
    -----
    Version 1.
    """

    system_id = "remote"
    parameters_type = RemoteParameters
    # The token goes there.
    typed_only = frozenset({"address"})

    def __init__(self, render_mode: str | None = None, **parameters: ParameterValue) -> None:
        if render_mode is not None:
            raise MisstepError("remote: a robot cannot be rendered")
        p = build_parameters(RemoteParameters, "remote", parameters)
        self.render_mode = None
        self._address, self._patience = p.address, p.patience
        self._link: Link | None = None
        if not (p.observations and p.actions and p.low and p.high and p.dt):
            p = self._ask_what_it_is(p)
        self.dt = p.dt
        self.observation_columns = _columns(p.observations, "observations")
        self.action_columns = _columns(p.actions, "actions")
        n, m = len(self.observation_columns), len(self.action_columns)
        self.observation_space = _box(p.observation_low, p.observation_high, n, "observation_")
        self.action_space = _box(p.low, p.high, m, "")
        self.parameters = {name: getattr(p, name) for name in RemoteParameters.__dataclass_fields__}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """Have the robot begin an episode.

        Raises
        ------
        MisstepError
            If it refuses or is gone.
        """
        super().reset(seed=seed)
        told = self._ask(encode(Kind.RESET, {"seed": seed}))
        return np.array(told.observation), {"failed": told.failed, "success": told.success}

    def step(
        self, action: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """Have the robot apply an action.

        Raises
        ------
        MisstepError
            If it refuses or is gone; the next `reset` connects anew.
        """
        told = self._ask(encode_action(tuple(np.asarray(action, np.float64).tolist())))
        info = {"failed": told.failed, "success": told.success, "timed_out": told.timed_out}
        observation = np.array(told.observation)
        return observation, told.reward, told.terminated, told.truncated, info

    def close(self) -> None:
        """Hang up; the robot goes to its safe action."""
        if self._link is not None:
            self._link.close()
            self._link = None

    def _ask_what_it_is(self, p: RemoteParameters) -> RemoteParameters:
        if not p.address:
            raise MisstepError(
                "remote: give the address of the robot, or describe it: observations, actions, "
                "low, high and dt"
            )
        _, told = self._connect()
        given = {name: getattr(p, name) for name in RemoteParameters.__dataclass_fields__}
        return RemoteParameters(**{**told, **{k: v for k, v in given.items() if v}})

    def _connect(self) -> tuple[Link, dict[str, Any]]:
        """Return a connection, and the parameters that the robot describes itself with."""
        if not self._address:
            raise MisstepError(
                "remote: it has no address, so it can only be served, not driven: give it, since "
                "none is taken from a file"
            )
        link = open_link(self._address, _TIMEOUT)
        hello = {"token": os.environ.get(TOKEN, ""), "role": "drive", "version": VERSION}
        try:
            link.send(encode(Kind.HELLO, hello))
            reply = link.receive(_TIMEOUT)
            told = decode(reply)
            if kind_of(reply) != Kind.WELCOME:
                raise MisstepError(f"{self._address}: {told.get('error', 'no robot answers')}")
            if "observations" not in told:
                raise MisstepError(f"{self._address}: an exploration service answers, and no robot")
        except OSError as error:
            link.close()
            raise MisstepError(f"{self._address}: no answer: {error}") from error
        except MisstepError:
            link.close()
            raise
        self._link = link
        known = RemoteParameters.__dataclass_fields__
        return link, {name: value for name, value in told.items() if name in known}

    def _ask(self, message: bytes) -> Observed:
        link = self._link or self._connect()[0]
        deadline = time.monotonic() + self._patience
        try:
            link.send(message)
            return self._observed(link.receive(remaining(deadline)))
        except OSError as error:
            self.close()
            raise MisstepError(f"{self._address}: the robot is gone: {error}") from error
        except MisstepError:
            self.close()
            raise

    def _observed(self, reply: bytes) -> Observed:
        """Return what an answer tells, or raise MisstepError."""
        if kind_of(reply) != Kind.OBSERVED:
            raise MisstepError(f"{self._address}: {decode(reply).get('error')}")
        observed = decode_observed(reply)
        values = (*observed.observation, observed.reward)
        if len(values) != len(self.observation_columns) + 1 or not all(map(math.isfinite, values)):
            raise MisstepError(f"{self._address}: the robot observes {observed.observation}")
        return observed


def describe_system(system: System) -> dict[str, ParameterValue]:
    """Return the parameters of a `RemoteSystem` that stands for `system` elsewhere."""
    actions: Any = system.action_space
    observations: Any = system.observation_space
    return {
        "observations": _listing(system.observation_columns),
        "actions": _listing(system.action_columns),
        "low": _numbers(actions.low),
        "high": _numbers(actions.high),
        "observation_low": _numbers(observations.low),
        "observation_high": _numbers(observations.high),
        "dt": system.dt,
    }


def _listing(columns: Sequence[Column]) -> str:
    return ", ".join(f"{column.name} {column.unit}".strip() for column in columns)


def _numbers(row: NDArray[np.float64]) -> str:
    return ", ".join(repr(value) for value in row.tolist())


def _columns(text: str, what: str) -> tuple[Column, ...]:
    names = [part.strip().partition(" ") for part in text.split(",")]
    if not all(name for name, _, _ in names) or len({name for name, _, _ in names}) < len(names):
        raise MisstepError(
            f"remote: {what} is {text!r}: list distinct columns, such as 'x m, theta rad'"
        )
    return tuple(Column(name, unit.strip()) for name, _, unit in names)


def _box(low: str, high: str, n: int, prefix: str) -> Any:
    rows = []
    for name, text, default in (("low", low, -math.inf), ("high", high, math.inf)):
        try:
            row = [float(part) for part in text.split(",")] if text else [default] * n
        except ValueError as error:
            raise MisstepError(f"remote: {prefix}{name} is {text!r}: write numbers") from error
        if len(row) != n or any(value != value for value in row):
            raise MisstepError(f"remote: {prefix}{name} is {text!r}: write {n} numbers")
        rows.append(np.array(row))
    if not np.all(rows[0] <= rows[1]):
        raise MisstepError(
            f"remote: {prefix}low is {low!r} and {prefix}high is {high!r}: write the smaller first"
        )
    return gymnasium.spaces.Box(rows[0], rows[1], dtype=np.float64)
