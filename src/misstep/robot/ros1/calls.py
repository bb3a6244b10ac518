"""Calling a service over a connection that stays, and not for ever.

rospy's own proxy waits for an answer without end: a node that hangs would take the controller, and
the robot with the last effort, with it.
"""

import socket
import struct
from io import BytesIO
from typing import Any

from misstep.errors import MisstepError
from misstep.robot.ros1.environment import import_ros
from misstep.robot.ros1.persistent_service import OK

_LENGTH = struct.Struct("<I")
_CHUNK = 4096


class PersistentCall:
    """A service of another node.

    Parameters
    ----------
    rospy : module
        With its node started.
    name : str
    kind : type
        Of the service.
    timeout : float, s
        Longest wait for an answer.
    """

    def __init__(self, rospy: Any, name: str, kind: Any, timeout: float = 10.0) -> None:
        self._rospy, self._name, self._kind = rospy, rospy.resolve_name(name), kind
        self._proxy: Any = None
        self._request, self._response = kind._request_class, kind._response_class
        self._timeout = timeout

    def __call__(self, **fields: Any) -> Any:
        """Call and return the response.

        Raises
        ------
        MisstepError
            If there is no answer in time, or the node says what is wrong.
        """
        rospy = self._rospy
        body = BytesIO()
        self._request(**fields).serialize(body)
        request = body.getvalue()
        try:
            proxy = self._proxy = self._proxy or self._open()
            connection = proxy.transport.socket
            connection.sendall(_LENGTH.pack(len(request)) + request)
            return self._response().deserialize(_receive(connection))
        except (
            OSError,
            rospy.ServiceException,
            rospy.ROSException,
            rospy.exceptions.ROSInternalException,
        ) as error:
            self.close()
            is_late = isinstance(error, BlockingIOError)  # how the operating system says it
            reason = f"no answer in {self._timeout:g} s" if is_late else error
            raise MisstepError(f"the service {self._name}: {reason}") from error

    def close(self) -> None:
        """Hang up; the next call connects anew. An answer that comes late finds nobody."""
        if self._proxy is not None:
            self._proxy.close()
            self._proxy = None

    def _open(self) -> Any:
        """Return rospy's proxy with its connection made, as its first call would make it."""
        rospy = self._rospy
        proxy = rospy.ServiceProxy(self._name, self._kind, persistent=True)
        uri = proxy._get_service_uri(self._request())
        host, port = rospy.core.parse_rosrpc_uri(uri)
        proxy.transport = import_ros("rospy.impl.tcpros_base").TCPROSTransport(
            proxy.protocol, self._name
        )
        proxy.transport.buff_size = proxy.buff_size
        proxy.transport.connect(host, port, uri, timeout=self._timeout)
        # The operating system's timeout costs no system call a message.
        proxy.transport.socket.setblocking(True)
        seconds, rest = divmod(self._timeout, 1.0)
        limit = struct.pack("@ll", int(seconds), round(rest * 1e6))
        proxy.transport.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)
        return proxy


def _receive(connection: socket.socket) -> bytes:
    """Return the body of a response; raise OSError if there is none, or an error instead."""
    data = connection.recv(_CHUNK)
    while len(data) < OK.size or len(data) < OK.size + OK.unpack_from(data)[1]:
        chunk = connection.recv(_CHUNK)
        if not chunk:
            raise ConnectionError("the node has hung up")
        data += chunk
    if not data[0]:
        raise ConnectionError(data[OK.size :].decode(errors="replace"))
    return data[OK.size :]
