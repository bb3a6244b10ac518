"""The controller's connection to the exploration node."""

import json
import math
import time
from typing import Any

from misstep.errors import MisstepError
from misstep.robot.guard import Command
from misstep.robot.limits import Reason, Row
from misstep.robot.ros.bus import Bus
from misstep.robot.service import Start

_SILENT = int(Reason.SILENT | Reason.WATCHDOG)
_PAUSE = 0.01  # s, between two questions whether the next policy is there
_PAUSE_LOST = 0.1  # s, between two attempts to find the node


class NodeExplorer:
    """Asks the exploration node for trials and actions.

    Parameters
    ----------
    bus : Bus
    node : str
        Name of the exploration node.
    patience : float, s
        Longest wait for the node to be there, at the start and after it was lost.

    Attributes
    ----------
    description : dict
        The columns and limits that the node knows; filled by `connect`.
    safe : tuple of m float
        The safe action.
    """

    def __init__(self, bus: Bus, node: str = "exploration", patience: float = 60.0) -> None:
        self._bus, self._node = bus, node
        self._connect = bus.call(f"{node}/connect", "Connect")
        self._patience = patience
        self._connected = False
        self._sequence = self._number = 0
        self.description: dict[str, Any] = {}
        self.safe: Row = ()

    def connect(self) -> None:
        """Take the wheel.

        Raises
        ------
        MisstepError
            If the node is not there.
        """
        self.description = json.loads(self._introduce().description)
        self.safe = tuple(self.description["safe"])
        self._start = self._bus.call(f"{self._node}/start", "Start")
        in_time = (
            {} if self.description["simulated_time"] else {"timeout": self.description["watchdog"]}
        )
        self._explore = self._bus.call(f"{self._node}/explore", "Explore", **in_time)
        self._sequence, self._number = 0, -1
        self._connected = True

    def start(self) -> Start | None:
        """Begin the next trial, once its policy is there; None if the run is finished.

        A node that was lost is waited for, and asked again.

        Raises
        ------
        MisstepError
            If it does not come back.
        """
        while True:
            if not self._connected:
                self.connect()
            try:
                reply = self._start()
            except MisstepError:
                self._connected = False
                continue
            if reply.started:
                return Start(reply.number, reply.seed)
            if reply.phase == "finished":
                return None
            time.sleep(_PAUSE)

    def ask(
        self,
        observation: Row,
        *,
        stamp: float,
        cost: float | None,
        failed: bool,
        succeeded: bool,
        over: bool,
    ) -> Command:
        """Return the command that answers a state; the safe one if there is no answer in time."""
        self._sequence += 1
        cost = math.nan if cost is None else cost
        try:
            r = self._explore(
                sequence=self._sequence,
                stamp=stamp,
                cost=cost,
                failed=failed,
                succeeded=succeeded,
                over=over,
                observation=observation,
            )
        except MisstepError:
            self._connected = False
            return Command(self.safe, self.safe, _SILENT, self._sequence, self._number)
        self._number = r.number
        return Command(tuple(r.action), tuple(r.intended), r.reason, r.sequence, r.number)

    def _introduce(self) -> Any:
        # A node that was killed is still known to the master, so that to be known says nothing.
        deadline = time.monotonic() + self._patience
        while True:
            try:
                return self._connect()
            except MisstepError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(_PAUSE_LOST)
