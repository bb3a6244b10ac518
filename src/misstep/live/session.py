"""The session: what a person is doing, what has been recorded, and what is being learned.

There is one, whatever pages look at it; one page drives and the others watch. The session is in
one of these modes::

    ready -> countdown -> driving <-> paused -> ended -> ready       an attempt, then keep or not
    ready -> learning -> ready                                       trials, in the worker
    ready -> balancing -> ready                                      the learned policy, live
"""

import asyncio
import contextlib
import json
import math
import re
import time
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from misstep.errors import MisstepError
from misstep.learners import LEARNERS
from misstep.live.attempt import Attempt, action_of, is_one_way
from misstep.live.attempts import Attempts, Kept
from misstep.live.clock import Clock
from misstep.live.hand import Hand
from misstep.live.lesson import Lesson
from misstep.live.narration import tell_end
from misstep.live.picture import (
    rounded,
    show_learners,
    show_recording,
    show_summary,
    show_system,
    show_systems,
)
from misstep.live.protocol import Message
from misstep.live.worker import Worker
from misstep.recordings.marking import Mark
from misstep.systems import make_system
from misstep.trajectory import Outcome, Trajectory

SILENCE = 4.0
"""Seconds without a word from the page that drives, after which an attempt is paused."""

_COUNT = 0.6  # s, one number of the countdown
_ENDLESS = 3600.0  # s, an episode of the learned policy
_FALLEN_FOR = 1.5  # s, how long a fallen policy lies before it starts again
_AHEAD = "countdown", "driving", "balancing"

Frame = dict[str, Any]


@dataclass(frozen=True)
class Settings:
    """How a person drives."""

    strength: float = 0.5
    """Share of the actuator's range that a full push is."""
    speed: float = 0.35
    """Seconds of the system in a second."""
    start_angle: float | None = None
    """Where an attempt starts, deg; None: where the system says."""
    countdown: int = 2


_STROKE_SPEED = 0.05  # a strike lasts a tenth of a second


class Listener(Protocol):
    """A page that is connected."""

    def news(self, message: str) -> None:
        """Send a message; none is left out."""

    def frame(self, message: str) -> None:
        """Send a state, in place of one that has not been sent yet."""


