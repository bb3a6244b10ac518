"""Answering the requests of connections that stay, straight from the socket.

rospy takes every message through several buffers and classes, which takes longer than most answers.
Its handshake, its names and its way of connections that do not stay remain; only the loop of one
that stays is another. On the wire nothing differs: a request is a u32 with its length and its
bytes; a response the same after a byte 1; an error a byte 0, a u32 and a text.
"""

import logging
import struct
from functools import cache
from io import BytesIO
from typing import Any

from misstep.errors import MisstepError
from misstep.robot.frames import FrameStream

OK = struct.Struct("<BI")
_LOG = logging.getLogger(__name__)


@cache
def persistent_service(rospy: Any) -> Any:
    """Return rospy's class Service with a quicker loop for connections that stay."""

    class PersistentService(rospy.Service):
        def handle(self, transport: Any, header: dict[str, str]) -> None:
            if header.get("persistent", "") not in ("1", "true", "True"):
                super().handle(transport, header)
                return
            transport.socket.setblocking(True)
            try:
                _converse(FrameStream(transport.socket), self._answer, header)
            except (OSError, MisstepError) as error:
                _LOG.info("%s: %s is lost: %s", self.resolved_name, header["callerid"], error)
            finally:
                transport.close()

        def _answer(self, message: bytes, header: dict[str, str]) -> bytes:
            try:
                request = self.request_class().deserialize(message)
                request._connection_header = header
                body = BytesIO()
                self.handler(request).serialize(body)
            except Exception as error:  # the caller is told; the service goes on, as rospy's does
                _LOG.warning("%s: %s", self.resolved_name, error)
                text = f"service cannot process request: {error}".encode()
                return OK.pack(0, len(text)) + text
            answer = body.getvalue()
            return OK.pack(1, len(answer)) + answer

    return PersistentService


def _converse(stream: FrameStream, answer: Any, header: dict[str, str]) -> None:
    while (message := stream.receive()) is not None:
        stream.send_raw(answer(message, header))
