"""The messages of Explore, which are sent in every control period, read and written quickly.

genpy's classes look at each field by itself and read a new format for each array. These are the
same classes with the same bytes, made and read at once; whatever is unusual is left to genpy's.
"""

import struct
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

_REQUEST, _RESPONSE, _COUNT, _DOUBLE = "<Q2d3?I", "<2QHI", 4, 8
_REQUEST_SIZE, _RESPONSE_SIZE = struct.calcsize(_REQUEST), struct.calcsize(_RESPONSE)


def quick_explore(kind: Any) -> Any:
    """Return the service type Explore with quicker messages.

    Parameters
    ----------
    kind : type
        As genpy made it.
    """
    return SimpleNamespace(
        _type=kind._type,
        _md5sum=kind._md5sum,
        _request_class=_quick_request(kind._request_class),
        _response_class=_quick_response(kind._response_class),
    )


@lru_cache(maxsize=64)
def _request_layout(n: int) -> struct.Struct:
    return struct.Struct(f"{_REQUEST}{n}d")


@lru_cache(maxsize=64)
def _response_layout(m: int, k: int) -> struct.Struct:
    return struct.Struct(f"{_RESPONSE}{m}dI{k}d")


def _quick_request(base: Any) -> Any:
    class ExploreRequest(base):
        __slots__ = base.__slots__  # genpy looks at them

        def __init__(
            self,
            sequence: int = 0,
            stamp: float = 0.0,
            cost: float = 0.0,
            failed: bool = False,
            succeeded: bool = False,
            over: bool = False,
            observation: tuple[float, ...] = (),
        ) -> None:
            self.sequence, self.stamp, self.cost = sequence, stamp, cost
            self.failed, self.succeeded, self.over = failed, succeeded, over
            self.observation = observation

        def serialize(self, buff: Any) -> None:
            row = self.observation
            try:
                data = _request_layout(len(row)).pack(
                    self.sequence,
                    self.stamp,
                    self.cost,
                    self.failed,
                    self.succeeded,
                    self.over,
                    len(row),
                    *row,
                )
            except (struct.error, TypeError):
                base.serialize(self, buff)  # says what is wrong
            else:
                buff.write(data)

        def deserialize(self, data: bytes) -> Any:
            n, rest = divmod(len(data) - _REQUEST_SIZE, _DOUBLE)
            if n < 0 or rest:
                return base.deserialize(self, data)
            values = _request_layout(n).unpack(data)
            if values[6] != n:
                return base.deserialize(self, data)
            self.sequence, self.stamp, self.cost = values[:3]
            self.failed, self.succeeded, self.over = values[3:6]
            self.observation = values[7:]
            return self

    return ExploreRequest


def _quick_response(base: Any) -> Any:
    class ExploreResponse(base):
        __slots__ = base.__slots__

        def __init__(
            self,
            sequence: int = 0,
            number: int = 0,
            reason: int = 0,
            action: tuple[float, ...] = (),
            intended: tuple[float, ...] = (),
        ) -> None:
            self.sequence, self.number, self.reason = sequence, number, reason
            self.action, self.intended = action, intended

        def serialize(self, buff: Any) -> None:
            action, intended = self.action, self.intended
            m, k = len(action), len(intended)
            try:
                data = _response_layout(m, k).pack(
                    self.sequence, self.number, self.reason, m, *action, k, *intended
                )
            except (struct.error, TypeError):
                base.serialize(self, buff)
            else:
                buff.write(data)

        def deserialize(self, data: bytes) -> Any:
            m, rest = divmod(len(data) - _RESPONSE_SIZE - _COUNT, 2 * _DOUBLE)
            if m < 0 or rest:
                return base.deserialize(self, data)
            values = _response_layout(m, m).unpack(data)
            if values[3] != m or values[4 + m] != m:
                return base.deserialize(self, data)
            self.sequence, self.number, self.reason = values[:3]
            self.action, self.intended = values[4 : 4 + m], values[5 + m :]
            return self

    return ExploreResponse
