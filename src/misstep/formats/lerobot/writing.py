"""Writing data sets of LeRobot's; `misstep.formats.lerobot` says how they are laid out."""

import json
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.formats.annotation import Annotation
from misstep.formats.folders import write_folder
from misstep.formats.format import Episode, FloatArray, Header
from misstep.formats.guard import prefixed
from misstep.formats.lerobot.files import DONE, REWARD, SUCCESS, damage, recognise
from misstep.formats.libraries import needed, parquet_writer
from misstep.formats.steps import dt_of, steps_of, uniform
from misstep.trajectory import Outcome

if TYPE_CHECKING:
    import pyarrow as pa
    from pyarrow import parquet


def write(path: Path, episodes: Iterable[Episode], version: str = "v3.0") -> None:
    """Write episodes as a data set of LeRobot's, in a single step.

    Parameters
    ----------
    path : path
        The folder to make.
    episodes : iterable of Episode
    version : "v3.0" or "v2.1"

    Raises
    ------
    MisstepError
        If an episode has no actions, no common dt, no whole number of rows a second, or another
        kind than the first; there is none; or the folder cannot be written.
    """
    needed("pyarrow", "a data set of LeRobot's", "lerobot")

    def fill(folder: Path) -> None:
        writer: _Writer | None = None
        with ExitStack() as open_files:
            for index, episode in enumerate(uniform(path, episodes)):
                with prefixed(f"cannot write {path}: episode_{index}"), damage("what is written"):
                    if writer is None:
                        writer = _WRITERS[version](folder, episode.header, open_files)
                    writer.episode(index, episode)
            if writer is not None:
                writer.close()

    write_folder(path, fill, recognise)


def _fps(header: Header) -> int:
    rate = 1 / dt_of(header)
    fps = round(rate)
    if fps < 1 or abs(rate - fps) > 1e-6 * rate:
        raise MisstepError(
            f"it has {rate:g} rows a second: LeRobot needs a whole number; bring it to one with "
            f"--to-rate {max(1, fps)}"
        )
    return fps


@dataclass
class _Statistics:
    """Extremes, mean and spread of a feature, over all rows seen so far."""

    count: int = 0
    low: NDArray[Any] = field(default_factory=lambda: np.array(np.inf))
    high: NDArray[Any] = field(default_factory=lambda: np.array(-np.inf))
    mean: NDArray[Any] = field(default_factory=lambda: np.array(0.0))
    squares: NDArray[Any] = field(default_factory=lambda: np.array(0.0))

    def add(self, rows: NDArray[Any]) -> None:
        """Add rows, shape (b, width)."""
        self.merge(
            _Statistics(
                len(rows),
                rows.min(axis=0),
                rows.max(axis=0),
                rows.mean(axis=0),
                ((rows - rows.mean(axis=0)) ** 2).sum(axis=0),
            )
        )

    def merge(self, other: "_Statistics") -> None:
        """Add what others saw (Chan, Golub & LeVeque 1979)."""
        total = self.count + other.count
        apart = other.mean - self.mean
        self.squares = self.squares + other.squares + apart**2 * self.count * other.count / total
        self.mean = self.mean + apart * other.count / total
        self.low = np.minimum(self.low, other.low)
        self.high = np.maximum(self.high, other.high)
        self.count = total

    def to_json(self) -> dict[str, list[float]]:
        """Return them under LeRobot's names."""
        return {
            "min": self.low.tolist(),
            "max": self.high.tolist(),
            "mean": self.mean.tolist(),
            "std": np.sqrt(self.squares / self.count).tolist(),
            "count": [self.count],
        }


