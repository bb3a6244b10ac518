"""What is being learned, and what has been: the runs of one system and the one on the desk.

A run is a folder that every command of misstep can use. The worker makes it, trial by trial, and
tells each trial as it is done; after each it waits until the page has shown it, or goes on at once
where nobody wants to watch.
"""

import json
import re
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from misstep.errors import MisstepError
from misstep.learners import LEARNERS, LearnedPolicy
from misstep.live.worker import StoppedError, Worker
from misstep.runs import CONFIG, load_config, load_run
from misstep.storage import as_file_name, make_folder
from misstep.systems import System

_RUN_NAME = re.compile(r"([0-9]{3,})-[\w.-]+")


class Lesson:
    """The runs of one system.

    Parameters
    ----------
    worker : Worker
    folder : Path
        Of the runs; made if there is none.
    key : int
        First number of what is on the desk; goes up with each run that is put there.
    changed : callable
        Called when there is something new to be seen.
    """

    def __init__(self, worker: Worker, folder: Path, key: int, changed: Callable[[], None]) -> None:
        make_folder(folder)
        self._worker = worker
        self._folder = folder
        self._changed = changed
        self.key = key
        self.watch = True
        """Whether each trial is watched before the next is made."""
        self.run: dict[str, Any] | None = None
        """What the page is told of the run on the desk."""
        self.trials: list[str] = []
        """Its trials as JSON."""
        self.demonstrations: str | None = None
        """What it started from as JSON, where that is not what has been kept now."""
        self._watched = 0
        self._policy: LearnedPolicy | None = None

    def runs(self) -> list[str]:
        """Return the names of the runs that are kept, last first."""
        numbers = self._numbers()
        kept = [name for name in numbers if (self._folder / name / CONFIG).exists()]
        return sorted(kept, key=numbers.__getitem__, reverse=True)

    def run_folder(self, name: str) -> Path:
        """Return the folder of a run by its name.

        Raises
        ------
        MisstepError
            If there is none of that name.
        """
        if name not in self.runs():
            raise MisstepError("there is no such run")
        return self._folder / name

    def learn(
        self, learner: str, state: Sequence[str], max_trials: int, shown: int, **job: Any
    ) -> Awaitable[str]:
        """Start a new run, and return what waits for its end; see `_watch_over`.

        Parameters
        ----------
        learner : str
        state : sequence of str
        max_trials : int
        shown : int
            Demonstrations that it starts from.
        **job
            What else the worker's job ``learn`` takes.
        """
        number = 1 + max(self._numbers().values(), default=0)
        name = f"{number:03d}-{as_file_name(learner)}"
        self._put_on_desk(name, learner, state, max_trials, shown)
        out = str(self._folder / name)
        given = {"learner": learner, "state": list(state), "max_trials": max_trials, "out": out}
        return self._watch_over("learn", {**given, **job})

    def load(
        self, name: str, system: str, parameters: Mapping[str, Any], *, go_on: bool
    ) -> Awaitable[str]:
        """Put a run on the desk, and go on with it if wanted; return what waits for its end.

        Parameters
        ----------
        name : str
        system : str
            Which it has to drive.
        parameters : mapping
            Of that system, as the server was started with.
        go_on : bool

        Raises
        ------
        MisstepError
            If there is no such run, or it drives another system.
        """
        folder = self.run_folder(name)
        config = load_config(folder)
        if config.system != system:
            raise MisstepError(f"that run drives {config.system}: choose that system first")
        self._put_on_desk(name, config.learner, config.state, config.max_trials, 0)
        job = {"folder": str(folder), "system": system, "parameters": parameters}
        return self._watch_over("resume" if go_on else "show_run", job)

    def close(self) -> None:
        """Take the run off the desk."""
        self.run, self.trials, self.demonstrations, self._policy = None, [], None, None

    def watched(self, trial: int) -> None:
        """Say that the last trial has been watched to its end."""
        if trial == len(self.trials):
            self._watched = trial
            self._worker.reply("next")

    def pace(self, watch: bool) -> None:
        """Say whether trials are to be watched."""
        self.watch = watch
        if not watch:
            self._worker.reply("next")

    def halt(self) -> None:
        """Stop: at once, but for what a trial that is being made has to lose."""
        if self._worker.waiting:
            self._worker.reply("halt")
        else:
            self._worker.stop()

    def policy(self, system: System) -> LearnedPolicy:
        """Return the policy of the first success, or else of the last trial, for `system`.

        Raises
        ------
        MisstepError
            If there is no trial yet.
        """
        if self.run is None or not self.trials:
            raise MisstepError("nothing has been learned yet")
        if self._policy is None:
            run = load_run(self._folder / self.run["name"], system=system)
            self._policy = run.policies[(run.trials_to_success or len(run.trials)) - 1]
        return self._policy

    def replayed(self) -> tuple[dict[str, Any] | None, list[dict[str, Any]] | None]:
        """Return the run for a replay, and the recordings it started from if they are its own."""
        if self.run is None or self.demonstrations is None:
            return self.run, None
        shown = json.loads(self.demonstrations)
        numbered = [{"id": number, **one} for number, one in enumerate(shown, start=1)]
        return {**self.run, "own_demonstrations": False}, numbered

    def _numbers(self) -> dict[str, int]:
        """Return the numbers of the runs in the folder, by name."""
        found = [_RUN_NAME.fullmatch(path.name) for path in self._folder.glob("*")]
        return {match[0]: int(match[1]) for match in found if match}

    def _put_on_desk(
        self, name: str, learner: str, state: Sequence[str], max_trials: int, shown: int
    ) -> None:
        self.close()
        self.key += 1
        self._watched = 0
        self.run = {
            "key": self.key,
            "name": name,
            "folder": str(self._folder / name),
            "learner": learner,
            "rung": LEARNERS[learner].rung,
            "state": list(state),
            "max_trials": max_trials,
            "demonstrations": shown,
            "own_demonstrations": False,
            "trials": [],
            "status": "starting",
        }

    async def _watch_over(self, job: str, arguments: dict[str, Any]) -> str:
        """Wait for the end of a job; return what went wrong, empty if nothing did."""
        key, problem = self.key, ""
        try:
            status = await self._worker.do(job, self._hear, **arguments)
        except StoppedError:
            status = "halted"
        except MisstepError as error:
            status, problem = "failed", str(error)
        if self.run is not None and self.key == key:
            self.run["status"] = status
            if problem and not self.trials:
                self.close()
        return problem

    def _hear(self, kind: str, value: Any) -> None:
        if self.run is None:
            return
        if kind == "waits":
            if not self.watch or self._watched == len(self.trials):
                self._worker.reply("next")
            return
        self.run["status"] = "learning"
        if kind == "demonstrations":
            self.demonstrations = value
            self.run["own_demonstrations"] = True
        elif kind == "trial":
            self.trials.append(value["whole"])
            self.run["trials"].append(json.loads(value["summary"]))
        self._changed()
