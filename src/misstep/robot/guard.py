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

from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from misstep.errors import MisstepError
from misstep.parameters import check_parameters, parameter
from misstep.robot import reckoning
from misstep.robot.limiter import ACTION, SLOPE, WANTED
from misstep.robot.limits import Limits, Reason, Row

_AT_REST = 1e-9  # of the action's range
# Plain numbers for what happens a thousand times a second: enumerations are ten times as slow.
_NO_TRIAL = int(Reason.IDLE | Reason.WATCHDOG | Reason.STOP)
_SILENT, _admit, _follow = reckoning.SILENT, reckoning.admit, reckoning.follow
_POLICY, _STOP, _DRY_RUN = int(Reason.POLICY), int(Reason.STOP), int(Reason.DRY_RUN)


class Refusal(StrEnum):
    """Why a state was refused."""

    LENGTH = "wrong length"
    NOT_FINITE = "not finite"
    RANGE = "out of range"
    ORDER = "out of order"
    STALE = "stale"
    CLOCK = "from the future"


_REFUSALS = {
    reckoning.LENGTH: Refusal.LENGTH,
    reckoning.NOT_FINITE: Refusal.NOT_FINITE,
    reckoning.RANGE: Refusal.RANGE,
    reckoning.ORDER: Refusal.ORDER,
    reckoning.STALE: Refusal.STALE,
    reckoning.FUTURE: Refusal.CLOCK,
}


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
    was_silent : bool
        Whether there had been no fresh state for longer than the watchdog waits when the last
        state came.
    observation : ndarray, shape (n,)
        Of the last fresh state; for whoever takes it to keep.
    """

    def __init__(self, limits: Limits, safety: Safety) -> None:
        self.limits = limits
        self.deadline = safety.deadline or limits.period
        self.stopped = self.was_silent = False
        self.refused: Counter[Refusal] = Counter()
        self.late = 0
        self.observation: NDArray[np.float64] = np.zeros(0)
        self._dry_run = safety.dry_run
        self._vector = reckoning.new_vector(limits, safety.watchdog)
        table = reckoning.table_in(self._vector)
        self._action, self._slope, self._wanted = table[ACTION], table[SLOPE], table[WANTED]
        self._tolerance = [
            _AT_REST * (high - low) for low, high in zip(limits.low, limits.high, strict=True)
        ]
        self._sequence: int | None = None  # of the last fresh state
        self._sent = limits.safe
        self._n_sent = 0
        self._answering = -1
        self._why = int(Reason.IDLE)

    def begin(self, now: float) -> None:
        """Begin a trial: its first state starts the watchdog, and sets the robot's clock."""
        reckoning.advance(self._vector, now)
        self._vector[[reckoning.OFFSET, reckoning.FRESH_AT]] = np.nan
        self.retreat(Reason.IDLE)

    def connect(self) -> None:
        """Take it that states are counted anew from here on."""
        self._sequence = None
        self._vector[reckoning.OFFSET] = np.nan
        self._answering = -1

    def retreat(self, why: Reason) -> None:
        """Go towards the safe action from now on, until a policy's action is sent again."""
        self._wanted[:], self._why = self.limits.safe, int(why)

    def check(self, state: State, now: float) -> Refusal | None:
        """Return why a state is refused, and count it; None if it can be true and is fresh."""
        sequence, stamp, row, cost = state[:4]
        last, self._answering = self._sequence, sequence
        observation = np.array(row, dtype=np.float64)
        in_order = last is None or sequence > last
        answer = _admit(self._vector, observation, in_order, stamp, cost or 0.0, now)
        self.was_silent = answer >= _SILENT
        if answer == 0 or answer == _SILENT:
            self._sequence, self.observation = sequence, observation
            return None
        refusal = _REFUSALS[answer & ~_SILENT]
        self.refused[refusal] += 1
        return refusal

    def is_silent(self, now: float) -> bool:
        """Return whether there has been no fresh state for longer than the watchdog waits."""
        silent: bool = reckoning.is_silent(self._vector, now)
        return silent

    def send(self, wanted: ArrayLike, now: float, asked: float) -> Command:
        """Return the command for a policy's action, (m,), to a state that came at `asked`.

        A policy that missed the deadline is not followed.

        Raises
        ------
        MisstepError
            If it is not finite; nothing has been sent.
        """
        if self.stopped:
            return self.keep_on(now)
        self._wanted[:], self._why = wanted, _POLICY
        if now - asked > self.deadline:
            self.late += 1
            if np.isfinite(self._wanted).all():
                self.retreat(Reason.LATE)
        return self.keep_on(now)

    def keep_on(self, now: float, why: int = 0) -> Command:
        """Return the command where there is nothing new: on towards what was wanted before."""
        if self.stopped:
            self._jump()
        reason = _follow(self._vector, now)
        if reason < 0:
            flaw = f"its action is {tuple(self._wanted.tolist())}"
            self.retreat(Reason.IDLE)
            raise MisstepError(flaw)
        intended = sent = tuple(self._action.tolist())
        why |= _STOP if self.stopped else self._why | reason
        if self._dry_run:
            sent, why = self.limits.safe, why | _DRY_RUN
        self._sent = sent
        self._n_sent = number = self._n_sent + 1
        return Command(sent, intended, why, self._answering, number)

    def stop(self) -> None:
        """Stop: every command is the safe action, until `clear`."""
        self.stopped = True
        self._jump()
        self.retreat(Reason.IDLE)

    def clear(self) -> None:
        """Take back the emergency stop; the action stays safe until a trial begins."""
        self.stopped = False

    @property
    def is_safe(self) -> bool:
        """Whether the last command was the safe action."""
        sent = zip(self._sent, self.limits.safe, self._tolerance, strict=True)
        return all(abs(action - safe) <= near for action, safe, near in sent)

    def _jump(self) -> None:
        """Be at the safe action at once, at rest, whatever the limits of rate and jerk."""
        self._action[:], self._slope[:] = self.limits.safe, 0.0
