"""The ways to die, each real: signals, a disk without room, a folder without rights, no memory."""

import ctypes
import errno
import os
import resource
import signal
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from nursery import Child

KILL, TERMINATE, INTERRUPT = "SIGKILL", "SIGTERM", "SIGINT"
FULL, READ_ONLY, MEMORY = "disk full", "read-only", "no memory"
WAYS = (KILL, TERMINATE, INTERRUPT, FULL, READ_ONLY, MEMORY)

_DISK = 48 * 2**20  # bytes
_PAGE = 4096
_MNT_DETACH = 2  # also while somebody looks at it
_BALLAST = ".ballast"
_ROOM = (0, 2**18, 2**20, 2**22, 2**24)
"""Bytes of memory that a process may still take, one of these."""


@contextmanager
def small_disk(place: Path) -> Iterator[Path | None]:
    """Mount a file system in memory that is full after 48 MiB; None where that is not allowed."""
    libc = ctypes.CDLL(None, use_errno=True)
    place.mkdir()
    options = f"size={_DISK}".encode()
    if libc.mount(b"misstep", os.fsencode(place), b"tmpfs", 0, options) != 0:
        yield None
        return
    try:
        yield place
    finally:
        libc.umount2(os.fsencode(place), _MNT_DETACH)


def strike(way: str, child: Child, folder: Path, rng: np.random.Generator) -> None:
    """Let it happen to a command that works in `folder`.

    Parameters
    ----------
    way : str
        One of `WAYS`.
    child : Child
    folder : Path
        For `FULL`, on a `small_disk`.
    rng : Generator
        How little room is left, where some is.
    """
    if way == KILL:
        os.kill(child.pid, signal.SIGKILL)
    elif way == TERMINATE:
        os.kill(child.pid, signal.SIGTERM)
    elif way == INTERRUPT:
        os.killpg(child.pid, signal.SIGINT)  # as a terminal does, to all of them
    elif way == FULL:
        _fill(folder, int(rng.integers(0, 16)) * _PAGE)
    elif way == READ_ONLY:
        _set_rights(folder, writable=False)
    else:
        _limit_memory(child, int(rng.choice(_ROOM)))


def relieve(way: str, child: Child, folder: Path) -> None:
    """Take it back, as far as it outlives the process."""
    if way == FULL:
        (folder / _BALLAST).unlink(missing_ok=True)
    elif way == READ_ONLY:
        _set_rights(folder, writable=True)
    elif way == MEMORY:
        for pid in child.processes():
            _set_limit(pid, resource.RLIM_INFINITY)


def _fill(folder: Path, room: int) -> None:
    """Take all that a disk has left but for `room` bytes."""
    with (folder / _BALLAST).open("wb", buffering=0) as ballast:
        taken = 0
        while (free := os.statvfs(folder)).f_bavail * free.f_bsize > room:
            more = free.f_bavail * free.f_bsize - room
            try:
                os.posix_fallocate(ballast.fileno(), taken, more)
            except OSError as error:
                if error.errno != errno.ENOSPC:
                    raise
                continue  # somebody else has taken some meanwhile
            taken += more


def _set_rights(folder: Path, *, writable: bool) -> None:
    for parent, folders, _ in os.walk(folder):
        for path in (parent, *(os.path.join(parent, name) for name in folders)):
            try:
                mode = os.stat(path).st_mode
                os.chmod(path, mode | stat.S_IWUSR if writable else mode & ~0o222)
            except FileNotFoundError:
                continue


def _limit_memory(child: Child, room: int) -> None:
    for pid in child.processes():
        try:
            pages = int(Path(f"/proc/{pid}/statm").read_text().split()[0])
        except (FileNotFoundError, ProcessLookupError):
            continue
        _set_limit(pid, pages * _PAGE + room)


def _set_limit(pid: int, most: int) -> None:
    try:
        resource.prlimit(pid, resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))
    except ProcessLookupError:
        return
