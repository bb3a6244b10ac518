"""Samples that do not fit in memory: they come by in chunks, once for each pass.

The first pass counts them, sums their moments and draws a uniform subsample by Vitter's reservoir
(algorithm R, 1985). The subsample is fitted in memory, which finds the starts; from there
expectation–maximisation goes over all chunks, for all K of a scan in the same pass. Memory is that
of one chunk and of the subsample, whatever the number of samples.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from misstep.errors import MisstepError
from misstep.mixture import em
from misstep.mixture.em import Samples

Array = NDArray[np.float64]

CHUNK = 65_536
SUBSAMPLE = 65_536


class Rows(Protocol):
    """What can be sliced by rows: an HDF5 dataset, a memory map, an array."""

    def __len__(self) -> int:
        """Return the number of rows."""

    def __getitem__(self, rows: slice, /) -> ArrayLike:
        """Return some rows."""


class RowChunks:
    """The rows of an HDF5 dataset, memory map or array, some at a time, as often as wanted.

    Parameters
    ----------
    rows : sliceable, shape (N, d)
    size : int, default=65536
        Rows of a chunk.

    Raises
    ------
    MisstepError
        If `size` is below 1.

    Examples
    --------
    >>> [len(chunk) for chunk in RowChunks(np.zeros((5, 2)), size=2)]
    [2, 2, 1]
    """

    def __init__(self, rows: Rows, size: int = CHUNK) -> None:
        if size < 1:
            raise MisstepError(f"a chunk has at least one row, got size={size}")
        self._rows = rows
        self._size = size

    def __iter__(self) -> Iterator[Array]:
        """Yield arrays of shape (up to `size`, d)."""
        for begin in range(0, len(self._rows), self._size):
            yield np.asarray(self._rows[begin : begin + self._size], dtype=np.float64)


class Survey(NamedTuple):
    """What the first pass finds out."""

    n_samples: int
    mean: Array
    """Of each column, shape (d,)."""
    scale: Array
    """Standard deviation of each column, shape (d,)."""
    subsample: Array
    """Samples drawn uniformly, shape (min(n_samples, size), d)."""


def survey(chunks: Iterable[ArrayLike], size: int, rng: np.random.Generator) -> Survey:
    """Go over all chunks once.

    Parameters
    ----------
    chunks : iterable of array-like, shape (n, d)
    size : int
        Most samples of the subsample.
    rng : numpy.random.Generator

    Raises
    ------
    MisstepError
        If the chunks cannot be read twice, differ in columns, hold a number that is not finite, or
        have fewer than two samples together.
    """
    if isinstance(chunks, Iterator):
        raise MisstepError(
            "chunks is an iterator, which one pass uses up: give a list, or an object whose "
            "__iter__ starts anew, such as RowChunks"
        )
    n, mean, squares, reservoir = 0, np.empty(0), np.empty(0), np.empty((0, 0))
    for chunk in _checked(chunks):
        if n == 0:
            mean, squares = np.zeros(chunk.shape[1]), np.zeros(chunk.shape[1])
            reservoir = np.empty((size, chunk.shape[1]))
        m = len(chunk)
        # Chan, Golub & LeVeque: moments of two parts from those of each.
        with np.errstate(over="ignore", invalid="ignore"):
            own = chunk.mean(axis=0)
            gap = own - mean
            squares += ((chunk - own) ** 2).sum(axis=0) + gap**2 * (n * m / (n + m))
            mean = mean + gap * (m / (n + m))
        _draw_into(reservoir, chunk, n, rng)
        n += m
    if n < 2:
        raise MisstepError(f"a mixture takes at least two samples, got {n}")
    return Survey(n, mean, np.sqrt(squares / n), reservoir[:n])


def _draw_into(reservoir: Array, chunk: Array, seen: int, rng: np.random.Generator) -> None:
    size, end = len(reservoir), seen + len(chunk)
    fresh = min(max(size - seen, 0), len(chunk))
    reservoir[seen : seen + fresh] = chunk[:fresh]
    place = rng.integers(0, np.arange(seen + fresh, end) + 1)
    kept = place < size
    # Where two samples draw one place, the later assignment holds, as if drawn one by one.
    reservoir[place[kept]] = chunk[fresh:][kept]


class StandardisedChunks:
    """The chunks again, standardised and in blocks, for `fitting.fit_by_passes`."""

    def __init__(self, chunks: Iterable[ArrayLike], found: Survey) -> None:
        self._chunks = chunks
        self._found = found

    def __iter__(self) -> Iterator[Samples]:
        """Yield each chunk; raise MisstepError if there are more or fewer samples than before."""
        n = 0
        for chunk in _checked(self._chunks):
            n += len(chunk)
            standardised = (chunk - self._found.mean) / self._found.scale
            yield em.in_blocks(standardised, np.ones(len(chunk)))
        if n != self._found.n_samples:
            raise MisstepError(
                f"the chunks held {self._found.n_samples} samples in the first pass but {n} in a "
                f"later one: each pass must read the same"
            )


def _checked(chunks: Iterable[ArrayLike]) -> Iterator[Array]:
    columns = None
    for i, given in enumerate(chunks):
        chunk = np.asarray(given, dtype=np.float64)
        if chunk.ndim != 2 or chunk.shape[1] == 0 or chunk.shape[1] != (columns or chunk.shape[1]):
            raise MisstepError(
                f"chunk {i} has shape {chunk.shape}: all chunks take (n, {columns or 'd'})"
            )
        if not np.all(np.isfinite(chunk)):
            raise MisstepError(f"chunk {i} holds a number that is not finite")
        columns = chunk.shape[1]
        if len(chunk):
            yield chunk
