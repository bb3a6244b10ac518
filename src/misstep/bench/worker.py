"""A contender's process, seen from the bench: it is handed jobs and gives answers.

It runs with a stated number of threads, is killed when a job takes too long, and may die; the next
job then finds a new one.
"""

import json
import os
import queue
import subprocess
import threading
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np
from numpy.typing import NDArray

from misstep.bench.peers import Peer

_HERE = Path(__file__).parent
_THREADS = ("OMP", "OPENBLAS", "MKL", "NUMBA", "BLIS", "VECLIB_MAXIMUM")


class Worker:
    """The process of one contender; a context manager, which ends it.

    Parameters
    ----------
    peer : Peer
    python : Path
        The interpreter of the environment that holds the contender.
    threads : int
        What the libraries may use.
    folder : Path
        For arrays on their way.
    """

    def __init__(self, peer: Peer, python: Path, threads: int, folder: Path) -> None:
        self.peer = peer
        self.threads = threads
        self._python = python
        self._folder = folder
        self._process: subprocess.Popen[str] | None = None
        self._answers: queue.Queue[str] = queue.Queue()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    def ask(
        self,
        operation: str,
        arrays: Mapping[str, NDArray[np.float64]],
        limit: float,
        **settings: float,
    ) -> dict[str, Any]:
        """Hand over a job and return its answer, which holds an ``error`` if there is no other.

        Parameters
        ----------
        operation : str
            One of `misstep.bench.contenders.__main__`.
        arrays : mapping of str to ndarray
        limit : float
            Seconds after which the process is killed.
        **settings
            Numbers that the operation takes.
        """
        paths = {}
        for name, array in arrays.items():
            paths[name] = str(self._folder / f"{name}.npy")
            np.save(paths[name], array, allow_pickle=False)
        process = self._running()
        job = json.dumps({"operation": operation, "arrays": paths, **settings})
        try:
            _open(process.stdin).write(job + "\n")
            _open(process.stdin).flush()
            line = self._answers.get(timeout=limit)
        except queue.Empty:
            self.stop()
            return {"error": f"longer than {limit:.0f} s"}
        except BrokenPipeError:
            line = ""
        if not line.endswith("\n"):  # it may die in the middle of an answer
            self.stop()
            return {"error": "its process died"}
        answer: dict[str, Any] = json.loads(line)
        return answer

    def stop(self) -> None:
        """End the process, if there is one."""
        if self._process is None:
            return
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            # What was on its way to a process that died stays where it is.
            try:
                _open(stream).close()
            except BrokenPipeError:
                continue
        self._process = None

    def _running(self) -> subprocess.Popen[str]:
        if self._process is None:
            self._answers = queue.Queue()
            environment = {f"{name}_NUM_THREADS": str(self.threads) for name in _THREADS}
            self._process = subprocess.Popen(  # noqa: S603 - our own words
                # -P keeps the folder that happens to be the present one out of the way.
                (str(self._python), "-P", "-m", "contenders", self.peer.module),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                env={**os.environ, **environment, "PYTHONPATH": str(_HERE)},
            )
            reader = (_open(self._process.stdout), self._answers)
            threading.Thread(target=_read, args=reader, daemon=True).start()
        return self._process


def _read(stream: IO[str], answers: "queue.Queue[str]") -> None:
    """Pass lines on, the last one perhaps cut off, and an empty one at the end."""
    try:
        for line in stream:
            answers.put(line)
    except ValueError:  # closed by `stop`
        return
    answers.put("")


def _open(stream: IO[str] | None) -> IO[str]:
    if stream is None:
        raise RuntimeError("the process was started without pipes")
    return stream
