"""What a command prints through: whoever reads it may leave, or not be there at all."""

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def forgiving_output() -> Iterator[None]:
    """Let the block print whatever it likes to whoever reads it.

    A reader that leaves, such as ``head``, misses the rest: the command goes on to its end. Where
    stdout, stderr or stdin is closed, nothing is there instead, so that no other file gets its
    number. What the terminal has no letter for is printed as ``?``.
    """
    _hold_descriptors()
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = _forgiving(sys.stdout, 1), _forgiving(sys.stderr, 2)
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        sys.stdout, sys.stderr = before


class _Output(io.FileIO):
    """A file that is thrown away from the moment on when nobody reads it any more."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except BrokenPipeError:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self.fileno())
            os.close(nowhere)
            return len(data)


def _forgiving(stream: Any, descriptor: int) -> Any:
    if stream is None:
        return open(os.devnull, "w", encoding="utf-8")
    own = stream in (sys.__stdout__, sys.__stderr__) and isinstance(stream, io.TextIOWrapper)
    if not own:  # of a test, or of an editor
        return stream
    stream.flush()
    output: Any = _Output(descriptor, "w", closefd=False)
    return io.TextIOWrapper(
        output if stream.write_through else io.BufferedWriter(output),  # PYTHONUNBUFFERED
        encoding=stream.encoding,
        errors="replace",
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )


def _hold_descriptors() -> None:
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free: this one
