"""The messages between a robot and misstep, as bytes; every transport carries the same ones.

A message is one byte that says what it is, and a body, little-endian. A WebSocket carries each as
one binary message; a socket puts its length before it, a u32.

============ ====== ============================================================================
from a client
-----------------------------------------------------------------------------------------------
HELLO        1      JSON: token, role (``drive``, ``watch``), name, version; always the first
START        2      JSON, empty: begin the next trial
STATE        3      u8 flags, i64 sequence, f64 stamp [s], f64 cost (NaN: unknown), f64 × n
MARK         4      JSON: outcome
STOP         5      JSON, empty: emergency stop
CLEAR        6      JSON, empty: take it back
STATUS       7      JSON, empty
RESET        8      JSON: seed (of a `RemoteSystem`)
STEP         9      f64 × m, the action (of a `RemoteSystem`)
============ ====== ============================================================================

============ ====== ============================================================================
from a server
-----------------------------------------------------------------------------------------------
WELCOME      64     JSON: the description of the robot and its limits; answers HELLO
STARTED      65     JSON: phase, and number and seed if a trial has begun
COMMAND      66     u16 reasons, i64 sequence, u64 number, f64 × m intended, f64 × m action
REPORT       67     JSON: the status; answers STATUS, MARK, STOP and CLEAR
REFUSED      68     JSON: error, one line
OBSERVED     69     u8 flags, f64 reward, f64 × n (of a `RemoteSystem`)
============ ====== ============================================================================

Flags of a STATE: 1 failed, 2 succeeded, 4 over. Of an OBSERVED: 1 failed, 2 success, 4 terminated,
8 truncated, 16 timed out.
"""

import hmac
import json
import math
import struct
from collections.abc import Mapping
from enum import IntEnum
from functools import lru_cache
from typing import Any, NamedTuple

from misstep.errors import MisstepError
from misstep.robot.guard import Command, State
from misstep.robot.limits import Row

VERSION = 1
LONGEST = 2**16
"""Bytes of a message."""

_DOUBLE = 8
_STATE = struct.Struct("<BBqdd")
_COMMAND = struct.Struct("<BHqQ")
_OBSERVED = struct.Struct("<BBd")


class Kind(IntEnum):
    """What a message is."""

    HELLO = 1
    START = 2
    STATE = 3
    MARK = 4
    STOP = 5
    CLEAR = 6
    STATUS = 7
    RESET = 8
    STEP = 9
    WELCOME = 64
    STARTED = 65
    COMMAND = 66
    REPORT = 67
    REFUSED = 68
    OBSERVED = 69


class Observed(NamedTuple):
    """What a step of a remote system led to."""

    observation: Row
    reward: float
    failed: bool
    success: bool
    terminated: bool
    truncated: bool
    timed_out: bool


_COMMAND_KIND = int(Kind.COMMAND)


def kind_of(message: bytes) -> int:
    """Return the first byte of a message; -1 if it is empty."""
    return message[0] if message else -1


def encode(kind: Kind, body: Mapping[str, Any] | None = None) -> bytes:
    """Return a message whose body is JSON."""
    return bytes([kind]) + json.dumps(body or {}, allow_nan=False).encode()


def decode(message: bytes) -> dict[str, Any]:
    """Return the body of a message whose body is JSON.

    Raises
    ------
    MisstepError
        If it is no JSON object.
    """
    try:
        body = json.loads(message[1:])
    except (ValueError, RecursionError) as error:
        raise MisstepError(f"a message holds no JSON: {error}") from error
    if not isinstance(body, dict):
        raise MisstepError("a message holds JSON that is no object")
    return body


def read_hello(message: bytes, token: str, we: str) -> dict[str, Any]:
    """Return what a client says of itself in its first message to us, a service or a robot.

    Raises
    ------
    MisstepError
        If it is no HELLO, or has another token or version.
    """
    if kind_of(message) != Kind.HELLO:
        raise MisstepError("the first message has to be a HELLO")
    hello = decode(message)
    given = hello.get("token")
    # A text of JSON can hold half a character, which is no UTF-8.
    ours, theirs = (str(text).encode("utf-8", "surrogatepass") for text in (token, given))
    if not isinstance(given, str) or not hmac.compare_digest(ours, theirs):
        raise MisstepError("the token is not the right one")
    if hello.get("version") != VERSION:
        raise MisstepError(f"this {we} speaks version {VERSION} of the protocol")
    return hello


