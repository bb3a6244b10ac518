"""misstep's own files: HDF5 in Minari's episode layout, with what Minari does not say beside it.

::

    /            attributes misstep_format, dt, observation_columns, action_columns (JSON lists
                 of [name, unit]), total_episodes, total_steps
    /episode_0   attributes id, total_steps, seed (if any), system, parameters (JSON),
                 demonstrator, time, notes (JSON list, if any), outcome, failure_step (if
                 any), costs_recorded
      observations (T + 1, n) float64    terminations (T,) bool
      actions      (T, m)     float64    truncations  (T,) bool
      rewards      (T,)       float64    infos        an empty group
    /episode_1   ...

Rewards are the costs with the sign turned, or zeros where no costs were recorded. The last step
of an episode is a termination if it failed there, and otherwise a truncation. How arrays are
stored says `misstep.formats.hdf5_arrays`. Equal data sets give equal files.

A file may come from anywhere, so reading takes nothing on trust: no size that is declared is
believed before as much is there, and episodes pass in blocks, whatever their length. Nothing is
written in place: a file is made beside the old one and takes its place when it is whole.
"""

import json
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np

from misstep.errors import MisstepError
from misstep.formats.format import (
    BLOCK_ROWS,
    Block,
    Ending,
    Episode,
    Format,
    Header,
    ReadOptions,
)
from misstep.formats.guard import check_same_kind, prefixed
from misstep.formats.hdf5_arrays import BOOL, FLOAT, RowReader, RowWriter, member
from misstep.formats.hdf5_attributes import (
    attribute,
    damage,
    has_attribute,
    json_attribute,
    set_attribute,
)
from misstep.formats.steps import uniform
from misstep.formats.unfailing import UnfailingFile
from misstep.storage import atomic_write
from misstep.trajectory import Column, Outcome, Provenance, Trajectory

_FORMAT_VERSION = 1
_BEGINNING = 2048  # bytes
_SIGNATURE = b"\x89HDF\r\n\x1a\n"


# Writing


def write(path: Path, episodes: Iterable[Episode]) -> None:
    """Write episodes to `path` in a single step, in place of what was there.

    Raises
    ------
    MisstepError
        If an episode has no actions, no common dt, or another kind than the first; there is none;
        or the file cannot be written.
    """

    def fill(temporary: Path) -> None:
        with _opened(temporary, "w+b") as (file, disk):
            # First of all, so that it lies near the beginning, where `recognise` looks.
            set_attribute(file, "misstep_format", _FORMAT_VERSION)
            count = steps = 0
            first: Header | None = None
            for count, episode in enumerate(uniform(path, episodes), start=1):
                first = first or episode.header
                with prefixed(f"cannot write {path}"):
                    steps += _write_episode(file, disk, count - 1, episode)
            if first is not None:  # `uniform` makes sure that there is one
                with prefixed(f"cannot write {path}"):
                    _write_header(file, first, count, steps)

    atomic_write(path, fill)


def append(path: Path, trajectory: Trajectory) -> None:
    """Add `trajectory` at the end of the file, in a single step.

    Raises
    ------
    MisstepError
        If the file cannot be read or written, or its trajectories have other columns or another
        dt.
    """
    episode = Episode.of(trajectory)

    def fill(temporary: Path) -> None:
        shutil.copyfile(path, temporary)
        with _opened(temporary, "r+b") as (file, disk):
            there = _read_header(file)
            first = _episode_header(_group(file, 0), there)
            with damage("its structure"):
                check_same_kind(there.n_episodes, episode.header, first)
                steps = _write_episode(file, disk, there.n_episodes, episode)
                file.attrs.modify("total_episodes", there.n_episodes + 1)
                file.attrs.modify("total_steps", there.n_steps + steps)

    with prefixed(f"cannot add a trajectory to {path}"):
        _check_signature(path)
        atomic_write(path, fill)


def _write_header(file: h5py.File, header: Header, episodes: int, steps: int) -> None:
    set_attribute(file, "dt", header.dt)
    set_attribute(file, "observation_columns", _columns_to_json(header.observation_columns))
    set_attribute(file, "action_columns", _columns_to_json(header.action_columns))
    set_attribute(file, "total_episodes", episodes)
    set_attribute(file, "total_steps", steps)


