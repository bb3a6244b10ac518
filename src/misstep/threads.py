"""Threads that a Ctrl-C does not leave behind, and how many cores there are for them."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor


def available_cores() -> int:
    """Return how many cores this process may use, which can be fewer than there are."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:
        return os.cpu_count() or 1


def thread_pool(threads: int, name: str = "") -> ThreadPoolExecutor:
    """Return a pool of threads all of which are running already.

    A pool starts its threads as work comes in. A Ctrl-C between the start of one and the line that
    notes it leaves a thread that nobody ends, and Python waits for it for ever. Only the main
    thread is interrupted, so another one starts them here.

    Raises
    ------
    RuntimeError
        If the system has no thread or memory left.
    """
    pool = ThreadPoolExecutor(threads, name)
    errors: list[Exception] = []
    starter = threading.Thread(target=_start_all, args=(pool, threads, errors))
    starter.start()
    starter.join()
    if errors:
        pool.shutdown()
        raise errors[0]
    return pool


def _start_all(pool: ThreadPoolExecutor, threads: int, errors: list[Exception]) -> None:
    """Hand in a piece of work for each thread that lasts until all have one."""
    done = threading.Event()
    try:
        for _ in range(threads):
            pool.submit(done.wait)
    except (MemoryError, RuntimeError) as error:
        errors.append(error)
    finally:
        done.set()
