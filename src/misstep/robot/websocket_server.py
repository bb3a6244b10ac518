"""The service over a WebSocket: the same binary messages, also for programs in a browser."""

import logging
import threading
from collections.abc import Sequence

from misstep.errors import MisstepError
from misstep.robot.addresses import WEB, listen
from misstep.robot.protocol import LONGEST
from misstep.robot.session import HELLO_TIMEOUT, Host, limit_sending

_LOG = logging.getLogger(__name__)


class WebSocketServer:
    """Listens at once, in threads of its own, until `close`.

    Parameters
    ----------
    hub : Host
    address : str
        ``host:port``, 0 for any port.
    origins : sequence of str
        Web pages that may connect, such as ``"http://localhost:8000"``. Programs that are no web
        page send no origin and may.

    Attributes
    ----------
    address : str
        Where it listens, ``ws://host:port``.

    Raises
    ------
    MisstepError
        If the address is taken, or the library is not installed.
    """

    def __init__(self, hub: Host, address: str, origins: Sequence[str] = ()) -> None:
        serve, self._closed = _library()
        self._hub = hub
        listener, where = listen(address)
        self.address = WEB + where
        self._server = serve(
            self._serve,
            sock=listener,
            origins=[None, *origins],
            compression=None,
            max_size=LONGEST,
            open_timeout=5,
            close_timeout=1,
            logger=_LOG,
        )
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Hang up on every client and stop listening."""
        self._server.shutdown()
        self._thread.join()

    def _serve(self, connection):  # type: ignore[no-untyped-def]
        def send(message: bytes) -> None:
            try:
                connection.send(message)
            except self._closed as error:
                raise ConnectionError(str(error)) from error

        limit_sending(connection.socket)
        try:
            session = self._hub.open(send)
        except MisstepError as error:
            connection.close(1013, str(error)[:100])
            return
        try:
            message = connection.recv(HELLO_TIMEOUT)
            while isinstance(message, bytes) and session.receive(message):
                message = connection.recv()
        except (OSError, self._closed) as error:
            _LOG.info("a client is lost: %s", error)
        finally:
            session.close()


def _library():  # type: ignore[no-untyped-def]
    try:
        from websockets.exceptions import ConnectionClosed
        from websockets.sync.server import serve
    except ImportError as error:
        raise MisstepError(
            "WebSockets need the package websockets: pip install 'misstep[live]'"
        ) from error
    return serve, ConnectionClosed
