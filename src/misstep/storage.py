"""Files that are either old or new, never half.

A file is written under a temporary name on the same file system, flushed to the disk, and then
renamed over the old one in a single step. Whoever reads sees the old file or the new one; a
process killed at any instant leaves at worst a hidden folder ``.NAME.XXXX.tmp`` behind.

Beside that, what goes with it: reading JSON back, folders, names of files.
"""

import atexit
import json
import os
import re
import secrets
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from misstep.errors import MisstepError

_LARGEST_JSON = 64 * 2**20  # bytes

_hidden: set[Path] = set()


def atomic_write(path: str | os.PathLike[str], write: Callable[[Path], object]) -> None:
    """Create or replace a file in a single step.

    The temporary file bears the final name, in a hidden folder beside the final place: writers
    that go by the suffix (pictures, videos, npz) see the right one, and a search for ``*.h5``
    never finds a file in the making.

    What is no file cannot be replaced: a device or a pipe is written to plainly, and so is this
    process's own output.

    Parameters
    ----------
    path : path
        The file to write. A symbolic link is followed, so that the link itself stays.
    write : callable
        Called with the path of the temporary file, which it has to create.

    Raises
    ------
    MisstepError
        If the system refuses: no such folder, no permission, a full disk; or if it is a folder, a
        disk or a socket. Whatever else `write` raises passes through. In either case the old file
        is untouched.
    """
    if is_stream(path):
        _write_plainly(path, write)
        return
    target = Path(os.path.realpath(path))
    with refusals_told(path):
        with hidden_folder(target) as folder:
            temporary = folder / target.name
            write(temporary)
            if target.exists():
                shutil.copymode(target, temporary)
            flush(temporary)
            temporary.replace(target)
        flush(target.parent)


def is_stream(path: str | os.PathLike[str]) -> bool:
    """Say whether `path` is written to plainly: a device, a pipe or this process's own output.

    Raises
    ------
    MisstepError
        If it is there but cannot be written to at all: a folder, a disk, a socket.
    """
    try:
        status = os.stat(path)
    except OSError:
        return False
    if stat.S_ISFIFO(status.st_mode) or stat.S_ISCHR(status.st_mode) or _output(status):
        return True
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a disk or a socket"
        raise MisstepError(f"cannot write {path}: it is {kind}; name a file")
    return False


def check_regular(path: str | os.PathLike[str]) -> None:
    """Raise MisstepError if `path` is a device or a pipe: reading it might never end."""
    with suppress(OSError):
        mode = os.stat(path).st_mode
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise MisstepError(f"cannot read {path}: it is a device or a pipe; name a file")


def _output(status: os.stat_result) -> int:
    """Return the descriptor of this process's output or errors that is this very file, or 0."""
    for descriptor in (1, 2):
        with suppress(OSError):
            if os.path.samestat(status, os.fstat(descriptor)):
                return descriptor
    return 0


def _write_plainly(path: str | os.PathLike[str], write: Callable[[Path], object]) -> None:
    with tempfile.TemporaryDirectory() as folder, refusals_told(path):
        temporary = Path(folder, Path(path).name)
        write(temporary)
        own = _output(os.stat(path))
        if own and sys.stdout is not None:
            sys.stdout.flush()  # what was printed before comes first
        # Its own output is not opened anew: that would begin at the start of the file again.
        with (
            open(temporary, "rb") as source,
            open(os.dup(own) if own else path, "wb", buffering=0) as stream,
        ):
            try:
                shutil.copyfileobj(source, stream)
            except BrokenPipeError:
                if not own:
                    raise


@contextmanager
def hidden_folder(target: Path) -> Iterator[Path]:
    """Make an empty folder beside `target` that is taken away again, with all that is in it.

    Also where an interrupt comes while it is made or taken away: then when the process ends.
    """
    folder = target.parent / f".{target.name}.{secrets.token_hex(6)}.tmp"
    _hidden.add(folder)
    try:
        folder.mkdir(mode=0o700)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        _hidden.discard(folder)


@atexit.register
def _take_away() -> None:
    for folder in _hidden:
        shutil.rmtree(folder, ignore_errors=True)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    r"""Write a text file in UTF-8 in a single step, with ``\n`` at the ends of lines.

    What is no text, as a file's name can be, becomes ``?``.

    Raises
    ------
    MisstepError
        As `atomic_write`.
    """
    atomic_write(path, lambda temporary: temporary.write_bytes(text.encode(errors="replace")))


def write_json(path: str | os.PathLike[str], value: object, *, sort_keys: bool = False) -> None:
    """Write a JSON file in a single step, indented, in UTF-8.

    Parameters
    ----------
    path : path
        The file to write.
    value : object
        Dictionaries, lists, strings, numbers, truth values and None.
    sort_keys : bool
        Sort the keys of dictionaries, so that equal values give equal files.

    Raises
    ------
    MisstepError
        If `value` holds NaN, an infinity or something that JSON cannot say, or as
        `atomic_write`.
    """
    try:
        text = json.dumps(value, allow_nan=False, indent=2, sort_keys=sort_keys)
    except (TypeError, ValueError) as error:
        raise MisstepError(f"cannot write {path} as JSON: {error}") from error
    write_text(path, text + "\n")


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises
    ------
    MisstepError
        If it is missing, no file, larger than 64 MiB, or no JSON.
    """
    check_regular(path)
    try:
        if path.stat().st_size > _LARGEST_JSON:
            raise MisstepError(f"{path} is too large: more than {_LARGEST_JSON} bytes of JSON")
        return json.loads(path.read_text(encoding="utf-8"))
    except MisstepError:
        raise
    except OSError as error:
        raise MisstepError(f"cannot read {path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise MisstepError(f"{path} is not valid JSON: {error}") from error


def make_folder(path: Path) -> None:
    """Make a folder and those above it; raise MisstepError where that is not possible."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise MisstepError(f"cannot make the folder {path}: {error.strerror}") from error


def as_file_name(text: str) -> str:
    """Return a text as a part of a file's name: letters, digits, ``_``, ``.`` and ``-``."""
    return re.sub(r"[^\w.-]", "-", text)


@contextmanager
def refusals_told(path: str | os.PathLike[str]) -> Iterator[None]:
    """Tell in one line, as a `MisstepError`, why the system refuses to write `path`."""
    try:
        yield
    except OSError as error:
        reason = " ".join(str(error.strerror or error).split())
        raise MisstepError(
            f"cannot write {path}: {reason}; choose a folder that exists and can be written to"
        ) from error


def flush(path: Path) -> None:
    """Have the system bring a file or a folder onto the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
