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
of an episode is a termination if it failed there, and otherwise a truncation. An array of more
than 1,000 elements is one chunk, shuffled and deflated; smaller ones are stored plainly. Equal
data sets give equal files.

A file may come from anywhere, so reading takes nothing on trust. Declared sizes are checked
before memory is asked for, links out of the file and any other way to store an array are
refused, and chunks are inflated here, since the HDF5 library would inflate a few kilobytes into
as much memory as they claim. The library only ever works in memory, as it crashes on a disk that
is full.
"""

import json
import math
import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.storage import atomic_write
from misstep.trajectory import Column, Dataset, Outcome, Provenance, Trajectory

SUFFIXES = (".h5", ".hdf5")

LARGEST_FILE = 2**31
"""Bytes that a file may take up at most, and the arrays in it when they are inflated."""

_FORMAT_VERSION = 1
_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_PLAIN_UP_TO = 1000  # elements; compressing fewer saves no space worth the time
_LONGEST_TEXT = 64000  # bytes: HDF5 has room for 64 KiB, what describes it included
_FILTERS = [h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE]
_FLOAT = np.dtype("<f8")
_BOOL = np.dtype(bool)

# What h5py raises when a file is damaged, depending on where.
_DAMAGE = (OSError, KeyError, RuntimeError, ValueError, TypeError, zlib.error)


def save(dataset: Dataset, path: Path) -> None:
    """Write `dataset` to `path` in a single step, in place of what was there.

    Raises
    ------
    MisstepError
        If the file cannot be written, or it would take up more than `LARGEST_FILE` bytes.
    """
    try:
        image = _image_of(dataset)
    except MisstepError as error:
        raise MisstepError(f"cannot write {path}: {error}") from error
    atomic_write(path, lambda temporary: temporary.write_bytes(image))


def append(path: Path, trajectory: Trajectory) -> None:
    """Add `trajectory` at the end of the file, or make the file, in a single step.

    Raises
    ------
    MisstepError
        If the file cannot be read or written, its trajectories have other columns or another dt,
        or it would outgrow `LARGEST_FILE` bytes.
    """
    if not os.path.lexists(path):
        save(Dataset([trajectory]), path)
        return

    try:
        with _opened(path) as file:
            episodes, steps = _check_kind(file, trajectory)
            with _damage("its structure"):
                _write_episode(file, episodes, trajectory)
                file.attrs.modify("total_episodes", episodes + 1)
                file.attrs.modify("total_steps", steps + trajectory.n_steps)
                image = _image(file)
    except MisstepError as error:
        raise MisstepError(f"cannot add a trajectory to {path}: {error}") from error
    atomic_write(path, lambda temporary: temporary.write_bytes(image))


def load(path: Path) -> Dataset:
    """Read the data set that `save` or `append` wrote to `path`.

    Raises
    ------
    MisstepError
        If there is no such file, it is not misstep's or of a newer version, it is damaged, it
        takes up more than `LARGEST_FILE` bytes, or any part of it lies outside it.
    """
    try:
        with _opened(path) as file:
            return Dataset(_trajectories(file))
    except MisstepError as error:
        raise MisstepError(f"cannot read {path}: {error}") from error


# Writing


def _image_of(dataset: Dataset) -> bytes:
    steps = [trajectory.n_steps for trajectory in dataset]
    n, m = len(dataset.observation_columns), len(dataset.action_columns)
    _check_size(_size_of_arrays(sum(steps), len(steps), n, m))
    with h5py.File.in_memory() as file:
        _set(file, "misstep_format", _FORMAT_VERSION)
        _set(file, "dt", dataset.dt)
        _set(file, "observation_columns", _columns_to_json(dataset.observation_columns))
        _set(file, "action_columns", _columns_to_json(dataset.action_columns))
        _set(file, "total_episodes", len(steps))
        _set(file, "total_steps", sum(steps))
        for index, trajectory in enumerate(dataset):
            _write_episode(file, index, trajectory)
        return _image(file)


def _image(file: h5py.File) -> bytes:
    """Return what the file in memory is to be on the disk."""
    file.flush()
    image: bytes = file.id.get_file_image()
    _check_size(len(image))
    return image


def _size_of_arrays(steps: int, episodes: int, n: int, m: int) -> int:
    """Return the bytes of `episodes` with `steps` in all, n observation and m action columns."""
    rewards_and_ends = _FLOAT.itemsize + 2 * _BOOL.itemsize
    return _FLOAT.itemsize * ((steps + episodes) * n + steps * m) + rewards_and_ends * steps


def _check_size(size: int) -> None:
    if size > LARGEST_FILE:
        raise MisstepError(f"it would take up {size} bytes: at most {LARGEST_FILE} are allowed")


def _write_episode(file: h5py.File, index: int, trajectory: Trajectory) -> None:
    group = file.create_group(f"episode_{index}")
    for name, value in _episode_attributes(index, trajectory).items():
        _set(group, name, value)
    group.create_group("infos")
    for name, array in _episode_arrays(trajectory).items():
        if array.size > _PLAIN_UP_TO:
            group.create_dataset(
                name,
                data=array,
                chunks=array.shape,
                shuffle=True,
                compression="gzip",
                compression_opts=1,
            )
        else:
            group.create_dataset(name, data=array)


def _set(owner: h5py.Group, name: str, value: Any) -> None:
    if not isinstance(value, str):
        owner.attrs[name] = value
        return
    # Of fixed length, because the HDF5 library crashes on damaged texts of variable length.
    text = value.encode()
    if len(text) > _LONGEST_TEXT:
        raise MisstepError(
            f"attribute {name} would take up {len(text)} bytes: at most {_LONGEST_TEXT} fit"
        )
    owner.attrs.create(name, text, dtype=h5py.string_dtype("utf-8", max(1, len(text))))


def _episode_attributes(index: int, trajectory: Trajectory) -> dict[str, Any]:
    provenance = trajectory.provenance
    attributes: dict[str, Any] = {
        "id": index,
        "total_steps": trajectory.n_steps,
        "system": provenance.system,
        "parameters": json.dumps(dict(provenance.parameters)),
        "demonstrator": provenance.demonstrator,
        "time": provenance.time,
        "outcome": trajectory.outcome.value,
        "costs_recorded": trajectory.costs is not None,
    }
    if trajectory.failure_step is not None:
        attributes["failure_step"] = trajectory.failure_step
    if provenance.notes:
        attributes["notes"] = json.dumps(provenance.notes)
    if provenance.seed is not None:
        # Minari reads a seed as int(seed): beyond 64 bits, which HDF5 lacks, digits do as well.
        seed = provenance.seed
        attributes["seed"] = np.uint64(seed) if seed < 2**64 else str(seed)
    return attributes


def _episode_arrays(trajectory: Trajectory) -> dict[str, NDArray[Any]]:
    steps = trajectory.n_steps
    last_step = np.arange(steps) == steps - 1
    failed_there = trajectory.outcome is Outcome.FAILURE and trajectory.failure_step == steps
    rewards = np.zeros(steps) if trajectory.costs is None else -trajectory.costs
    return {
        "observations": trajectory.observations.astype(_FLOAT, copy=False),
        "actions": trajectory.actions.astype(_FLOAT, copy=False),
        "rewards": rewards.astype(_FLOAT, copy=False),
        "terminations": last_step & failed_there,
        "truncations": last_step & (not failed_there),
    }


def _columns_to_json(columns: tuple[Column, ...]) -> str:
    return json.dumps([[column.name, column.unit] for column in columns])


# Reading: the file


def _read_image(path: Path) -> bytes:
    if not path.exists():
        raise MisstepError("there is no such file")
    if not path.is_file():
        raise MisstepError("it is a folder or a device; name a file")
    try:
        _check_size(path.stat().st_size)
        image = path.read_bytes()
    except OSError as error:
        raise MisstepError(f"{error.strerror}") from error
    if not image:
        raise MisstepError("the file is empty")
    if not image.startswith(_SIGNATURE):
        raise MisstepError("it is not an HDF5 file")
    return image


@contextmanager
def _damage(what: str) -> Iterator[None]:
    """Tell what h5py raises over a damaged file as one line."""
    try:
        yield
    except MisstepError:
        raise
    except _DAMAGE as error:
        reason = " ".join(str(error).split())
        raise MisstepError(f"{what} is damaged ({reason})") from error


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    """Open a copy of the file in memory, where it may be changed."""
    image = _read_image(path)
    with _damage("its structure"):
        file = h5py.File.in_memory(image)
    try:
        yield file
    finally:
        with _damage("its structure"):
            file.close()


def _trajectories(file: h5py.File) -> Iterator[Trajectory]:
    dt, observation_columns, action_columns, episodes, left = _header(file)
    for index in range(episodes):
        name = f"episode_{index}"
        group = _member(file, name, h5py.Group)
        try:
            trajectory = _read_episode(group, left, dt, observation_columns, action_columns)
        except MisstepError as error:
            raise MisstepError(f"{name}: {error}") from error
        left -= trajectory.n_steps
        yield trajectory
    if left != 0:
        raise MisstepError(f"total_steps counts {left} steps more than the episodes hold")


def _header(file: h5py.File) -> tuple[float, tuple[Column, ...], tuple[Column, ...], int, int]:
    """Return dt, the columns, and how many episodes and steps there are."""
    if not _has(file, "misstep_format"):
        raise MisstepError("it is an HDF5 file, but not of misstep's: no attribute misstep_format")
    version = _attribute(file, "misstep_format", int)
    if version > _FORMAT_VERSION:
        raise MisstepError(
            f"its format version is {version} and this misstep reads up to {_FORMAT_VERSION}: "
            "install a newer misstep"
        )
    if version < 1:
        raise MisstepError(f"its format version is {version}: the first one is 1")
    dt = _attribute(file, "dt", float)
    observation_columns = _columns_from_json(file, "observation_columns")
    action_columns = _columns_from_json(file, "action_columns")
    episodes = _attribute(file, "total_episodes", int)
    steps = _attribute(file, "total_steps", int)
    with _damage("the list of episodes"):
        found = len(file)
    if found != episodes:
        raise MisstepError(f"total_episodes is {episodes} but there are {found} groups")
    n, m = len(observation_columns), len(action_columns)
    _check_size(_size_of_arrays(steps, episodes, n, m))
    return dt, observation_columns, action_columns, episodes, steps


def _check_kind(file: h5py.File, trajectory: Trajectory) -> tuple[int, int]:
    """Check that `trajectory` goes with those in `file`; return their number and steps."""
    _, observation_columns, action_columns, episodes, steps = _header(file)
    first = next(_trajectories(file), None)
    if first is None:
        raise MisstepError("it holds no episode")
    n, m = len(observation_columns), len(action_columns)
    _check_size(_size_of_arrays(steps + trajectory.n_steps, episodes + 1, n, m))
    Dataset([first, trajectory])
    return episodes, steps


# Reading: one episode


def _read_episode(
    group: h5py.Group,
    most_steps: int,
    dt: float,
    observation_columns: tuple[Column, ...],
    action_columns: tuple[Column, ...],
) -> Trajectory:
    steps = _attribute(group, "total_steps", int)
    if not 1 <= steps <= most_steps:
        raise MisstepError(f"total_steps is {steps}, but the file has {most_steps} left for it")
    for name in ("terminations", "truncations"):
        _dataset(group, name, (steps,), _BOOL)  # they follow from the outcome: nothing to read
    rewards = _read_array(group, "rewards", (steps,))
    return Trajectory(
        observations=_read_array(group, "observations", (steps + 1, len(observation_columns))),
        actions=_read_array(group, "actions", (steps, len(action_columns))),
        dt=dt,
        observation_columns=observation_columns,
        action_columns=action_columns,
        provenance=_read_provenance(group),
        outcome=_attribute(group, "outcome", str),
        costs=-rewards if _attribute(group, "costs_recorded", bool) else None,
        failure_step=_attribute(group, "failure_step", int)
        if _has(group, "failure_step")
        else None,
    )


def _read_provenance(group: h5py.Group) -> Provenance:
    seed: int | None = None
    if _has(group, "seed"):
        with _damage("attribute seed"):
            seed = int(_attribute(group, "seed", (int, str)))
    return Provenance(
        system=_attribute(group, "system", str),
        parameters=_json(group, "parameters"),
        demonstrator=_attribute(group, "demonstrator", str),
        seed=seed,
        time=_attribute(group, "time", str),
        notes=_json(group, "notes") if _has(group, "notes") else (),
    )


def _member(group: h5py.Group, name: str, kind: type) -> Any:
    with _damage(name):
        link = group.get(name, getlink=True)
        if link is None:
            raise MisstepError(f"{name} is missing")
        if not isinstance(link, h5py.HardLink):
            raise MisstepError(f"{name} is a link to elsewhere: only plain members are read")
        member = group[name]
    if not isinstance(member, kind):
        raise MisstepError(f"{name} is not a {kind.__name__.lower()}")
    return member


def _dataset(
    group: h5py.Group, name: str, shape: tuple[int, ...], dtype: np.dtype[Any]
) -> h5py.Dataset:
    """Return the array `name`, not read yet, once its kind, shape and layout are sure."""
    dataset = _member(group, name, h5py.Dataset)
    with _damage(name):
        if dataset.shape != shape:
            raise MisstepError(f"{name} has shape {dataset.shape}: it has to be {shape}")
        if dataset.dtype != dtype:
            raise MisstepError(f"{name} has dtype {dataset.dtype}: it has to be {dtype}")
        if dataset.is_virtual or dataset.external:
            raise MisstepError(f"{name} lies in another file: only what is in this one is read")
        if dataset.chunks is None:
            stored_well = dataset.id.get_storage_size() == dataset.nbytes
        else:
            properties = dataset.id.get_create_plist()
            filters = [properties.get_filter(i)[0] for i in range(properties.get_nfilters())]
            stored_well = dataset.chunks == shape and filters == _FILTERS
            stored_well = stored_well and 0 < dataset.id.get_storage_size() <= dataset.nbytes
    if not stored_well:
        raise MisstepError(
            f"{name} is stored in another way than misstep does: whole and plain, or in one "
            "chunk, shuffled and deflated"
        )
    return dataset


def _read_array(group: h5py.Group, name: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    dataset = _dataset(group, name, shape, _FLOAT)
    with _damage(name):
        if dataset.chunks is None:
            return np.asarray(dataset[...])
        skipped, stored = dataset.id.read_direct_chunk((0,) * len(shape))
        return _unpack(stored, skipped, math.prod(shape)).reshape(shape)


def _unpack(stored: bytes, skipped: int, size: int) -> NDArray[np.float64]:
    """Undo deflation and shuffling of `size` float64, never making more than those.

    `skipped` is HDF5's mask of filters that were left out when the chunk was written.
    """
    shuffling_skipped, deflation_skipped = skipped & 1, skipped & 2
    n_bytes = size * _FLOAT.itemsize
    plain = stored
    if not deflation_skipped:
        inflater = zlib.decompressobj()
        plain = inflater.decompress(stored, n_bytes + 1)
        if not inflater.eof:
            raise MisstepError("a compressed array is longer or shorter than it has to be")
    if len(plain) != n_bytes:
        raise MisstepError(f"a compressed array holds {len(plain)} bytes, not {n_bytes}")
    if shuffling_skipped:
        return np.frombuffer(plain, _FLOAT)
    # Shuffled: first the first byte of every number, then all second bytes, and so on.
    planes = np.frombuffer(plain, np.uint8).reshape(_FLOAT.itemsize, size)
    return np.ascontiguousarray(planes.T).view(_FLOAT).ravel()


# Reading: attributes


def _has(owner: h5py.Group, name: str) -> bool:
    with _damage(f"attribute {name}"):
        return name in owner.attrs


def _attribute(owner: h5py.Group, name: str, kind: type | tuple[type, ...]) -> Any:
    """Return a single int, float, bool or str, whichever of these `kind` is."""
    if not _has(owner, name):
        raise MisstepError(f"attribute {name} is missing")
    with _damage(f"attribute {name}"):
        identifier = owner.attrs.get_id(name)
        if identifier.shape != () or not _is_plain(identifier.get_type()):
            raise MisstepError(f"attribute {name} is not a single number or text of fixed length")
        plain = owner.attrs[name].item()
        if isinstance(plain, bytes):
            plain = plain.decode()
    if not isinstance(plain, kind) or (isinstance(plain, bool) and kind is not bool):
        raise MisstepError(f"attribute {name} is {plain!r}: that is of the wrong type")
    return plain


def _is_plain(kind: h5py.h5t.TypeID) -> bool:
    if isinstance(kind, h5py.h5t.TypeStringID):
        return not kind.is_variable_str() and kind.get_size() <= _LONGEST_TEXT
    return isinstance(kind, h5py.h5t.TypeIntegerID | h5py.h5t.TypeFloatID | h5py.h5t.TypeEnumID)


def _json(owner: h5py.Group, name: str) -> Any:
    text = _attribute(owner, name, str)
    with _damage(f"attribute {name}"):  # nested too deeply is a RuntimeError
        return json.loads(text)


def _columns_from_json(file: h5py.File, name: str) -> tuple[Column, ...]:
    pairs = _json(file, name)
    if not isinstance(pairs, list) or not all(isinstance(p, list) and len(p) == 2 for p in pairs):
        raise MisstepError(f"attribute {name} has to list pairs of name and unit")
    return tuple(Column(*pair) for pair in pairs)
