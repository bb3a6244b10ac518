"""The exploration service: which action now? A run whose trials are made by a robot elsewhere.

           start                     states in, actions out             judged: over
  ready ───────────▶ running ────────────────────────────────▶ learning ────────────▶ ready
    ▲                   │                                          (or finished)
    └───────────────────┘ watchdog, emergency stop, lost robot: abandoned, tried again

Between trials the next policy is learned in the background exactly as `misstep.learning.learn` does
it, so a robot that is a simulation in lock-step makes the very run that `learn` would have made.
The service knows no transport: sockets, web pages and ROS nodes all call these few methods, from
whatever threads they like. No action is asked of a policy while the lock is held, so an emergency
stop never waits for one.

A trial is judged by whoever speaks first: the predicates of a `Judged` system, a person
(`mark`), or the robot itself, with its states.
"""

import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.formats import save_dataset
from misstep.learners import Task
from misstep.learning import Proposal, propose
from misstep.robot.cadence import Cadence
from misstep.robot.guard import Command, Guard, Safety, State
from misstep.robot.limits import Limits, Reason, Row
from misstep.robot.log import ActionLog
from misstep.robot.numbering import next_number
from misstep.robot.reported import ReportedTrial
from misstep.rollout import Policy, utc_now
from misstep.runs import Run
from misstep.seeds import Stream, stream_of
from misstep.storage import make_folder
from misstep.systems import System
from misstep.threads import thread_pool
from misstep.trajectory import Dataset, Outcome, Trajectory

OnTrial = Callable[[Run, Trajectory], None]

Clock = Callable[[], float]
"""Returns seconds; `time.monotonic`, or a test's own."""

LOGS = "actions"
"""Folder of the logs in a run's folder."""

DRIVEN = "driven"
"""Folder of the trials in a run's folder that nothing is learned from."""

_LONGEST_TRIAL = 60.0  # s, where the system does not say


class Phase(IntEnum):
    """What a service is doing."""

    LEARNING = 0
    """Learning the next policy, or keeping the trial before."""
    READY = 1
    """Waiting for `ExplorationService.start`."""
    RUNNING = 2
    """In a trial."""
    FINISHED = 3
    """The run is finished: there will be no further trial."""


class Start(NamedTuple):
    """A trial that has begun."""

    number: int
    """Counts from 0."""
    seed: int
    """Of the trial; a simulation resets with it."""


