"""A log that says afterwards why each action was sent.

One append-only file a service, of small binary records: a state, the policy's action and the one
sent, with the reasons, for every command; a line of text for every event between them.

The end of the file is mapped into memory. A record is therefore with the operating system, and
outlives the process, as soon as it is written, which takes a microsecond and no system call; its
first four bytes are written last, so that what a kill leaves is whole records and then zeros. The
room is reserved on the disk ahead: a disk that is full is found out while there is still room to
say so.

===========  ====================================================================================
part         layout, little-endian
===========  ====================================================================================
file         ``MISSTEP1``, then a u32 and so many bytes of JSON: columns, limits, time of the start
every record u8 kind, u8 0, u16 length of what follows these 4 bytes
kind 1       u16 reasons, u64 sequence, f64 time [s]; f64 observation (n), intended (m), sent (m)
kind 2       f64 time [s], then text in UTF-8
kind 0       the end
===========  ====================================================================================
"""

import errno
import json
import mmap
import os
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from misstep.errors import MisstepError
from misstep.robot.guard import Command
from misstep.robot.limits import Reason, Row
from misstep.storage import check_regular

_MAGIC = b"MISSTEP1"
_HEAD = struct.Struct("<BBH")
_COMMAND, _EVENT = 1, 2
_TIME = struct.Struct("<d")
_LONGEST_TEXT = 2000
_LONGEST_RECORD = _HEAD.size + 2**16
_MOST_NUMBERS = 2**16 // 8
_NO_SEQUENCE = 2**64 - 1
_WINDOW = 2**18
"""Bytes that are mapped; the next are reserved when half of them are full."""


class Sent(NamedTuple):
    """A command as it was sent."""

    time: float
    """By the service's clock, s."""
    sequence: int | None
    """Of the state that it answered."""
    reason: Reason
    observation: Row
    """NaN where there was no state, or one that was refused."""
    intended: Row
    action: Row

    def explain(self) -> str:
        """Return a line that says what was sent and why."""
        why = ", ".join(part.name.lower().replace("_", " ") for part in self.reason if part.name)
        numbers = " ".join(f"{value:g}" for value in self.action)
        aimed = ""
        if self.intended != self.action:
            aimed = f" (intended {' '.join(f'{value:g}' for value in self.intended)})"
        return f"{self.time:.6f} s  sent {numbers}{aimed}: {why}"


class Event(NamedTuple):
    """Something that happened between commands: a start, a refusal, an emergency stop."""

    time: float
    """By the service's clock, s."""
    text: str

    def explain(self) -> str:
        """Return a line that says what happened."""
        return f"{self.time:.6f} s  {self.text}"


class ActionLog:
    """Appends to a log file; keeps nothing in memory.

    Parameters
    ----------
    path : path
        A new file.
    header : mapping
        What JSON can say; `n_observations` and `n_actions` among it.

    Raises
    ------
    MisstepError
        If the file exists or cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], header: Mapping[str, Any]) -> None:
        self.path = Path(path)
        n, m = header["n_observations"], header["n_actions"]
        record = _command_layout(n, m)
        self._pack, self._length = record.pack_into, record.size
        self._command_head = _HEAD.pack(_COMMAND, 0, record.size)
        self._unknown = (float("nan"),) * n
        self._base = self._at = 0
        text = json.dumps(header).encode()
        start = _MAGIC + struct.pack("<I", len(text)) + text
        try:
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644)
            try:
                os.write(self._file, start)
                self._map(len(start))
            except OSError:
                os.close(self._file)
                raise
        except OSError as error:
            raise MisstepError(f"cannot write the log {path}: {error.strerror}") from error

    def reserve(self) -> bool:
        """Have room for what comes next; return whether there is plenty.

        Where there is none on the disk, some more records can still be written.
        """
        if self._at <= _WINDOW // 2:
            return True
        old = self._window
        try:
            self._map(self._base + self._at)
        except OSError:
            return False
        old.close()
        return True

    def command(self, time: float, command: Command, observation: Row | None) -> None:
        """Append a command; raise OSError where there is no room left."""
        action, intended, reason, sequence, _ = command
        start = self._at + _HEAD.size
        end = start + self._length
        if end > _WINDOW:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._pack(
            self._window,
            start,
            reason,
            sequence if sequence >= 0 else _NO_SEQUENCE,
            time,
            *(self._unknown if observation is None else observation),
            *intended,
            *action,
        )
        self._window[self._at : start] = self._command_head
        self._at = end

    def event(self, time: float, text: str) -> None:
        """Append a line of text; raise OSError where there is no room left."""
        line = _TIME.pack(time) + text.encode(errors="replace")[:_LONGEST_TEXT]
        start = self._at + _HEAD.size
        end = start + len(line)
        if end > _WINDOW:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._window[start:end] = line
        self._window[self._at : start] = _HEAD.pack(_EVENT, 0, len(line))
        self._at = end

    def close(self) -> None:
        """Bring the file onto the disk, without the room that was not needed, and close it.

        Raises
        ------
        MisstepError
            If the disk refuses.
        """
        self._window.close()
        try:
            os.ftruncate(self._file, self._base + self._at)
            os.fsync(self._file)
        except OSError as error:
            raise MisstepError(f"cannot write the log {self.path}: {error.strerror}") from error
        finally:
            os.close(self._file)

    def _map(self, end: int) -> None:
        """Reserve and map a window in which the file ends at `end`."""
        base = end - end % mmap.ALLOCATIONGRANULARITY
        _allocate(self._file, base, _WINDOW)
        self._window = mmap.mmap(self._file, _WINDOW, offset=base)
        self._base, self._at = base, end - base


def _allocate(file: int, start: int, length: int) -> None:
    """Have blocks of a disk for a part of a file; raise OSError where there are none."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file, start, length)
    else:  # macOS
        end = os.fstat(file).st_size
        os.pwrite(file, bytes(start + length - end), end)


