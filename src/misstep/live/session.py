"""The session: what a person is doing, what has been recorded, and what is being learned.

There is one, whatever pages look at it; one page drives and the others watch. The session is in
one of these modes::

    ready -> countdown -> driving <-> paused -> ended -> ready       an attempt, then keep or not
    ready -> learning -> ready                                       trials, in the worker
    ready -> balancing -> ready                                      the learned policy, live
"""

import asyncio
import secrets
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from misstep.errors import MisstepError
from misstep.learners import LEARNERS
from misstep.live.attempts import Attempts
from misstep.live.audience import Audience, Listener
from misstep.live.balancing import Balancing
from misstep.live.clock import Clock
from misstep.live.description import Description
from misstep.live.driving import Driving, Settings
from misstep.live.lesson import Lesson
from misstep.live.listing import Listing, show_pending, unfit_learners
from misstep.live.picture import (
    rounded,
    show_learners,
    show_recording,
    show_system,
    show_systems,
    still_columns,
    to_json,
)
from misstep.live.protocol import Message
from misstep.live.worker import Worker
from misstep.recordings.marking import Mark
from misstep.storage import as_file_name
from misstep.systems import make_system
from misstep.trajectory import Outcome, Trajectory

SILENCE = 4.0
"""Seconds without a word from the page that drives, after which an attempt is paused."""

_COUNT = 0.6  # s, one number of the countdown
_AHEAD = "countdown", "driving", "balancing"


