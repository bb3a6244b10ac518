"""A process beside the server that does one job after the other, and ends with it.

A fit takes a second and a plan longer; in the server's own process, they would hold up the clock
of an attempt. A recording that somebody drops in can be anything; here it harms nobody. And a job
that is to stop at once is stopped by ending the process: what it writes, it writes atomically.
"""

import asyncio
import contextlib
import itertools
import multiprocessing
import os
import queue
import signal
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

from misstep.errors import MisstepError

OnNews = Callable[[str, Any], None]
"""``on_news(kind, value)``: what a job tells while it goes on."""


_HANG_UP = object()


class _Job(NamedTuple):
    result: "asyncio.Future[Any]"
    on_news: OnNews | None


class Worker:
    """The process, started when it is first needed and again when it has died.

    Made and used in an event loop.
    """

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._numbers = itertools.count(1)
        self._jobs: dict[int, _Job] = {}
        self._process: Any = None
        self._outgoing: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.waiting = False
        """Whether a job waits for `reply`."""

    def start(self) -> None:
        """Start the process, unless it runs."""
        if self._process is not None:
            if self._process.is_alive():
                return
            self._bury(self._process)  # its listener has not come to say so
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_work, args=(theirs,), daemon=True, name="misstep worker")
        # A Ctrl-C goes to all processes of a terminal; this one is for the server to end.
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            process.start()
        finally:
            signal.signal(signal.SIGINT, before)
        theirs.close()
        self._process, self._outgoing = process, queue.SimpleQueue()
        threading.Thread(target=_speak, args=(ours, self._outgoing), daemon=True).start()
        threading.Thread(target=self._listen, args=(ours, process), daemon=True).start()

    async def do(self, job: str, on_news: OnNews | None = None, /, **arguments: Any) -> Any:
        """Have a job of `misstep.live.jobs.JOBS` done, and return its result.

        Raises
        ------
        MisstepError
            That the job raised, or that the process ended before it was done.
        """
        self.start()
        number = next(self._numbers)
        result = self._loop.create_future()
        self._jobs[number] = _Job(result, on_news)
        try:
            self._outgoing.put((number, job, arguments))
            return await result
        finally:
            self._jobs.pop(number, None)

    def reply(self, word: str) -> None:
        """Tell the job that waits how to go on."""
        if self.waiting:
            self.waiting = False
            self._outgoing.put(word)

    def stop(self) -> None:
        """End the process and whatever it is doing."""
        process = self._process
        if process is not None:
            process.kill()
            process.join()
            self._bury(process)

    def _listen(self, pipe: Connection, process: Any) -> None:
        """Pass on what the process tells, in a thread of its own, until it ends."""
        with contextlib.suppress(EOFError, OSError, RuntimeError):  # RuntimeError: the loop is over
            while True:
                message = pipe.recv()
                self._loop.call_soon_threadsafe(self._hear, process, *message)
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._bury, process)

    def _hear(self, process: Any, number: int, kind: str, value: Any) -> None:
        if process is not self._process:  # what it had still said when it was stopped
            return
        if kind == "waits":
            self.waiting = True
        job = self._jobs.get(number)
        if job is None or job.result.done():
            return
        if kind == "done":
            job.result.set_result(value)
        elif kind == "error":
            job.result.set_exception(MisstepError(value))
        elif job.on_news is not None:
            job.on_news(kind, value)

    def _bury(self, process: Any) -> None:
        if process is not self._process:
            return
        self._process, self.waiting = None, False
        self._outgoing.put(_HANG_UP)
        for job in self._jobs.values():
            if not job.result.done():
                job.result.set_exception(StoppedError("it was stopped before it was done"))


def _speak(pipe: Connection, outgoing: "queue.SimpleQueue[Any]") -> None:
    """Pass on what is sent, in a thread of its own: a process that is busy does not read it."""
    with contextlib.suppress(OSError):  # it has died; the listener says so to all who wait
        while (message := outgoing.get()) is not _HANG_UP:
            pipe.send(message)


class StoppedError(MisstepError):
    """The worker's process ended before its job was done."""


def _work(pipe: Connection) -> None:
    """Do the jobs that come through the pipe until nobody is at its other end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with_parent()
    with contextlib.suppress(EOFError):
        while True:
            _do(pipe, *pipe.recv())


def _do(pipe: Connection, number: int, job: str, arguments: dict[str, Any]) -> None:
    from misstep.live.jobs import JOBS  # seconds of imports, in this process alone

    def tell(kind: str, value: Any) -> None:
        pipe.send((number, kind, value))

    def ask() -> str:
        tell("waits", None)
        # What is wanted meanwhile, such as a download, is done first.
        while not isinstance(message := pipe.recv(), str):
            _do(pipe, *message)
        return message

    try:
        tell("done", JOBS[job](tell, ask, **arguments))
    except MisstepError as error:
        tell("error", str(error))
    except EOFError:
        raise
    except Exception as error:
        # Whoever asked has to be told, or waits for ever; the process stays for the next job.
        tell("error", f"{job} failed: {type(error).__name__}: {' '.join(str(error).split())}")


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
