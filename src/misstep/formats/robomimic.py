"""robomimic's HDF5 files, as its documentation lays them out ("Dataset Structure").

::

    /data          attributes total, env_args (JSON: env_name, env_type, env_kwargs)
      demo_0       attribute num_samples
        obs        one array (T, D) for every observation key; images (T, H, W, C)
        next_obs   the same, one step later
        actions    (T, A)      dones    (T,)
        rewards    (T,)        states   (T, S), of the simulator
    /mask          one list of demo names for every filter key

Reading: the low-dimensional keys, in their order, are the observations; a key ``eef_pos`` of three
numbers becomes the columns ``eef_pos_0`` to ``eef_pos_2``. The last row of ``next_obs`` is the
final observation; in files without it the last action is dropped, and noted. Costs are the rewards
with the sign turned. Demos under the filter keys ``success`` and ``failure`` have that outcome.
Images and simulator states are left alone, and noted. The rate is the ``control_freq`` of the
environment, if it has one.

Writing: columns ``name_0``, ``name_1`` ... become one key ``name`` again, any other column a key of
its own, (T, 1). Actions keep their units, though robomimic's training expects them between -1 and
1. Each demo is listed under the filter key of its outcome. What robomimic has no place for stands
in an attribute ``misstep`` of every demo.
"""

import json
import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from misstep.errors import MisstepError
from misstep.formats.annotation import Annotation, read_annotation
from misstep.formats.format import (
    BLOCK_ROWS,
    Block,
    Ending,
    Episode,
    Format,
    Header,
    ReadOptions,
)
from misstep.formats.guard import prefixed
from misstep.formats.hdf5.arrays import FLOAT, RowWriter, member
from misstep.formats.hdf5.attributes import (
    attribute,
    damage,
    has_attribute,
    json_attribute,
    set_attribute,
)
from misstep.formats.hdf5.foreign_arrays import ForeignArray
from misstep.formats.hdf5.opening import opened
from misstep.formats.hdf5.texts import read_texts
from misstep.formats.hdf5.unfailing import UnfailingFile
from misstep.formats.steps import dt_of, steps_of, uniform
from misstep.storage import atomic_write
from misstep.trajectory import Column, Outcome, Provenance

_GYM = 2  # robomimic's EnvType.GYM_TYPE
_OUTCOMES = (Outcome.SUCCESS, Outcome.FAILURE)


# Reading


def recognise(path: Path) -> bool:
    """Say whether a file is laid out as robomimic's are."""
    try:
        with opened(path, "rb") as (file, _):
            return "misstep_format" not in file.attrs and bool(
                _demos(member(file, "data", h5py.Group))
            )
    except (MisstepError, OSError, ValueError, RuntimeError, KeyError):
        return False


def read(path: Path, options: ReadOptions) -> Iterator[Episode]:
    """Read a file of robomimic's; see `misstep.formats.format.Format`.

    ``options.only`` names a filter key: its demos alone are read.

    Raises
    ------
    MisstepError
        If the file is laid out in another way or damaged, or does not say how much time passes
        between observations and ``options.rate`` does not either.
    """
    with opened(path, "rb") as (file, _):
        data = member(file, "data", h5py.Group)
        names = _demos(data)
        if not names:
            raise MisstepError("data holds no demo_0, demo_1, ...: it is not robomimic's")
        there = _mask_keys(file)
        if options.only is not None and options.only not in there:
            listed = ", ".join(sorted(there)) or "none"
            raise MisstepError(f"there is no filter key {options.only!r}; there are: {listed}")
        needed = {options.only, *(outcome.value for outcome in _OUTCOMES)}
        masks = {key: set(_mask(file, path, key)) for key in there if key in needed}
        if options.only is not None:
            names = [name for name in names if name in masks[options.only]]
        reader = _Reader(file, path, options, masks)
        for done, name in enumerate(names):
            with prefixed(name), damage("its structure"):
                episode = reader.episode(name)
            yield episode
            if options.report is not None:
                options.report(done + 1, len(names))


