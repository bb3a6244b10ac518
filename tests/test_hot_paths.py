"""Do the two hot paths still cost what they did? In instructions, which no busy machine changes.

A child process is stepped through each path by the kernel (ptrace), one instruction at a time: what
callgrind counts, without having to install it. The code is compiled for one fixed processor, so the
figures of ``hot_paths.json`` hold on every x86-64 Linux. A loop that no longer vectorises, an
allocation, a slower call from Python: all of it shows.

``python tests/test_hot_paths.py > tests/hot_paths.json`` stores the figures of today.
"""

import ctypes
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from hot_paths import PATHS

HERE = Path(__file__).parent
STORED = HERE / "hot_paths.json"
# Versions of Python differ by 6 % in calling a query, and by 1 % in what they call of a pass.
TOLERANCES = {"EM": 0.04, "query": 0.1}
SINGLESTEP = 9
KILL = 8
FIXED = {
    "NUMBA_CPU_NAME": "haswell",
    "NUMBA_CPU_FEATURES": "",
    "PYTHONHASHSEED": "0",
    "OMP_NUM_THREADS": "1",
}


class NotPermittedError(Exception):
    """A process may not be stepped through here."""


def count_instructions(**environment):
    """Return the instructions of every path by its name; all compiled code is made anew."""
    with tempfile.TemporaryDirectory() as cache:
        variables = {**os.environ, **FIXED, "NUMBA_CACHE_DIR": cache, **environment}
        child = subprocess.Popen([sys.executable, HERE / "hot_paths.py"], env=variables)
        try:
            return count(child.pid)
        finally:
            child.kill()
            child.wait()


def count(process):
    libc = ctypes.CDLL(None, use_errno=True)
    libc.ptrace.argtypes = (ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p)
    step, wait = libc.ptrace, os.waitpid
    wait_for_stop(process)
    counts = {}
    for name in PATHS:
        instructions, stopped_by = 0, signal.SIGTRAP
        while stopped_by != signal.SIGSTOP:
            if step(SINGLESTEP, process, None, None):
                raise NotPermittedError(os.strerror(ctypes.get_errno()))
            status = wait(process, 0)[1]
            assert os.WIFSTOPPED(status), f"the program ended in {name}"
            stopped_by = os.WSTOPSIG(status)
            instructions += 1
        counts[name] = instructions
    step(KILL, process, None, None)
    return counts


def wait_for_stop(process):
    status = os.waitpid(process, os.WUNTRACED)[1]
    assert os.WIFSTOPPED(status), "the program ended before its first path"


@pytest.fixture(scope="module")
def counts():
    if (platform.system(), platform.machine()) != ("Linux", "x86_64"):
        pytest.skip("the stored figures are those of x86-64 Linux")
    try:
        return count_instructions()
    except NotPermittedError as refusal:
        pytest.skip(f"no process may be stepped through here: {refusal}")


@pytest.mark.parametrize("name", PATHS)
def test_a_hot_path_costs_what_it_did(counts, name):
    stored = json.loads(STORED.read_text())[name]
    change = counts[name] / stored - 1.0
    assert abs(change) < TOLERANCES[name.partition(",")[0]], (
        f"{name}: {counts[name]:,} instructions, {change:+.1%}; if that is meant to be, store it"
    )


if __name__ == "__main__":
    print(json.dumps(count_instructions(), indent=2))
