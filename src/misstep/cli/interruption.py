"""What to do when somebody ends a command: with a Ctrl-C, or with a SIGTERM as a machine does."""

import os
import shlex
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

_AGAIN = 0.01  # s
_INTERRUPTED = 130


class Terminated(KeyboardInterrupt):
    """A SIGTERM. It ends a command as a Ctrl-C does: in order, and with nothing half-written."""


@contextmanager
def interruptible() -> Iterator[None]:
    """Let a SIGTERM end the block too, and let neither a SIGTERM nor a Ctrl-C be lost.

    A SIGTERM raises `Terminated`, unless the process has something else in mind for it. An
    exception that a signal raises while Python collects an object goes nowhere: then the signal
    is sent once more.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before, hook = signal.getsignal(signal.SIGTERM), sys.unraisablehook
    if before is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _terminate)
    sys.unraisablehook = _not_lost
    try:
        yield
    finally:
        sys.unraisablehook = hook
        if before is signal.SIG_DFL:
            signal.signal(signal.SIGTERM, before)


@contextmanager
def ending_at_once() -> Iterator[None]:
    """Let a Ctrl-C end the process at once while nothing has begun in it yet.

    An exception would be raised in the middle of some library's import, which may make anything
    of it.
    """
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, _end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def resumable(folder: Path, configuration: str, command: str = "resume") -> Iterator[None]:
    """Say how to go on when the block is interrupted, once there is something to go on with.

    Parameters
    ----------
    folder : Path
        What `misstep resume` would take, or another command that goes on.
    configuration : str
        Name of the file in `folder` without which it could not.
    command : str
        The command that goes on.
    """
    try:
        yield
    except KeyboardInterrupt as interrupt:
        if (folder / configuration).exists():
            resuming = f"`misstep {command} {shlex.quote(str(folder))}` goes on"
            raise type(interrupt)(resuming) from interrupt
        raise


def _end(number: int, frame: FrameType | None) -> None:
    os.write(2, b"misstep: interrupted\n")
    os._exit(_INTERRUPTED)


def _terminate(number: int, frame: FrameType | None) -> None:
    raise Terminated


def _not_lost(unraisable: "sys.UnraisableHookArgs") -> None:
    """Send a signal again whose exception nobody could hear; tell of anything else."""
    if not issubclass(unraisable.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)
        return
    terminated = issubclass(unraisable.exc_type, Terminated)
    number = signal.SIGTERM if terminated else signal.SIGINT
    # A moment later: here it would be raised in vain again.
    again = threading.Timer(_AGAIN, os.kill, (os.getpid(), number))
    again.daemon = True
    again.start()
