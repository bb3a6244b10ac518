"""Arrays of an HDF5 file, written and read some rows at a time, by whoever made the file.

An array of up to 1,000 elements is stored plainly; up to 65,536 elements as one chunk; a longer
one in chunks of as many rows as make 65,536 elements. Chunks are shuffled and deflated.

Reading takes nothing on trust. Links out of the file and any other way to store an array are
refused, and chunks are inflated by `misstep.formats.hdf5.chunks`.
"""

import math
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.formats.hdf5.attributes import damage
from misstep.formats.hdf5.chunks import check_sizes, filters_of, read_chunk

FLOAT = np.dtype("<f8")
BOOL = np.dtype(bool)

_PLAIN_UP_TO = 1000  # elements; compressing fewer saves no space worth the time
_CHUNK = 2**16  # elements
_LARGEST_CHUNK = 2**31  # bytes, inflated: before there were chunks of rows, a whole array was one
_FILTERS = [h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE]
_PACKING = {"shuffle": True, "compression": "gzip", "compression_opts": 1}


def _rows_of_a_chunk(row_shape: tuple[int, ...]) -> int:
    return max(1, _CHUNK // max(1, math.prod(row_shape)))


class RowWriter:
    """Writes one array of unknown length, some rows at a time.

    Parameters
    ----------
    group : h5py.Group
        Where the array goes.
    name : str
    row_shape : tuple of int
        Shape of a row: (n,), or () for a plain number.
    dtype : dtype
    """

    def __init__(
        self, group: h5py.Group, name: str, row_shape: tuple[int, ...], dtype: np.dtype[Any]
    ) -> None:
        self._group, self._name, self._dtype = group, name, dtype
        self._row_shape, self._chunk_rows = row_shape, _rows_of_a_chunk(row_shape)
        self._dataset: h5py.Dataset | None = None
        self._waiting: list[NDArray[Any]] = []
        self._n_waiting = 0
        self.n_rows = 0

    def write(self, rows: NDArray[Any]) -> None:
        """Add rows, shape (b, *row_shape)."""
        # A copy: what waits must not change with the reader's buffers.
        self._waiting.append(np.array(rows, self._dtype))
        self._n_waiting += len(rows)
        self.n_rows += len(rows)
        if self._n_waiting > self._chunk_rows:
            self._write_chunks()

    def close(self) -> None:
        """Write what is left."""
        rows = self._taken()
        if self._dataset is not None:
            self._extend(rows)
        elif rows.size > _PLAIN_UP_TO:
            self._group.create_dataset(self._name, data=rows, chunks=rows.shape, **_PACKING)
        else:
            self._group.create_dataset(self._name, data=rows)

    def _taken(self) -> NDArray[Any]:
        empty = np.empty((0, *self._row_shape), self._dtype)
        rows = np.concatenate([empty, *self._waiting])
        self._waiting, self._n_waiting = [], 0
        return rows

    def _write_chunks(self) -> None:
        if self._dataset is None:
            self._dataset = self._group.create_dataset(
                self._name,
                shape=(0, *self._row_shape),
                maxshape=(None, *self._row_shape),
                dtype=self._dtype,
                chunks=(self._chunk_rows, *self._row_shape),
                **_PACKING,
            )
        rows = self._taken()
        left = len(rows) % self._chunk_rows  # only whole chunks, or some would be packed twice
        self._extend(rows[: len(rows) - left])
        self._waiting, self._n_waiting = [rows[len(rows) - left :]], left

    def _extend(self, rows: NDArray[Any]) -> None:
        if len(rows) and self._dataset is not None:
            start = self._dataset.shape[0]
            self._dataset.resize(start + len(rows), axis=0)
            self._dataset[start:] = rows


class RowReader:
    """Reads one array, some rows at a time, in their order.

    Parameters
    ----------
    group : h5py.Group
    name : str
    shape : tuple of int
        The shape that it has to have.
    dtype : dtype
        The type that it has to have.

    Raises
    ------
    MisstepError
        If there is no such array, or its shape, type or layout is another.
    """

    def __init__(
        self, group: h5py.Group, name: str, shape: tuple[int, ...], dtype: np.dtype[Any]
    ) -> None:
        self._dataset = member(group, name, h5py.Dataset)
        self._name, self._shape, self._dtype = name, shape, dtype
        with damage(name):
            self._check()
        self._left = np.empty((0, *shape[1:]), dtype)  # inflated, not handed on yet
        self._next = 0  # first row that was not read

    def read(self, n_rows: int) -> NDArray[Any]:
        """Return the next rows: `n_rows` of them, or what is left.

        Raises
        ------
        MisstepError
            If what is stored is damaged.
        """
        parts, missing = [self._left[:n_rows]], n_rows - len(self._left)
        self._left = self._left[n_rows:]
        while missing > 0 and self._next < self._shape[0]:
            with damage(self._name):
                rows = self._stored_rows(missing)
            parts.append(rows[:missing])
            self._left = rows[missing:]
            missing -= len(parts[-1])
        return np.concatenate(parts)

    def _check(self) -> None:
        dataset, name = self._dataset, self._name
        if dataset.shape != self._shape:
            raise MisstepError(f"{name} has shape {dataset.shape}: it has to be {self._shape}")
        if dataset.dtype != self._dtype:
            raise MisstepError(f"{name} has dtype {dataset.dtype}: it has to be {self._dtype}")
        if dataset.is_virtual or dataset.external:
            raise MisstepError(f"{name} lies in another file: only what is in this one is read")
        if not self._is_stored_well():
            raise MisstepError(
                f"{name} is stored in another way than misstep does: plainly, or in chunks of "
                "whole rows, shuffled and deflated"
            )

    def _is_stored_well(self) -> bool:
        dataset = self._dataset
        if dataset.chunks is None:
            return bool(dataset.id.get_storage_size() == dataset.nbytes)
        rows = _rows_of_a_chunk(self._shape[1:])
        in_rows = self._shape[0] > rows and dataset.chunks == (rows, *self._shape[1:])
        if filters_of(dataset) != _FILTERS or not (in_rows or dataset.chunks == self._shape):
            return False
        check_sizes(dataset, self._name, _LARGEST_CHUNK)
        return bool(dataset.id.get_storage_size() > 0)

    def _stored_rows(self, n_rows: int) -> NDArray[Any]:
        """Return the next rows as they are stored together."""
        start, chunks = self._next, self._dataset.chunks
        if chunks is None:
            self._next = min(start + n_rows, self._shape[0])
            return np.asarray(self._dataset[start : self._next])
        self._next = min(start + chunks[0], self._shape[0])
        offset = (start, *(0 for _ in self._shape[1:]))
        return read_chunk(self._dataset, offset, _FILTERS)[: self._next - start]


def member(group: h5py.Group, name: str, kind: type) -> Any:
    """Return a group or an array that lies in `group`, not elsewhere.

    Raises
    ------
    MisstepError
        If it is missing, of another kind, or a link.
    """
    with damage(name):
        link = group.get(name, getlink=True)
        if link is None:
            raise MisstepError(f"{name} is missing")
        if not isinstance(link, h5py.HardLink):
            raise MisstepError(f"{name} is a link to elsewhere: only plain members are read")
        found = group[name]
    if not isinstance(found, kind):
        raise MisstepError(f"{name} is not a {kind.__name__.lower()}")
    return found
