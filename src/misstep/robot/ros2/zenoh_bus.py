"""The nodes' bus without ROS 2: Zenoh, with the names and bytes of ROS 2's Zenoh middleware.

========= ========================================================================================
what      how it looks in Zenoh
========= ========================================================================================
topic     key ``<domain>/<topic>/<type>/<type hash>``, CDR, and an attachment of 33 bytes: number
          (i64), time [ns] (i64), 16, id of the sender
service   a complete queryable with the key ``<domain>/<service>/<type>/<type hash>``; request and
          response are CDR, and the attachment goes there and back
graph     a liveliness token for the node and each of its ends: ``@ros2_lv/<domain>/<session>/…``
========= ========================================================================================

The first node on a machine listens at tcp/127.0.0.1:7447, where rmw_zenoh's router would; the
others find it there and each other through it. ROS_DOMAIN_ID and ZENOH_CONFIG_OVERRIDE
(``key=value;key=value``) mean what they mean to rmw_zenoh.
"""

import json
import os
import struct
import threading
import time
from collections.abc import Callable, Mapping
from itertools import count as counter
from typing import Any

from misstep.errors import MisstepError
from misstep.robot.ros.bus import Call, Handler, JointArrays
from misstep.robot.ros2.types import FLOAT64, JOINT_STATE, Types, joint_arrays, joint_fields

_ROUTER = "tcp/127.0.0.1:7447"
_ATTACHMENT = struct.Struct("<qqB16s")
_QOS = "::,10:,:,:,,"  # reliable, volatile, the last 10: ROS 2's default
_SOMEBODY = "a node of ROS 2"  # a request does not say whose it is


