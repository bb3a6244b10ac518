"""Files of trajectories: one module or folder a format, chosen by the suffix of the file.

A format is a `Format`, registered under a name. Another package announces its own through an
entry point of the group ``misstep.formats``. `load_dataset` and `save_dataset` hold a data set in
memory; `read_episodes` and `write_episodes` pass recordings of any size block by block.
"""

import os
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path

from misstep.errors import MisstepError
from misstep.formats import bags, hdf5, lerobot, minari, robomimic, tables
from misstep.formats.format import (
    LARGEST_IN_MEMORY,
    Block,
    Ending,
    Episode,
    Format,
    Header,
    Read,
    ReadOptions,
)
from misstep.formats.guard import guarded, prefixed
from misstep.registry import Registry
from misstep.storage import check_regular
from misstep.trajectory import Dataset, Trajectory

__all__ = [
    "FORMATS",
    "Block",
    "Ending",
    "Episode",
    "Format",
    "Header",
    "ReadOptions",
    "append_trajectory",
    "format_of",
    "format_to_read",
    "load_dataset",
    "read_episodes",
    "save_dataset",
    "write_episodes",
]

FORMATS: Registry[Format] = Registry("format", "misstep.formats")
FORMATS.register("hdf5")(hdf5.FORMAT)
FORMATS.register("csv")(tables.CSV)
FORMATS.register("parquet")(tables.PARQUET)
FORMATS.register("minari")(minari.FORMAT)
FORMATS.register("minari-arrow")(minari.ARROW)
FORMATS.register("robomimic")(robomimic.FORMAT)
FORMATS.register("lerobot")(lerobot.FORMAT)
FORMATS.register("lerobot-v2.1")(lerobot.V21)
FORMATS.register("rosbag")(bags.ROS1)
FORMATS.register("rosbag2")(bags.ROS2)
FORMATS.register("mcap")(bags.MCAP)
FORMATS.register("db3")(bags.DB3)


def load_dataset(path: str | os.PathLike[str], format: str | None = None) -> Dataset:
    """Read a file of trajectories.

    Parameters
    ----------
    path : path
    format : str, optional
        Name of a format; by default what the content and the suffix say.

    Raises
    ------
    MisstepError
        If no format goes by the suffix, the file is missing, damaged or of another kind, or what
        it holds are not trajectories: no actions, uneven times.
    """
    source = _reader(path, format)
    with prefixed(f"cannot read {path}"):
        return Dataset(_trajectories(source(Path(path), ReadOptions())))


def _trajectories(episodes: Iterable[Episode]) -> Iterator[Trajectory]:
    n_bytes = 0
    for index, episode in enumerate(episodes):
        with prefixed(f"episode_{index}"):  # a trajectory checks itself: no guard is needed
            trajectory = episode.trajectory()
        n_bytes += trajectory.observations.nbytes + trajectory.actions.nbytes
        if n_bytes > LARGEST_IN_MEMORY:
            raise MisstepError(
                f"it takes up more than {LARGEST_IN_MEMORY} bytes in memory: convert it to "
                "several files, or bring it to a lower rate with --to-rate"
            )
        yield trajectory


def save_dataset(dataset: Dataset, path: str | os.PathLike[str], format: str | None = None) -> None:
    """Write trajectories to a file, in place of what was there.

    Parameters
    ----------
    dataset : Dataset
    path : path
    format : str, optional
        Name of a format; by default the one that goes by the suffix.

    Raises
    ------
    MisstepError
        If no format goes by the suffix, it cannot hold all of the data set, or the file cannot be
        written.
    """
    episodes = map(Episode.of, dataset)
    write_episodes(path, episodes, format)


def append_trajectory(path: str | os.PathLike[str], trajectory: Trajectory) -> None:
    """Add one trajectory at the end of a file, or make the file with that one.

    Killed at any instant, it leaves the file as it was or with the trajectory added. Two
    processes must not append to one file at the same time: one of the additions would be lost.
    Formats other than misstep's own are written anew, with what misstep reads of them: videos or
    topics that another program wrote beside it are not kept.

    Raises
    ------
    MisstepError
        If no format goes by the suffix, the file cannot be read or written, or its trajectories
        have other columns or another dt.
    """
    if not os.path.lexists(minari.located(path)):
        write_episodes(path, [Episode.of(trajectory)])
        return
    target = format_to_read(path)
    if target.append is not None:
        target.append(Path(path), trajectory)
    else:
        whole = chain(read_episodes(path), [Episode.of(trajectory)])
        write_episodes(path, whole, _name_of(target))


