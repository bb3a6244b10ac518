"""Messages over a stream: a length before each, and nothing longer than is ever needed."""

import socket
import struct
from contextlib import suppress

from misstep.errors import MisstepError
from misstep.robot.protocol import LONGEST

_LENGTH = struct.Struct("<I")
_CHUNK = 4096


class FrameStream:
    """Sends and receives whole messages over a connected stream socket.

    Parameters
    ----------
    connection : socket
    """

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        self._rest = b""

    def send(self, message: bytes) -> None:
        """Send a message; raise OSError if that fails."""
        self.send_raw(_LENGTH.pack(len(message)) + message)

    def send_raw(self, data: bytes) -> None:
        """Send bytes that say their length by themselves; raise OSError if that fails."""
        self._socket.sendall(data)

    def receive(self) -> bytes | None:
        """Return the next message; None if the stream has ended, also in the middle of one.

        Raises
        ------
        OSError
            If the connection is lost; TimeoutError if the socket's time is over, and the next
            call goes on where this one was.
        MisstepError
            If the message is too long.
        """
        while True:
            data = self._rest
            if len(data) >= _LENGTH.size:
                (length,) = _LENGTH.unpack_from(data)
                if length > LONGEST:
                    raise MisstepError(f"a message of {length} bytes: at most {LONGEST} are read")
                end = _LENGTH.size + length
                if len(data) >= end:
                    self._rest = data[end:]
                    return data[_LENGTH.size : end]
            chunk = self._socket.recv(_CHUNK)
            if not chunk:
                return None
            self._rest = data + chunk

    def settimeout(self, seconds: float | None) -> None:
        """Let `receive` wait so long, s; None for ever."""
        self._socket.settimeout(seconds)

    def close(self) -> None:
        """Close the connection."""
        with suppress(OSError):  # the other side was faster
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