def read_log(path: str | os.PathLike[str]) -> tuple[dict[str, Any], Iterator[Sent | Event]]:
    """Read a log back.

    Parameters
    ----------
    path : path

    Returns
    -------
    header : dict
    records : iterator of Sent or Event
        In order; what a killed machine left half-written at the end is left out.

    Raises
    ------
    MisstepError
        If the file cannot be read or is no log.
    """
    try:
        check_regular(path)
        with Path(path).open("rb") as file:
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise MisstepError(f"cannot read {path}: {error.strerror}") from error
    except ValueError as error:
        raise MisstepError(f"{path} is not a log of a service: it is empty") from error
    try:
        if data[: len(_MAGIC)] != _MAGIC:
            raise ValueError("it does not start as one")
        (length,) = struct.unpack_from("<I", data, len(_MAGIC))
        start = len(_MAGIC) + 4
        header = json.loads(data[start : start + length])
        n, m = header["n_observations"], header["n_actions"]
        if not (type(n) is type(m) is int and min(n, m) >= 0 and n + 2 * m <= _MOST_NUMBERS):
            raise ValueError(f"it says that a record holds {n} + 2 × {m} numbers")
    except (ValueError, KeyError, TypeError, RecursionError, struct.error) as error:
        raise MisstepError(f"{path} is not a log of a service: {error}") from error
    return header, _records(data, start + length, n, m, path)


def _command_layout(n: int, m: int) -> struct.Struct:
    """Return the layout of what follows the head of a command; see the module."""
    return struct.Struct(f"<HQd{n + 2 * m}d")


def _records(
    data: mmap.mmap, at: int, n: int, m: int, path: str | os.PathLike[str]
) -> Iterator[Sent | Event]:
    layout = _command_layout(n, m)
    while at + _HEAD.size <= len(data):
        kind, zero, length = _HEAD.unpack_from(data, at)
        if kind == zero == length == 0 and not any(data[at + _LONGEST_RECORD :]):
            return
        at += _HEAD.size
        if at + length > len(data):
            return
        if zero == 0 and kind == _COMMAND and length == layout.size:
            reason, sequence, time, *values = layout.unpack_from(data, at)
            yield Sent(
                time,
                None if sequence == _NO_SEQUENCE else sequence,
                Reason(reason),
                tuple(values[:n]),
                tuple(values[n : n + m]),
                tuple(values[n + m :]),
            )
        elif zero == 0 and kind == _EVENT and length >= _TIME.size:
            text = data[at + _TIME.size : at + length].decode(errors="replace")
            yield Event(_TIME.unpack_from(data, at)[0], text)
        else:
            raise MisstepError(f"{path} is damaged at byte {at - _HEAD.size}: no such record")
        at += length