class Session:
    """What is going on.

    Parameters
    ----------
    folder : Path
        Everything that is recorded goes there; made if there is none.
    system : str
        Name of the system to begin with.
    parameters : mapping
        Of that system, where they are not its defaults.

    Raises
    ------
    MisstepError
        If there is no such system or the folder cannot be used.
    """

    def __init__(self, folder: Path, system: str, parameters: Mapping[str, Any]) -> None:
        self.folder = folder
        self.mode = "ready"
        self.worker = Worker()
        self.listeners: list[Listener] = []
        self.driver: Listener | None = None
        self._given = {system: dict(parameters)}
        self._systems = show_systems()
        if system not in {shown["name"] for shown in self._systems}:
            self._systems.append({"name": system, "title": system, "task": ""})
        self._learners = show_learners()
        self._clock = Clock(0.02)
        self._wake = asyncio.Event()
        self._dirty = False
        self._rng = np.random.default_rng()
        self._tasks: set[asyncio.Task[Any]] = set()
        self._hand: list[float] = []
        self._acknowledged = 0
        self._heard = time.monotonic()
        self._describing = 0
        self._use(system, 0)

    # The system and what is at hand of it

    def _use(self, name: str, key: int) -> None:
        """Turn to a system and what has been recorded of it."""
        system = make_system(name, **self._given.get(name, {}))
        folder = self.folder / re.sub(r"[^\w.-]", "-", name)
        self.attempts = Attempts(folder)
        self.lesson = Lesson(self.worker, folder / "runs", key, self.changed)
        self._summaries: dict[int, tuple[Trajectory, dict[str, Any]]] = {}
        self.system, self.name = system, name
        self.shown_system = show_system(name, system)
        self.settings = Settings(speed=_STROKE_SPEED) if is_one_way(system) else Settings()
        self.model: str | None = None
        self.note = ""
        self.attempt = Attempt(system, 0)
        self._set_mode("ended" if self.attempts.pending is not None else "ready")
        self._describe()

    # Pages

    def join(self, listener: Listener) -> None:
        """Have a page take part; it drives if none does."""
        self.listeners.append(listener)
        if self.driver is None:
            self.driver = listener
            self._heard = time.monotonic()
        listener.news(_json({"t": "hello", "systems": self._systems, "learners": self._learners}))
        listener.news(self._snapshot(listener, self._told()))
        listener.news(f'{{"t":"model","model":{self.model or "null"}}}')
        listener.frame(self._frame())
        self.changed()

    def leave(self, listener: Listener) -> None:
        """Have a page go; what it drives is paused, until it or another one goes on."""
        self.listeners.remove(listener)
        if self.driver is listener:
            self.driver = self.listeners[0] if self.listeners else None
            self._pause("the page that drove has gone: the attempt waits")
        self.changed()

    def changed(self) -> None:
        """Tell all pages how things are, once this turn of the loop is over."""
        if not self._dirty:
            self._dirty = True
            asyncio.get_running_loop().call_soon(self._tell_all)

    def _tell_all(self) -> None:
        self._dirty = False
        told = self._told()
        for listener in self.listeners:
            listener.news(self._snapshot(listener, told))

    def _snapshot(self, listener: Listener, told: dict[str, Any]) -> str:
        return _json({"t": "session", "drives": listener is self.driver, **told})

    def _told(self) -> dict[str, Any]:
        return {
            "mode": self.mode,
            "system": self.shown_system,
            "settings": asdict(self.settings),
            "attempts": [self._summary(kept) for kept in self.attempts],
            "pending": self._show_pending(),
            "can_undo": self.attempts.can_undo,
            "runs": self.lesson.runs(),
            "run": self.lesson.run,
            "watch": self.lesson.watch,
            "note": self.note,
            "folder": str(self.folder),
            "fits": self._fitting(),
        }

    def _summary(self, kept: Kept) -> dict[str, Any]:
        """Return one attempt for the list; made once, as a snapshot holds hundreds."""
        trajectory, summary = self._summaries.get(kept.id, (None, {}))
        if trajectory is not kept.trajectory:
            summary = {"id": kept.id, **show_summary(kept.trajectory)}
            self._summaries[kept.id] = kept.trajectory, summary
        return summary

    def _show_pending(self) -> dict[str, Any] | None:
        pending = self.attempts.pending
        if pending is None:
            return None
        return {**show_summary(pending), "sentence": tell_end(pending, self.system)}

    def _fitting(self) -> dict[str, str]:
        """Return why learners cannot be taken now, by name."""
        reasons = {}
        failed = any(k.trajectory.failure_step is not None for k in self.attempts)
        for name, kind in LEARNERS.items():
            if not len(self.attempts):
                reasons[name] = "keep at least one failed attempt first"
            elif kind.rung >= 4 and self.system.cost is None:
                reasons[name] = "this system has no cost as a function"
            elif kind.rung == 2 and not failed:
                reasons[name] = "no attempt has a failure time: mark one"
        return reasons

    def _frame(self) -> str:
        shown: Frame = {
            "t": "f",
            "o": rounded(self.attempt.observation),
            "a": rounded(self._action),
            "k": self.attempt.n_steps,
            "n": self._acknowledged,
            "late": self._clock.late,
            "ticks": self._clock.ticks,
        }
        if self.mode == "countdown":
            shown["left"] = self._left
        if self.mode == "balancing":
            shown["hold"] = rounded(self._hand_at.place)
        return _json(shown)

    def _send_frame(self) -> None:
        frame = self._frame()
        for listener in self.listeners:
            listener.frame(frame)

    # What a page asks for

    def do(self, listener: Listener, message: Message) -> None:
        """Do what a page asks for.

        Raises
        ------
        MisstepError
            If that is not possible now.
        """
        kind, values = message.kind, message.values
        if kind == "take":
            if self.driver is not listener:
                self._pause("another tab drives now")
                self.driver = listener
        elif self.driver is not listener:
            if kind in ("alive", "hidden", "input"):
                return
            raise MisstepError("another tab drives; press “Drive here” to take over")
        self._heard = time.monotonic()
        if kind == "input":
            self._hand, self._acknowledged = values["v"], values["n"]
            return
        if kind == "alive":
            return
        handler: Callable[..., None] | None = getattr(self, f"_do_{kind}", None)
        if handler is not None:
            handler(**values)
        if kind not in ("push", "poke"):
            self.changed()

    def _need(self, *modes: str) -> None:
        if self.mode not in modes:
            doing = {
                "countdown": "an attempt is running",
                "driving": "an attempt is running",
                "paused": "an attempt is paused",
                "ended": "an attempt waits: keep it (Enter) or throw it away (Backspace)",
                "learning": "it is learning",
                "balancing": "the learned policy is running",
                "ready": "no attempt is running",
            }
            raise MisstepError(f"not now: {doing[self.mode]}")

    def _set_mode(self, mode: str) -> None:
        self.mode = mode
        self._hand = []
        self._action = np.zeros(len(self.system.action_columns))
        self._left = 0
        self._hand_at = Hand(self.system)
        self._clock.restart()
        self._wake.set()

    # Driving

    def _do_begin(self) -> None:
        self._need("ready")
        self._begin()

    def _do_restart(self) -> None:
        self._need("ready", "countdown", "driving", "paused", "ended")
        self.attempts.discard()
        self._begin()

    def _begin(self) -> None:
        angle = self.settings.start_angle
        start = None if angle is None else math.radians(angle)
        self.attempt = Attempt(self.system, int(self._rng.integers(2**31)), start)
        self.note = ""
        self._set_mode("countdown" if self.settings.countdown else "driving")
        self._left = self.settings.countdown
        self._clock.period = _COUNT if self._left else self._period
        self._send_frame()

    @property
    def _period(self) -> float:
        return self.system.dt / self.settings.speed

    def _do_stop(self) -> None:
        if self.mode == "balancing":
            self._do_rest()
        elif self.mode == "learning":
            self._do_halt()
        else:
            self._need("countdown", "driving", "paused")
            self._end()

    def _do_fail(self) -> None:
        self._need("driving", "paused")
        self.attempt.fail_now()
        self._end()

    def _do_pause(self) -> None:
        self._need("countdown", "driving", "balancing")
        self._pause("")

    def _do_resume(self) -> None:
        self._need("paused")
        self.note = ""
        hand = self._hand
        self._set_mode("driving")
        self._hand = hand
        self._clock.period = self._period

    def _do_hidden(self, hidden: bool) -> None:
        if hidden:
            self._pause("the page was hidden: the attempt waits")

    def _pause(self, note: str) -> None:
        if self.mode in ("countdown", "driving"):
            self._set_mode("paused")
            self.note = note
            self.changed()
        elif self.mode == "balancing":
            self._do_rest()
            self.changed()

    def _do_keep(self) -> None:
        self._need("ended")
        self.attempts.keep()
        self._back_to_start()
        self._describe()

    def _do_discard(self) -> None:
        self._need("ended", "paused")
        self.attempts.discard()
        self._back_to_start()

    def _back_to_start(self) -> None:
        self.attempt = Attempt(self.system, int(self._rng.integers(2**31)))
        self.note = ""
        self._set_mode("ready")
        self._send_frame()

    def _end(self) -> None:
        """End the attempt; what was recorded is in a file before anybody decides on it."""
        speed = self.settings.speed
        notes = () if speed == 1.0 else (f"time: driven by hand at {speed:g} of real time",)
        trajectory = self.attempt.trajectory(notes)
        if trajectory is None:
            self._back_to_start()
        else:
            self.attempts.put_aside(trajectory)
            self._set_mode("ended")
        self._send_frame()
        self.changed()

    def _do_settings(self, **settings: Any) -> None:
        self.settings = Settings(**settings)
        if self.mode == "driving":
            self._clock.period = self._period

    def _do_system(self, name: str) -> None:
        self._need("ready", "ended")
        if name not in {shown["name"] for shown in self._systems}:
            raise MisstepError("there is no such system")
        self._use(name, self.lesson.key)
        self._send_frame()
        self._tell_model()

    # What was recorded

    def _do_delete(self, id: int) -> None:
        self._quiet()
        self.attempts.delete(id)
        self._describe()

    def _do_mark(
        self,
        id: int,
        outcome: str | None,
        failure_time: float | None,
        usable: list[float] | None,
    ) -> None:
        self._quiet()
        if outcome is not None and outcome not in set(Outcome):
            raise MisstepError("the outcome is success, failure or unknown")
        if usable is not None and len(usable) != 2:
            raise MisstepError("the usable part has a start and an end")
        part = None if usable is None else (usable[0], usable[1])
        said = None if outcome is None else Outcome(outcome)
        self.attempts.mark(id, Mark(said, failure_time, part))
        self._describe()

    def _do_undo(self) -> None:
        self._quiet()
        self.note = self.attempts.undo()
        self._describe()

    def _quiet(self) -> None:
        """Refuse changes to what was recorded while something is going on."""
        self._need("ready", "ended", "paused")

    async def take_in(self, path: Path) -> int:
        """Append what a file holds to the attempts, and return how many those are.

        Raises
        ------
        MisstepError
            If the file cannot be read, or does not fit the system.
        """
        self._quiet()
        read = await self.worker.do(
            "read", path=str(path), system=self.name, parameters=self._given.get(self.name, {})
        )
        self._quiet()
        self.attempts.add(read)
        self._describe()
        self.changed()
        return len(read)

    def recording(self, id: int) -> str:
        """Return an attempt as JSON.

        Raises
        ------
        MisstepError
            If it is not there.
        """
        return _json({"id": id, **show_recording(self.attempts[id])})

    def replay(self) -> tuple[dict[str, Any], list[str], list[str]]:
        """Return what a replay needs: the session, its demonstrations and its trials as JSON."""
        session = self._told()
        run, shown = self.lesson.replayed()
        if shown is None:
            recordings = [
                {"id": kept.id, **show_recording(kept.trajectory)} for kept in self.attempts
            ]
        else:  # of a run that was opened, the attempts are those that it started from
            recordings = shown
            whole = ("observations", "actions")
            listed = [{k: v for k, v in one.items() if k not in whole} for one in recordings]
            session = {**session, "attempts": listed}
        told = [_json(one) for one in recordings]
        return {**session, "run": run}, told, list(self.lesson.trials)

    def _describe(self) -> None:
        """Have a mixture fitted to what was recorded, for the plane."""
        self._describing += 1
        if len(self.attempts) == 0:
            self.model = None
            self._tell_model()
            return
        self._spawn(self._describe_when_quiet(self._describing))

    async def _describe_when_quiet(self, number: int) -> None:
        path = str(self.attempts.path)
        # A mixture that cannot be fitted is not shown, and learning will say why.
        with contextlib.suppress(MisstepError):
            model = await self.worker.do("describe", attempts=path, state=[])
            if number == self._describing:
                self.model = model
                self._tell_model()

    def _tell_model(self) -> None:
        for listener in self.listeners:
            listener.news(f'{{"t":"model","model":{self.model or "null"}}}')

    # Learning

    def _do_learn(self, learner: str, state: list[str], max_trials: int, seed: int) -> None:
        self._need("ready")
        shown = len(self.attempts.dataset)
        if learner not in LEARNERS:
            raise MisstepError("there is no such learner")
        if learner in (reasons := self._fitting()):
            raise MisstepError(f"{learner} cannot learn from this: {reasons[learner]}")
        known = [c.name for c in self.system.observation_columns]
        chosen = [column for column in known if column in state] or known
        self._start_learning(
            self.lesson.learn(
                learner,
                chosen,
                max_trials,
                shown,
                seed=seed,
                system=self.name,
                parameters=self._given.get(self.name, {}),
                attempts=str(self.attempts.path),
            )
        )

    def _do_resume_run(self, name: str) -> None:
        self._need("ready")
        self._start_learning(self.lesson.load(name, self.name, go_on=True))

    def _do_open_run(self, name: str) -> None:
        self._need("ready")
        self._start_learning(self.lesson.load(name, self.name, go_on=False))

    def _do_close_run(self) -> None:
        self._need("ready")
        self.lesson.close()

    def _start_learning(self, end: Awaitable[str]) -> None:
        self.note = ""
        self._set_mode("learning")
        self._spawn(self._learn(end))

    async def _learn(self, end: Awaitable[str]) -> None:
        self.note = await end
        self._back_to_ready()
        self.changed()

    def _back_to_ready(self) -> None:
        note = self.note
        self._back_to_start()
        self.note = note
        if self.attempts.pending is not None:
            self._set_mode("ended")

    def _do_next(self, trial: int) -> None:
        self.lesson.watched(trial)

    def _do_pace(self, watch: bool) -> None:
        self.lesson.pace(watch)

    def _do_halt(self) -> None:
        self._need("learning")
        self.lesson.halt()

    # The policy that was learned, live

    def _do_balance(self) -> None:
        self._need("ready")
        self._policy = self.lesson.policy()
        parameters = dict(self._given.get(self.name, {}))
        if "duration" in self.system.parameters:
            parameters["duration"] = _ENDLESS
        self._stage = make_system(self.name, **parameters)
        self._stand_up()
        self._set_mode("balancing")
        self._hand_at = Hand(self._stage)
        self._clock.period = self.system.dt

    def _stand_up(self) -> None:
        self.attempt = Attempt(self._stage, int(self._rng.integers(2**31)))
        self._fallen = 0
        self._policy.reset()

    def _do_rest(self) -> None:
        self._need("balancing")
        self._back_to_ready()

    def _do_push(self, x: float | None) -> None:
        if self.mode == "balancing":
            self._hand_at.hold(x)

    def _do_poke(self, side: float) -> None:
        if self.mode == "balancing":
            self._hand_at.poke(side)

    # Time

    async def live(self) -> None:
        """Let time pass for as long as the server runs."""
        self.worker.start()
        while True:
            if self.mode not in _AHEAD:
                self._wake.clear()
                await self._wake.wait()
                continue
            await self._clock.tick()
            try:
                self._tick()
            except MisstepError as error:
                self.note = str(error)
                self._end()

    def _tick(self) -> None:
        if self.mode == "countdown":
            self._left -= 1
            if self._left <= 0:
                hand = self._hand
                self._set_mode("driving")
                self._hand = hand
                self._clock.period = self._period
                self.changed()
            self._send_frame()
        elif self.mode == "driving":
            self._drive()
        elif self.mode == "balancing":
            self._balance()
        if self.mode in _AHEAD and time.monotonic() - self._heard > SILENCE:
            self._pause("nothing was heard from the page: the attempt waits")

    def _drive(self) -> None:
        self._action = action_of(self.system, self._hand, self.settings.strength)
        # A stroke begins with the first push: standing still would be its end.
        idle = is_one_way(self.system) and not self.attempt.n_steps and not np.any(self._action)
        if not idle:
            self.attempt.step(self._action)
        if self.attempt.over:
            self._end()
        else:
            self._send_frame()

    def _balance(self) -> None:
        if self.attempt.over:
            self._fallen += 1
            if self._fallen * self.system.dt > _FALLEN_FOR:
                self._stand_up()
        else:
            self._hand_at.act()
            self._action = self._policy(self.attempt.observation)
            self.attempt.step(self._action)
        self._send_frame()

    # The end

    def close(self) -> None:
        """Put aside what is being recorded, and end the worker."""
        if self.mode in ("driving", "paused", "countdown"):
            trajectory = self.attempt.trajectory(("end: the server was stopped",))
            if trajectory is not None:
                self.attempts.put_aside(trajectory)
        self.worker.stop()

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


def _json(value: object) -> str:
    return json.dumps(value, allow_nan=False, separators=(",", ":"))