def _demos(data: h5py.Group) -> list[str]:
    with damage("data"):
        names = [name for name in data if re.fullmatch(r"demo_\d{1,18}", name)]
    return sorted(names, key=lambda name: int(name[5:]))


def _mask_keys(file: h5py.File) -> list[str]:
    with damage("mask"):
        return list(member(file, "mask", h5py.Group)) if "mask" in file else []


def _mask(file: h5py.File, path: Path, key: str) -> list[str]:
    member(member(file, "mask", h5py.Group), key, h5py.Dataset)
    return read_texts(file, path, f"mask/{key}")


@dataclass(frozen=True)
class _Key:
    """One observation key of one demo."""

    name: str
    now: ForeignArray
    after: ForeignArray | None

    def columns(self) -> tuple[Column, ...]:
        width = self.now.row_width
        if len(self.now.shape) == 1 or width == 1:
            return (Column(self.name, ""),)
        return tuple(Column(f"{self.name}_{i}", "") for i in range(width))


class _Reader:
    """Reads the demos of one file."""

    def __init__(
        self, file: h5py.File, path: Path, options: ReadOptions, masks: dict[str, set[str]]
    ) -> None:
        self._file, self._path, self._options, self._masks = file, path, options, masks
        self._environment: tuple[str, float | None] | None = None

    def episode(self, name: str) -> Episode:
        demo = member(member(self._file, "data", h5py.Group), name, h5py.Group)
        actions = ForeignArray(demo, "actions")
        steps = actions.shape[0]
        if has_attribute(demo, "num_samples"):
            told = attribute(demo, "num_samples", int)
            if told != steps:
                raise MisstepError(f"num_samples is {told} but actions has {steps} rows")
        annotation = None
        if has_attribute(demo, "misstep"):
            annotation = read_annotation(attribute(demo, "misstep", str))
        keys, left_out = self._keys(demo, steps)
        rewards = ForeignArray(demo, "rewards") if "rewards" in demo else None
        if rewards is not None and rewards.shape != (steps,):
            raise MisstepError(f"rewards has shape {rewards.shape}: it has to be ({steps},)")
        if annotation is not None and not annotation.has_costs:
            rewards = None
        is_whole = all(key.after is not None for key in keys)
        notes = tuple(f"{what} left out" for what in left_out)
        if not is_whole:
            notes += ("the last action left out: the file has no observation after it",)
        header = self._header(annotation, keys, actions, notes)
        return Episode(
            header,
            _blocks(keys, actions, rewards, steps if is_whole else steps - 1),
            ending=lambda: annotation.ending if annotation else self._ending(name),
        )

    def _keys(self, demo: h5py.Group, steps: int) -> tuple[list[_Key], list[str]]:
        """Return the keys that are read, and what is not."""
        now = member(demo, "obs", h5py.Group)
        after = member(demo, "next_obs", h5py.Group) if "next_obs" in demo else None
        keys, left_out = [], []
        for name in self._key_names(demo, now):
            with prefixed(f"obs/{name}"):
                array = member(now, name, h5py.Dataset)
                if array.dtype.kind not in "fiub" or len(array.shape) not in (1, 2):
                    left_out.append(f"observation {name} of shape {array.shape[1:]}")
                    continue
                key = _Key(
                    name,
                    ForeignArray(now, name),
                    None if after is None else ForeignArray(after, name),
                )
                for rows in (key.now, key.after):
                    if rows is not None and rows.shape != (steps, *key.now.shape[1:]):
                        raise MisstepError(f"shape {rows.shape} does not fit {steps} actions")
            keys.append(key)
        if not keys:
            raise MisstepError("obs holds no low-dimensional observations")
        if "states" in demo and member(demo, "states", h5py.Dataset).size:
            left_out.append("states of the simulator")
        return keys, left_out

    def _key_names(self, demo: h5py.Group, now: h5py.Group) -> list[str]:
        if has_attribute(demo, "misstep_keys"):
            return [str(name) for name in json_attribute(demo, "misstep_keys")]
        with damage("obs"):
            return sorted(now)

    def _header(
        self,
        annotation: Annotation | None,
        keys: list[_Key],
        actions: ForeignArray,
        notes: tuple[str, ...],
    ) -> Header:
        observation_columns = tuple(column for key in keys for column in key.columns())
        action_columns = _action_columns(actions)
        if annotation is not None:
            header = annotation.header
            widths = len(header.observation_columns), len(header.action_columns)
            if widths != (len(observation_columns), len(action_columns)):
                raise MisstepError("misstep's annotation names other columns than there are")
            return header
        system, rate = self._environment_of_file()
        rate = rate or self._options.rate
        if rate is None:
            raise MisstepError(
                "the file does not say how many observations there are a second: say it with --rate"
            )
        provenance = Provenance(system, {}, "", None, "", notes)
        return Header(1 / rate, observation_columns, action_columns, provenance)

    def _environment_of_file(self) -> tuple[str, float | None]:
        """Return the name of the environment and its rate, Hz, as far as the file says them."""
        if self._environment is None:
            data = member(self._file, "data", h5py.Group)
            text = "{}"
            if has_attribute(data, "env_args"):
                (text,) = read_texts(self._file, self._path, "data", "env_args") or ("{}",)
            self._environment = _environment(text)
        return self._environment

    def _ending(self, name: str) -> Ending:
        for outcome in _OUTCOMES:
            if name in self._masks.get(outcome.value, ()):
                return Ending(outcome)
        return Ending()


