"""An HDF5 file of any make, opened so that neither damage nor a full disk ends the process."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import h5py

from misstep.errors import MisstepError
from misstep.formats.hdf5.attributes import damage
from misstep.formats.hdf5.unfailing import UnfailingFile

_SIGNATURE = b"\x89HDF\r\n\x1a\n"


@contextmanager
def opened(
    path: Path, mode: Literal["w+b", "r+b", "rb"]
) -> Iterator[tuple[h5py.File, UnfailingFile]]:
    """Open a file, and in the end make sure that all of it was written.

    Yields the file and what it is written through, which knows whether the disk is full.

    Raises
    ------
    MisstepError
        If its structure is damaged.
    OSError
        If it cannot be opened, or a write failed.
    """
    disk = UnfailingFile(path, mode)
    try:
        with damage("its structure"):
            file = h5py.File(disk, {"w+b": "w", "r+b": "r+", "rb": "r"}[mode])
        try:
            yield file, disk
        finally:
            with damage("its structure"):
                file.close()
        disk.check()
    finally:
        disk.close()


def check_signature(path: Path) -> None:
    """Make sure that a file is there and begins as an HDF5 file does.

    Raises
    ------
    MisstepError
        If it is not or does not.
    """
    if not path.is_file():
        raise MisstepError("it is a folder or a device; name a file")
    try:
        with open(path, "rb") as file:
            start = file.read(len(_SIGNATURE))
    except OSError as error:
        raise MisstepError(f"{error.strerror}") from error
    if not start:
        raise MisstepError("the file is empty")
    if start != _SIGNATURE:
        raise MisstepError("it is not an HDF5 file")