def encode_state(state: State) -> bytes:
    """Return a STATE message."""
    flags = state.failed | state.succeeded << 1 | state.over << 2
    cost = math.nan if state.cost is None else state.cost
    head = _STATE.pack(Kind.STATE, flags, state.sequence, state.stamp, cost)
    return head + _row(len(state.observation)).pack(*state.observation)


def decode_state(message: bytes) -> State:
    """Return the state of a STATE message, of whatever length and values.

    Raises
    ------
    MisstepError
        If it was cut.
    """
    values = _state(len(message)).unpack(message)
    flags, cost = values[1], values[4]
    return State(
        values[2],
        values[3],
        values[5:],
        None if cost != cost else cost,
        flags & 1 > 0,
        flags & 2 > 0,
        flags & 4 > 0,
    )


def encode_command(command: Command) -> bytes:
    """Return a COMMAND message."""
    action, intended, reason, sequence, number = command
    layout = _command(len(action))
    return layout.pack(_COMMAND_KIND, reason, sequence, number, *intended, *action)


def decode_command(message: bytes) -> Command:
    """Return the command of a COMMAND message.

    Raises
    ------
    MisstepError
        If it was cut.
    """
    n = _count(message, _COMMAND.size)
    _, reason, sequence, number = _COMMAND.unpack_from(message)
    values = _row(n).unpack_from(message, _COMMAND.size)
    return Command(values[n // 2 :], values[: n // 2], reason, sequence, number)


def encode_action(action: Row) -> bytes:
    """Return a STEP message."""
    return bytes([Kind.STEP]) + _row(len(action)).pack(*action)


def decode_action(message: bytes) -> Row:
    """Return the action of a STEP message; raise MisstepError if it was cut."""
    return _row(_count(message, 1)).unpack_from(message, 1)


def encode_observed(observed: Observed) -> bytes:
    """Return an OBSERVED message."""
    bits = (
        observed.failed,
        observed.success,
        observed.terminated,
        observed.truncated,
        observed.timed_out,
    )
    flags = sum(bool(bit) << i for i, bit in enumerate(bits))
    head = _OBSERVED.pack(Kind.OBSERVED, flags, observed.reward)
    return head + _row(len(observed.observation)).pack(*observed.observation)


def decode_observed(message: bytes) -> Observed:
    """Return what an OBSERVED message tells; raise MisstepError if it was cut."""
    n = _count(message, _OBSERVED.size)
    _, flags, reward = _OBSERVED.unpack_from(message)
    bits = [bool(flags >> i & 1) for i in range(5)]
    return Observed(_row(n).unpack_from(message, _OBSERVED.size), reward, *bits)


# Looked up by length, because to read a format takes longer than to use it.


@lru_cache(maxsize=64)
def _state(length: int) -> struct.Struct:
    """Return the layout of a STATE message of so many bytes."""
    n, rest = divmod(length - _STATE.size, _DOUBLE)
    if n < 0 or rest:
        raise MisstepError(f"a message of {length} bytes was cut")
    return struct.Struct(f"{_STATE.format}{n}d")


@lru_cache(maxsize=64)
def _command(m: int) -> struct.Struct:
    return struct.Struct(f"{_COMMAND.format}{2 * m}d")


@lru_cache(maxsize=64)
def _row(n: int) -> struct.Struct:
    return struct.Struct(f"<{n}d")


def _count(message: bytes, head: int) -> int:
    """Return how many numbers follow a head of so many bytes."""
    n, rest = divmod(len(message) - head, _DOUBLE)
    if n < 0 or rest:
        raise MisstepError(f"a message of {len(message)} bytes was cut")
    return n
