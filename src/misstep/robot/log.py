"""A log that says afterwards why each action was sent.

One append-only file a service, of small binary records: a state, the policy's action and the one
sent, with the reasons, for every command; a line of text for every event between them. A record
is handed to the operating system before its action leaves, so it outlives the process; a disk that
is full keeps whole records alone.

===========  ====================================================================================
part         layout, little-endian
===========  ====================================================================================
file         ``MISSTEP1``, then a u32 and so many bytes of JSON: columns, limits, time of the start
every record u8 kind, u8 0, u16 length of what follows these 4 bytes
kind 1       u16 reasons, u64 sequence, f64 time [s]; f64 observation (n), intended (m), sent (m)
kind 2       f64 time [s], then text in UTF-8
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

_MAGIC = b"MISSTEP1"
_HEAD = struct.Struct("<BBH")
_COMMAND, _EVENT = 1, 2
_TIME = struct.Struct("<d")
_LONGEST_TEXT = 2000
_NO_SEQUENCE = 2**64 - 1


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
        self._record = struct.Struct(f"<BBHHQd{n + 2 * m}d")
        self._unknown = (float("nan"),) * n
        text = json.dumps(header).encode()
        try:
            flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_EXCL
            self._file = os.open(self.path, flags, 0o644)
            self._size = 0
            self._append(_MAGIC + struct.pack("<I", len(text)) + text)
        except OSError as error:
            raise MisstepError(f"cannot write the log {path}: {error.strerror}") from error

    def command(self, time: float, command: Command, observation: Row | None) -> None:
        """Append a command; raise OSError where the disk refuses."""
        sequence = command.sequence if command.sequence >= 0 else _NO_SEQUENCE
        observed = self._unknown if observation is None else observation
        length = self._record.size - _HEAD.size
        self._append(
            self._record.pack(
                _COMMAND,
                0,
                length,
                command.reason,
                sequence,
                time,
                *observed,
                *command.intended,
                *command.action,
            )
        )

    def event(self, time: float, text: str) -> None:
        """Append a line of text; raise OSError where the disk refuses."""
        line = text.encode()[:_LONGEST_TEXT]
        self._append(_HEAD.pack(_EVENT, 0, _TIME.size + len(line)) + _TIME.pack(time) + line)

    def close(self) -> None:
        """Bring the file onto the disk and close it.

        Raises
        ------
        MisstepError
            If the disk refuses.
        """
        try:
            os.fsync(self._file)
        except OSError as error:
            raise MisstepError(f"cannot write the log {self.path}: {error.strerror}") from error
        finally:
            os.close(self._file)

    def _append(self, record: bytes) -> None:
        written = os.write(self._file, record)
        if written < len(record):  # the disk is full: half a record would hide those after it
            os.ftruncate(self._file, self._size)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._size += written


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
        n, m = int(header["n_observations"]), int(header["n_actions"])
    except (ValueError, KeyError, TypeError, struct.error) as error:
        raise MisstepError(f"{path} is not a log of a service: {error}") from error
    return header, _records(data, start + length, n, m, path)


def _records(
    data: mmap.mmap, at: int, n: int, m: int, path: str | os.PathLike[str]
) -> Iterator[Sent | Event]:
    layout = struct.Struct(f"<HQd{n + 2 * m}d")
    while at + _HEAD.size <= len(data):
        kind, zero, length = _HEAD.unpack_from(data, at)
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
            raise MisstepError(f"{path} is damaged at byte {at}: no such record")
        at += length
