"""Processes that try slices of a target's cases, each with bounds on its time and memory.

A worker handles many cases. What it is at stands in memory that it shares with the parent, so that
when it crashes, or has to be ended because a case takes too long, the parent knows which case it
was, counts a finding, and lets a new worker go on with the next one.
"""

import ctypes
import json
import mmap
import os
import resource
import shutil
import signal
import tempfile
import time
import traceback
from pathlib import Path
from typing import NamedTuple, NoReturn

from fuzzing.cases import Attempt, Target, case_of, tried

LONGEST_CPU = 5.0
"""Seconds of computing that a case may take."""
LONGEST_WALL = 600.0
"""Seconds that a case may take on a machine that does other things, too."""
MOST_MEMORY = 2**30
"""Bytes by which a case may raise a worker's peak."""

_ADDRESS_ROOM = 4 * 2**30  # bytes beyond what a worker has when it starts
_LARGEST_FILE = 2**30  # bytes
_TICKS = os.sysconf("SC_CLK_TCK")
_PAGE = os.sysconf("SC_PAGE_SIZE")
_SCRATCH = Path("/dev/shm")  # noqa: S108 a disk in memory, where there is one


class Slice(NamedTuple):
    """Some cases of one target: ``start``, ... , ``stop - 1``."""

    target: Target
    seed: int
    start: int
    stop: int


class _Board(ctypes.Structure):
    """What a worker is at, for its parent to see."""

    _fields_ = (
        ("index", ctypes.c_int64),
        ("cpu", ctypes.c_double),  # s, of the process, when the case began
        ("began", ctypes.c_double),  # s, monotonic, likewise
        ("taken", ctypes.c_int64),
        ("refused", ctypes.c_int64),
        ("slowest", ctypes.c_double),  # s of computing, of one case
        ("slowest_index", ctypes.c_int64),
        ("peak", ctypes.c_int64),  # bytes beyond the start
    )


class Worker:
    """A process that tries the cases of a slice.

    Parameters
    ----------
    work : Slice

    Attributes
    ----------
    board : _Board
        What it is at.
    """

    def __init__(self, work: Slice) -> None:
        self.work = work
        self._shared = mmap.mmap(-1, ctypes.sizeof(_Board))
        self.board = _Board.from_buffer(self._shared)
        self.board.index = work.start - 1
        self.board.began = time.monotonic()
        self._folder = scratch()
        self._findings = self._folder / "findings.jsonl"
        self._findings.touch()
        self._pid = os.fork()
        if self._pid == 0:
            _work(work, self.board, self._folder)

    def ended(self) -> bool:
        """Return whether it has ended; end it if its case takes too long."""
        pid, status = os.waitpid(self._pid, os.WNOHANG)
        if pid:
            self._status = status
            return True
        cpu = _cpu_of(self._pid) - self.board.cpu
        wall = time.monotonic() - self.board.began
        if self.board.index >= self.work.start and (cpu > LONGEST_CPU or wall > LONGEST_WALL):
            self.kill()
            self._note(f"it takes more than {cpu:.0f} s of computing, {wall:.0f} s in all")
            return True
        return False

    def kill(self) -> None:
        """End it."""
        os.kill(self._pid, signal.SIGKILL)
        os.waitpid(self._pid, 0)
        self._status = 0

    def results(self) -> tuple[list[dict[str, object]], int]:
        """Return the findings, and the first case that is still to be tried."""
        if os.WIFSIGNALED(self._status):
            self._note(f"the process is ended by {signal.Signals(os.WTERMSIG(self._status)).name}")
        elif os.WEXITSTATUS(self._status):
            self._note("the target cannot be opened")
        findings = [json.loads(line) for line in self._findings.read_text().splitlines()]
        shutil.rmtree(self._folder)
        return findings, self.board.index + 1

    def _note(self, message: str) -> None:
        _append(self._findings, self.board.index, message)


def _work(work: Slice, board: _Board, folder: Path) -> NoReturn:
    """Try the cases, in the child; never returns."""
    code = 1
    try:
        die_with_parent()
        findings = folder / "findings.jsonl"
        attempt = opened(work.target, folder)
        start = _peak()
        for index in range(work.start, work.stop):
            case = case_of(work.target, work.seed, index)
            board.cpu, board.began = time.process_time(), time.monotonic()
            board.index = index
            verdict = tried(attempt, case)
            took = time.process_time() - board.cpu
            if took > board.slowest:
                board.slowest, board.slowest_index = took, index
            board.peak = max(board.peak, _peak() - start)
            if verdict.kind == "finding":
                _append(findings, index, verdict.message)
            elif verdict.kind == "taken":
                board.taken += 1
            else:
                board.refused += 1
            if board.peak > MOST_MEMORY:
                _append(findings, index, f"it takes {board.peak} bytes of memory")
                break  # the next worker's peak starts anew
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def die_with_parent() -> None:
    """Have this process end when its parent does."""
    set_parent_death_signal = 1
    ctypes.CDLL(None).prctl(set_parent_death_signal, signal.SIGKILL)


def scratch() -> Path:
    """Make a folder, in memory where there is a place for that."""
    place = _SCRATCH if _SCRATCH.is_dir() else None
    return Path(tempfile.mkdtemp(prefix="misstep-fuzz-", dir=place))


def opened(target: Target, folder: Path) -> Attempt:
    """Open a target in this process, which from now on is bounded in what it may take.

    It may take some memory, files of some size, and leaves no dump of its memory behind.
    """
    own = folder / "own"
    own.mkdir()
    temporary = folder / "temporary"
    temporary.mkdir()
    tempfile.tempdir = str(temporary)
    attempt = target.open(own)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    room = pages * _PAGE + _ADDRESS_ROOM
    resource.setrlimit(resource.RLIMIT_AS, (room, room))
    resource.setrlimit(resource.RLIMIT_FSIZE, (_LARGEST_FILE, _LARGEST_FILE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    return attempt


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _cpu_of(pid: int) -> float:
    """Return how long a process has computed, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


def _append(findings: Path, index: int, message: str) -> None:
    with open(findings, "a") as file:
        file.write(json.dumps({"case": index, "what": message}) + "\n")
