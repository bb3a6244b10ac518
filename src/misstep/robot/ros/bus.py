"""What a middleware has to do for the nodes; ROS 1, ROS 2 and Zenoh each do it in their own way."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol


class JointArrays(NamedTuple):
    """What a ``sensor_msgs/JointState`` says."""

    stamp: float
    """When it was measured, s."""
    names: Sequence[str]
    positions: Sequence[float]
    velocities: Sequence[float]
    efforts: Sequence[float]


Handler = Callable[[Any, str], Mapping[str, Any] | tuple[Any, ...]]
"""Takes a request and who sent it; returns the fields of the response, by name or in order."""

Call = Callable[..., Any]
"""Takes the fields of a request; returns the response, or raises MisstepError."""

TRIGGER = "std_srvs/Trigger"


class Bus(Protocol):
    """One node in the graph.

    Names of topics and services are relative to its namespace; ``~`` stands for the node itself.
    Services are named by type: those of misstep_ros, such as ``"Explore"``, and `TRIGGER`. A
    callback may come in any thread. Messages are not lost on the way: lock-step relies on it.
    """

    def publish_joints(self, topic: str) -> Callable[[JointArrays], None]:
        """Return a function that publishes joint states."""

    def subscribe_joints(self, topic: str, callback: Callable[[JointArrays], None]) -> None:
        """Have a function called with every joint state."""

    def publish_effort(self, topic: str) -> Callable[[float], None]:
        """Return a function that publishes a ``std_msgs/Float64``."""

    def subscribe_effort(self, topic: str, callback: Callable[[float], None]) -> None:
        """Have a function called with every effort."""

    def serve(self, service: str, kind: str, handler: Handler) -> None:
        """Offer a service."""

    def call(self, service: str, kind: str, timeout: float = 10.0) -> Call:
        """Return a function that calls a service, over a connection that stays."""

    def count(self, topic: str) -> int:
        """Return how many others are at the other end of a topic that this node uses."""

    def close(self) -> None:
        """Leave the graph."""


class Recorder(Protocol):
    """Keeps what a controller saw, attempt by attempt."""

    def begin(self) -> None:
        """Begin the record of the next attempt."""

    def joints(self, topic: str, joints: JointArrays) -> None:
        """Add joint states."""

    def effort(self, topic: str, effort: float, stamp: float) -> None:
        """Add an effort."""

    def end(self) -> None:
        """End the record; it is whole now."""