def _environment(text: str) -> tuple[str, float | None]:
    with damage("attribute env_args"):
        said = json.loads(text)
    if not isinstance(said, dict):
        raise MisstepError("attribute env_args is no JSON object")
    name, kwargs = said.get("env_name", ""), said.get("env_kwargs", {})
    rate = kwargs.get("control_freq") if isinstance(kwargs, dict) else None
    if not isinstance(rate, int | float) or isinstance(rate, bool):
        return str(name), None
    if not 0 < rate < math.inf:
        raise MisstepError(f"attribute env_args says control_freq {rate}: it has to be positive")
    return str(name), float(rate)


def _action_columns(actions: ForeignArray) -> tuple[Column, ...]:
    if len(actions.shape) == 1 or actions.row_width == 1:
        return (Column("action", ""),)
    return tuple(Column(f"action_{i}", "") for i in range(actions.row_width))


def _blocks(
    keys: list[_Key], actions: ForeignArray, rewards: ForeignArray | None, steps: int
) -> Iterator[Block]:
    """Yield `steps` steps and the observation after them."""
    for start in range(0, steps, BLOCK_ROWS):
        stop = min(start + BLOCK_ROWS, steps)
        yield Block(
            np.concatenate([key.now.read(start, stop) for key in keys], axis=1),
            actions.read(start, stop),
            None if rewards is None else 0.0 - rewards.read(start, stop)[:, 0],
        )
    if steps < 1:
        return
    last = [
        key.now.read(steps, steps + 1)
        if key.after is None or steps < key.now.shape[0]
        else key.after.read(steps - 1, steps)
        for key in keys
    ]
    yield Block(
        np.concatenate(last, axis=1),
        np.empty((0, actions.row_width)),
        None if rewards is None else np.empty(0),
    )


# Writing


