"""What a client of the service says and is told, whatever carries it.

A `Hub` belongs to one service: it knows which client drives the robot, and a thread of its own
looks after the watchdog. A `Session` is one client's conversation; a transport hands it the
messages that come in and a function that sends one.
"""

import logging
import socket
import struct
import threading
from collections.abc import Callable
from typing import Any, Protocol

from misstep.errors import MisstepError
from misstep.robot.guard import Command
from misstep.robot.protocol import (
    Kind,
    decode,
    decode_state,
    encode,
    encode_command,
    kind_of,
    read_hello,
)
from misstep.robot.service import ExplorationService, Phase
from misstep.trajectory import Outcome

Send = Callable[[bytes], None]
"""Sends a message; raises OSError where the client is gone."""

MOST_CLIENTS = 16
HELLO_TIMEOUT = 5.0
"""Seconds that a transport waits for the first message of a client."""
_SEND_TIMEOUT = struct.pack("@ll", 1, 0)  # a timeval of 1 s


def limit_sending(connection: socket.socket) -> None:
    """Have `send` raise OSError after 1 s: who does not read is let go, and holds nobody up."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _SEND_TIMEOUT)


class Conversation(Protocol):
    """What a transport needs of one client's conversation."""

    def receive(self, message: bytes) -> bool:
        """Answer a message; return whether to go on listening; OSError if the client is gone."""

    def close(self) -> None:
        """End the conversation."""


class Host(Protocol):
    """What a transport needs: somebody who talks to each client."""

    def open(self, send: Send) -> Conversation:
        """Return the conversation of a new client; MisstepError if there are too many."""


_LOG = logging.getLogger(__name__)
_LONGEST_NAME = 40
_STATE = int(Kind.STATE)  # an enumeration takes longer to look up


class Hub:
    """All the clients of a service.

    Parameters
    ----------
    service : ExplorationService
    token : str
        What every client has to know.

    Attributes
    ----------
    service : ExplorationService
    token : str
    """

    def __init__(self, service: ExplorationService, token: str) -> None:
        self.service, self.token = service, token
        self._lock = threading.Lock()
        self._sessions: set[Session] = set()
        self._driver: Session | None = None
        self._closing = threading.Event()
        self._ticker = threading.Thread(target=self._tick_on, name="watchdog", daemon=True)
        self._ticker.start()

    def open(self, send: Send) -> "Session":
        """Return the conversation of a new client.

        Raises
        ------
        MisstepError
            If there are too many.
        """
        session = Session(self, send)
        with self._lock:
            if len(self._sessions) >= MOST_CLIENTS:
                raise MisstepError(f"there are {MOST_CLIENTS} clients already")
            self._sessions.add(session)
        return session

    def forget(self, session: "Session") -> None:
        """Let a client go; if it drives, its trial is abandoned."""
        with self._lock:
            self._sessions.discard(session)
            drove = self._driver is session
            if drove:
                self._driver = None
        if drove:
            self.service.disconnect(session.name)

    def take_wheel(self, session: "Session") -> None:
        """Let a client drive, in place of one that is not in a trial.

        Raises
        ------
        MisstepError
            If another one is in a trial.
        """
        with self._lock:
            if self._driver is not None and self.service.phase is Phase.RUNNING:
                raise MisstepError(f"{self._driver.name} drives, and is in a trial")
            self._driver = session
        self.service.connect(session.name)

    @property
    def is_driven(self) -> bool:
        """Whether a client drives."""
        return self._driver is not None

    def drives(self, session: "Session") -> bool:
        """Return whether a client drives."""
        return self._driver is session

    def tick(self) -> None:
        """Look at the watchdog, and tell the robot what it has to be told unasked."""
        command = self.service.tick()
        driver = self._driver
        if command is not None and driver is not None:
            try:
                driver.tell(command)
            except OSError as error:
                _LOG.info("%s cannot be reached: %s", driver.name, error)

    def close(self) -> None:
        """Stop looking after the watchdog."""
        self._closing.set()
        self._ticker.join()

    def _tick_on(self) -> None:
        while not self._closing.wait(self.service.limits.period):
            self.tick()


class Session:
    """One client's conversation.

    Parameters
    ----------
    hub : Hub
    send : callable
        Sends a message to the client.

    Attributes
    ----------
    name : str
        As the client calls itself.
    """

    def __init__(self, hub: Hub, send: Send) -> None:
        self.name = "a client"
        self._hub = hub
        self._service = hub.service
        self._send = send
        self._lock = threading.Lock()
        self._last_number = -1
        self._welcome = False

    def receive(self, message: bytes) -> bool:
        """Answer a message; return whether to go on listening to this client.

        Raises
        ------
        OSError
            If the client is gone.
        """
        kind = kind_of(message)
        try:
            if kind == _STATE and self._welcome:
                if not self._hub.drives(self):
                    raise MisstepError("another client drives")
                self.tell(self._service.exchange(decode_state(message)))
                return True
            self._answer(kind, message)
        except MisstepError as error:
            self._say(encode(Kind.REFUSED, {"error": str(error)}))
            # Who starts a trial in vain may try again; who cannot speak is not listened to.
            return self._welcome and kind in (Kind.START, Kind.MARK)
        return True

    def tell(self, command: Command) -> None:
        """Send a command, unless a later one was sent already; raise OSError if that fails."""
        with self._lock:
            if command.number > self._last_number:
                self._last_number = command.number
                self._send(encode_command(command))

    def close(self) -> None:
        """End the conversation."""
        self._hub.forget(self)

    def _say(self, message: bytes) -> None:
        with self._lock:
            self._send(message)

    def _answer(self, kind: int, message: bytes) -> None:
        if not self._welcome:
            self._greet(message)
            return
        service = self._service
        if kind == Kind.START:
            self._say(encode(Kind.STARTED, self._start()))
            return
        if kind == Kind.STOP:
            service.stop(self.name)
            self._hub.tick()
        elif kind == Kind.CLEAR:
            service.clear(self.name)
        elif kind == Kind.MARK:
            service.mark(_outcome(decode(message)), self.name)
            self._hub.tick()
        elif kind != Kind.STATUS:
            raise MisstepError(f"a message of kind {kind} says nothing here")
        self._say(encode(Kind.REPORT, service.status()))

    def _greet(self, message: bytes) -> None:
        hello = read_hello(message, self._hub.token, "service")
        name = hello.get("name")
        if isinstance(name, str) and name.isprintable():
            self.name = name[:_LONGEST_NAME]
        if hello.get("role") == "drive":
            self._hub.take_wheel(self)
        self._welcome = True
        self._say(encode(Kind.WELCOME, self._service.describe()))

    def _start(self) -> dict[str, Any]:
        if not self._hub.drives(self):
            raise MisstepError("another client drives")
        start = self._service.start()
        phase = {"phase": self._service.phase.name.lower()}
        return phase if start is None else {**phase, **start._asdict()}


def _outcome(body: dict[str, Any]) -> Outcome:
    try:
        return Outcome(body.get("outcome"))  # type: ignore[arg-type]
    except ValueError as error:
        raise MisstepError(f"an outcome is one of {', '.join(Outcome)}") from error
