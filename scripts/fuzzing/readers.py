"""Readers: whole files of every format, of which one is damaged, read to the end."""

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.random import Generator

from fuzzing import structures
from fuzzing.cases import Attempt, Case, Target
from fuzzing.damage import damaged, damaged_text, one_of
from misstep.formats import ReadOptions, load_dataset, read_episodes, save_dataset
from misstep.formats.hdf5 import texts
from misstep.trajectory import Column, Dataset, Outcome, Provenance, Trajectory

_CASES = 110_000
_COMPUTING_SECONDS = 2
"""For texts of HDF5 that a process apart reads, in place of the 20 s that large files are given."""

Damage = Callable[[Generator, Path], None]


def _trajectory(steps: int, costs: bool) -> Trajectory:
    rng = np.random.default_rng(steps)
    return Trajectory(
        observations=rng.normal(size=(steps + 1, 2)),
        actions=rng.normal(size=(steps, 1)),
        dt=0.02,
        observation_columns=(Column("x", "m"), Column("x_dot", "m/s")),
        action_columns=(Column("force", "N"),),
        provenance=Provenance("cartpole", {"force_limit": 10.0}, "weak", 7, "", ("a note",)),
        outcome=Outcome.FAILURE,
        costs=np.ones(steps) if costs else None,
        failure_step=1,
    )


_OURS = Dataset([_trajectory(3, True), _trajectory(2, True)])


@dataclass
class _Seed:
    """A whole file or folder, how it is read, and how its files can be damaged in their structure.

    Parameters
    ----------
    path : Path
    format : str
    options : sequence of ReadOptions
        With each of which it can be read.
    structural : mapping from str to damage
        By the suffix of a file.
    """

    path: Path
    format: str
    options: Sequence[ReadOptions]
    structural: dict[str, Damage]

    def __post_init__(self) -> None:
        files = [self.path] if self.path.is_file() else sorted(self.path.rglob("*"))
        self.whole = {file: file.read_bytes() for file in files if file.is_file()}

    def restore(self, changed: Path) -> None:
        """Put back the file that was changed."""
        changed.write_bytes(self.whole[changed])


class _Reading:
    """Damages one file of one seed, and reads the whole.

    Parameters
    ----------
    seeds : sequence of _Seed
    """

    def __init__(self, seeds: Sequence[_Seed]) -> None:
        texts._COMPUTING_SECONDS = _COMPUTING_SECONDS
        self._seeds = seeds
        self._pieces = [data for seed in seeds for data in seed.whole.values()]
        for seed in seeds:
            for options in seed.options:
                _read(seed.path, options, seed.format)

    def __call__(self, case: Case) -> bool:
        rng = case.rng
        seed = one_of(rng, self._seeds)
        victim = one_of(rng, list(seed.whole))
        options = one_of(rng, seed.options)
        name = seed.format if rng.random() < 0.7 else None
        how = seed.structural.get(victim.suffix)
        structure = how is not None and rng.random() < 0.4
        into_memory = rng.random() < 0.2
        try:
            if structure and how is not None:
                how(rng, victim)
            else:
                victim.write_bytes(damaged(rng, seed.whole[victim], self._pieces))
            case.given = _given(seed)
            if into_memory:
                load_dataset(seed.path, format=name)
            else:
                _read(seed.path, options, name)
        finally:
            seed.restore(victim)
        return True


def _given(seed: _Seed) -> dict[str, bytes | str]:
    if seed.path.is_file():
        return {seed.path.name: seed.path.read_bytes()}
    root = seed.path.parent
    return {str(file.relative_to(root)): file.read_bytes() for file in seed.whole}


def _read(path: Path, options: ReadOptions, name: str | None) -> None:
    for episode in read_episodes(path, options, format=name):
        for _ in episode.blocks:
            pass
        episode.ending()


# Tables


def _open_csv(folder: Path) -> Attempt:
    ours, named = folder / "ours.csv", folder / "named.csv"
    save_dataset(_OURS, ours)
    named.write_text("t;x [m];F\n0,0;1,0;2,5\n0,1;1,5;-2,5\n0,2;1,25;0,0\n")
    told = ReadOptions(time="t", actions=("F",), observations=("x [m]",))
    structural = {".csv": partial(_damage_text, words=("t", "x", "episode", "nan", "1e5", "\n"))}
    return _Reading(
        [
            _Seed(ours, "csv", [ReadOptions(), ReadOptions(keep_nan=True)], structural),
            _Seed(named, "csv", [told, ReadOptions(), ReadOptions(rate=10.0)], structural),
        ]
    )


