"""Chunks of HDF5 arrays, inflated here.

The HDF5 library would inflate a few kilobytes into as much memory as they claim, and ask for as
much as a chunk claims to take up in the file. So both are checked before, and nothing is ever made
larger than the shape of a chunk.
"""

import math
import zlib
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError

_CHECKSUM = 4  # bytes of Fletcher's checksum at the end of a chunk
_Bytes = bytes | memoryview


def filters_of(dataset: h5py.Dataset) -> list[int]:
    """Return the filters of an array's chunks, in the order in which they were applied."""
    properties = dataset.id.get_create_plist()
    return [properties.get_filter(i)[0] for i in range(properties.get_nfilters())]


def check_sizes(dataset: h5py.Dataset, name: str, largest: int) -> None:
    """Refuse chunks that take up more than `largest` bytes, or more in the file than they hold.

    Raises
    ------
    MisstepError
        If there are such.
    """
    n_bytes = math.prod(dataset.chunks) * dataset.dtype.itemsize
    if n_bytes > largest:
        raise MisstepError(
            f"{name} would take up {n_bytes} bytes in one piece: at most {largest} are allowed"
        )
    most = n_bytes + n_bytes // 100 + 1024  # what cannot be deflated grows a little
    if dataset.id.chunk_iter(lambda chunk: chunk.size > most or None) is not None:
        raise MisstepError(f"{name} has a chunk that takes up more than it holds")


def read_chunk(dataset: h5py.Dataset, corner: tuple[int, ...], filters: list[int]) -> NDArray[Any]:
    """Return the chunk at a corner, unpacked.

    Parameters
    ----------
    dataset : h5py.Dataset
    corner : tuple of int
        Its first element.
    filters : list of int
        What `filters_of` says: shuffling, deflation and checksums.

    Raises
    ------
    MisstepError
        If it is longer or shorter than its shape.
    """
    # `skipped` is HDF5's mask of filters that were left out when the chunk was written.
    skipped, packed = dataset.id.read_direct_chunk(corner)
    n_bytes = math.prod(dataset.chunks) * dataset.dtype.itemsize
    plain: _Bytes = packed
    for place in reversed(range(len(filters))):
        if not skipped >> place & 1:
            plain = _undone(filters[place], plain, n_bytes, dataset.dtype.itemsize)
    if len(plain) != n_bytes:
        raise MisstepError(f"a compressed array holds {len(plain)} bytes, not {n_bytes}")
    return np.frombuffer(plain, dataset.dtype).reshape(dataset.chunks)


def _undone(kind: int, packed: _Bytes, n_bytes: int, itemsize: int) -> _Bytes:
    """Undo one filter of a chunk of `n_bytes`, never making more than those and a checksum."""
    if kind == h5py.h5z.FILTER_FLETCHER32:
        return packed[:-_CHECKSUM]
    if kind == h5py.h5z.FILTER_DEFLATE:
        inflater = zlib.decompressobj()
        plain = inflater.decompress(packed, n_bytes + _CHECKSUM + 1)
        if not inflater.eof:
            raise MisstepError("a compressed array is longer or shorter than it has to be")
        return plain
    # Shuffled: first the first byte of every number, then all second bytes, and so on.
    planes = np.frombuffer(packed, np.uint8).reshape(itemsize, -1)
    return np.ascontiguousarray(planes.T).reshape(-1).data
