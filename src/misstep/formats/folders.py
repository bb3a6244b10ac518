"""Data sets that are folders, written in a single step: the old one or the new one, never half.

The folder is filled under a hidden name beside its place, flushed to the disk, and renamed. An
old one is renamed away just before: for that instant there is none under the name.
"""

import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from misstep.errors import MisstepError
from misstep.storage import flush, refusals_told


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
        hidden = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".tmp", dir=target.parent))
        try:
            new = hidden / target.name
            write(new)
            _flush_all(new)
            if target.exists():
                target.replace(hidden / "old")
            new.replace(target)
        finally:
            if (hidden / "old").exists() and not target.exists():
                (hidden / "old").replace(target)
            shutil.rmtree(hidden, ignore_errors=True)
        flush(target.parent)


def _is_empty(folder: Path) -> bool:
    return not any(folder.iterdir())


def _flush_all(folder: Path) -> None:
    for parent, _, names in os.walk(folder):
        for name in names:
            flush(Path(parent, name))
        flush(Path(parent))
