"""What stands between a policy and a robot: always on, knows neither policies nor networks.

States come in, and are refused unless they can be true and are fresh. Actions go out, through the
limits of `misstep.robot.limits`. Whatever arrives, in whatever order, what leaves is finite, within
the limits, and the policy's only while fresh states arrive in time and nobody has stopped it.

============== ==================================================================================
what happens   what leaves
============== ==================================================================================
policy in time its action, within the limits of value, rate and jerk
state refused  on towards what was wanted before, within the limits
policy late    towards the safe action, within the limits, until the next action in time
watchdog       towards the safe action, within the limits, until a new trial begins
no trial       towards the safe action, within the limits
emergency stop the safe action **at once**: the one thing that the limits of rate and jerk do not
               hold back. It is latched: it lasts until somebody clears it
dry run        the safe action, always; what would have been sent is told beside it
============== ==================================================================================

Time is handed in with every call, in seconds of any clock. A clock that jumps back counts as one
that stood still.
"""

import math
from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from misstep.parameters import check_parameters, parameter
from misstep.robot.limits import Limiter, Limits, Reason, Row

_AT_REST = 1e-9  # of the action's range
_NO_TRIAL = int(Reason.IDLE | Reason.WATCHDOG | Reason.STOP)
_POLICY, _STOP, _DRY_RUN = int(Reason.POLICY), int(Reason.STOP), int(Reason.DRY_RUN)


class Refusal(StrEnum):
    """Why a state was refused."""

    LENGTH = "wrong length"
    NOT_FINITE = "not finite"
    RANGE = "out of range"
    ORDER = "out of order"
    STALE = "stale"
    CLOCK = "from the future"


class State(NamedTuple):
    """A state as a robot reports it."""

    sequence: int
    """Counts the states of a connection; grows from one to the next."""
    stamp: float
    """When it was measured, by the robot's own clock, s; grows too."""
    observation: Row
    """Shape (n,)."""
    cost: float | None = None
    """Of the step that led here, where the robot knows it."""
    failed: bool = False
    """The robot says that this trial has failed."""
    succeeded: bool = False
    """The robot says that this trial is a success if it ends here."""
    over: bool = False
    """The robot says that this trial ends here."""


class Command(NamedTuple):
    """What is sent, and why."""

    action: Row
    """What is sent, shape (m,)."""
    intended: Row
    """What would be sent if this were not a dry run, shape (m,)."""
    reason: int
    """Bits of `Reason`."""
    sequence: int
    """Of the state that it answers; of the last one if nothing was asked; -1 before any."""
    number: int
    """Counts commands. Threads and networks may swap two: a robot never obeys the smaller after
    the larger."""

    @property
    def in_trial(self) -> bool:
        """Whether a trial is still running."""
        return not self.reason & _NO_TRIAL


@dataclass(frozen=True)
class Safety:
    """Times within which a robot is kept safe."""

    watchdog: float = parameter(
        0.1, "s", "longest time without a fresh state; what is older is stale", above=0
    )
    deadline: float = parameter(
        0.0, "s", "time in which an action must follow its state; 0: a control period", at_least=0
    )
    dry_run: bool = parameter(False, "", "send the safe action, and tell what would be sent")

    def __post_init__(self) -> None:
        check_parameters(self, "safety")