def write(path: Path, episodes: Iterable[Episode]) -> None:
    """Write episodes as a file of robomimic's, in a single step.

    Raises
    ------
    MisstepError
        If an episode has no actions, no common dt, or another kind than the first; there is none;
        or the file cannot be written.
    """

    def fill(temporary: Path) -> None:
        with opened(temporary, "w+b") as (file, disk), prefixed(f"cannot write {path}"):
            data = file.create_group("data")
            total = 0
            masks: dict[str, list[str]] = {outcome.value: [] for outcome in _OUTCOMES}
            for index, episode in enumerate(uniform(path, episodes)):
                name = f"demo_{index}"
                steps, ending = _write_demo(data.create_group(name), disk, episode)
                total += steps
                masks.get(ending.outcome.value, []).append(name)
                if index == 0:
                    data.attrs["env_args"] = _env_args(episode.header)
            data.attrs["total"] = total
            for key, names in masks.items():
                if names:
                    file[f"mask/{key}"] = np.array(names, dtype="S")

    atomic_write(path, fill)


def _env_args(header: Header) -> str:
    parameters = {
        name: value if not isinstance(value, float) or math.isfinite(value) else None
        for name, value in header.provenance.parameters.items()
    }
    kwargs = {**parameters, "control_freq": 1 / dt_of(header)}
    return json.dumps(
        {"env_name": header.provenance.system, "env_type": _GYM, "env_kwargs": kwargs}
    )


def _write_demo(demo: h5py.Group, disk: UnfailingFile, episode: Episode) -> tuple[int, Ending]:
    """Write one demo, step by step; return the number of steps and the ending."""
    header = episode.header
    keys = _keys_of(header.observation_columns)
    now, after = (
        [RowWriter(demo.require_group(group), key, (width,), FLOAT) for key, width in keys]
        for group in ("obs", "next_obs")
    )
    actions = RowWriter(demo, "actions", (len(header.action_columns),), FLOAT)
    rewards, dones = RowWriter(demo, "rewards", (), FLOAT), RowWriter(demo, "dones", (), _INT)
    edges = np.cumsum([width for _, width in keys])[:-1]
    has_costs = False
    for steps in steps_of(episode.blocks):
        for writers, rows in ((now, steps.observations), (after, steps.next_observations)):
            for writer, part in zip(writers, np.split(rows, edges, axis=1), strict=True):
                writer.write(part)
        actions.write(steps.actions)
        has_costs |= steps.costs is not None
        zeros = np.zeros(len(steps.actions))
        rewards.write(zeros if steps.costs is None else -steps.costs)
        dones.write(zeros[: actions.n_rows - 1 - dones.n_rows])  # the last one waits for its value
        disk.check()
    dones.write(np.ones(1))
    for array in (*now, *after, actions, rewards, dones):
        array.close()
    demo.create_dataset("states", shape=(actions.n_rows, 0), dtype=FLOAT)
    ending = episode.ending()
    set_attribute(demo, "num_samples", actions.n_rows)
    set_attribute(demo, "misstep", Annotation(header, ending, has_costs).to_text())
    set_attribute(demo, "misstep_keys", json.dumps([key for key, _ in keys]))
    disk.check()
    return actions.n_rows, ending


_INT: np.dtype[Any] = np.dtype("<i8")


def _keys_of(columns: tuple[Column, ...]) -> list[tuple[str, int]]:
    """Return names and widths of the observation keys that hold these columns, in their order."""
    names = [column.name for column in columns]
    keys: list[tuple[str, int]] = []
    while names:
        stem = re.fullmatch(r"(.+)_0", names[0])
        width = 0
        while stem and width < len(names) and names[width] == f"{stem[1]}_{width}":
            width += 1
        keys.append((stem[1], width) if stem and width > 1 else (names[0], 1))
        names = names[max(1, width) :]
    plain = [(re.sub(r"[/.]", "|", key), width) for key, width in keys]
    if len({key for key, _ in plain}) < len(plain):
        return [(f"column_{i}", 1) for i in range(len(columns))]
    return plain


FORMAT = Format(
    "robomimic HDF5",
    (),
    read,
    write,
    read_suffixes=(".h5", ".hdf5"),
    recognise=recognise,
)
