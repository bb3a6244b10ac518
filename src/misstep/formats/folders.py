"""Data sets that are folders, written in a single step: the old one or the new one, never half.

The folder is filled under a hidden name beside its place, flushed to the disk, and renamed, or
made to change places with an old one. Only where the system cannot exchange two names is the old
one renamed away just before, and for that instant there is none under the name.
"""

import ctypes
import os
import sys
from collections.abc import Callable
from pathlib import Path

from misstep.errors import MisstepError
from misstep.storage import flush, hidden_folder, refusals_told

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # of Linux


def write_folder(
    path: Path, write: Callable[[Path], object], recognise: Callable[[Path], bool]
) -> None:
    """Make a folder, in place of an old one of its kind.

    Parameters
    ----------
    path : path
        The folder to make.
    write : callable
        Called with a path that does not exist yet, where it makes the folder.
    recognise : callable
        Whether an existing folder is of this kind, and may therefore go.

    Raises
    ------
    MisstepError
        If something else is in the place, or the system refuses: no permission, a full disk.
        What `write` raises passes through. In either case what was there is untouched.
    """
    target = Path(os.path.realpath(path))
    if target.exists() and not (target.is_dir() and (recognise(target) or _is_empty(target))):
        raise MisstepError(
            f"cannot write {path}: something else is there; name a folder that does not exist, or "
            "a data set of this format"
        )
    with refusals_told(path):
        with hidden_folder(target) as hidden:
            new = hidden / target.name
            write(new)
            _flush_all(new)
            _put_in_place(new, target, hidden / "old")
        flush(target.parent)


def _put_in_place(new: Path, target: Path, old: Path) -> None:
    if not target.exists():
        new.replace(target)
    elif not exchange(new, target):
        target.replace(old)
        try:
            new.replace(target)
        except BaseException:
            old.replace(target)
            raise


def exchange(one: Path, other: Path) -> bool:
    """Let two files or folders change places in a single step; return whether the system did."""
    rename = getattr(ctypes.CDLL(None), "renameat2", None) if sys.platform == "linux" else None
    if rename is None:
        return False
    names = os.fsencode(one), os.fsencode(other)
    return bool(rename(_AT_FDCWD, names[0], _AT_FDCWD, names[1], _RENAME_EXCHANGE) == 0)


def _is_empty(folder: Path) -> bool:
    return not any(folder.iterdir())


def _flush_all(folder: Path) -> None:
    for parent, _, names in os.walk(folder):
        for name in names:
            flush(Path(parent, name))
        flush(Path(parent))