def _open_headerless(folder: Path) -> Attempt:
    commas, blanks = folder / "plain.csv", folder / "blanks.tsv"
    rows = np.random.default_rng(0).normal(size=(5, 4))
    np.savetxt(commas, rows, delimiter=",")
    np.savetxt(blanks, rows, fmt="%.3f", delimiter=" ", header="a comment")
    options = [
        ReadOptions(rate=1000.0, named=False),
        ReadOptions(rate=1000.0, observations=("0", "1", "2"), actions=("3",), keep_nan=True),
        ReadOptions(rate=50.0),
    ]
    structural = {
        suffix: partial(_damage_text, words=("nan", "1e5", "\n", ",", "-inf"))
        for suffix in (".csv", ".tsv")
    }
    return _Reading([_Seed(path, "csv", options, structural) for path in (commas, blanks)])


def _damage_text(rng: Generator, path: Path, words: Sequence[str]) -> None:
    text = damaged_text(rng, path.read_text(), words)
    path.write_text(text, encoding="utf-8", errors="replace")


def _open_parquet(folder: Path) -> Attempt:
    import pyarrow as pa
    from pyarrow import parquet

    ours, others = folder / "ours.parquet", folder / "others.parquet"
    save_dataset(_OURS, ours)
    columns = {
        "stamp": pa.array(np.arange(4) * 10**7, pa.timestamp("ns")),
        "x": np.arange(4.0),
        "n": pa.array([1, None, 3, 4]),
        "key": ["a", "a", "b", "b"],
    }
    parquet.write_table(pa.table(columns), others, compression="gzip")
    told = ReadOptions(time="stamp", observations=("x", "n"), episode="key", keep_nan=True)
    structural: dict[str, Damage] = {".parquet": structures.damage_parquet}
    return _Reading(
        [
            _Seed(ours, "parquet", [ReadOptions(), ReadOptions(keep_nan=True)], structural),
            _Seed(others, "parquet", [told], structural),
        ]
    )


# HDF5 and what is made of it

_HDF5: dict[str, Damage] = {
    ".h5": structures.damage_hdf5,
    ".hdf5": structures.damage_hdf5,
    ".json": structures.damage_json,
}


def _open_hdf5(folder: Path) -> Attempt:
    small, packed = folder / "small.h5", folder / "packed.h5"
    save_dataset(_OURS, small)
    save_dataset(Dataset([_trajectory(1200, False)]), packed)  # long enough to be deflated
    return _Reading([_Seed(path, "hdf5", [ReadOptions()], _HDF5) for path in (small, packed)])


def _open_robomimic(folder: Path) -> Attempt:
    ours, others = folder / "ours.hdf5", folder / "others.hdf5"
    save_dataset(_OURS, ours, format="robomimic")
    _as_documented(others)
    told = [ReadOptions(), ReadOptions(only="success"), ReadOptions(rate=20.0)]
    return _Reading(
        [
            _Seed(ours, "robomimic", [ReadOptions()], _HDF5),
            _Seed(others, "robomimic", told, _HDF5),
        ]
    )


def _as_documented(path: Path) -> None:
    """Write a file as robomimic's documentation lays it out, with h5py alone."""
    said = {"env_name": "Can", "env_type": 1, "env_kwargs": {"control_freq": 20}}
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = np.bytes_(json.dumps(said).encode())
        for i in range(2):
            demo = data.create_group(f"demo_{i}")
            demo.attrs["num_samples"] = 4
            for group in ("obs", "next_obs")[: 2 - i]:
                demo.create_dataset(f"{group}/pos", data=np.ones((4, 3)), compression="gzip")
                demo.create_dataset(f"{group}/grip", data=np.ones((4, 1)), chunks=(2, 1))
            demo["actions"] = np.ones((4, 2), "f4")
            demo["rewards"] = np.zeros(4)
        file["mask/success"] = np.array(["demo_1"], dtype="S")
        file["mask/failure"] = np.array(["demo_0"], dtype="S")


def _open_texts(folder: Path) -> Attempt:
    """Open files whose texts have no fixed length, so that a process apart reads them."""
    path = folder / "texts.hdf5"
    _as_documented(path)
    with h5py.File(path, "r+") as file:
        file["data"].attrs["env_args"] = file["data"].attrs["env_args"].decode()
        del file["mask/success"]
        file["mask/success"] = ["demo_1"]
    return _Reading([_Seed(path, "robomimic", [ReadOptions(only="success")], _HDF5)])


