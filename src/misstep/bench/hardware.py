"""What this machine can do at best, and how long the work would take at that speed.

Three figures are measured in the same run as everything else: bytes moved by a copy that fits no
cache, multiply-adds in registers, and exponentials by the polynomial that the mixture uses. The
bare time of a task is what its operations and bytes take at those rates when nothing stands in the
way; no program can be faster that does the same operations.
"""

import math
import os
import platform
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import njit, prange

from misstep.mixture.elementary import exp_nonpositive

_COPY = 8_000_000
_BLOCK = 512
_DEGREE = 32
_REPEATS = 5


class Rates(NamedTuple):
    """What a number of threads reached."""

    threads: int
    bytes_per_second: float
    flops_per_second: float
    """A multiply-add counts as two."""
    exps_per_second: float


class Work(NamedTuple):
    """What a task cannot do without."""

    n_bytes: float
    flops: float
    exps: float

    def seconds(self, rates: Rates) -> float:
        """Return the bare time: bytes move while operations are done."""
        computing = self.flops / rates.flops_per_second + self.exps / rates.exps_per_second
        return max(self.n_bytes / rates.bytes_per_second, computing)


def em_work(n: int, d: int, K: int, iterations: int) -> Work:
    """Return the work of EM: each iteration reads the data once.

    Per sample and component: a triangular product for the distance, d(d+1) + 2d flops, and an
    exponential; first and second moments, d(d+1) + 2d flops.
    """
    each = 2.0 * d * (d + 1) + 4.0 * d
    return Work(8.0 * n * d * iterations, each * n * K * iterations, float(n * K * iterations))


def query_work(d: int, m: int, K: int) -> Work:
    """Return the work of one mode: condition once, look at the density three times.

    Three is the least that an ascent can do: where it stands, a step, and that it is over.
    """
    n = d - m
    condition = n * (n + 1) + 2 * n + 2 * m * n
    density = 2 * m * (m + 1) + 20
    return Work(0.0, float(K * (condition + 3 * density)), float(K * (1 + 3 * 3)))


def measure_rates(threads: int) -> Rates:
    """Measure this machine with `threads` threads.

    Parameters
    ----------
    threads : int
        At most `numba.config.NUMBA_NUM_THREADS`.
    """
    before = numba.get_num_threads()
    numba.set_num_threads(threads)
    try:
        source, target = np.ones(_COPY), np.zeros(_COPY)
        block = np.linspace(-1.0, 0.0, _BLOCK)
        rounds = 40_000
        work = float(threads * rounds * _BLOCK)
        copying = least_seconds(lambda: _copy(source, target), _REPEATS)
        adding = least_seconds(lambda: _multiply_add(block, threads, rounds), _REPEATS)
        raising = least_seconds(lambda: _exponentials(block, threads, rounds), _REPEATS)
        return Rates(threads, 16.0 * _COPY / copying, 2.0 * _DEGREE * work / adding, work / raising)
    finally:
        numba.set_num_threads(before)


def describe_machine() -> dict[str, Any]:
    """Return what stands beside a measurement: processor, cores, memory, system, versions."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "numpy": np.__version__,
        "numba": numba.__version__,
    }


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            for line in lines:
                if line.startswith("model name"):
                    return line.partition(":")[2].strip()
    except OSError:  # not Linux
        return platform.processor() or platform.machine()
    return platform.machine()


def least_seconds(run: Callable[[], object], repeats: int) -> float:
    """Return the least time of several, s; a first one, which may compile, does not count."""
    run()
    seconds = math.inf
    for _ in range(repeats):
        started = time.perf_counter()
        run()
        seconds = min(seconds, time.perf_counter() - started)
    return seconds


@njit(parallel=True, cache=True)
def _copy(source, target):  # type: ignore[no-untyped-def]
    for i in prange(len(source)):
        target[i] = source[i]


@njit(parallel=True, fastmath={"contract"}, cache=True)
def _multiply_add(block, threads, rounds):  # type: ignore[no-untyped-def]
    """Evaluate a polynomial of degree `_DEGREE` by Horner: one load for many operations."""
    total = np.zeros(threads)
    for t in prange(threads):
        out = block.copy()
        for _ in range(rounds):
            for i in range(_BLOCK):
                x = block[i]
                p = out[i]
                for _ in range(_DEGREE):
                    p = p * x + 0.5
                out[i] = p
        total[t] = out[0]
    return total


@njit(parallel=True, cache=True)
def _exponentials(block, threads, rounds):  # type: ignore[no-untyped-def]
    total = np.zeros(threads)
    for t in prange(threads):
        out = np.zeros(_BLOCK)
        for r in range(rounds):
            for i in range(_BLOCK):
                out[i] += exp_nonpositive(block[i] - 1e-9 * r)
        total[t] = out[0]
    return total
