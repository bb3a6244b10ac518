import os
import subprocess
import sys
import threading

import pytest

from misstep.threads import available_cores, thread_pool

INTERRUPTED = """
import threading

start = threading.Thread.start

def start_and_interrupt(thread):
    start(thread)
    if threading.current_thread() is threading.main_thread():
        raise KeyboardInterrupt  # as a Ctrl-C does that comes now

threading.Thread.start = start_and_interrupt
from misstep.threads import thread_pool
try:
    thread_pool(3)
except KeyboardInterrupt as error:
    kept = error  # and with it all that was at hand
    print("interrupted")
"""


def test_an_interrupt_while_threads_start_leaves_none_behind():
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "interrupted\n", "")


def test_all_threads_run_before_there_is_work_and_end_with_the_pool():
    with thread_pool(3, "ours") as pool:
        ours = {t for t in threading.enumerate() if t.name.startswith("ours")}
        assert len(ours) == 3
        names = set(pool.map(lambda _: threading.current_thread().name, range(100)))
        assert names <= {t.name for t in ours}
    assert not any(t.is_alive() for t in ours)


def test_a_system_without_threads_left_is_told(monkeypatch):
    begun = []

    def start(thread, real=threading.Thread.start):
        begun.append(thread)
        if len(begun) == 3:  # the one that starts the others, one of them, and one too many
            raise RuntimeError("can't start new thread")
        real(thread)

    monkeypatch.setattr(threading.Thread, "start", start)
    with pytest.raises(RuntimeError, match="can't start"):
        thread_pool(2)
    assert not any(t.is_alive() for t in begun)


def test_cores_are_those_of_this_process():
    assert 1 <= available_cores() <= os.cpu_count()