def _open_minari(storage: str, folder: Path) -> Attempt:
    ours = folder / "ours.minari"
    save_dataset(_OURS, ours, format="minari" if storage == "hdf5" else "minari-arrow")
    structural = {**_HDF5, ".arrow": structures.damage_arrow}
    options = [ReadOptions(), ReadOptions(rate=50.0)]
    format = "minari" if storage == "hdf5" else "minari-arrow"
    return _Reading([_Seed(ours, format, options, structural)])


# LeRobot

_LEROBOT: dict[str, Damage] = {
    ".parquet": structures.damage_parquet,
    ".json": structures.damage_json,
    ".jsonl": structures.damage_json,
}


def _open_lerobot(version: str, folder: Path) -> Attempt:
    path = folder / "ours.lerobot"
    name = "lerobot" if version == "v3" else "lerobot-v2.1"
    save_dataset(_OURS, path, format=name)
    others = folder / "others"
    shutil.copytree(path, others)
    (others / "meta" / "misstep.jsonl").unlink()  # then all has to come from LeRobot's own files
    return _Reading(
        [
            _Seed(path, name, [ReadOptions()], _LEROBOT),
            _Seed(others, name, [ReadOptions(), ReadOptions(keep_nan=True)], _LEROBOT),
        ]
    )


# Bags

_FIELDS = ReadOptions(observations=("/joint_states.position",), actions=("/command.data",))
_BAG_OPTIONS = (
    ReadOptions(),
    ReadOptions(rate=100.0),
    _FIELDS,
    ReadOptions(time="header.stamp"),
    ReadOptions(episode="1s"),
)


def _open_bag(kind: str, folder: Path) -> Attempt:
    name = {"ros1": "rosbag", "sqlite3": "rosbag2", "mcap": "mcap"}[kind]
    ours = folder / ("ours" + {"ros1": ".bag", "sqlite3": ".ros2", "mcap": ".mcap"}[kind])
    save_dataset(Dataset([_trajectory(1, True)]), ours, format=name)
    others = folder / ("others.bag" if kind == "ros1" else "others.ros2")
    structures.write_bag(others, kind)
    seeds = [
        _Seed(ours, name, [ReadOptions()], _BAG_FILES),
        _Seed(others, "rosbag" if kind == "ros1" else "rosbag2", _BAG_OPTIONS, _BAG_FILES),
    ]
    reading = _Reading(seeds)
    packed = _PackedBag(folder / ("packed.bag" if kind == "ros1" else "packed.ros2"), kind)

    def attempt(case: Case) -> bool:
        return packed(case) if case.rng.random() < 0.2 else reading(case)

    return attempt


_BAG_FILES: dict[str, Damage] = {
    ".yaml": structures.damage_yaml,
    ".db3": structures.damage_sqlite,
}


class _PackedBag:
    """Has a bag written whose messages are damaged before they are packed, and reads it."""

    def __init__(self, path: Path, kind: str) -> None:
        self._path, self._kind = path, kind

    def __call__(self, case: Case) -> bool:
        path = self._path
        if path.is_dir():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        structures.write_bag(path, self._kind, case.rng)
        files: Any = [path] if path.is_file() else sorted(path.iterdir())
        case.given = {str(file.relative_to(path.parent)): file.read_bytes() for file in files}
        _read(path, one_of(case.rng, _BAG_OPTIONS), None)
        return True


TARGETS = (
    Target("csv", _CASES, _open_csv),
    Target("csv-headerless", _CASES, _open_headerless),
    Target("parquet", _CASES, _open_parquet),
    Target("hdf5", _CASES, _open_hdf5),
    Target("robomimic", _CASES, _open_robomimic),
    Target("hdf5-texts", 5_000, _open_texts),
    Target("minari-hdf5", _CASES, partial(_open_minari, "hdf5")),
    Target("minari-arrow", _CASES, partial(_open_minari, "arrow")),
    Target("lerobot-v2.1", _CASES, partial(_open_lerobot, "v2.1")),
    Target("lerobot-v3", _CASES, partial(_open_lerobot, "v3")),
    Target("rosbag", _CASES, partial(_open_bag, "ros1")),
    Target("rosbag2-sqlite3", _CASES, partial(_open_bag, "sqlite3")),
    Target("rosbag2-mcap", _CASES, partial(_open_bag, "mcap")),
)
