"""A client's end of a connection, over a socket or a WebSocket."""

import time
from contextlib import ExitStack
from typing import Any, Protocol

from misstep.errors import MisstepError
from misstep.robot.addresses import WEB, connect_socket
from misstep.robot.frames import FrameStream
from misstep.robot.protocol import LONGEST


class Link(Protocol):
    """Carries whole messages."""

    def send(self, message: bytes) -> None:
        """Send a message; raise OSError if the connection is lost."""

    def receive(self, timeout: float) -> bytes:
        """Return the next message.

        Raises
        ------
        TimeoutError
            If there is none in `timeout` s.
        OSError
            If the connection is lost.
        MisstepError
            If the message is too long.
        """

    def close(self) -> None:
        """Close the connection."""


def open_link(address: str, timeout: float) -> Link:
    """Connect to ``host:port``, ``unix:PATH`` or ``ws://host:port``.

    Raises
    ------
    MisstepError
        If nobody answers there in `timeout` s.
    """
    if address.startswith(WEB):
        return _WebSocketLink(address, timeout)
    return _SocketLink(address, timeout)


class _SocketLink:
    def __init__(self, address: str, timeout: float) -> None:
        self._stream = FrameStream(connect_socket(address, timeout))

    def send(self, message: bytes) -> None:
        self._stream.send(message)

    def receive(self, timeout: float) -> bytes:
        self._stream.settimeout(max(timeout, 1e-6))  # 0 would mean something else
        message = self._stream.receive()
        if message is None:
            raise ConnectionError("the other side has hung up")
        return message

    def close(self) -> None:
        self._stream.close()


class _WebSocketLink:
    def __init__(self, address: str, timeout: float) -> None:
        try:
            from websockets.exceptions import ConnectionClosed, WebSocketException
            from websockets.sync.client import connect
        except ImportError as error:
            raise MisstepError(
                "WebSockets need the package websockets: pip install 'misstep[live]'"
            ) from error
        # The library wants a context, from version 17.1 on.
        self._closed, self._open = ConnectionClosed, ExitStack()
        options: dict[str, Any] = {"max_size": LONGEST, "open_timeout": timeout, "close_timeout": 1}
        try:
            # Straight there: no proxy for web pages is to see what a robot is told.
            connecting: Any = connect(address, compression=None, proxy=None, **options)
            self._connection = self._open.enter_context(connecting)
        except (OSError, ValueError, WebSocketException) as error:  # ValueError: no such port
            raise MisstepError(f"nobody answers at {address}: {error}") from error

    def send(self, message: bytes) -> None:
        try:
            self._connection.send(message)
        except self._closed as error:
            raise ConnectionError(str(error)) from error

    def receive(self, timeout: float) -> bytes:
        try:
            message = self._connection.recv(timeout)
        except self._closed as error:
            raise ConnectionError(str(error)) from error
        if isinstance(message, str):
            raise MisstepError("a text came where bytes were expected")
        return bytes(message)

    def close(self) -> None:
        self._open.close()


def remaining(deadline: float) -> float:
    """Return the time until `deadline` of the monotonic clock, s.

    Raises
    ------
    TimeoutError
        If it has passed.
    """
    left = deadline - time.monotonic()
    if left <= 0:
        raise TimeoutError("no answer in time")
    return left
