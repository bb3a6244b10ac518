"""Studies on Ray: the same cells on the cores of this machine or of a whole cluster.

The only file that imports Ray. Results come back to the process that asked for them, so that the
machines of a cluster need misstep installed and no common disk.
"""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import Any, TypeVar

from misstep.errors import MisstepError
from misstep.workers import ATTEMPTS, Lost

J = TypeVar("J")
R = TypeVar("R")

PATIENCE = 30.0
"""How long a cluster is waited for, s."""

_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_task_oom_retries": str(ATTEMPTS - 1),
}

# Ray itself waits for a cluster for minutes, and not always in Python: so another process tries.
_PROBE = "import sys, ray; ray.init(address=sys.argv[1], log_to_driver=False)"


def run_on_ray(
    function: Callable[[J], R], jobs: Sequence[J], workers: int | None, address: str | None
) -> Iterator[tuple[J, R | Lost]]:
    """Run a function on each job, on Ray; see `misstep.workers.run_in_processes`.

    Parameters
    ----------
    function : callable
    jobs : sequence
    workers : int or None
        Jobs at a time; on a cluster None means all of its cores.
    address : str or None
        Of a cluster, ``"host:port"`` or ``"auto"``; None starts Ray on this machine.

    Yields
    ------
    job, result
        As they are done.
    """
    with _session(workers, address) as ray:
        remote = ray.remote(max_retries=ATTEMPTS - 1, num_cpus=1)(function)
        waiting = list(reversed(jobs))
        running: dict[Any, J] = {}
        most = len(jobs) if workers is None else workers
        while waiting or running:
            while waiting and len(running) < most:
                job = waiting.pop()
                running[remote.remote(job)] = job
            for reference in ray.wait(list(running))[0]:
                job = running.pop(reference)
                try:
                    result: R | Lost = ray.get(reference)
                except (ray.exceptions.WorkerCrashedError, ray.exceptions.OutOfMemoryError):
                    result = Lost(f"its process died {ATTEMPTS} times: killed, or out of memory")
                except ray.exceptions.NodeDiedError:
                    result = Lost("its machine went away")
                yield job, result


def check_ray(address: str | None) -> None:
    """Make sure that there is a Ray to run on, before anything else is done.

    Raises
    ------
    MisstepError
        If Ray is not installed, or no cluster answers at the address.
    """
    _import_ray()
    if address is not None:
        _check_cluster(address)


@contextmanager
def _session(workers: int | None, address: str | None) -> Iterator[Any]:
    """Start Ray or join a cluster, and leave it at the end."""
    ray = _import_ray()
    if address is None:
        # A cluster of its own, also where another one runs here or RAY_ADDRESS names one: without
        # this word Ray would join that one, and refuse to be told how many processes to use.
        options: dict[str, Any] = {
            "address": "local",
            "num_cpus": workers,
            "include_dashboard": False,
            "_node_ip_address": "127.0.0.1",
        }
    else:
        options = {"address": address}
    ray.init(**options, log_to_driver=False, logging_level="ERROR")
    try:
        yield ray
    finally:
        ray.shutdown()


def _import_ray() -> ModuleType:
    for name, value in _SETTINGS.items():
        os.environ.setdefault(name, value)
    try:
        import ray
    except ImportError as error:
        raise MisstepError("the engine ray needs Ray: pip install 'misstep[ray]'") from error
    return ray


def _check_cluster(address: str) -> None:
    words = [sys.executable, "-c", _PROBE, address]
    hint = (
        "start one with `ray start --head` (RAY_AUTH_MODE=token joins one that asks for a token), "
        "or leave --address out to use this machine"
    )
    try:
        probe = subprocess.run(  # noqa: S603 - our own words
            words, capture_output=True, text=True, timeout=PATIENCE
        )
    except subprocess.TimeoutExpired as error:
        raise MisstepError(
            f"no Ray cluster answers at {address} within {PATIENCE:g} s: {hint}"
        ) from error
    if probe.returncode != 0:
        reason = (probe.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise MisstepError(f"cannot join a Ray cluster at {address} ({reason}): {hint}")
