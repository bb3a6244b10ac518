"""One process at a time drives a run, a study or a reproduction; reading is free.

The lock is the kernel's, on a hidden file in the folder: it goes with the process that holds it,
however that ends, and needs no cleaning up. What is written in the file only tells the next one who
it is. It holds between processes of one machine, and over a network file system that passes locks
on. Systems without ``fcntl`` have no such lock: there two processes are not kept apart.
"""

import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from misstep.errors import MisstepError, reason_of
from misstep.version import command_line

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

LOCK = ".driver"
"""Hidden, so that a folder with nothing else in it counts as empty."""

_LONGEST = 10_000  # bytes


@contextmanager
def driven(folder: Path) -> Iterator[None]:
    """Be the only one who drives what is in a folder.

    Raises
    ------
    MisstepError
        If somebody else does, or the folder cannot be written.
    """
    try:
        # Whoever this process starts does not inherit it.
        file = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise MisstepError(f"cannot drive {folder}: {reason_of(error)}") from error
    try:
        if fcntl is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise MisstepError(
                    f"{folder} is driven by {_holder(file)}: stop that, or wait until it ends"
                ) from error
        _say_who(file)
        yield
        with suppress(OSError):
            os.ftruncate(file, 0)  # so that what was driven is the same, whoever did
    finally:
        os.close(file)


def _say_who(file: int) -> None:
    who = {
        "command": " ".join(command_line()),
        "process": os.getpid(),
        "machine": socket.gethostname(),
        "since": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    with suppress(OSError):  # on a full disk the lock is as good without a name
        os.ftruncate(file, 0)
        os.pwrite(file, json.dumps(who).encode(), 0)


def _holder(file: int) -> str:
    """Return who holds a lock, as far as its file says."""
    try:
        who: Any = json.loads(os.pread(file, _LONGEST, 0))
        return (
            f"process {int(who['process'])} on {who['machine']} ({who['command']}), since "
            f"{who['since']}"
        )
    except (OSError, ValueError, TypeError, KeyError):
        return "another process"