class ZenohBus:
    """A node of ROS 2 without ROS 2.

    Parameters
    ----------
    node : str

    Raises
    ------
    MisstepError
        If eclipse-zenoh is not installed, or no session can be had.
    """

    def __init__(self, node: str) -> None:
        self._zenoh = _library()
        self._types = Types()
        self._node, self._domain = node, os.environ.get("ROS_DOMAIN_ID", "0")
        try:
            self._session = self._zenoh.open(_config(self._zenoh))
        except self._zenoh.ZError as error:
            raise MisstepError(f"Zenoh cannot be reached: {error}") from error
        self._gid = os.urandom(16)
        self._ids, self._numbers = counter(), counter(1)
        self._ends: dict[str, tuple[str, str]] = {}
        self._tokens: list[Any] = []
        self._declare_token("NN", "")

    def publish_joints(self, topic: str) -> Callable[[JointArrays], None]:
        """Return a function that publishes joint states."""
        put = self._publisher(topic, JOINT_STATE)
        return lambda joints: put(joint_fields(joints))

    def subscribe_joints(self, topic: str, callback: Callable[[JointArrays], None]) -> None:
        """Have a function called with every joint state."""
        self._subscribe(topic, JOINT_STATE, lambda message: callback(joint_arrays(message)))

    def publish_effort(self, topic: str) -> Callable[[float], None]:
        """Return a function that publishes a ``std_msgs/msg/Float64``."""
        put = self._publisher(topic, FLOAT64)
        return lambda effort: put({"data": effort})

    def subscribe_effort(self, topic: str, callback: Callable[[float], None]) -> None:
        """Have a function called with every effort."""
        self._subscribe(topic, FLOAT64, lambda message: callback(float(message.data)))

    def serve(self, service: str, kind: str, handler: Handler) -> None:
        """Offer a service, in a thread of its own."""
        name = self._types.service(kind)
        key = self._key(service, name)
        queries = self._session.declare_queryable(key, complete=True)
        self._declare_token("SS", key)
        response = self._types.fields(f"{name}_Response")

        def answer(query: Any) -> None:
            try:
                if query.payload is None or query.attachment is None:
                    raise MisstepError("a request has a payload and an attachment")
                number, _, _, gid = _ATTACHMENT.unpack(query.attachment.to_bytes())
                request = self._types.decode(f"{name}_Request", query.payload.to_bytes())
                fields = handler(request, _SOMEBODY)
                if not isinstance(fields, Mapping):
                    fields = dict(zip(response, fields, strict=True))
                reply = self._types.encode(f"{name}_Response", fields)
            except Exception as error:  # the caller is told; the service goes on, as rospy's does
                query.reply_err(str(error))
                return
            attachment = _ATTACHMENT.pack(number, time.time_ns(), 16, gid)
            query.reply(key, reply, attachment=attachment)

        def serve_on() -> None:
            for query in queries:
                with query:
                    answer(query)

        threading.Thread(target=serve_on, name=service, daemon=True).start()

    def call(self, service: str, kind: str, timeout: float = 10.0) -> Call:
        """Return a function that calls a service."""
        name = self._types.service(kind)
        key = self._key(service, name)
        zenoh = self._zenoh
        querier = self._session.declare_querier(
            key,
            target=zenoh.QueryTarget.ALL_COMPLETE,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
            express=True,
        )
        self._declare_token("SC", key)

        def call(**fields: Any) -> Any:
            payload = self._types.encode(f"{name}_Request", fields)
            for reply in querier.get(payload=payload, attachment=self._attachment()):
                if reply.ok is None:
                    raise MisstepError(f"the service {service}: {reply.err.payload.to_string()}")
                return self._types.decode(f"{name}_Response", reply.ok.payload.to_bytes())
            raise MisstepError(f"the service {service} does not answer")

        return call

    def count(self, topic: str) -> int:
        """Return how many others are at the other end of a topic that this node uses."""
        kind, key = self._ends[topic]
        other = {"MP": "MS", "MS": "MP"}[kind]
        tokens = self._session.liveliness().get(
            f"@ros2_lv/{self._domain}/*/*/*/{other}/*/*/*/{_mangled(key)}/{_QOS}"
        )
        return sum(1 for _ in tokens)

    def close(self) -> None:
        """Leave the graph."""
        self._session.close()

    def _publisher(self, topic: str, name: str) -> Callable[[Mapping[str, Any]], None]:
        zenoh = self._zenoh
        key = self._key(topic, name)
        publisher = self._session.declare_publisher(
            key,
            congestion_control=zenoh.CongestionControl.BLOCK,
            reliability=zenoh.Reliability.RELIABLE,
            express=True,
        )
        self._ends[topic] = ("MP", key)
        self._declare_token("MP", key)
        return lambda fields: publisher.put(
            self._types.encode(name, fields), attachment=self._attachment()
        )

    def _subscribe(self, topic: str, name: str, callback: Callable[[Any], None]) -> None:
        key = self._key(topic, name)
        self._tokens.append(
            self._session.declare_subscriber(
                key, lambda sample: callback(self._types.decode(name, sample.payload.to_bytes()))
            )
        )
        self._ends[topic] = ("MS", key)
        self._declare_token("MS", key)

    def _attachment(self) -> bytes:
        return _ATTACHMENT.pack(next(self._numbers), time.time_ns(), 16, self._gid)

    def _key(self, name: str, kind: str) -> str:
        """Return the key expression of a topic or a service."""
        full = name.replace("~", f"{self._node}/").strip("/")
        package, group, short = kind.split("/")
        dds = f"{package}::{group}::dds_::{short}_"
        return f"{self._domain}/{full}/{dds}/{self._types.hash(kind)}"

    def _declare_token(self, kind: str, key: str) -> None:
        """Let the graph know of this node, or of one of its ends."""
        where = f"@ros2_lv/{self._domain}/{self._session.zid()}/0/{next(self._ids)}/{kind}"
        what = f"/{_mangled(key)}/{_QOS}" if key else ""
        token = f"{where}/%/%/{self._node}{what}"
        self._tokens.append(self._session.liveliness().declare_token(token))


def _mangled(key: str) -> str:
    """Return name, type and hash of a key as a token has them: slashes in the name are ``%``."""
    name, kind, digest = key.partition("/")[2].rsplit("/", 2)
    return f"%{name.replace('/', '%')}/{kind}/{digest}"


def _config(zenoh: Any) -> Any:
    config = zenoh.Config()
    settings = {
        "mode": '"peer"',
        "scouting/multicast/enabled": "false",
        "listen/endpoints": json.dumps([_ROUTER, "tcp/127.0.0.1:0"]),
        "listen/exit_on_failure": "false",
        "connect/endpoints": json.dumps([_ROUTER]),
        "connect/exit_on_failure": "false",
        "connect/timeout_ms": "0",
    }
    for setting in filter(None, os.environ.get("ZENOH_CONFIG_OVERRIDE", "").split(";")):
        name, _, value = setting.partition("=")
        settings[name.strip()] = value.strip()
    for name, value in settings.items():
        try:
            config.insert_json5(name, value)
        except zenoh.ZError as error:
            raise MisstepError(f"ZENOH_CONFIG_OVERRIDE: {name}={value}: {error}") from error
    return config


def _library() -> Any:
    try:
        import zenoh
    except ImportError as error:
        raise MisstepError(
            "neither ROS 2 is sourced nor eclipse-zenoh installed: pip install 'misstep[ros2]'"
        ) from error
    return zenoh
