"""Tiny jobs of the commands that serve somebody: `serve` a robot, and `live` a page.

The robot is a simulation in lock-step, the page a program that says what a browser would. Both
note what they are told to be kept, and what they are told to have gone wrong.
"""

import json
import re
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jobs import INPUT, RUN, Counts, Job, trials_of
from nursery import SECRET, Child
from traces import Trace
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from misstep import MisstepError, load_dataset, make_system
from misstep.live.attempts import PENDING
from misstep.robot.client import RobotClient, drive
from misstep.robot.service import Start

PATIENCE = 60.0  # s

_DATA, _LEARNED = "live", "001-random-linear"
_TRIALS = 4


class _Thread:
    """A visitor in a thread of its own."""

    def __init__(self, child: Child, visit: Callable[["_Thread"], None]) -> None:
        self.told: Counts = {}
        self.problems: list[str] = []
        self._child, self._closing = child, threading.Event()
        self._thread = threading.Thread(target=self._visit, args=(visit,), daemon=True)
        self._thread.start()

    def is_done(self) -> bool:
        """Return whether the visitor has nothing more to say."""
        return not self._thread.is_alive()

    def close(self) -> None:
        """End it."""
        self._closing.set()
        self._thread.join(PATIENCE)

    def wait_for(self, condition: Callable[[], bool]) -> None:
        """Wait until something holds; raise MisstepError if nobody waits any more."""
        while not condition():
            if self._closing.is_set():
                raise MisstepError("the command has ended")
            time.sleep(0.002)

    def _visit(self, visit: Callable[["_Thread"], None]) -> None:
        try:
            visit(self)
        except (MisstepError, OSError, WebSocketException) as error:
            self.problems.append(str(error))


class _Robot(RobotClient):
    """A robot that notes which trials it was told to be over and kept."""

    def __init__(self, address: str, told: Counts) -> None:
        super().__init__(address, SECRET, patience=PATIENCE, timeout=PATIENCE)
        self._told = told

    def start(self) -> Start | None:
        start = super().start()
        if start is not None:
            self._told["trials"] = start.number  # the number of the next one
        return start


class ServeJob(Job):
    """A run whose trials a simulated robot makes."""

    command = "serve"
    serves = True

    def words(self, outside: Path) -> list[str]:
        """Return the words of the command."""
        return (
            f"serve {RUN} --from {INPUT} --system cartpole --learner donut "
            "--state theta,theta_dot --max-trials 8 --simulated-time --watchdog-ms 60000 "
            f"--deadline-ms 60000 --socket unix:{outside / 'socket'}"
        ).split()

    def visit(self, outside: Path, child: Child) -> _Thread:
        """Drive a simulation."""
        path = outside / "socket"

        def visit(thread: _Thread) -> None:
            thread.wait_for(lambda: _is_listening(path))
            with _Robot(f"unix:{path}", thread.told) as robot:
                drive(robot, make_system("cartpole", duration=2.0))

        path.unlink(missing_ok=True)
        return _Thread(child, visit)

    def told(self, child: Child) -> Counts:
        """Return how many trials were reported."""
        return {"trials": max(map(int, re.findall(r"(\d+) trials in all", child.out)), default=0)}

    def kept(self, folder: Path) -> Counts:
        """Return how many trials there are."""
        return {"trials": trials_of(folder / RUN)}

    def going_on(self, folder: Path, outside: Path) -> list[str]:
        """Resume the run with the simulation; begin it where it had not begun."""
        if (folder / RUN / "run.json").exists():
            return ["resume", RUN]
        return (
            f"learn cartpole --from {INPUT} --learner donut --state theta,theta_dot "
            f"--max-trials 8 --out {RUN}"
        ).split()

    def comparable(self, held: Trace) -> Trace:
        """Return everything but the log: a trial that is abandoned is in it too."""
        return {path: value for path, value in held.items() if not path.endswith(".log")}


