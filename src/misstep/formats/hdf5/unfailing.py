"""A file that the HDF5 library can write to without ever being told that the disk is full.

The library crashes the whole process when a write fails. Here it never does: from the first
failure on, what is written is kept in memory, where the library reads it back as from a disk, and
the error waits for the writer, who asks for it with `check` and gives up.
"""

import os
from pathlib import Path
from typing import Literal


class UnfailingFile:
    """A file for h5py's driver of Python file objects.

    Parameters
    ----------
    path : Path
    mode : "w+b", "r+b" or "rb"
        Make the file anew, change the one that exists, or only read it.

    Raises
    ------
    OSError
        If it cannot be opened; from then on only by `check`.
    """

    def __init__(self, path: Path, mode: Literal["w+b", "r+b", "rb"]) -> None:
        self._file = open(path, mode, buffering=0)  # noqa: SIM115
        self._position = 0
        self._size = os.fstat(self._file.fileno()).st_size
        self._kept: list[tuple[int, bytes]] = []  # offset and what could not be written there
        self._error: OSError | None = None

    def check(self) -> None:
        """Raise the OSError of the first write that failed, if one did."""
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    # What h5py asks of a file object

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Set the position, in bytes."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._size}[whence]
        self._position = start + offset
        return self._position

    def tell(self) -> int:
        """Return the position, in bytes."""
        return self._position

    def write(self, data: "bytes | memoryview") -> int:
        """Write at the position; whatever happens, all of it counts as written."""
        left, at = memoryview(data).cast("B"), self._position
        size = len(left)
        self._position += size
        self._size = max(self._size, self._position)
        try:
            while len(left) and self._error is None:
                self._file.seek(at)
                written = self._file.write(left) or 0
                left, at = left[written:], at + written
        except OSError as error:
            self._error = error
        if len(left):
            self._kept.append((at, bytes(left)))
        return size

    def read(self, size: int) -> bytes:
        """Read `size` bytes at the position; h5py asks whether there is such a method."""
        data = bytearray(size)
        self.readinto(data)
        return bytes(data)

    def readinto(self, buffer: "bytearray | memoryview") -> int:
        """Read at the position; what was never written is zero."""
        view, start = memoryview(buffer).cast("B"), self._position
        view[:] = bytes(len(view))
        if start < self._size:  # a damaged file can ask for more than a system could have
            self._file.seek(start)
            filled = 0
            while filled < len(view) and (count := self._file.readinto(view[filled:])):
                filled += count
        for at, data in self._kept:  # in the order of writing: the last one counts
            first, last = max(at, start), min(at + len(data), start + len(view))
            if first < last:
                view[first - start : last - start] = data[first - at : last - at]
        self._position += len(view)
        return len(view)

    def truncate(self, size: int) -> int:
        """Set the size, in bytes."""
        self._size = size
        try:
            if self._error is None:
                self._file.truncate(size)
        except OSError as error:
            self._error = error
        return size

    def flush(self) -> None:
        """Do nothing: there is no buffer."""