class _Writer:
    """Writes one data set, episode by episode; what both versions have in common.

    Parameters
    ----------
    folder : Path
        To be made.
    header : Header
        Of the first episode.
    open_files : ExitStack
        Closes in the end, whatever happens, what is open for the whole time.
    """

    version: str
    data_path: str
    chunks_size = 1000

    def __init__(self, folder: Path, header: Header, open_files: ExitStack) -> None:
        self.folder = folder
        self.fps = _fps(header)
        self.robot = header.provenance.system
        self.tasks: dict[str, int] = {}
        self.total_episodes = self.total_frames = 0
        self._features = _features_of(header)
        (folder / "meta").mkdir(parents=True)
        self._annotations = open_files.enter_context(
            (folder / "meta" / "misstep.jsonl").open("w", encoding="utf-8")
        )

    def episode(self, index: int, episode: Episode) -> None:
        """Write one episode."""
        task = episode.header.provenance.system or "unknown"
        task_index = self.tasks.setdefault(task, len(self.tasks))
        statistics = {key: _Statistics() for key in self._features}
        length, has_costs = 0, False
        self.begin(index)
        last = None
        for steps in steps_of(episode.blocks):
            has_costs |= steps.costs is not None
            rewards = np.zeros(len(steps.actions)) if steps.costs is None else -steps.costs
            self._rows(
                statistics, index, length, task_index, steps.observations, steps.actions, rewards
            )
            length += len(steps.actions)
            last = steps.next_observations[-1:], steps.actions[-1:]
        ending = episode.ending()
        if last is None:
            raise MisstepError("it has no steps")
        succeeded = ending.outcome is Outcome.SUCCESS
        self._rows(statistics, index, length, task_index, *last, np.zeros(1), (True, succeeded))
        length += 1
        self.end(index, task, length, statistics)
        self._annotations.write(Annotation(episode.header, ending, has_costs).to_text() + "\n")
        self.total_episodes += 1
        self.total_frames += length

    def _rows(
        self,
        statistics: dict[str, _Statistics],
        index: int,
        start: int,
        task_index: int,
        observations: FloatArray,
        actions: FloatArray,
        rewards: FloatArray,
        ended: tuple[bool, bool] = (False, False),
    ) -> None:
        count = len(actions)
        frames = np.arange(start, start + count)
        values = {
            "observation.state": observations,
            "action": actions,
            REWARD: rewards,
            DONE: np.full(count, ended[0]),
            SUCCESS: np.full(count, ended[1]),
            "timestamp": frames / self.fps,
            "frame_index": frames,
            "episode_index": np.full(count, index),
            "index": self.total_frames + frames,
            "task_index": np.full(count, task_index),
        }
        for key, rows in values.items():
            statistics[key].add(rows.reshape(count, -1).astype(np.float64))
        self.rows(_table(values, self._features))

    def begin(self, index: int) -> None:
        """Make ready for the rows of an episode."""
        raise NotImplementedError

    def rows(self, table: "pa.Table") -> None:
        """Write rows of the episode."""
        raise NotImplementedError

    def end(self, index: int, task: str, length: int, statistics: dict[str, _Statistics]) -> None:
        """Write what is said of the episode."""
        raise NotImplementedError

    def close(self) -> None:
        """Write what is said of all episodes."""
        self.write_json("info.json", {**self._info(), **self.more_info()})

    def more_info(self) -> dict[str, Any]:
        """Return what this version alone says in ``info.json``."""
        raise NotImplementedError

    def write_json(self, name: str, value: object) -> None:
        """Write one file of ``meta``."""
        text = json.dumps(value, indent=4, ensure_ascii=False, allow_nan=False)
        (self.folder / "meta" / name).write_text(text, encoding="utf-8")

    def _info(self) -> dict[str, Any]:
        return {
            "codebase_version": self.version,
            "robot_type": self.robot or None,
            "total_episodes": self.total_episodes,
            "total_frames": self.total_frames,
            "total_tasks": len(self.tasks),
            "chunks_size": self.chunks_size,
            "fps": self.fps,
            "splits": {"train": f"0:{self.total_episodes}"},
            "data_path": self.data_path,
            "video_path": None,
            "features": self._features,
        }

    def data_file(self, **places: int) -> Path:
        """Return where rows go."""
        path = self.folder / self.data_path.format(**places)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


def _features_of(header: Header) -> dict[str, dict[str, Any]]:
    def feature(dtype: str, names: list[str] | None = None) -> dict[str, Any]:
        return {"dtype": dtype, "shape": [len(names) if names else 1], "names": names}

    return {
        "observation.state": feature("float32", [c.name for c in header.observation_columns]),
        "action": feature("float32", [c.name for c in header.action_columns]),
        REWARD: feature("float32"),
        DONE: feature("bool"),
        SUCCESS: feature("bool"),
        "timestamp": feature("float32"),
        "frame_index": feature("int64"),
        "episode_index": feature("int64"),
        "index": feature("int64"),
        "task_index": feature("int64"),
    }


def _table(values: dict[str, NDArray[Any]], features: dict[str, dict[str, Any]]) -> "pa.Table":
    import pyarrow as pa

    columns = {}
    for key, rows in values.items():
        dtype, (width,) = np.dtype(features[key]["dtype"]), features[key]["shape"]
        with np.errstate(over="ignore"):
            flat = pa.array(np.ascontiguousarray(rows.reshape(-1), dtype))
        columns[key] = flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)
    return pa.table(columns)