def _write_episode(file: h5py.File, disk: UnfailingFile, index: int, episode: Episode) -> int:
    """Write an episode block by block; return its number of steps."""
    group = file.create_group(f"episode_{index}")
    header = episode.header
    observations = RowWriter(group, "observations", (len(header.observation_columns),), FLOAT)
    actions = RowWriter(group, "actions", (len(header.action_columns),), FLOAT)
    rewards = RowWriter(group, "rewards", (), FLOAT)
    costs_recorded = False
    for block in episode.blocks:
        observations.write(block.observations)
        actions.write(block.actions)
        if block.costs is not None:
            rewards.write(-block.costs)
            costs_recorded = True
        disk.check()
    steps, ending = actions.n_rows, episode.ending()
    if not costs_recorded:
        _write_constant(rewards, 0.0, steps)
    for array in (observations, actions, rewards):
        array.close()
    failed_there = ending.outcome is Outcome.FAILURE and ending.failure_step == steps
    for name, ended in (("terminations", failed_there), ("truncations", not failed_there)):
        flags = RowWriter(group, name, (), BOOL)
        _write_constant(flags, False, steps - 1)
        flags.write(np.array([ended]))
        flags.close()
    group.create_group("infos")
    notes = (*header.provenance.notes, *ending.notes)
    provenance = replace(header.provenance, notes=notes)
    for name, value in _episode_attributes(index, steps, provenance, ending).items():
        set_attribute(group, name, value)
    set_attribute(group, "costs_recorded", costs_recorded)
    disk.check()
    return steps


def _write_constant(writer: RowWriter, value: float | bool, count: int) -> None:
    for start in range(0, count, BLOCK_ROWS):
        writer.write(np.full(min(BLOCK_ROWS, count - start), value))


def _episode_attributes(
    index: int, steps: int, provenance: Provenance, ending: Ending
) -> dict[str, Any]:
    attributes: dict[str, Any] = {
        "id": index,
        "total_steps": steps,
        "system": provenance.system,
        "parameters": json.dumps(dict(provenance.parameters)),
        "demonstrator": provenance.demonstrator,
        "time": provenance.time,
        "outcome": ending.outcome.value,
    }
    if ending.failure_step is not None:
        attributes["failure_step"] = ending.failure_step
    if provenance.notes:
        attributes["notes"] = json.dumps(provenance.notes)
    if provenance.seed is not None:
        # Minari reads a seed as int(seed): beyond 64 bits, which HDF5 lacks, digits do as well.
        seed = provenance.seed
        attributes["seed"] = np.uint64(seed) if seed < 2**64 else str(seed)
    return attributes


def _columns_to_json(columns: tuple[Column, ...]) -> str:
    return json.dumps([[column.name, column.unit] for column in columns])


# The file


@contextmanager
def _opened(
    path: Path, mode: Literal["w+b", "r+b", "rb"]
) -> Iterator[tuple[h5py.File, UnfailingFile]]:
    """Open a file, and in the end make sure that all of it was written."""
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


def recognise(path: Path) -> bool:
    """Say whether a file is surely of this format, without going through it."""
    try:
        with open(path, "rb") as file:
            return b"misstep_format" in file.read(_BEGINNING)
    except OSError:
        return False


def _check_signature(path: Path) -> None:
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


# Reading


@dataclass(frozen=True)
class _FileHeader:
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
    _check_signature(path)
    with _opened(path, "rb") as (file, _):
        header = _read_header(file)
        left = header.n_steps
        for index in range(header.n_episodes):
            group = _group(file, index)
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


def _read_header(file: h5py.File) -> _FileHeader:
    if not has_attribute(file, "misstep_format"):
        raise MisstepError("it is an HDF5 file, but not of misstep's: no attribute misstep_format")
    version = attribute(file, "misstep_format", int)
    if version > _FORMAT_VERSION:
        raise MisstepError(
            f"its format version is {version} and this misstep reads up to {_FORMAT_VERSION}: "
            "install a newer misstep"
        )
    if version < 1:
        raise MisstepError(f"its format version is {version}: the first one is 1")
    header = _FileHeader(
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


def _group(file: h5py.File, index: int) -> h5py.Group:
    return member(file, f"episode_{index}", h5py.Group)


def _episode_header(group: h5py.Group, file: _FileHeader) -> Header:
    return Header(file.dt, file.observation_columns, file.action_columns, _read_provenance(group))


def _read_episode(group: h5py.Group, steps: int, file: _FileHeader) -> Episode:
    header = _episode_header(group, file)
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


FORMAT = Format(
    description="misstep's own: HDF5 in Minari's episode layout; loses nothing",
    suffixes=(".h5", ".hdf5"),
    read=read,
    write=write,
    append=append,
    recognise=recognise,
)
