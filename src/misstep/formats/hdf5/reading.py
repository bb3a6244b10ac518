"""Reading misstep's own files; `misstep.formats.hdf5` says how they are laid out."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import h5py
import numpy as np

from misstep.errors import MisstepError
from misstep.formats.format import BLOCK_ROWS, Block, Ending, Episode, Header, ReadOptions
from misstep.formats.guard import prefixed
from misstep.formats.hdf5.arrays import BOOL, FLOAT, RowReader, member
from misstep.formats.hdf5.attributes import attribute, damage, has_attribute, json_attribute
from misstep.formats.hdf5.opening import check_signature, opened
from misstep.trajectory import Column, Outcome, Provenance

FORMAT_VERSION = 1
_BEGINNING = 2048  # bytes


def recognise(path: Path) -> bool:
    """Say whether a file is surely of this format, without going through it."""
    try:
        with open(path, "rb") as file:
            return b"misstep_format" in file.read(_BEGINNING)
    except OSError:
        return False


@dataclass(frozen=True)
class FileHeader:
    """What the file says of all its episodes."""

    dt: float
    observation_columns: tuple[Column, ...]
    action_columns: tuple[Column, ...]
    n_episodes: int
    n_steps: int


def read(path: Path, options: ReadOptions) -> Iterator[Episode]:
    """Read what `write` or `append` wrote; see `misstep.formats.format.Format`.

    Raises
    ------
    MisstepError
        If the file is not misstep's or of a newer version, it is damaged, or any part of it lies
        outside it.
    """
    check_signature(path)
    with opened(path, "rb") as (file, _):
        header = read_header(file)
        left = header.n_steps
        for index in range(header.n_episodes):
            group = group_of(file, index)
            with prefixed(f"episode_{index}"):
                steps = attribute(group, "total_steps", int)
                if not 1 <= steps <= left:
                    raise MisstepError(
                        f"total_steps is {steps}, but the file has {left} left for it"
                    )
                episode = _read_episode(group, steps, header)
            yield episode
            left -= steps
            if options.report is not None:
                options.report(header.n_steps - left, header.n_steps)
        if left != 0:
            raise MisstepError(f"total_steps counts {left} steps more than the episodes hold")


def read_header(file: h5py.File) -> FileHeader:
    """Return what the file says of all its episodes.

    Raises
    ------
    MisstepError
        If it is not misstep's, of a newer version, or damaged.
    """
    if not has_attribute(file, "misstep_format"):
        raise MisstepError("it is an HDF5 file, but not of misstep's: no attribute misstep_format")
    version = attribute(file, "misstep_format", int)
    if version > FORMAT_VERSION:
        raise MisstepError(
            f"its format version is {version} and this misstep reads up to {FORMAT_VERSION}: "
            "install a newer misstep"
        )
    if version < 1:
        raise MisstepError(f"its format version is {version}: the first one is 1")
    header = FileHeader(
        attribute(file, "dt", float),
        _columns_from_json(file, "observation_columns"),
        _columns_from_json(file, "action_columns"),
        attribute(file, "total_episodes", int),
        attribute(file, "total_steps", int),
    )
    with damage("the list of episodes"):
        found = len(file)
    if found != header.n_episodes:
        raise MisstepError(f"total_episodes is {header.n_episodes} but there are {found} groups")
    if not 0 < header.dt < np.inf:
        raise MisstepError(f"dt is {header.dt}: it has to be a positive number of seconds")
    return header


def group_of(file: h5py.File, index: int) -> h5py.Group:
    """Return the group of an episode, from 0."""
    return member(file, f"episode_{index}", h5py.Group)


def episode_header(group: h5py.Group, file: FileHeader) -> Header:
    """Return what is known of an episode before its first row."""
    return Header(file.dt, file.observation_columns, file.action_columns, _read_provenance(group))


def _read_episode(group: h5py.Group, steps: int, file: FileHeader) -> Episode:
    header = episode_header(group, file)
    for name in ("terminations", "truncations"):
        RowReader(group, name, (steps,), BOOL)  # they follow from the outcome: nothing to read
    arrays = {
        "observations": RowReader(
            group, "observations", (steps + 1, len(header.observation_columns)), FLOAT
        ),
        "actions": RowReader(group, "actions", (steps, len(header.action_columns)), FLOAT),
        "rewards": RowReader(group, "rewards", (steps,), FLOAT),
    }
    costs_recorded = attribute(group, "costs_recorded", bool)
    return Episode(header, _blocks(arrays, steps, costs_recorded), partial(_ending, group, steps))


def _blocks(arrays: dict[str, RowReader], steps: int, costs_recorded: bool) -> Iterator[Block]:
    for _ in range(0, steps + 1, BLOCK_ROWS):
        rows = {name: array.read(BLOCK_ROWS) for name, array in arrays.items()}
        costs = -rows["rewards"] if costs_recorded else None
        yield Block(rows["observations"], rows["actions"], costs)


def _ending(group: h5py.Group, steps: int) -> Ending:
    outcome = attribute(group, "outcome", str)
    if outcome not in list(Outcome):
        raise MisstepError(f"outcome is {outcome!r}; there are: {', '.join(Outcome)}")
    if not has_attribute(group, "failure_step"):
        return Ending(Outcome(outcome))
    step = attribute(group, "failure_step", int)
    if not 0 <= step <= steps:
        raise MisstepError(
            f"failure_step is {step} but there are {steps} actions: it numbers an observation"
        )
    return Ending(Outcome(outcome), step)


def _read_provenance(group: h5py.Group) -> Provenance:
    seed: int | None = None
    if has_attribute(group, "seed"):
        with damage("attribute seed"):
            seed = int(attribute(group, "seed", (int, str)))
    return Provenance(
        system=attribute(group, "system", str),
        parameters=json_attribute(group, "parameters"),
        demonstrator=attribute(group, "demonstrator", str),
        seed=seed,
        time=attribute(group, "time", str),
        notes=json_attribute(group, "notes") if has_attribute(group, "notes") else (),
    )


def _columns_from_json(file: h5py.File, name: str) -> tuple[Column, ...]:
    pairs = json_attribute(file, name)
    if not isinstance(pairs, list) or not all(isinstance(p, list) and len(p) == 2 for p in pairs):
        raise MisstepError(f"attribute {name} has to list pairs of name and unit")
    return tuple(Column(*pair) for pair in pairs)
