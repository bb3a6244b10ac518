"""ROS 2's types without ROS 2: CDR bytes and type hashes, both by the library rosbags."""

from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np

from misstep.errors import MisstepError
from misstep.robot.ros.bus import TRIGGER, JointArrays

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

JOINT_STATE = "sensor_msgs/msg/JointState"
FLOAT64 = "std_msgs/msg/Float64"

_PACKAGE = "misstep_ros"
_EVENT_INFO = "service_msgs/msg/ServiceEventInfo"
_TRIGGER = "---\nbool success\nstring message\n"


class Types:
    """Encodes, decodes and hashes the types of the nodes' topics and services."""

    def __init__(self) -> None:
        self._store = _typestore()

    def service(self, kind: str) -> str:
        """Return the full name of a service type, which is known from now on."""
        name = "std_srvs/srv/Trigger" if kind == TRIGGER else f"{_PACKAGE}/srv/{kind}"
        if name not in self._store.fielddefs:
            _register_service(self._store, name, _TRIGGER if kind == TRIGGER else _definition(kind))
        return name

    def hash(self, name: str) -> str:
        """Return the hash of a type (REP 2016), ``RIHS01_`` and 64 digits."""
        return str(self._store.hash_rihs01(name))

    def fields(self, name: str) -> list[str]:
        """Return the names of the fields of a type, in order."""
        return [field for field, _ in self._store.fielddefs[name][1]]

    def encode(self, name: str, fields: Mapping[str, Any]) -> bytes:
        """Return a message as CDR, little-endian; missing fields are 0, empty or false."""
        return bytes(self._store.serialize_cdr(self._make(name, fields), name, little_endian=True))

    def decode(self, name: str, data: bytes) -> Any:
        """Return a message with its fields as attributes.

        Raises
        ------
        MisstepError
            If the bytes are not one.
        """
        from rosbags.serde import SerdeError

        try:
            return self._store.deserialize_cdr(data, name)
        except (SerdeError, ValueError, IndexError) as error:
            raise MisstepError(f"{len(data)} bytes are no {name}: {error}") from error

    def _make(self, name: str, fields: Mapping[str, Any]) -> Any:
        values = {}
        for field, (kind, detail) in self._store.fielddefs[name][1]:
            values[field] = self._value(kind.name, detail, fields.get(field))
        return self._store.types[name](**values)

    def _value(self, kind: str, detail: Any, value: Any) -> Any:
        if kind == "NAME":
            return self._make(detail, value or {})
        if kind == "SEQUENCE":
            basic = detail[0][1][0]
            given = () if value is None else value
            return list(given) if basic == "string" else np.array(given, np.dtype(basic))
        return value if value is not None else "" if detail[0] == "string" else 0


def joint_fields(joints: JointArrays) -> dict[str, Any]:
    """Return the fields of a ``sensor_msgs/msg/JointState``."""
    nanoseconds = round(joints.stamp * 1e9)
    stamp = {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}
    return {
        "header": {"stamp": stamp},
        "name": joints.names,
        "position": joints.positions,
        "velocity": joints.velocities,
        "effort": joints.efforts,
    }


def joint_arrays(message: Any) -> JointArrays:
    """Return what a ``sensor_msgs/msg/JointState`` says."""
    stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
    arrays = (message.position, message.velocity, message.effort)
    return JointArrays(stamp, list(message.name), *(np.asarray(a).tolist() for a in arrays))


def _definition(kind: str) -> str:
    # The language of service files is the same in ROS 1 and ROS 2.
    path = files("misstep.robot.ros1").joinpath(f"srv/{kind}.srv")
    return path.read_text(encoding="utf-8")


@cache
def _nodetypes() -> Any:
    from rosbags.interfaces import Nodetype

    return Nodetype


def _typestore() -> "Typestore":
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise MisstepError(
            "ROS 2 without ROS needs rosbags and eclipse-zenoh: pip install 'misstep[ros2]'"
        ) from error
    store = get_typestore(Stores.ROS2_JAZZY)
    # ROS 2 hashes a char as the uint8 that it is; rosbags does not, and then no service's hash is
    # the one that ROS 2 has.
    constants, fields = store.fielddefs[_EVENT_INFO]
    as_bytes = (_nodetypes().ARRAY, ((_nodetypes().BASE, ("uint8", 0)), 16))
    fields = [(name, as_bytes if name == "client_gid" else kind) for name, kind in fields]
    store.fielddefs[_EVENT_INFO] = (constants, fields)
    return store


def _register_service(store: "Typestore", name: str, definition: str) -> None:
    """Make a service known as ROS 2 does: request, response, event, and the three together."""
    from rosbags.typesys import get_types_from_msg

    node = _nodetypes()
    filler = [("structure_needs_at_least_one_member", (node.BASE, ("uint8", 0)))]
    request, _, response = definition.partition("---\n")
    for suffix, text in (("Request", request), ("Response", response)):
        ((constants, fields),) = get_types_from_msg(text, f"{_PACKAGE}/msg/Part").values()
        store.register({f"{name}_{suffix}": (constants, fields or filler)})
    event = [("info", (node.NAME, _EVENT_INFO))] + [
        (part.lower(), (node.SEQUENCE, ((node.NAME, f"{name}_{part}"), 1)))
        for part in ("Request", "Response")
    ]
    store.register({f"{name}_Event": ([], event)})
    whole = [
        (f"{part.lower()}_message", (node.NAME, f"{name}_{part}"))
        for part in ("Request", "Response", "Event")
    ]
    store.register({name: ([], whole)})