class Guard:
    """Lets states in and actions out; see the module.

    Parameters
    ----------
    limits : Limits
    safety : Safety

    Attributes
    ----------
    limits : Limits
    deadline : float, s
    stopped : bool
        Whether an emergency stop is latched.
    refused : Counter of Refusal
        How many states were refused, by why.
    late : int
        How many actions missed the deadline.
    """

    def __init__(self, limits: Limits, safety: Safety) -> None:
        self.limits = limits
        self.deadline = safety.deadline or limits.period
        self.stopped = False
        self.refused: Counter[Refusal] = Counter()
        self.late = 0
        self._watchdog, self._dry_run = safety.watchdog, safety.dry_run
        self._limiter = Limiter(limits)
        self._ranges = tuple(zip(limits.observation_low, limits.observation_high, strict=True))
        self._tolerance = [
            _AT_REST * (high - low) for low, high in zip(limits.low, limits.high, strict=True)
        ]
        self._clock: float | None = None  # as last handed in
        self._time = 0.0  # the same, without steps back
        self._sent_at: float | None = None
        self._last: State | None = None
        self._offset: float | None = None  # from the robot's clock to ours
        self._fresh_at: float | None = None  # since the beginning of the trial
        self._sent = limits.safe
        self._n_sent = 0
        self._answering = -1
        self._target: Row = limits.safe
        self._why = int(Reason.IDLE)

    def begin(self, now: float) -> None:
        """Begin a trial: its first state starts the watchdog, and sets the robot's clock."""
        self._advance(now)
        self._offset = None
        self._fresh_at = None
        self._target, self._why = self.limits.safe, int(Reason.IDLE)

    def connect(self) -> None:
        """Take it that states are counted anew from here on."""
        self._last = None
        self._offset = None
        self._answering = -1

    def retreat(self, why: Reason) -> None:
        """Go towards the safe action from now on, until a policy's action is sent again."""
        self._target, self._why = self.limits.safe, int(why)

    def check(self, state: State, now: float) -> Refusal | None:
        """Return why a state is refused, and count it; None if it can be true and is fresh."""
        self._advance(now)
        self._answering = state.sequence
        refusal = self._flaw(state) or self._lag(state)
        if refusal is not None:
            self.refused[refusal] += 1
            return refusal
        self._last = state
        if self._offset is None:
            self._offset = self._time - state.stamp
        self._fresh_at = self._time
        return None

    def is_silent(self, now: float) -> bool:
        """Return whether there has been no fresh state for longer than the watchdog waits."""
        self._advance(now)
        return self._fresh_at is not None and self._time - self._fresh_at > self._watchdog

    def send(self, wanted: Row, now: float, asked: float) -> Command:
        """Return the command for a policy's action, (m,) finite, to a state that came at `asked`.

        A policy that missed the deadline is not followed.
        """
        if self.stopped:
            return self.keep_on(now)
        if now - asked > self.deadline:
            self.late += 1
            self.retreat(Reason.LATE)
        else:
            self._target, self._why = wanted, _POLICY
        return self.keep_on(now)

    def keep_on(self, now: float, why: int = 0) -> Command:
        """Return the command where there is nothing new: on towards what was wanted before."""
        self._advance(now)
        sent_at, self._sent_at = self._sent_at, self._time
        if self.stopped:
            self._limiter.jump(self.limits.safe)
            return self._command(_STOP | why)
        elapsed = self.limits.period if sent_at is None else self._time - sent_at
        return self._command(self._why | why | self._limiter.move(self._target, elapsed))

    def stop(self) -> None:
        """Stop: every command is the safe action, until `clear`."""
        self.stopped = True
        self._limiter.jump(self.limits.safe)
        self.retreat(Reason.IDLE)

    def clear(self) -> None:
        """Take back the emergency stop; the action stays safe until a trial begins."""
        self.stopped = False

    @property
    def is_safe(self) -> bool:
        """Whether the last command was the safe action."""
        sent = zip(self._sent, self.limits.safe, self._tolerance, strict=True)
        return all(abs(action - safe) <= near for action, safe, near in sent)

    def _advance(self, now: float) -> None:
        if self._clock is not None:
            self._time += max(0.0, now - self._clock)
        self._clock = now

    def _flaw(self, state: State) -> Refusal | None:
        """Return what is wrong with a state by itself."""
        if len(state.observation) != len(self._ranges):
            return Refusal.LENGTH
        if not all(map(math.isfinite, (state.stamp, state.cost or 0.0, *state.observation))):
            return Refusal.NOT_FINITE
        for value, (low, high) in zip(state.observation, self._ranges, strict=True):
            if not low <= value <= high:
                return Refusal.RANGE
        return None

    def _lag(self, state: State) -> Refusal | None:
        """Return what is wrong with the time of a state."""
        if self._last is not None:
            if state.sequence <= self._last.sequence:
                return Refusal.ORDER
            if state.stamp <= self._last.stamp and self._offset is not None:
                return Refusal.STALE
        if self._offset is None:
            return None
        age = self._time - state.stamp - self._offset
        if age > self._watchdog:
            return Refusal.STALE
        return Refusal.CLOCK if age < -self._watchdog else None

    def _command(self, reason: int) -> Command:
        intended = tuple(self._limiter.action)
        self._sent = intended
        if self._dry_run:
            self._sent = self.limits.safe
            reason |= _DRY_RUN
        self._n_sent += 1
        return Command(self._sent, intended, reason, self._answering, self._n_sent)
