"""The nodes' bus in ROS 1: rospy, with a connection for each topic and service that stays."""

import warnings
from collections.abc import Callable, Mapping
from typing import Any

from misstep.errors import MisstepError
from misstep.robot.ros.bus import TRIGGER, Call, Handler, JointArrays
from misstep.robot.ros1.calls import PersistentCall
from misstep.robot.ros1.environment import import_ros, init_node
from misstep.robot.ros1.messages import joint_arrays, joint_state
from misstep.robot.ros1.persistent_service import persistent_service
from misstep.robot.ros1.services import service_type


class Ros1Bus:
    """A rospy node; one in a process.

    Parameters
    ----------
    node : str

    Raises
    ------
    MisstepError
        If ROS 1 is not installed, or no roscore answers.
    """

    def __init__(self, node: str) -> None:
        self._rospy = init_node(node)
        self._float64 = import_ros("std_msgs.msg").Float64
        self._joint_state = import_ros("sensor_msgs.msg").JointState
        self._links: dict[str, Any] = {}
        self._services: list[Any] = []

    def publish_joints(self, topic: str) -> Callable[[JointArrays], None]:
        """Return a function that publishes joint states."""
        publisher = self._publisher(topic, self._joint_state)
        return lambda joints: publisher.publish(joint_state(joints))

    def subscribe_joints(self, topic: str, callback: Callable[[JointArrays], None]) -> None:
        """Have a function called with every joint state."""
        self._subscribe(topic, self._joint_state, lambda message: callback(joint_arrays(message)))

    def publish_effort(self, topic: str) -> Callable[[float], None]:
        """Return a function that publishes a ``std_msgs/Float64``."""
        publisher = self._publisher(topic, self._float64)
        return lambda effort: publisher.publish(self._float64(effort))

    def subscribe_effort(self, topic: str, callback: Callable[[float], None]) -> None:
        """Have a function called with every effort."""
        self._subscribe(topic, self._float64, lambda message: callback(message.data))

    def serve(self, service: str, kind: str, handler: Handler) -> None:
        """Offer a service; what it raises as a MisstepError its caller is told."""
        response = _kind(kind)._response_class

        def answer(request: Any) -> Any:
            try:
                fields = handler(request, request._connection_header["callerid"])
            except MisstepError as error:
                raise self._rospy.ServiceException(str(error)) from error
            return response(**fields) if isinstance(fields, Mapping) else response(*fields)

        offer = persistent_service(self._rospy)
        self._services.append(offer(service, _kind(kind), answer))

    def call(self, service: str, kind: str, timeout: float = 10.0) -> Call:
        """Return a function that calls a service, over a connection that stays."""
        return PersistentCall(self._rospy, service, _kind(kind), timeout)

    def count(self, topic: str) -> int:
        """Return how many others are at the other end of a topic that this node uses."""
        return int(self._links[topic].get_num_connections())

    def close(self) -> None:
        """Leave the graph."""
        self._rospy.signal_shutdown("the node ends")

    def _publisher(self, topic: str, kind: Any) -> Any:
        # Without a queue, a message has been sent when `publish` returns. rospy warns of that,
        # because one slow subscriber holds it up; a queue would hand every message to another
        # thread, which takes longer than to send it.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SyntaxWarning)
            self._links[topic] = self._rospy.Publisher(topic, kind, tcp_nodelay=True)
        return self._links[topic]

    def _subscribe(self, topic: str, kind: Any, callback: Callable[[Any], None]) -> None:
        self._links[topic] = self._rospy.Subscriber(topic, kind, callback, tcp_nodelay=True)


def _kind(name: str) -> Any:
    return import_ros("std_srvs.srv").Trigger if name == TRIGGER else service_type(name)