_DOING = {
    "countdown": "an attempt is running",
    "driving": "an attempt is running",
    "paused": "an attempt is paused",
    "ended": "an attempt waits: keep it (Enter) or throw it away (Backspace)",
    "learning": "it is learning",
    "balancing": "the learned policy is running",
    "ready": "no attempt is running",
}


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
        self.audience = Audience()
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
        self._acknowledged = 0
        self._heard = time.monotonic()
        # Not the same again when the server is: a page can have been away meanwhile.
        self._use(system, secrets.randbelow(2**31))

    # The system and what is at hand of it

    def _use(self, name: str, key: int) -> None:
        """Turn to a system and what has been recorded of it."""
        system = make_system(name, **self._given.get(name, {}))
        folder = self.folder / as_file_name(name)
        # All that can fail comes first: where it does, the present system stays as it is.
        driving, attempts = Driving(system, self._rng), Attempts(folder)
        self.lesson = Lesson(self.worker, folder / "runs", key, self.changed)
        self.driving, self.attempts = driving, attempts
        given = {"system": name, "parameters": self._given.get(name, {})}
        self.description = Description(self.worker, self.attempts.path, self._tell_model, **given)
        self._listing = Listing()
        self.system, self.name = system, name
        self.shown_system = show_system(name, system)
        self.note = ""
        self._set_mode("ended" if self.attempts.pending is not None else "ready")
        self._recorded()

    # Pages

    def join(self, listener: Listener) -> None:
        """Have a page take part; it drives if none does."""
        if self.audience.join(listener):
            self._heard = time.monotonic()
        listener.news(to_json({"t": "hello", "systems": self._systems, "learners": self._learners}))
        listener.news(self._snapshot(listener, self._told()))
        listener.news(self._model())
        listener.frame(self._frame())
        self.changed()

    def leave(self, listener: Listener) -> None:
        """Have a page go; what it drives is paused, until it or another one goes on."""
        if self.audience.leave(listener):
            self.driving.hand = []
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
        for listener in self.audience:
            listener.news(self._snapshot(listener, told))

    def _tell_model(self) -> None:
        self.audience.news(self._model())

    def _model(self) -> str:
        return f'{{"t":"model","model":{self.description.model}}}'

    def _snapshot(self, listener: Listener, told: dict[str, Any]) -> str:
        return to_json({"t": "session", "drives": listener is self.audience.driver, **told})

    def _told(self) -> dict[str, Any]:
        return {
            "mode": self.mode,
            "system": self.shown_system,
            "settings": asdict(self.driving.settings),
            "attempts": self._listing.show(self.attempts),
            "pending": show_pending(self.attempts.pending, self.system),
            "can_undo": self.attempts.can_undo,
            "runs": self.lesson.runs(),
            "run": self.lesson.run,
            "watch": self.lesson.watch,
            "note": self.note,
            "folder": str(self.folder),
            "fits": unfit_learners(self.attempts, self.system),
            "still": self._still,
        }

    def _frame(self) -> str:
        seen = self.balancing or self.driving
        shown: dict[str, Any] = {
            "t": "f",
            "o": rounded(seen.attempt.observation),
            "a": rounded(seen.action),
            "k": seen.attempt.n_steps,
            "n": self._acknowledged,
            "late": self._clock.late,
            "ticks": self._clock.ticks,
        }
        if self.mode == "countdown":
            shown["left"] = self._left
        if self.balancing is not None:
            shown["hold"] = rounded(self.balancing.hand.place)
        return to_json(shown)

    def _send_frame(self) -> None:
        self.audience.frame(self._frame())

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
            if self.audience.driver is not listener:
                self.driving.hand = []
                self._pause("another tab drives now")
                self.audience.driver = listener
        elif self.audience.driver is not listener:
            if kind in ("alive", "hidden", "input"):
                return
            raise MisstepError("another tab drives; press “Drive here” to take over")
        self._heard = time.monotonic()
        if kind == "input":
            self.driving.hand, self._acknowledged = values["v"], values["n"]
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
            raise MisstepError(f"not now: {_DOING[self.mode]}")

    def _set_mode(self, mode: str) -> None:
        self.mode = mode
        self.driving.let_go()
        self._left = 0
        self.balancing: Balancing | None = None
        self._clock.restart()
        self._wake.set()

    # Driving

    def _do_begin(self) -> None:
        self._need("ready")
        self._begin()

    def _do_restart(self) -> None:
        self._need("ready", "countdown", "driving", "paused", "ended")
        self._throw_away()
        self._begin()

    def _throw_away(self) -> None:
        """Throw away what waits or is running; `undo` brings it back."""
        if self.mode in ("countdown", "driving", "paused"):
            self._end()
        self.attempts.discard()

    def _begin(self) -> None:
        self.driving.begin()
        self.note = ""
        countdown = self.driving.settings.countdown
        self._set_mode("countdown" if countdown else "driving")
        self._left = countdown
        self._clock.period = _COUNT if countdown else self.driving.period
        self._send_frame()

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
        self.driving.attempt.fail_now()
        self._end()

    def _do_pause(self) -> None:
        self._need("countdown", "driving", "balancing")
        self._pause("")

    def _do_resume(self) -> None:
        self._need("paused")
        self.note = ""
        self._drive()

    def _drive(self) -> None:
        self._set_mode("driving")
        self._clock.period = self.driving.period

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
        self._recorded()

    def _do_discard(self) -> None:
        self._need("ended", "paused")
        self._throw_away()
        self._back_to_start()

    def _back_to_start(self) -> None:
        self.driving.rest()
        self.note = ""
        self._set_mode("ready")
        self._send_frame()

    def _end(self) -> None:
        """End the attempt; what was recorded is in a file before anybody decides on it."""
        trajectory = self.driving.recorded()
        if trajectory is None:
            self._back_to_start()
        else:
            try:
                self.attempts.put_aside(trajectory)
            except MisstepError as error:
                self.note = f"{error}; the attempt is in memory alone: keep it to try again"
            self._set_mode("ended")
        self._send_frame()
        self.changed()

    def _do_settings(self, **settings: Any) -> None:
        self.driving.settings = Settings(**settings)
        if self.mode == "driving":
            self._clock.period = self.driving.period

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
        self._recorded()

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
        self._recorded()

    def _do_undo(self) -> None:
        self._quiet()
        self.note = self.attempts.undo()
        self._recorded()

    def _recorded(self) -> None:
        """Draw the consequences of a change of what was recorded."""
        self._still = still_columns([kept.trajectory for kept in self.attempts])
        self.description.renew()

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
        attempts = self.attempts
        read = await self.worker.do(
            "read", path=str(path), system=self.name, parameters=self._given.get(self.name, {})
        )
        self._quiet()
        if attempts is not self.attempts:
            raise MisstepError("another system was chosen meanwhile: add it again")
        attempts.add(read)
        self._recorded()
        self.changed()
        return len(read)

    def replay(self) -> tuple[dict[str, Any], Callable[[], list[str]], list[str]]:
        """Return what a replay needs: the session, its demonstrations and its trials as JSON.

        The demonstrations are made when asked for: that takes long, and can be done in a thread.
        """
        # Where it lies on this machine is nobody's business whom the replay is sent to.
        session = {**self._told(), "folder": ""}
        run, shown = self.lesson.replayed()
        session["run"] = run and {**run, "folder": ""}
        if shown is None:
            held = list(self.attempts)
            return session, lambda: [attempt_json(*kept) for kept in held], list(self.lesson.trials)
        # Of a run that was opened, the attempts are those that it started from.
        whole = ("observations", "actions")
        session["attempts"] = [{k: v for k, v in o.items() if k not in whole} for o in shown]
        return session, lambda: [to_json(one) for one in shown], list(self.lesson.trials)

    # Learning

    def _do_learn(self, learner: str, state: list[str], max_trials: int, seed: int) -> None:
        self._need("ready")
        shown = len(self.attempts.dataset)
        if learner not in LEARNERS:
            raise MisstepError("there is no such learner")
        if learner in (reasons := unfit_learners(self.attempts, self.system)):
            raise MisstepError(f"{learner} cannot learn from this: {reasons[learner]}")
        known = [c.name for c in self.system.observation_columns]
        varied = [column for column in known if column not in self._still]
        chosen = [column for column in known if column in state] or varied or known
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
        given = self._given.get(self.name, {})
        self._start_learning(self.lesson.load(name, self.name, given, go_on=True))

    def _do_open_run(self, name: str) -> None:
        self._need("ready")
        given = self._given.get(self.name, {})
        self._start_learning(self.lesson.load(name, self.name, given, go_on=False))

    def _start_learning(self, end: Awaitable[str]) -> None:
        self.note = ""
        self._set_mode("learning")
        task = asyncio.get_running_loop().create_task(self._learn(end))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _learn(self, end: Awaitable[str]) -> None:
        self.note = await end
        self._back_to_ready()
        self.description.catch_up()
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
        given = self._given.get(self.name, {})
        balancing = Balancing(self.name, given, self.lesson.policy(self.system), self._rng)
        self.note = ""
        self._set_mode("balancing")
        self.balancing = balancing
        self._clock.period = self.system.dt

    def _do_rest(self) -> None:
        self._need("balancing")
        self._back_to_ready()

    def _do_push(self, x: float | None) -> None:
        if self.balancing is not None:
            self.balancing.hand.hold(x)

    def _do_poke(self, side: float) -> None:
        if self.balancing is not None:
            self.balancing.hand.poke(side)

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
            except Exception as error:
                # Whatever a policy or an environment raises: time goes on, and the page is told.
                self._stumble(error)

    def _stumble(self, error: Exception) -> None:
        """End what went wrong, and keep what was recorded of it."""
        said = str(error) if isinstance(error, MisstepError) else f"{type(error).__name__}: {error}"
        self.note = f"it was stopped: {' '.join(said.split())}"
        if self.mode == "driving":
            self._end()
        else:
            self._back_to_ready()
            self.changed()

    def _tick(self) -> None:
        if self.mode == "countdown":
            self._left -= 1
            if self._left <= 0:
                self._drive()
                self.changed()
            self._send_frame()
        elif self.mode == "driving":
            self.driving.step()
            if self.driving.attempt.over:
                self._end()
            else:
                self._send_frame()
        elif self.balancing is not None:
            self.balancing.step()
            self._send_frame()
        if self.mode in _AHEAD and time.monotonic() - self._heard > SILENCE:
            self._pause("nothing was heard from the page: the attempt waits")

    # The end

    def close(self) -> None:
        """Put aside what is being recorded, and end the worker."""
        try:
            if self.mode in ("driving", "paused", "countdown"):
                trajectory = self.driving.recorded("end: the server was stopped")
                if trajectory is not None:
                    self.attempts.put_aside(trajectory)
        finally:
            self.worker.stop()


def attempt_json(id: int, trajectory: Trajectory) -> str:
    """Return an attempt as JSON."""
    return to_json({"id": id, **show_recording(trajectory)})
