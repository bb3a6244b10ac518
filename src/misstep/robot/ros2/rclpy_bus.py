"""The nodes' bus in ROS 2: rclpy, where an installation is sourced.

Thin on purpose, and not tested: no ROS 2 runs where misstep is built. The messages and services are
those of the packages sensor_msgs, std_msgs, std_srvs and misstep_ros (``ros2/misstep_ros``).
"""

import logging
import threading
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

from misstep.errors import MisstepError
from misstep.robot.ros.bus import TRIGGER, Call, Handler, JointArrays
from misstep.robot.ros2.types import joint_arrays

_LOG = logging.getLogger(__name__)
_DEPTH = 1000  # messages: in lock-step none may be lost
_SOMEBODY = "a node of ROS 2"  # a request does not say whose it is


class RclpyBus:
    """An rclpy node, spun in threads of its own.

    Parameters
    ----------
    node : str

    Raises
    ------
    MisstepError
        If the package misstep_ros is not sourced.
    """

    def __init__(self, node: str) -> None:
        self._rclpy = rclpy = import_module("rclpy")
        self._joint_state = import_module("sensor_msgs.msg").JointState
        self._float64 = import_module("std_msgs.msg").Float64
        rclpy.init()
        self._node = rclpy.create_node(node)
        self._group = import_module("rclpy.callback_groups").ReentrantCallbackGroup()
        self._executor = import_module("rclpy.executors").MultiThreadedExecutor()
        self._executor.add_node(self._node)
        self._publishers: set[str] = set()
        threading.Thread(target=self._spin, name="rclpy", daemon=True).start()

    def publish_joints(self, topic: str) -> Callable[[JointArrays], None]:
        """Return a function that publishes joint states."""
        publisher = self._publisher(topic, self._joint_state)

        def publish(joints: JointArrays) -> None:
            message = self._joint_state()
            nanoseconds = round(joints.stamp * 1e9)
            message.header.stamp.sec = nanoseconds // 10**9
            message.header.stamp.nanosec = nanoseconds % 10**9
            message.name = list(joints.names)
            message.position, message.velocity = list(joints.positions), list(joints.velocities)
            message.effort = list(joints.efforts)
            publisher.publish(message)

        return publish

    def subscribe_joints(self, topic: str, callback: Callable[[JointArrays], None]) -> None:
        """Have a function called with every joint state."""
        self._subscribe(topic, self._joint_state, lambda message: callback(joint_arrays(message)))

    def publish_effort(self, topic: str) -> Callable[[float], None]:
        """Return a function that publishes a ``std_msgs/msg/Float64``."""
        publisher = self._publisher(topic, self._float64)
        return lambda effort: publisher.publish(self._float64(data=effort))

    def subscribe_effort(self, topic: str, callback: Callable[[float], None]) -> None:
        """Have a function called with every effort."""
        self._subscribe(topic, self._float64, lambda message: callback(message.data))

    def serve(self, service: str, kind: str, handler: Handler) -> None:
        """Offer a service; a request that is refused is not answered, so its caller waits."""

        def answer(request: Any, response: Any) -> Any:
            fields = handler(request, _SOMEBODY)
            names = response.get_fields_and_field_types()
            if not isinstance(fields, Mapping):
                fields = dict(zip(names, fields, strict=True))
            for name, value in fields.items():
                setattr(response, name, list(value) if isinstance(value, tuple) else value)
            return response

        self._node.create_service(_kind(kind), service, answer, callback_group=self._group)

    def call(self, service: str, kind: str, timeout: float = 10.0) -> Call:
        """Return a function that calls a service."""
        client = self._node.create_client(_kind(kind), service, callback_group=self._group)

        def call(**fields: Any) -> Any:
            if not client.service_is_ready() and not client.wait_for_service(timeout):
                raise MisstepError(f"no node offers the service {service}")
            request = _kind(kind).Request()
            for name, value in fields.items():
                setattr(request, name, list(value) if isinstance(value, tuple) else value)
            answered = threading.Event()
            future = client.call_async(request)
            future.add_done_callback(lambda _: answered.set())
            if not answered.wait(timeout):
                client.remove_pending_request(future)
                raise MisstepError(f"the service {service} does not answer")
            return future.result()

        return call

    def count(self, topic: str) -> int:
        """Return how many others are at the other end of a topic that this node uses."""
        node = self._node
        if topic in self._publishers:
            return int(node.count_subscribers(topic))
        return int(node.count_publishers(topic))

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._rclpy.shutdown()

    def _spin(self) -> None:
        """Serve until the end: what a callback raises, the executor's `spin` raises too."""
        while self._rclpy.ok():
            try:
                self._executor.spin()
                return
            except Exception as error:  # whoever asked is not answered; the node goes on
                _LOG.warning("a request or a message was refused: %s", error)

    def _publisher(self, topic: str, kind: Any) -> Any:
        self._publishers.add(topic)
        return self._node.create_publisher(kind, topic, _DEPTH)

    def _subscribe(self, topic: str, kind: Any, callback: Callable[[Any], None]) -> None:
        self._node.create_subscription(kind, topic, callback, _DEPTH, callback_group=self._group)


def _kind(name: str) -> Any:
    if name == TRIGGER:
        return import_module("std_srvs.srv").Trigger
    try:
        srv = import_module("misstep_ros.srv")
    except ImportError as error:
        raise MisstepError(
            "ROS 2's package misstep_ros is not sourced: build ros2/misstep_ros with colcon"
        ) from error
    return getattr(srv, name)
