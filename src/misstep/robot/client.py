"""A robot's side of the exploration service: it reports its states and asks for actions.

Nothing that happens to the service leaves the robot with an old action: where no answer comes in
time, or none at all, `RobotClient.ask` returns the safe one by itself.
"""

import os
import time
from contextlib import suppress
from typing import Any, Self

import numpy as np

from misstep.errors import MisstepError
from misstep.robot.addresses import TOKEN
from misstep.robot.guard import Command, State
from misstep.robot.limits import Reason, Row
from misstep.robot.link import open_link, remaining
from misstep.robot.protocol import (
    VERSION,
    Kind,
    decode,
    decode_command,
    encode,
    encode_state,
    kind_of,
)
from misstep.robot.service import Start
from misstep.systems import System
from misstep.trajectory import Outcome

_PAUSE = 0.005  # s, between two questions whether the next policy has been learned


class RobotClient:
    """A connection to a service, for a robot or for a person who watches.

    Parameters
    ----------
    address : str
        ``host:port``, ``unix:PATH`` or ``ws://host:port``.
    token : str, optional
        The environment variable MISSTEP_TOKEN if left out.
    name : str
        For the log.
    role : str
        ``"drive"``, or ``"watch"`` for one that may stop, clear and mark.
    patience : float, s, optional
        Longest time to wait for an action; the service's watchdog if left out.
    timeout : float, s
        Longest time to wait for anything else.

    Attributes
    ----------
    description : dict
        The robot's columns and limits as the service knows them.
    safe : tuple of m float
        The safe action.

    Raises
    ------
    MisstepError
        If nobody answers, the service refuses, or it is no exploration service.
    """

    def __init__(
        self,
        address: str,
        token: str | None = None,
        *,
        name: str = "robot",
        role: str = "drive",
        patience: float | None = None,
        timeout: float = 10.0,
    ) -> None:
        self._address, self._timeout = address, timeout
        self._link = open_link(address, timeout)
        hello = {
            "token": os.environ.get(TOKEN, "") if token is None else token,
            "role": role,
            "name": name,
            "version": VERSION,
        }
        try:
            self.description = self._ask_json(encode(Kind.HELLO, hello), Kind.WELCOME)
            if "watchdog" not in self.description:
                raise MisstepError(f"{address}: a robot answers, and no exploration service")
        except MisstepError:
            self._link.close()
            raise
        self.safe: Row = tuple(self.description["safe"])
        self._patience = self.description["watchdog"] if patience is None else patience
        self._sequence = 0
        self._number = -1

    def start(self) -> Start | None:
        """Begin the next trial, once its policy has been learned; None if the run is finished.

        Raises
        ------
        MisstepError
            If the service refuses or is gone.
        """
        while True:
            reply = self._ask_json(encode(Kind.START), Kind.STARTED)
            if "seed" in reply:
                return Start(int(reply["number"]), int(reply["seed"]))
            if reply["phase"] == "finished":
                return None
            time.sleep(_PAUSE)

    def ask(
        self,
        observation: Row,
        *,
        stamp: float | None = None,
        cost: float | None = None,
        failed: bool = False,
        succeeded: bool = False,
        over: bool = False,
    ) -> Command:
        """Report a state and return the command that answers it, or the safe one.

        Parameters
        ----------
        observation : tuple of n float
        stamp : float, s, optional
            When it was measured, by the robot's own clock; now if left out.
        cost : float, optional
            Of the step before.
        failed, succeeded, over : bool
            What the robot says of its trial; see `State`.

        Returns
        -------
        Command
            To be applied at once. After `patience`, or without a connection, the safe action with
            the reason `Reason.SILENT`.
        """
        self._sequence += 1
        stamp = time.monotonic() if stamp is None else stamp
        state = State(self._sequence, stamp, observation, cost, failed, succeeded, over)
        deadline = time.monotonic() + self._patience
        try:
            self._link.send(encode_state(state))
            while True:
                command = self._command(self._link.receive(remaining(deadline)))
                if command is not None and command.sequence >= self._sequence:
                    return command
        except (OSError, MisstepError):
            why = Reason.SILENT | Reason.WATCHDOG
            return Command(self.safe, self.safe, why, self._sequence, self._number)

    def poll(self) -> Command | None:
        """Return a command that came unasked and has to be applied; None if there is none.

        For a robot whose next state is delayed: after a while the service sends the safe action.
        A lost connection is such a command too.
        """
        latest = None
        try:
            while True:
                command = self._command(self._link.receive(0.0))
                latest = latest if command is None else command
        except TimeoutError:
            return latest
        except (OSError, MisstepError):
            why = Reason.SILENT | Reason.WATCHDOG
            return Command(self.safe, self.safe, why, self._sequence, self._number)

    def stop(self) -> dict[str, Any]:
        """Stop the robot at once, until `clear`; return the service's status."""
        return self._ask_json(encode(Kind.STOP), Kind.REPORT)

    def clear(self) -> dict[str, Any]:
        """Take back an emergency stop; return the service's status."""
        return self._ask_json(encode(Kind.CLEAR), Kind.REPORT)

    def mark(self, outcome: Outcome) -> dict[str, Any]:
        """Judge the trial in progress, which ends it; return the service's status."""
        return self._ask_json(encode(Kind.MARK, {"outcome": str(outcome)}), Kind.REPORT)

    def status(self) -> dict[str, Any]:
        """Return the service's status."""
        return self._ask_json(encode(Kind.STATUS), Kind.REPORT)

    def close(self) -> None:
        """Hang up."""
        self._link.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _command(self, message: bytes) -> Command | None:
        """Return a command that is not older than one before; None for anything else."""
        if kind_of(message) == Kind.REFUSED:
            raise MisstepError(str(decode(message).get("error")))
        if kind_of(message) != Kind.COMMAND:
            return None
        command = decode_command(message)
        if command.number <= self._number:
            return None
        self._number = command.number
        return command

    def _ask_json(self, message: bytes, answer: Kind) -> dict[str, Any]:
        deadline = time.monotonic() + self._timeout
        try:
            # Who refuses a client may have hung up before it speaks; why is still to be read.
            with suppress(ConnectionError):
                self._link.send(message)
            while True:
                reply = self._link.receive(remaining(deadline))
                if kind_of(reply) == Kind.REFUSED:
                    raise MisstepError(f"{self._address}: {decode(reply).get('error')}")
                if kind_of(reply) == answer:
                    return decode(reply)
        except OSError as error:
            raise MisstepError(f"{self._address}: no answer: {error}") from error


def drive(client: RobotClient, system: System) -> None:
    """Let a simulation be the robot of a service, in lock-step, until the run is finished.

    Parameters
    ----------
    client : RobotClient
    system : System
        Reset with the seed of each trial.

    Raises
    ------
    MisstepError
        If the service refuses to start a trial or is gone.
    """
    simulated = client.description["simulated_time"]
    steps = 0
    while (start := client.start()) is not None:
        observation, info = system.reset(seed=start.seed)
        cost, over, steps = None, False, steps + 1
        while True:
            command = client.ask(
                tuple(observation.tolist()),
                stamp=steps * system.dt if simulated else None,
                cost=cost,
                failed=bool(info.get("failed", False)),
                succeeded=bool(info.get("success", False)),
                over=over,
            )
            if over or not command.in_trial:
                break
            observation, reward, terminated, truncated, info = system.step(np.array(command.action))
            cost, over, steps = -float(reward), terminated or truncated, steps + 1
