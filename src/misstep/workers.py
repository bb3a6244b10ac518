"""Many pieces of work, spread over processes that end with this one.

Work that shares a fate, such as the parts of one report, goes to a `process_pool`: its first error
ends it all. Independent work goes through `run_in_processes`, where a worker that is killed costs
nothing but the job it had in hand, and that job is tried once more.
"""

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, as_completed, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, TypeVar

from misstep.errors import MisstepError
from misstep.threads import available_cores

J = TypeVar("J")
R = TypeVar("R")

Progress = Callable[[int, int, str], None]
"""``progress(done, total, what)``."""

ATTEMPTS = 2
"""How often a job is tried whose worker dies."""


class Lost(NamedTuple):
    """What stands in for the result of a job whose workers died."""

    reason: str


class Tally:
    """Counts work and reports each piece as it is done; waits for what is in progress.

    Parameters
    ----------
    progress : callable
        Called with how much is done, how much there is, and what was done last.
    total : int
    done : int
        What was done before.
    """

    def __init__(self, progress: Progress, total: int, done: int = 0) -> None:
        self.total, self.done = total, done
        self._progress = progress
        self._expected: dict[Future[None], str] = {}

    def expect(self, future: Future[None], what: str) -> None:
        """Add a piece of work to wait for."""
        self._expected[future] = what

    def wait(self) -> None:
        """Wait for all that is expected; the first error ends it."""
        for future in as_completed(self._expected):
            future.result()
            self.count(self._expected[future])
        self._expected.clear()

    def count(self, what: str) -> None:
        """Report one more piece as done."""
        self.done += 1
        self._progress(self.done, self.total, what)


def check_workers(workers: int | None) -> int:
    """Return how many processes to use: for None, one for each core that this process may use.

    Raises
    ------
    MisstepError
        If `workers` is below 1.
    """
    if workers is not None and workers < 1:
        raise MisstepError(f"workers is {workers}: at least one process is needed")
    return workers or available_cores()


class _Pool(ProcessPoolExecutor):
    """Holds interrupts back from its processes until they know what to do with them.

    A Ctrl-C goes to all processes of a terminal, and one that was still importing would print a
    traceback. A process inherits what is held back; the initializer lets it through.
    """

    def submit(self, fn: Callable[..., R], /, *args: Any, **kwargs: Any) -> "Future[R]":
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            return super().submit(fn, *args, **kwargs)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def process_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Open processes that end with this one and drop what is waiting after an error."""
    context = multiprocessing.get_context("spawn")
    heard, said = context.Pipe(duplex=False)
    pool = _Pool(workers, context, initializer=_end_with_parent, initargs=(heard,))
    try:
        yield pool
    except BaseException:
        said.close()  # what they are at is wanted no more, and may take long
        # A Ctrl-C ends them too, and then the pool may be closing itself at this very moment.
        with suppress(OSError):
            pool.shutdown(wait=False, cancel_futures=True)
        raise
    finally:
        heard.close()
    pool.shutdown()
    said.close()


def run_in_processes(
    function: Callable[[J], R], jobs: Sequence[J], workers: int
) -> Iterator[tuple[J, R | Lost]]:
    """Run a function on each job, in processes of this machine.

    Parameters
    ----------
    function : callable
        Of a module, so that another process finds it.
    jobs : sequence
    workers : int
        Processes.

    Yields
    ------
    job, result
        As they are done, in any order. The result is `Lost` if the process died with the job twice;
        an exception that `function` raises passes through.
    """
    waiting = deque((job, 1) for job in jobs)
    with ExitStack() as stack:
        # One process a pool: when it dies it is known which job it had in hand.
        free = [stack.enter_context(process_pool(1)) for _ in range(min(workers, len(jobs)))]
        running: dict[Future[R], tuple[ProcessPoolExecutor, J, int]] = {}
        while waiting or running:
            while waiting and free:
                pool, (job, attempt) = free.pop(), waiting.popleft()
                running[_submit(pool, function, job)] = pool, job, attempt
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                pool, job, attempt = running.pop(future)
                if not isinstance(future.exception(), BrokenProcessPool):
                    free.append(pool)
                    yield job, future.result()
                    continue
                free.append(stack.enter_context(process_pool(1)))
                if attempt < ATTEMPTS:
                    waiting.appendleft((job, attempt + 1))
                else:
                    yield job, Lost(f"its process died {ATTEMPTS} times: killed, or out of memory")


def _submit(pool: ProcessPoolExecutor, function: Callable[[J], R], job: J) -> Future[R]:
    """Return the future of a job; it bears the error too if the process has died while idle."""
    try:
        return pool.submit(function, job)
    except BrokenProcessPool as error:
        future: Future[R] = Future()
        future.set_exception(error)
        return future


def _end_with_parent(heard: Connection) -> None:
    """Have a worker end when its parent does or says so, and at Ctrl-C without a word.

    However the parent ends, nobody is at the other end of the pipe `heard` any more.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})

    def watch() -> None:
        heard.poll(None)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def silent(done: int, total: int, what: str) -> None:
    """Show no progress."""
