"""How much memory a piece of Python took at its peak, in a process of its own.

From the system's own account, as `resource.getrusage` counts in what the process that started it
had in memory.
"""

import subprocess
import sys
from pathlib import Path

import pytest

STATUS = Path("/proc/self/status")
needs_status = pytest.mark.skipif(not STATUS.exists(), reason="needs Linux's /proc")

_PEAK = f"""
import sys
def peak():
    with open({str(STATUS)!r}) as file:
        return next(int(line.split()[1]) for line in file if line.startswith("VmHWM"))
"""


def run_with_peak(code, *words):
    """Run code that may call ``peak()`` [KiB]; return the lines that it prints."""
    done = subprocess.run(
        [sys.executable, "-c", _PEAK + code, *map(str, words)],
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.splitlines()
