"""Writing misstep's own files; `misstep.formats.hdf5` says how they are laid out."""

import json
import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from misstep.formats.format import BLOCK_ROWS, Ending, Episode, Header
from misstep.formats.guard import check_same_kind, prefixed
from misstep.formats.hdf5.arrays import BOOL, FLOAT, RowWriter
from misstep.formats.hdf5.attributes import damage, set_attribute
from misstep.formats.hdf5.opening import check_signature, opened
from misstep.formats.hdf5.reading import FORMAT_VERSION, episode_header, group_of, read_header
from misstep.formats.hdf5.unfailing import UnfailingFile
from misstep.formats.steps import uniform
from misstep.storage import atomic_write
from misstep.trajectory import Column, Outcome, Provenance, Trajectory


def write(path: Path, episodes: Iterable[Episode]) -> None:
    """Write episodes to `path` in a single step, in place of what was there.

    Raises
    ------
    MisstepError
        If an episode has no actions, no common dt, or another kind than the first; there is none;
        or the file cannot be written.
    """

    def fill(temporary: Path) -> None:
        with opened(temporary, "w+b") as (file, disk):
            # First of all, so that it lies near the beginning, where `recognise` looks.
            set_attribute(file, "misstep_format", FORMAT_VERSION)
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
        with opened(temporary, "r+b") as (file, disk):
            there = read_header(file)
            first = episode_header(group_of(file, 0), there)
            with damage("its structure"):
                check_same_kind(there.n_episodes, episode.header, first)
                steps = _write_episode(file, disk, there.n_episodes, episode)
                file.attrs.modify("total_episodes", there.n_episodes + 1)
                file.attrs.modify("total_steps", there.n_steps + steps)

    with prefixed(f"cannot add a trajectory to {path}"):
        check_signature(path)
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
