"""Arrays in HDF5 files of other projects, read some rows at a time, however they are chunked.

Nothing is taken on trust: links out of the file, filters that are not built into HDF5, and chunks
larger than memory should hold are refused. Deflated chunks are inflated by
`misstep.formats.hdf5.chunks`.
"""

import itertools
import math
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.formats.hdf5.arrays import member
from misstep.formats.hdf5.attributes import damage
from misstep.formats.hdf5.chunks import check_sizes, filters_of, read_chunk

_LARGEST_CHUNK = 2**26  # bytes, inflated
_LARGEST_LZF = 2**24  # bytes, inflated: the library does that itself
_LARGEST_ROW = 2**20  # bytes
_UNDONE = {h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_FLETCHER32}


class ForeignArray:
    """One array of numbers, (rows, ...) of which any rows can be read.

    Parameters
    ----------
    group : h5py.Group
    name : str

    Attributes
    ----------
    shape : tuple of int

    Raises
    ------
    MisstepError
        If there is no such array, it holds no numbers, or it is stored in a way that is refused.
    """

    def __init__(self, group: h5py.Group, name: str) -> None:
        self._name = name
        self._dataset: h5py.Dataset = member(group, name, h5py.Dataset)
        with damage(name):
            self._check()
            self.shape: tuple[int, ...] = self._dataset.shape
            self._dtype: np.dtype[Any] = self._dataset.dtype

    @property
    def row_width(self) -> int:
        """Numbers in a row."""
        return math.prod(self.shape[1:])

    def read(self, start: int, stop: int) -> NDArray[np.float64]:
        """Return rows `start` to `stop`, shape (b, row_width).

        Raises
        ------
        MisstepError
            If what is stored is damaged.
        """
        with damage(self._name):
            rows = self._plain(start, stop) if self._filters is None else self._own(start, stop)
            return rows.reshape(stop - start, -1).astype(np.float64)

    def check(self) -> None:
        """Unpack all of it, so that whoever reads it next with HDF5 makes no more of it.

        Raises
        ------
        MisstepError
            If what is stored is damaged.
        """
        if self._filters is not None:
            rows = self._dataset.chunks[0]
            for start in range(0, self.shape[0], rows):
                self.read(start, min(start + rows, self.shape[0]))

    def _check(self) -> None:
        dataset, name = self._dataset, self._name
        if not dataset.shape or dataset.dtype.kind not in "fiub" or dataset.dtype.subdtype:
            raise MisstepError(f"{name} is no array of numbers")
        if dataset.is_virtual or dataset.external:
            raise MisstepError(f"{name} lies in another file: only what is in this one is read")
        if math.prod(dataset.shape[1:]) * dataset.dtype.itemsize > _LARGEST_ROW:
            raise MisstepError(f"{name} has rows of shape {dataset.shape[1:]}: that is too much")
        self._filters: list[int] | None = None
        self._unpacked: tuple[tuple[int, ...], NDArray[Any]] | None = None  # the last chunk
        if dataset.chunks is None:
            if dataset.id.get_storage_size() < dataset.nbytes:
                raise MisstepError(f"{name} claims to be longer than what is stored of it")
            return
        self._check_chunks()

    def _check_chunks(self) -> None:
        dataset, name = self._dataset, self._name
        filters = filters_of(dataset)
        is_lzf = h5py.h5z.FILTER_LZF in filters
        check_sizes(dataset, name, _LARGEST_LZF if is_lzf else _LARGEST_CHUNK)
        if set(filters) - _UNDONE - {h5py.h5z.FILTER_LZF}:
            raise MisstepError(
                f"{name} is packed with HDF5 filters {sorted(filters)}: rewrite it with gzip, lzf "
                "or none"
            )
        chunks = math.prod(-(-n // c) for n, c in zip(dataset.shape, dataset.chunks, strict=True))
        if dataset.id.get_num_chunks() < chunks:
            raise MisstepError(f"{name} claims to be longer than what is stored of it")
        if filters and set(filters) <= _UNDONE:
            self._filters = filters

    def _plain(self, start: int, stop: int) -> NDArray[Any]:
        return np.asarray(self._dataset[start:stop])

    def _own(self, start: int, stop: int) -> NDArray[Any]:
        """Return rows whose chunks are unpacked here."""
        chunk = self._dataset.chunks
        rows = np.empty((stop - start, *self.shape[1:]), self._dtype)
        corners = [
            range(start - start % chunk[0], stop, chunk[0]),
            *(range(0, n, c) for n, c in zip(self.shape[1:], chunk[1:], strict=True)),
        ]
        for corner in itertools.product(*corners):
            if self._unpacked is None or self._unpacked[0] != corner:
                self._unpacked = None  # before there is another one in memory
                self._unpacked = corner, read_chunk(self._dataset, corner, self._filters or [])
            block = self._unpacked[1]
            first, last = max(corner[0], start), min(corner[0] + chunk[0], stop)
            rest = tuple(
                slice(at, min(at + c, n))
                for at, c, n in zip(corner[1:], chunk[1:], self.shape[1:], strict=True)
            )
            inside = tuple(slice(0, part.stop - part.start) for part in rest)
            rows[(slice(first - start, last - start), *rest)] = block[
                (slice(first - corner[0], last - corner[0]), *inside)
            ]
        return rows
