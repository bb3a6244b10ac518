"""The service over a Unix-domain socket or TCP: binary messages, a thread for each client."""

import logging
import socket
import threading
from contextlib import suppress
from pathlib import Path

from misstep.errors import MisstepError
from misstep.robot.addresses import UNIX, listen, parse_address
from misstep.robot.frames import FrameStream
from misstep.robot.protocol import Kind, encode
from misstep.robot.session import HELLO_TIMEOUT, Host, limit_sending

_LOG = logging.getLogger(__name__)
_PAUSE = 0.1  # s after a client could not be let in, as where there are too many open files


class SocketServer:
    """Listens at once, in threads of its own, until `close`.

    Parameters
    ----------
    hub : Host
    address : str
        ``host:port`` (0 for any port) or ``unix:PATH``.

    Attributes
    ----------
    address : str
        Where it listens.

    Raises
    ------
    MisstepError
        If the address is taken or cannot be had.
    """

    def __init__(self, hub: Host, address: str) -> None:
        self._hub = hub
        self._listener, self.address = listen(address)
        self._streams: set[FrameStream] = set()
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._accept, name="listener", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Hang up on every client and stop listening."""
        self._closing.set()
        with suppress(OSError):  # on some systems a listener cannot be shut down
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join()
        with self._lock:
            streams = list(self._streams)
        for stream in streams:
            stream.close()
        where = parse_address(self.address)
        if isinstance(where, str):
            Path(where).unlink(missing_ok=True)

    def _accept(self) -> None:
        while not self._closing.is_set():
            try:
                connection, _ = self._listener.accept()
            except OSError as error:
                if not self._closing.is_set():
                    _LOG.warning("a client could not be let in: %s", error)
                self._closing.wait(_PAUSE)
                continue
            # Before its thread is there: `close` has to find it.
            stream = FrameStream(connection)
            with self._lock:
                self._streams.add(stream)
            self._give_thread(connection, stream)

    def _give_thread(self, connection: socket.socket, stream: FrameStream) -> None:
        try:
            threading.Thread(target=self._serve, args=(connection, stream), daemon=True).start()
        except RuntimeError as error:  # no memory for one: others may still be let in later
            _LOG.warning("a client could not be let in: %s", error)
            self._forget(stream)

    def _serve(self, connection: socket.socket, stream: FrameStream) -> None:
        try:
            limit_sending(connection)
            if not self.address.startswith(UNIX):
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._converse(stream)
        except OSError as error:
            _LOG.info("a client is lost: %s", error)
        finally:
            self._forget(stream)

    def _forget(self, stream: FrameStream) -> None:
        with self._lock:
            self._streams.discard(stream)
        stream.close()

    def _converse(self, stream: FrameStream) -> None:
        try:
            session = self._hub.open(stream.send)
        except MisstepError as error:
            stream.send(encode(Kind.REFUSED, {"error": str(error)}))
            return
        try:
            stream.settimeout(HELLO_TIMEOUT)
            message = stream.receive()
            stream.settimeout(None)
            while message is not None and session.receive(message):
                message = stream.receive()
        except MisstepError as error:
            stream.send(encode(Kind.REFUSED, {"error": str(error)}))
        finally:
            session.close()
