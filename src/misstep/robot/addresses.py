"""Where a service listens: ``127.0.0.1:7106``, ``unix:/run/user/1000/misstep``, ``ws://…``."""

import errno
import socket
from pathlib import Path

from misstep.errors import MisstepError

UNIX = "unix:"
WEB = "ws://"
TOKEN = "MISSTEP_TOKEN"  # noqa: S105 - the name of a variable
"""Environment variable that holds what both sides have to know."""
LOOPBACK = "127.0.0.1"


def parse_address(address: str) -> tuple[str, int] | str:
    """Return host and port of ``host:port``, or the path of ``unix:path``.

    Raises
    ------
    MisstepError
        If it is neither.
    """
    if address.startswith(UNIX) and len(address) > len(UNIX):
        return address.removeprefix(UNIX)
    host, _, port = address.rpartition(":")
    is_port = port.isascii() and port.isdigit() and len(port) <= 5 and int(port) <= 65535
    if not host or not is_port:
        raise MisstepError(
            f"the address {address!r} is neither host:port, such as {LOOPBACK}:7106, nor {UNIX}PATH"
        )
    return host, int(port)


def connect_socket(address: str, timeout: float) -> socket.socket:
    """Return a socket connected to `address`.

    Raises
    ------
    MisstepError
        If nobody answers there in `timeout` s.
    """
    where = parse_address(address)
    try:
        if isinstance(where, str):
            return _connect_unix(where, timeout)
        connection = socket.create_connection(where, timeout=timeout)
    except (OSError, UnicodeError) as error:
        raise MisstepError(f"nobody answers at {address}: {_reason(error)}") from error
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def listen(address: str) -> tuple[socket.socket, str]:
    """Return a listening socket and its address, with the port in place of 0.

    Raises
    ------
    MisstepError
        If it is taken or cannot be had.
    """
    where = parse_address(address)
    try:
        if isinstance(where, str):
            return _listen_unix(where), address
        listener = socket.create_server(where)
    except (OSError, UnicodeError) as error:
        raise MisstepError(f"cannot listen at {address}: {_reason(error)}") from error
    return listener, f"{where[0]}:{listener.getsockname()[1]}"


def _reason(error: OSError | UnicodeError) -> str:
    """Return why there is no connection; a host that can be no name is a UnicodeError."""
    return getattr(error, "strerror", None) or str(error)


def _connect_unix(path: str, timeout: float) -> socket.socket:
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connection.settimeout(timeout)
    try:
        connection.connect(path)
    except OSError:
        connection.close()
        raise
    return connection


def _listen_unix(path: str) -> socket.socket:
    """Listen at a path that the owner alone can reach, also where a killed service left one."""
    if Path(path).is_socket():
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            answer = probe.connect_ex(path)
        if answer == 0:
            raise MisstepError(f"a service listens at {UNIX}{path} already")
        if answer == errno.ECONNREFUSED:  # nobody listens any more
            Path(path).unlink()
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        listener.bind(path)
        Path(path).chmod(0o600)
        listener.listen()
    except OSError:
        listener.close()
        raise
    return listener
