"""The exploration node: the exploration service as services of the graph.

========= =================== ====================================================================
service   type                what it does
========= =================== ====================================================================
connect   misstep_ros/Connect a controller begins
start     misstep_ros/Start   begins the next trial
explore   misstep_ros/Explore which action now?
mark      misstep_ros/Mark    a person judges the trial in progress
stop      std_srvs/Trigger    emergency stop; anybody may call it
clear     std_srvs/Trigger    takes it back
status    std_srvs/Trigger    how things stand, as JSON
========= =================== ====================================================================

Where the controller falls silent, this node sends the safe effort to the robot by itself.
"""

import json
import math
import threading
import time
from collections.abc import Sequence
from typing import Any

from misstep.errors import MisstepError
from misstep.robot.guard import State
from misstep.robot.ros.bus import TRIGGER, Bus
from misstep.robot.service import ExplorationService, Phase
from misstep.trajectory import Outcome

_GRACE = 0.2  # s for the last answer to leave
_LOOK = 1.0  # s


class ExplorationNode:
    """Offers the services from now on.

    Parameters
    ----------
    bus : Bus
    service : ExplorationService
    commands : sequence of m str
        Topics of the efforts, for the safe one where the controller is gone.
    lock_step : bool
        The simulation waits for its controller: then no command is sent unasked.
    """

    def __init__(
        self,
        bus: Bus,
        service: ExplorationService,
        commands: Sequence[str],
        *,
        lock_step: bool = False,
    ) -> None:
        self._service = service
        self._driver = ""
        self._heard, self._closing = threading.Event(), threading.Event()
        self._commands = [bus.publish_effort(name) for name in commands]
        # The one that a controller begins with comes last: then all are there.
        for name, kind, handler in (
            ("stop", TRIGGER, self._stop),
            ("clear", TRIGGER, self._clear),
            ("status", TRIGGER, self._status),
            ("mark", "Mark", self._mark),
            ("explore", "Explore", self._explore),
            ("start", "Start", self._start),
            ("connect", "Connect", self._connect),
        ):
            bus.serve(f"~{name}", kind, handler)
        self._thread = threading.Thread(target=self._tick_on, name="watchdog", daemon=True)
        if not lock_step:
            self._thread.start()

    def wait(self) -> None:
        """Wait until the run is finished and its controller has heard of it."""
        while not self._heard.wait(_LOOK):
            pass
        time.sleep(_GRACE)

    def close(self) -> None:
        """Send nothing any more."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()

    def _connect(self, request: Any, who: str) -> tuple[str]:
        self._driver = who
        self._service.connect(who)
        return (json.dumps(self._service.describe()),)

    def _start(self, request: Any, who: str) -> dict[str, Any]:
        self._check_driver(who)
        try:
            start = self._service.start()
        except MisstepError as error:
            return {"started": False, "phase": self._phase(), "message": str(error)}
        if start is None:
            if self._service.phase is Phase.FINISHED:
                self._heard.set()
            return {"started": False, "phase": self._phase()}
        return {"started": True, "phase": self._phase(), **start._asdict()}

    def _explore(self, request: Any, who: str) -> tuple[Any, ...]:
        self._check_driver(who)
        command = self._service.exchange(
            State(
                request.sequence,
                request.stamp,
                tuple(request.observation),
                None if math.isnan(request.cost) else request.cost,
                request.failed,
                request.succeeded,
                request.over,
            )
        )
        return command.sequence, command.number, command.reason, command.action, command.intended

    def _mark(self, request: Any, who: str) -> tuple[bool, str]:
        try:
            outcome = Outcome(request.outcome)
        except ValueError:
            return False, f"an outcome is one of {', '.join(Outcome)}"
        done = self._service.mark(outcome, who)
        return done, "" if done else "no trial is running"

    def _stop(self, request: Any, who: str) -> tuple[bool, str]:
        self._service.stop(who)
        return True, "stopped until clear"

    def _clear(self, request: Any, who: str) -> tuple[bool, str]:
        self._service.clear(who)
        return True, "cleared"

    def _status(self, request: Any, who: str) -> tuple[bool, str]:
        return True, json.dumps(self._service.status())

    def _check_driver(self, who: str) -> None:
        if who != self._driver:
            raise MisstepError(f"{self._driver or 'nobody'} drives: connect first")

    def _phase(self) -> str:
        return self._service.phase.name.lower()

    def _tick_on(self) -> None:
        while not self._closing.wait(self._service.limits.period):
            command = self._service.tick()
            if command is not None:
                for publish, effort in zip(self._commands, command.action, strict=True):
                    publish(effort)
