"""The robot's side of a `RemoteSystem`: offers a system to whoever knows the token.

Safe by itself: actions are held within the limits of value, rate and jerk; where the other side is
gone, or says nothing for too long in an episode, the system is stepped towards the safe action
until it is there, and the episode is over.
"""

import logging
import threading
import time
from typing import Any

import numpy as np

from misstep.errors import MisstepError
from misstep.robot.limiter import Limiter
from misstep.robot.limits import Limits, Row
from misstep.robot.protocol import (
    Kind,
    Observed,
    decode,
    decode_action,
    encode,
    encode_observed,
    kind_of,
    read_hello,
)
from misstep.robot.remote_system import describe_system
from misstep.robot.service import Clock
from misstep.robot.session import MOST_CLIENTS, Send
from misstep.systems import System

_LOG = logging.getLogger(__name__)
_NEAR = 1e-9  # of the action's unit
_MOST_STEPS_TO_SAFE = 10_000
_PARTING = 1.0  # s, in which a client that has just gone is noticed, also by a busy machine


class SystemHub:
    """Offers a system; give it to a `SocketServer` or a `WebSocketServer`.

    Parameters
    ----------
    system : System
        A simulation, or a robot: its `step` applies the action, waits until the control period is
        over and observes.
    token : str
    limits : Limits, optional
        Those of the system's spaces if left out.
    watchdog : float, s
        Longest time between the steps of an episode, from the first on.
    clock : callable
        Returns s, of any origin; monotonic.

    Raises
    ------
    MisstepError
        If the limits do not fit.
    """

    def __init__(
        self,
        system: System,
        token: str,
        *,
        limits: Limits | None = None,
        watchdog: float = 0.5,
        clock: Clock = time.monotonic,
    ) -> None:
        self._system, self._token, self._watchdog = system, token, watchdog
        self._clock = clock
        self._limits = Limits.of(system) if limits is None else limits
        self._limiter = Limiter(self._limits)
        self._lock = threading.Lock()
        self._door = threading.Lock()
        self._sessions: set[_SystemSession] = set()
        self._driver: _SystemSession | None = None
        self._wheel_is_free = threading.Condition(self._lock)
        self._in_episode = False
        self._stepped_at: float | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._watch_on, name="watchdog", daemon=True)
        self._thread.start()

    def open(self, send: Send) -> "_SystemSession":
        """Return the conversation of a new client; MisstepError if there are too many."""
        session = _SystemSession(self, send)
        with self._door:
            if len(self._sessions) >= MOST_CLIENTS:
                raise MisstepError(f"there are {MOST_CLIENTS} clients already")
            self._sessions.add(session)
        return session

    def forget(self, session: "_SystemSession") -> None:
        """Let a client go; its episode is over."""
        with self._door:
            self._sessions.discard(session)
        with self._lock:
            if self._driver is session:
                self._driver = None
                self._wheel_is_free.notify()
                self._retreat("the other side is gone")

    def close(self) -> None:
        """End the episode and stop looking after the watchdog."""
        self._closing.set()
        self._thread.join()
        with self._lock:
            self._retreat("the end")

    def greet(self, session: "_SystemSession", message: bytes) -> dict[str, Any]:
        """Let a client drive and return the description of the system, or raise MisstepError."""
        read_hello(message, self._token, "robot")
        with self._lock:
            if not self._wheel_is_free.wait_for(lambda: self._driver is None, _PARTING):
                raise MisstepError("another client drives")
            self._driver = session
        return {"system": self._system.system_id, **describe_system(self._system)}

    def reset(self, seed: object) -> Observed:
        """Begin an episode; raise MisstepError if the seed is no whole number."""
        if not (seed is None or (type(seed) is int and seed >= 0)):
            raise MisstepError(f"the seed is {seed!r}: a whole number or nothing is wanted")
        with self._lock:
            self._retreat("a new episode was asked for")
            observation, info = self._system.reset(seed=seed)
            self._limiter = Limiter(self._limits)
            self._in_episode, self._stepped_at = True, None
            return _observed(observation, 0.0, False, False, info)

    def step(self, action: Row) -> Observed:
        """Apply an action within the limits; raise MisstepError if that cannot be done."""
        with self._lock:
            if not self._in_episode:
                raise MisstepError("no episode is running: reset first")
            if len(action) != len(self._limits.safe) or not np.isfinite(action).all():
                self._retreat("an action was refused")
                raise MisstepError(
                    f"the action is {action}: {len(self._limits.safe)} finite numbers are wanted"
                )
            return self._apply(action)

    def _apply(self, wanted: Row) -> Observed:
        self._limiter.move(wanted, self._limits.period)
        result = self._system.step(np.array(self._limiter.action))
        self._stepped_at = self._clock()
        observation, reward, terminated, truncated, info = result
        self._in_episode = not (terminated or truncated)
        return _observed(observation, float(reward), terminated, truncated, info)

    def _retreat(self, why: str) -> None:
        """Step towards the safe action until it is there; the episode is over."""
        if not self._in_episode:
            return
        _LOG.warning("to the safe action: %s", why)
        safe = self._limits.safe
        try:
            for _ in range(_MOST_STEPS_TO_SAFE):
                self._apply(safe)
                is_safe = np.allclose(self._limiter.action, safe, rtol=0, atol=_NEAR)
                if is_safe or not self._in_episode:
                    break
        finally:
            self._in_episode = False

    def _watch_on(self) -> None:
        while not self._closing.wait(self._limits.period):
            with self._lock:
                since = self._stepped_at
                if since is None or self._clock() - since <= self._watchdog:
                    continue
                try:
                    self._retreat("nothing was heard for too long")
                except Exception:  # whatever the robot raises: the next episode is watched too
                    _LOG.exception("the robot could not be brought to its safe action")


class _SystemSession:
    """One client's conversation with a system."""

    def __init__(self, hub: SystemHub, send: Send) -> None:
        self._hub, self._send = hub, send
        self._welcome = False

    def receive(self, message: bytes) -> bool:
        """Answer a message; return whether to go on listening; raise OSError on a lost client."""
        try:
            self._send(self._answer(message))
        except MisstepError as error:
            self._send(encode(Kind.REFUSED, {"error": str(error)}))
            return False
        return True

    def close(self) -> None:
        """End the conversation."""
        self._hub.forget(self)

    def _answer(self, message: bytes) -> bytes:
        kind = kind_of(message)
        if not self._welcome:
            description = self._hub.greet(self, message)
            self._welcome = True
            return encode(Kind.WELCOME, description)
        if kind == Kind.STEP:
            return encode_observed(self._hub.step(decode_action(message)))
        if kind == Kind.RESET:
            return encode_observed(self._hub.reset(decode(message).get("seed")))
        raise MisstepError(f"a message of kind {kind} says nothing here")


def _observed(
    observation: Any, reward: float, terminated: bool, truncated: bool, info: dict[str, Any]
) -> Observed:
    return Observed(
        tuple(observation.tolist()),
        reward,
        bool(info.get("failed", False)),
        bool(info.get("success", False)),
        bool(terminated),
        bool(truncated),
        bool(info.get("timed_out", False)),
    )
