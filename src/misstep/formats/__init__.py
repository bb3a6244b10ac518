"""Files of trajectories: one module a format, chosen by the suffix of the file.

A format is a `Format`, registered under a name. Another package announces its own through an
entry point of the group ``misstep.formats``.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from misstep.errors import MisstepError
from misstep.formats import hdf5
from misstep.registry import Registry
from misstep.trajectory import Dataset, Trajectory


@dataclass(frozen=True)
class Format:
    """How to read and write one kind of file.

    Parameters
    ----------
    suffixes : tuple of str
        The suffixes it goes by, in lower case, each with its dot.
    load : callable
        ``load(path) -> Dataset``.
    save : callable
        ``save(dataset, path)``, in a single step: the old file or the new one, never half.
    append : callable
        ``append(path, trajectory)``, in a single step; makes the file where there is none.
    """

    suffixes: tuple[str, ...]
    load: Callable[[Path], Dataset]
    save: Callable[[Dataset, Path], None]
    append: Callable[[Path, Trajectory], None]


FORMATS: Registry[Format] = Registry("format", "misstep.formats")
FORMATS.register("hdf5")(Format(hdf5.SUFFIXES, hdf5.load, hdf5.save, hdf5.append))


def load_dataset(path: str | os.PathLike[str]) -> Dataset:
    """Read a file of trajectories.

    Raises
    ------
    MisstepError
        If no format goes by the suffix, or the file is missing, damaged or of another kind.
    """
    return format_of(path).load(Path(path))


def save_dataset(dataset: Dataset, path: str | os.PathLike[str]) -> None:
    """Write trajectories to a file, in place of what was there.

    Raises
    ------
    MisstepError
        If no format goes by the suffix, or the file cannot be written.
    """
    format_of(path).save(dataset, Path(path))


def append_trajectory(path: str | os.PathLike[str], trajectory: Trajectory) -> None:
    """Add one trajectory at the end of a file, or make the file with that one.

    Killed at any instant, it leaves the file as it was or with the trajectory added. Two
    processes must not append to one file at the same time: one of the additions would be lost.

    Raises
    ------
    MisstepError
        If no format goes by the suffix, the file cannot be read or written, or its trajectories
        have other columns or another dt.
    """
    format_of(path).append(Path(path), trajectory)


def format_of(path: str | os.PathLike[str]) -> Format:
    """Return the format that goes by the suffix of `path`.

    Raises
    ------
    MisstepError
        If there is none.
    """
    try:
        return _format_by_suffix(Path(path).suffix.lower())
    except MisstepError as error:
        raise MisstepError(f"{path}: {error}") from error


@cache  # looking through the installed packages takes longer than writing a trajectory
def _format_by_suffix(suffix: str) -> Format:
    for entry in FORMATS.values():
        if suffix in entry.suffixes:
            return entry
    known = ", ".join(suffix for entry in FORMATS.values() for suffix in entry.suffixes)
    raise MisstepError(f"no format goes by the suffix {suffix!r}; there are: {known}")