class ExplorationService:
    """Drives a robot through the trials of a run.

    Parameters
    ----------
    run : Run
        Its trials are added to it, and to its folder if it has one.
    system : System, optional
        What the robot is described by, never driven; the run's own if left out. Where it is
        `Judged`, its formulas judge the robot's states.
    limits : Limits, optional
        Those of the system's spaces if left out, with a safe action of 0.
    safety : Safety, optional
    duration : float, s
        Longest trial; 0 for the system's own duration, or 60 s.
    simulated_time : bool
        Take the states' stamps for the time, instead of `clock`: for a simulation that does not
        run in real time. The watchdog then sees no time but that of the states.
    clock : callable
        Returns s, of any origin; monotonic.
    learning : bool
        If not, drive with the policy of the run's last trial, as often as is asked for, and learn
        nothing: the trials are kept beside the run, in its folder ``driven``.
    on_trial : callable, optional
        Called with the run and each trial that was kept, from another thread.

    Attributes
    ----------
    run : Run
    limits : Limits
    cadence : Cadence
        How long each exchange took, s.
    unlogged : int
        Records for which there was no room on the disk, long after an emergency stop.

    Raises
    ------
    MisstepError
        If the limits do not fit, the trial is shorter than a step, the log cannot be written, or
        somebody else drives the run.
    """

    def __init__(
        self,
        run: Run,
        *,
        system: System | None = None,
        limits: Limits | None = None,
        safety: Safety | None = None,
        duration: float = 0.0,
        simulated_time: bool = False,
        clock: Clock = time.monotonic,
        learning: bool = True,
        on_trial: OnTrial | None = None,
    ) -> None:
        self.run = run
        self._system = run.config.make_system() if system is None else system
        self.limits = Limits.of(self._system) if limits is None else limits
        self._safety = Safety() if safety is None else safety
        self._guard = Guard(self.limits, self._safety)
        self._shape = (len(self.limits.safe),)
        self._n_steps = _n_steps(self._system, duration)
        self._simulated, self._stamp = simulated_time, 0.0
        self._now: Clock = self._last_stamp if simulated_time else clock
        self._learning, self._on_trial = learning, on_trial
        self._n_driven = next_number(run.folder / DRIVEN, "trial_*.h5") if run.folder else 0
        self._task = Task.of(self._system, run.config.state)
        self.cadence = Cadence()
        self.unlogged = 0
        self._lock = threading.Lock()
        self._trial: ReportedTrial | None = None
        self._unkept: tuple[Proposal, Trajectory] | None = None
        self._driving = ExitStack()
        self._driving.enter_context(run.driven())
        try:
            self._log = self._open_log()
        except MisstepError:
            self._driving.close()
            raise
        self._pool = thread_pool(1, "learning")
        self._job: Future[Proposal | None] = self._pool.submit(self._learn, None)

    # What a transport calls

    def describe(self) -> dict[str, Any]:
        """Return what a robot needs to know, in what JSON can say."""
        limits, safety = self.limits, self._safety
        return {
            "system": self._system.system_id,
            "observation_columns": [[c.name, c.unit] for c in limits.observation_columns],
            "action_columns": [[c.name, c.unit] for c in limits.action_columns],
            "n_observations": len(limits.observation_columns),
            "n_actions": len(limits.action_columns),
            "dt": limits.period,
            "low": list(limits.low),
            "high": list(limits.high),
            "rate": [_or_none(value) for value in limits.rate],
            "jerk": [_or_none(value) for value in limits.jerk],
            "safe": list(limits.safe),
            "watchdog": safety.watchdog,
            "deadline": self._guard.deadline,
            "dry_run": safety.dry_run,
            "simulated_time": self._simulated,
            "learner": self.run.config.learner,
            "state": list(self.run.config.state),
            "max_steps": self._n_steps,
        }

    def status(self) -> dict[str, Any]:
        """Return how things stand, in what JSON can say."""
        with self._lock:
            return {
                "phase": self._phase.name.lower(),
                "trials": self._n_kept(),
                "succeeded": self.run.succeeded,
                "stopped": self._guard.stopped,
                "safe": self._guard.is_safe,
                "states": self.cadence.n,
                "refused": {str(why): n for why, n in sorted(self._guard.refused.items())},
                "deadline_misses": self._guard.late,
                "unlogged": self.unlogged,
                "p50_us": _microseconds(self.cadence.quantile(0.5)),
                "p99_us": _microseconds(self.cadence.quantile(0.99)),
                "longest_us": _microseconds(self.cadence.longest),
            }

    @property
    def phase(self) -> Phase:
        """What the service is doing."""
        with self._lock:
            return self._phase

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it is no longer learning; return whether it is not, after `timeout` s."""
        job = self._job
        try:
            job.exception(timeout)
        except TimeoutError:
            return False
        return True

    def connect(self, who: str) -> None:
        """Let a robot begin: from here on it counts its states anew."""
        with self._lock:
            self._abandon(f"{who} connected", Reason.IDLE)
            self._event(f"{who} drives")
            self._guard.connect()

    def disconnect(self, who: str) -> None:
        """Let a robot go; a trial in progress is abandoned."""
        with self._lock:
            self._abandon(f"{who} is gone", Reason.WATCHDOG)
            self._event(f"{who} drives no more")

    def start(self) -> Start | None:
        """Begin the next trial; a trial in progress is abandoned.

        Returns
        -------
        Start or None
            None while the next policy is being learned, and once the run is finished; `phase`
            tells which.

        Raises
        ------
        MisstepError
            If an emergency stop is latched; or if the trial before could not be kept or learned
            from, which the next call tries again.
        """
        with self._lock:
            if self._guard.stopped:
                raise MisstepError("an emergency stop is latched: clear it before a trial")
            self._abandon("another trial was asked for", Reason.IDLE)
            if not self._job.done():
                return None
            error = self._job.exception()
            if error is not None:
                self._job = self._pool.submit(self._learn, None)
                raise error
            proposal = self._job.result()
            if proposal is None:
                return None
            self._trial = ReportedTrial(self._system, proposal, self._n_steps)
            proposal.policy.reset()
            self._guard.begin(self._now())
            number = self._n_kept()
            self._event(f"trial {number} starts, seed {proposal.seed}")
            return Start(number, proposal.seed)

    def exchange(self, state: State) -> Command:
        """Return the command that answers a state, for any state whatsoever."""
        guard = self._guard
        with self._lock:
            if self._simulated and self._stamp < state.stamp < math.inf:
                self._stamp = state.stamp
            asked = self._now()
            refusal = guard.check(state, asked)
            if guard.was_silent:
                self._give_up()
            trial = self._trial
            if refusal is not None:
                self._event(f"state {state.sequence} refused: {refusal}")
                return self._send(guard.keep_on(asked, Reason.REFUSED), asked, None)
            if trial is None or not self._goes_on(trial, state):
                return self._send(guard.keep_on(asked), asked, state.observation)
            observation = guard.observation
        action, flaw = self._ask(trial.proposal.policy, observation)
        with self._lock:
            now = self._now()
            if self._trial is not trial:  # stopped, or gone, while the policy was at work
                return self._send(guard.keep_on(now), now, state.observation)
            command = self._fail(flaw, now) if flaw else self._obey(action, now, asked)
            command = self._send(command, now, state.observation)
            if self._trial is trial:
                trial.act(command.action)
            self.cadence.add(now - asked)
            return command

    def tick(self) -> Command | None:
        """Look at the watchdog; to be called about once in a control period, by one thread.

        Returns
        -------
        Command or None
            A command to send although nobody asked, on the way to the safe action; None where
            there is nothing to say.
        """
        with self._lock:
            now = self._now()
            if self._guard.is_silent(now):
                self._give_up()
            under_way = self._trial is not None and self._trial.is_under_way
            # In simulated time nothing moves between states, but a stop is a stop.
            stands = self._simulated and not self._guard.stopped
            if under_way or stands or self._guard.is_safe:
                return None
            return self._send(self._guard.keep_on(now), now, None)

    def mark(self, outcome: Outcome, who: str) -> bool:
        """Let a person judge the trial in progress, which ends it; return whether there was one."""
        with self._lock:
            trial = self._trial
            if trial is None or trial.n_steps == 0:
                return False
            self._event(f"{who} marks {outcome}")
            trial.mark(outcome)
            self._finish(trial)
            return True

    def stop(self, who: str) -> None:
        """Stop at once, until `clear`; a trial in progress is abandoned."""
        with self._lock:
            self._stop(f"emergency stop by {who}")

    def clear(self, who: str) -> None:
        """Take back an emergency stop."""
        with self._lock:
            self._guard.clear()
            self._event(f"emergency stop cleared by {who}")

    @property
    def stopped(self) -> bool:
        """Whether an emergency stop is latched."""
        return self._guard.stopped

    def close(self) -> None:
        """End: wait until what is finished has been kept, and close the log.

        Raises
        ------
        MisstepError
            If the last trial could not be kept.
        """
        with self._lock:
            self._abandon("the service ends", Reason.IDLE)
        self._pool.shutdown(wait=True)
        with self._lock:
            self._event("the service ends")
            log, self._log = self._log, None
        if log is not None:
            log.close()
        with self._driving:
            if self._unkept is not None:
                self._keep(*self._unkept)  # the disk may have room by now
            elif (error := self._job.exception()) is not None:
                raise error

    def _ask(
        self, policy: Policy, observation: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], str]:
        """Return a policy's action, (m,), and what is wrong with it: nothing, as a rule."""
        try:
            action = np.asarray(policy(observation), dtype=np.float64)
        except Exception as error:  # a robot must not be left alone with its last action
            return observation, f"{type(error).__name__}: {error}"
        return action, "" if action.shape == self._shape else f"its action has shape {action.shape}"

    # Inside, with the lock held

    @property
    def _phase(self) -> Phase:
        if self._trial is not None:
            return Phase.RUNNING
        if not self._job.done():
            return Phase.LEARNING
        if self._job.exception() is None and self._job.result() is None:
            return Phase.FINISHED
        return Phase.READY

    def _last_stamp(self) -> float:
        return self._stamp

    def _give_up(self) -> None:
        self._abandon("watchdog: no fresh state", Reason.WATCHDOG)

    def _goes_on(self, trial: ReportedTrial, state: State) -> bool:
        """Judge and record a state; return whether the trial goes on."""
        try:
            trial.observe(state, self._guard.observation)
        except MisstepError as error:
            self._stop(str(error))
            return False
        if not trial.over:
            return True
        if trial.n_steps:
            self._finish(trial)
        else:
            self._abandon("over before its first action", Reason.IDLE)
        return False

    def _obey(self, action: NDArray[np.float64], now: float, asked: float) -> Command:
        try:
            return self._guard.send(action, now, asked)
        except MisstepError as error:
            return self._fail(str(error), now)

    def _fail(self, flaw: str, now: float) -> Command:
        self._stop(f"the policy failed: {flaw}")
        return self._guard.keep_on(now)

    def _finish(self, trial: ReportedTrial) -> None:
        if self._safety.dry_run:
            self._abandon("it is over; from a dry run there is nothing to learn", Reason.IDLE)
            return
        self._trial = None
        self._guard.retreat(Reason.IDLE)
        self._event(f"trial {self._n_kept()} is over after {trial.n_steps} steps")
        self._job = self._pool.submit(self._learn, trial)

    def _abandon(self, why: str, reason: Reason) -> None:
        if self._trial is not None:
            self._trial = None
            self._guard.retreat(reason)
            self._event(f"trial {self._n_kept()} abandoned: {why}")

    def _stop(self, why: str) -> None:
        self._guard.stop()
        self._abandon(why, Reason.IDLE)
        self._event(why)

    # The log: what could not be logged is not sent

    def _open_log(self) -> ActionLog | None:
        if self.run.folder is None:
            return None
        folder = self.run.folder / LOGS
        make_folder(folder)
        header = {**self.describe(), "time": utc_now(), "clock": self._now()}
        return ActionLog(folder / f"{next_number(folder, '*.log'):04d}.log", header)

    def _send(self, command: Command, now: float, observation: Row | None) -> Command:
        """Log a command and return it; where the disk is full, an emergency stop instead."""
        log = self._log
        if log is None:
            return command
        if not log.reserve():
            self._disk_is_full()
            command = self._guard.keep_on(now)
        try:
            log.command(now, command, observation)
        except OSError:
            self.unlogged += 1
        return command

    def _event(self, text: str) -> None:
        log = self._log
        if log is None:
            return
        if not log.reserve():
            self._disk_is_full()
        try:
            log.event(self._now(), text)
        except OSError:
            self.unlogged += 1

    def _disk_is_full(self) -> None:
        if not self._guard.stopped:
            self._stop("the disk has no room for the log")

    # In the background, without the lock

    def _learn(self, trial: ReportedTrial | None) -> Proposal | None:
        """Keep a trial that is over, and return what to try next; None at the end of the run."""
        if trial is not None:
            self._unkept = trial.proposal, trial.trajectory()
        if self._unkept is not None:
            self._keep(*self._unkept)
        return self._same_policy() if not self._learning else self._next_policy()

    def _keep(self, proposal: Proposal, trajectory: Trajectory) -> None:
        if self._learning:
            self.run.add(proposal.policy, trajectory, proposal.seconds)
        elif self.run.folder is not None:
            make_folder(self.run.folder / DRIVEN)
            file = self.run.folder / DRIVEN / f"trial_{self._n_kept():03d}.h5"
            save_dataset(Dataset([trajectory]), file)
        self._unkept = None
        self._n_driven += 1
        if self._on_trial is not None:
            self._on_trial(self.run, trajectory)

    def _next_policy(self) -> Proposal | None:
        return None if self.run.finished else propose(self.run, self._task)

    def _same_policy(self) -> Proposal:
        stream = stream_of(self.run.config.seed, Stream.DRIVE, self._n_kept())
        demonstrator = f"learner:{self.run.config.learner}"
        return Proposal(self.run.policy, int(stream.generate_state(1)[0]), demonstrator, 0.0)

    def _n_kept(self) -> int:
        """Return the number of the next trial: how many have been kept, unless some are gone."""
        return len(self.run.trials) if self._learning else self._n_driven


def _n_steps(system: System, duration: float) -> int:
    longest = duration or float(system.parameters.get("duration", _LONGEST_TRIAL))
    n_steps = round(longest / system.dt)
    if n_steps < 1:
        raise MisstepError(
            f"a trial of {longest:g} s is shorter than one control period of {system.dt:g} s"
        )
    return n_steps


def _or_none(value: float) -> float | None:
    return None if value == math.inf else value


def _microseconds(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds * 1e6, 1)