class LiveJob(Job):
    """A page on which recordings are dropped, something is learned, and an attempt is driven."""

    command = "live"
    serves = True
    ends = False

    def words(self, outside: Path) -> list[str]:
        """Return the words of the command."""
        told = outside / "live.json"
        told.unlink(missing_ok=True)
        return f"live --no-browser --port 0 --data {_DATA} --json {told}".split()

    def visit(self, outside: Path, child: Child) -> _Thread:
        """Do what a person does."""
        content = (self.source / INPUT).read_bytes()
        told = outside / "live.json"

        def visit(thread: _Thread) -> None:
            thread.wait_for(told.exists)
            _Page(json.loads(told.read_text())["url"], thread).use(content)

        return _Thread(child, visit)

    def told(self, child: Child) -> Counts:
        """Return nothing: the page is told."""
        return {}

    def kept(self, folder: Path) -> Counts:
        """Return how many attempts and trials there are."""
        place = folder / _DATA / "cartpole"
        attempts, pending = place / "attempts.h5", place / PENDING
        kept = len(load_dataset(attempts)) if attempts.exists() else 0
        driven = max(0, kept - 3) + (len(load_dataset(pending)) if pending.exists() else 0)
        return {
            "attempts": kept,
            "attempts driven": driven,
            "trials": trials_of(place / "runs" / _LEARNED),
        }

    def going_on(self, folder: Path, outside: Path) -> list[str]:
        """Resume the run that was being learned; without one there is nothing to go on with."""
        run = folder / _DATA / "cartpole" / "runs" / _LEARNED
        if (run / "run.json").exists():
            return ["resume", str(run.relative_to(folder))]
        return []

    def is_right(self, path: str, held: Any, before: Trace, whole: Trace) -> bool:
        """Say whether a file is right; what was driven by hand is new every time."""
        if path.endswith("attempts.h5"):
            return bool(held[:3] == whole[path][:3])
        if "/runs/" not in path and path != INPUT:
            return True
        return super().is_right(path, held, before, whole)

    def comparable(self, held: Trace) -> Trace:
        """Return the run that was learned."""
        return {path: value for path, value in held.items() if "/runs/" in path}


class _Page:
    """A page without a browser."""

    def __init__(self, url: str, thread: _Thread) -> None:
        self._url, self._thread = url, thread
        self._last: dict[str, Any] = {}

    def use(self, content: bytes) -> None:
        """Drop recordings, learn from them, drive an attempt until it falls, and keep it."""
        told = self._thread.told
        server = self._url.split("/")[2]
        origin = f"http://{server}"
        with connect(
            f"ws://{server}/{self._url.split('/')[3]}/socket",
            origin=origin,  # type: ignore[arg-type]
            open_timeout=PATIENCE,
            max_size=2**24,
        ) as self._socket:
            self._until(lambda m: True)
            self._drop(content)
            told["attempts"] = 3
            self._send("pace", watch=False)
            self._send("learn", learner="random-linear", state=[], max_trials=_TRIALS, seed=3)
            ends = "finished", "succeeded"
            self._until(lambda m: m["mode"] == "ready" and m["run"] and m["run"]["status"] in ends)
            self._send("settings", strength=1.0, speed=2.0, start_angle=20.0, countdown=0)
            self._send("begin")
            self._send("input", v=[1.0], n=1)
            self._until(lambda m: m["mode"] == "ended")
            told["attempts driven"] = 1
            self._send("keep")
            self._until(lambda m: m["mode"] == "ready")
            told["attempts"] = 4

    def _drop(self, content: bytes) -> None:
        asked = urllib.request.Request(  # noqa: S310 - our own server
            f"{self._url}api/upload?name=D.h5", data=content, method="PUT"
        )
        try:
            urllib.request.urlopen(asked, timeout=PATIENCE).close()  # noqa: S310
        except urllib.error.HTTPError as error:
            said = error.read().decode(errors="replace")  # plain text from a server that is ending
            raise MisstepError(said) from error

    def _send(self, kind: str, **values: Any) -> None:
        self._socket.send(json.dumps({"t": kind, **values}))

    def _until(self, accept: Callable[[dict[str, Any]], Any]) -> None:
        """Hear what there is to hear until the session is as wanted."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            message = json.loads(self._socket.recv(timeout=PATIENCE))
            if message["t"] == "problem":
                raise MisstepError(message["text"])
            if message["t"] != "session":
                continue
            if "cannot " in message["note"]:
                raise MisstepError(message["note"])
            if message["mode"] == "paused":  # on a busy machine silence is soon too long
                self._send("resume")
            run = message["run"]
            if run is not None:
                self._thread.told["trials"] = len(run["trials"])
            if accept(message):
                return
        raise MisstepError("the page waited in vain")


def _is_listening(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX) as probe:
        return probe.connect_ex(str(path)) == 0