def read_episodes(
    path: str | os.PathLike[str],
    options: ReadOptions | None = None,
    format: str | None = None,
) -> Iterator[Episode]:
    """Read a file of recordings of any size, one episode after the other, block by block.

    Parameters
    ----------
    path : path
        A file, or a folder where the format is one.
    options : ReadOptions, optional
        What the file does not say itself.
    format : str, optional
        Name of a format; by default what the content and the suffix say.

    Yields
    ------
    Episode
        To be gone through before the next one is asked for.

    Raises
    ------
    MisstepError
        Also on the way: if no format goes by the suffix, or the file is missing, damaged or of
        another kind.
    """
    options = options or ReadOptions()
    episodes = _reader(path, format)(Path(path), options)
    return guarded(Path(path), episodes, keep_nan=options.keep_nan)


def _reader(path: str | os.PathLike[str], name: str | None) -> Read:
    source = format_to_read(path, name)
    if source.read is None:
        raise MisstepError(f"{path}: {source.description} is only written, not read")
    place = minari.located(path)
    if not os.path.exists(place):
        raise MisstepError(f"cannot read {path}: there is no such file")
    for file in _files(place):
        check_regular(file)
    return source.read


def _files(place: str | os.PathLike[str]) -> Iterator[str]:
    """Yield a file, or all files in a folder, each folder once even where links go in circles."""
    yield os.fspath(place)
    seen = set()
    for folder, inner, names in os.walk(place, followlinks=True):
        status = os.stat(folder)
        if (key := (status.st_dev, status.st_ino)) in seen:
            inner.clear()
            continue
        seen.add(key)
        yield from (os.path.join(folder, name) for name in names)


def write_episodes(
    path: str | os.PathLike[str], episodes: Iterable[Episode], format: str | None = None
) -> None:
    """Write recordings of any size to a file, in place of what was there, in a single step.

    Parameters
    ----------
    path : path
    episodes : iterable of Episode
        Each is gone through once.
    format : str, optional
        Name of a format; by default the one that goes by the suffix.

    Raises
    ------
    MisstepError
        If no format goes by the suffix, it cannot hold an episode, or the file cannot be written.
    """
    target = format_of(path, format)
    if target.write is None:
        raise MisstepError(f"{path}: {target.description} is only read, not written")
    target.write(Path(path), episodes)


def format_of(path: str | os.PathLike[str], name: str | None = None) -> Format:
    """Return the format in which a file is to be written.

    Parameters
    ----------
    path : path
    name : str, optional
        Name of the format, which settles it.

    Raises
    ------
    MisstepError
        If there is none of that name, or none goes by the suffix.
    """
    if name is not None:
        return FORMATS[name]
    if os.fspath(path).startswith(minari.SCHEME):
        return FORMATS["minari"]
    suffix = Path(path).suffix.lower()
    for candidate in _formats():
        if suffix in candidate.suffixes:
            return candidate
    known = ", ".join(suffix for entry in _formats() for suffix in entry.suffixes)
    raise MisstepError(f"{path}: no format goes by the suffix {suffix!r}; there are: {known}")


def format_to_read(path: str | os.PathLike[str], name: str | None = None) -> Format:
    """Return the format of a file that exists.

    Its content is looked at where several formats go by its suffix, or where it is a folder.

    Parameters
    ----------
    path : path
    name : str, optional
        Name of the format, which settles it.

    Raises
    ------
    MisstepError
        If there is none of that name, none goes by the suffix, or there is no such file.
    """
    if name is not None:
        return FORMATS[name]
    check_regular(path)
    path = Path(path)
    suffix, is_folder = path.suffix.lower(), path.is_dir()
    own = [entry for entry in _formats() if suffix in entry.suffixes]
    others = [
        entry
        for entry in _formats()
        if (entry.is_folder if is_folder else suffix in entry.read_suffixes)
    ]
    for candidate in (*own, *others):
        if path.exists() and candidate.recognise(path):
            return candidate
    if is_folder and suffix not in {s for f in _formats() for s in f.suffixes}:
        folders = (
            ", ".join(name for name, entry in FORMATS.loaded()[0].items() if entry.is_folder)
            or "none"
        )
        raise MisstepError(
            f"{path}: the folder is of no known format; formats that are folders: {folders}"
        )
    return format_of(path)


def _formats() -> tuple[Format, ...]:
    """Return the formats that can be loaded: one that cannot is no reason to read no file."""
    return tuple(FORMATS.loaded()[0].values())


def _name_of(target: Format) -> str:
    return next(name for name, entry in FORMATS.loaded()[0].items() if entry is target)
