"""What the page may say to the server: small JSON objects, each of a known kind and checked.

A message is ``{"t": kind, ...}`` with the fields of its kind and no others. Whatever is not that
is refused in one sentence, and what comes too fast is not read at all.
"""

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from misstep.errors import MisstepError

LONGEST_MESSAGE = 4096
"""Characters of a message."""
MESSAGES_PER_SECOND, BURST = 250.0, 500.0
"""A page sends a message for each key that goes up or down, a few for a mouse: far fewer."""

Check = Callable[[object], Any]


class NotOursError(MisstepError):
    """What came is no message of the page."""


@dataclass(frozen=True)
class Message:
    """A message of a known kind with checked values."""

    kind: str
    values: Mapping[str, Any]


def number(low: float, high: float) -> Check:
    """Return a check for a number from `low` to `high`."""

    def check(value: object) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise NotOursError(f"a number is wanted, not {_short(value)}")
        if not low <= value <= high:  # NaN is not either
            raise NotOursError(f"{_short(value)} is not from {low:g} to {high:g}")
        return float(value)

    return check


def whole(low: int, high: int) -> Check:
    """Return a check for a whole number from `low` to `high`."""

    def check(value: object) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise NotOursError(f"a whole number from {low} to {high} is wanted")
        return value

    return check


def text(longest: int) -> Check:
    """Return a check for a printable text of at most `longest` characters."""

    def check(value: object) -> str:
        if not isinstance(value, str) or len(value) > longest or not value.isprintable():
            raise NotOursError(f"a text of at most {longest} characters is wanted")
        return value

    return check


def truth(value: object) -> bool:
    """Check for true or false."""
    if not isinstance(value, bool):
        raise NotOursError("true or false is wanted")
    return value


def many(check: Check, most: int) -> Check:
    """Return a check for a list of at most `most` values."""

    def check_all(value: object) -> list[Any]:
        if not isinstance(value, list) or len(value) > most:
            raise NotOursError(f"a list of at most {most} is wanted")
        return [check(item) for item in value]

    return check_all


def optional(check: Check) -> Check:
    """Return a check that lets null pass."""
    return lambda value: None if value is None else check(value)


_ID = whole(0, 2**31)
_NAME = text(200)
KINDS: dict[str, dict[str, Check]] = {
    # Driving: how far each action is pushed, and a number that comes back with its effect.
    "input": {"v": many(number(-1.0, 1.0), 8), "n": _ID},
    "alive": {},
    "begin": {},
    "restart": {},
    "keep": {},
    "discard": {},
    "stop": {},
    "fail": {},
    "pause": {},
    "resume": {},
    "hidden": {"hidden": truth},
    "take": {},
    "settings": {
        "strength": number(0.05, 1.0),
        "speed": number(0.01, 2.0),
        "start_angle": optional(number(-180.0, 180.0)),
        "countdown": whole(0, 5),
    },
    "system": {"name": _NAME},
    # What was recorded.
    "delete": {"id": _ID},
    "undo": {},
    "mark": {
        "id": _ID,
        "outcome": optional(text(10)),
        "failure_time": optional(number(0.0, 1e6)),
        "usable": optional(many(number(0.0, 1e6), 2)),
    },
    # Learning.
    "learn": {
        "learner": _NAME,
        "state": many(_NAME, 64),
        "max_trials": whole(1, 200),
        "seed": whole(0, 2**31),
    },
    "resume_run": {"name": _NAME},
    "open_run": {"name": _NAME},
    "halt": {},
    "next": {"trial": _ID},
    "pace": {"watch": truth},
    # The policy that was learned, live.
    "balance": {},
    "rest": {},
    "push": {"x": optional(number(-1e6, 1e6))},
    "poke": {"side": number(-1.0, 1.0)},
}
"""Every kind of message and the checks of its fields."""


def parse(raw: str | bytes) -> Message:
    """Read a message.

    Raises
    ------
    NotOursError
        If it is none.
    """
    if len(raw) > LONGEST_MESSAGE:
        raise NotOursError(f"it is longer than {LONGEST_MESSAGE} characters")
    try:
        values = json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise NotOursError("it is not JSON") from error
    kind = values.pop("t", None) if isinstance(values, dict) else None
    if not isinstance(kind, str) or kind not in KINDS:
        raise NotOursError("it is of no kind that is known here")
    checks = KINDS[kind]
    if set(values) != set(checks):
        wanted = ", ".join(sorted(checks)) or "nothing else"
        raise NotOursError(f"{kind} takes {wanted}")
    return Message(kind, {name: check(values[name]) for name, check in checks.items()})


class Allowance:
    """How many messages may still come: a bucket that fills at a rate.

    Parameters
    ----------
    rate : float, 1/s
    burst : float
        What it holds.
    """

    def __init__(self, rate: float = MESSAGES_PER_SECOND, burst: float = BURST) -> None:
        self._rate, self._burst = rate, burst
        self._left, self._since = burst, time.monotonic()

    def take(self) -> bool:
        """Count one message; return whether it is still within bounds."""
        now = time.monotonic()
        self._left = min(self._burst, self._left + (now - self._since) * self._rate)
        self._since = now
        self._left -= 1.0
        return self._left >= 0.0


def _short(value: object) -> str:
    shown = repr(value)
    return shown if len(shown) <= 40 else f"{shown[:37]}..."