class _Writer21(_Writer):
    """Version 2.1: one file an episode, and lines of JSON."""

    version = "v2.1"
    data_path = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"

    def begin(self, index: int) -> None:
        self._path = self.data_file(episode_chunk=index // self.chunks_size, episode_index=index)
        self._file: parquet.ParquetWriter | None = None

    def rows(self, table: "pa.Table") -> None:
        if self._file is None:
            self._file = _parquet_writer(self._path, table)
        self._file.write_table(table)

    def end(self, index: int, task: str, length: int, statistics: dict[str, _Statistics]) -> None:
        if self._file is not None:
            self._file.close()
        stats = {key: each.to_json() for key, each in statistics.items()}
        self._line("episodes.jsonl", {"episode_index": index, "tasks": [task], "length": length})
        self._line("episodes_stats.jsonl", {"episode_index": index, "stats": stats})

    def _line(self, name: str, value: object) -> None:
        with open(self.folder / "meta" / name, "a", encoding="utf-8") as file:
            file.write(json.dumps(value, ensure_ascii=False, allow_nan=False) + "\n")

    def more_info(self) -> dict[str, Any]:
        for task, index in self.tasks.items():
            self._line("tasks.jsonl", {"task_index": index, "task": task})
        chunks = -(-self.total_episodes // self.chunks_size)
        return {"total_chunks": chunks, "total_videos": 0}


class _Writer30(_Writer):
    """Version 3.0: many episodes a file, and Parquet for what is said of them."""

    version = "v3.0"
    data_path = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    file_size = 100  # MB

    def __init__(self, folder: Path, header: Header, open_files: ExitStack) -> None:
        super().__init__(folder, header, open_files)
        self._files = 0
        self._file: parquet.ParquetWriter | None = None
        self._path = folder
        self._said: list[dict[str, Any]] = []
        self._episodes: parquet.ParquetWriter | None = None
        self._all = {key: _Statistics() for key in self._features}

    def begin(self, index: int) -> None:
        if self._file is not None and self._path.stat().st_size > self.file_size * 2**20:
            self._file.close()
            self._file = None
            self._files += 1
        self._chunk, self._place = divmod(self._files, self.chunks_size)

    def rows(self, table: "pa.Table") -> None:
        if self._file is None:
            self._path = self.data_file(chunk_index=self._chunk, file_index=self._place)
            self._file = _parquet_writer(self._path, table)
        self._file.write_table(table)

    def end(self, index: int, task: str, length: int, statistics: dict[str, _Statistics]) -> None:
        said: dict[str, Any] = {
            "episode_index": index,
            "tasks": [task],
            "length": length,
            "data/chunk_index": self._chunk,
            "data/file_index": self._place,
            "dataset_from_index": self.total_frames,
            "dataset_to_index": self.total_frames + length,
        }
        for key, each in statistics.items():
            self._all[key].merge(each)
            said |= {f"stats/{key}/{name}": value for name, value in each.to_json().items()}
        self._said.append({**said, "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0})
        if len(self._said) == self.chunks_size:
            self._write_said()

    def _write_said(self) -> None:
        import pyarrow as pa

        table = pa.Table.from_pylist(self._said)
        if self._episodes is None:
            path = self.folder / "meta/episodes/chunk-000/file-000.parquet"
            path.parent.mkdir(parents=True)
            self._episodes = _parquet_writer(path, table)
        self._episodes.write_table(table)
        self._said = []

    def more_info(self) -> dict[str, Any]:
        if self._said:
            self._write_said()
        for file in (self._file, self._episodes):
            if file is not None:
                file.close()
        _write_tasks(self.folder / "meta" / "tasks.parquet", self.tasks)
        self.write_json("stats.json", {key: each.to_json() for key, each in self._all.items()})
        return {"data_files_size_in_mb": self.file_size, "video_files_size_in_mb": 200}


def _parquet_writer(path: Path, table: "pa.Table") -> "parquet.ParquetWriter":
    return parquet_writer(path, table.schema, compression="snappy")


def _write_tasks(path: Path, tasks: dict[str, int]) -> None:
    """Write the tasks as pandas writes a table whose index are the tasks: LeRobot reads it so."""
    import pyarrow as pa
    from pyarrow import parquet

    def column(name: str, kind: str, stored: str) -> dict[str, Any]:
        return {
            "name": name,
            "field_name": name,
            "pandas_type": kind,
            "numpy_type": stored,
            "metadata": None,
        }

    pandas = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [column("task_index", "int64", "int64"), column("task", "unicode", "object")],
        "pandas_version": "2.0.0",
    }
    table = pa.table({"task_index": list(tasks.values()), "task": list(tasks)})
    parquet.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), path)


_WRITERS: dict[str, type[_Writer]] = {"v3.0": _Writer30, "v2.1": _Writer21}
