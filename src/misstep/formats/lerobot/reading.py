"""Reading data sets of LeRobot's; `misstep.formats.lerobot` says how they are laid out."""

import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.formats.annotation import Annotation, read_annotation
from misstep.formats.format import (
    BLOCK_ROWS,
    Block,
    Ending,
    Episode,
    FloatArray,
    Header,
    ReadOptions,
)
from misstep.formats.guard import prefixed
from misstep.formats.lerobot.files import REWARD, SUCCESS, damage, read_lines
from misstep.formats.lerobot.footer import column_parts
from misstep.formats.libraries import needed, read_json
from misstep.parameters import LARGEST
from misstep.trajectory import Column, Outcome, Provenance

if TYPE_CHECKING:
    import pyarrow as pa
    from pyarrow import parquet

_WIDEST = 10**5  # numbers in one feature
_MOST_NUMBERS = 2**22  # in the rows that are read at a time
_TOLERANCE = 1e-3  # s, of time stamps; LeRobot's own is 1e-4, and they are float32
_NUMBERS = re.compile(r"(float|u?int)(8|16|32|64)|bool")
_INDEX = ("episode_index", "frame_index", "timestamp", "task_index")


@dataclass(frozen=True)
class _Feature:
    """One feature whose numbers are read."""

    key: str
    width: int
    columns: tuple[Column, ...]


@dataclass(frozen=True)
class _Info:
    """What ``info.json`` says."""

    rate: float
    robot: str
    total_episodes: int | None
    observations: tuple[_Feature, ...]
    actions: tuple[_Feature, ...]
    others: frozenset[str]
    left_out: tuple[str, ...]


def read(path: Path, options: ReadOptions) -> Iterator[Episode]:
    """Read a data set of LeRobot's; see `misstep.formats.format.Format`.

    Raises
    ------
    MisstepError
        If it is of a version other than 2.x and 3.x, laid out in another way, or damaged.
    """
    needed("pyarrow", "a data set of LeRobot's", "lerobot")
    info = _info(read_json(path / "meta" / "info.json"))
    files = sorted(path.glob("data/*/*.parquet"), key=_numbers_in)
    if not files:
        raise MisstepError("there is no data/chunk-000/*.parquet")
    tasks = _tasks(path / "meta")
    annotations = read_lines(path / "meta" / "misstep.jsonl")
    count = 0
    for index, pieces in groupby(_pieces(files, info, options), key=itemgetter(0)):
        count += 1
        with prefixed(f"episode_index {index}"):
            line = next(annotations, None)
            annotation = None if line is None else read_annotation(line)
            episode = _episode(info, tasks, annotation, (piece for _, piece in pieces))
        yield episode
    if info.total_episodes is not None and count != info.total_episodes:
        raise MisstepError(
            f"info.json counts {info.total_episodes} episodes, but {count} are there"
        )


def _numbers_in(path: Path) -> tuple[list[int], str]:
    numbers = re.findall(r"\d{1,18}", f"{path.parent.name}/{path.name}")
    return [int(number) for number in numbers], str(path)


def _info(said: dict[str, Any]) -> _Info:
    version = str(said.get("codebase_version"))
    if not re.match(r"v?[23]\.", version):
        raise MisstepError(f"info.json says codebase_version {version}: 2.x and 3.x are read")
    rate, features = said.get("fps"), said.get("features")
    if not isinstance(rate, int | float) or isinstance(rate, bool) or not 0 < rate <= LARGEST:
        raise MisstepError(f"info.json says fps {rate!r}: it has to be a positive number")
    if not isinstance(features, dict):
        raise MisstepError("info.json names no features")
    left_out = []
    chosen: dict[str, list[_Feature]] = {"observation": [], "action": []}
    for key, feature in features.items():
        kind = key.partition(".")[0]
        if kind not in chosen:
            continue
        with prefixed(f"info.json, feature {key!r}"):
            read = _feature(key, feature)
        if read is None:
            left_out.append(f"{key} left out")
        else:
            chosen[kind].append(read)
    if not chosen["observation"]:
        raise MisstepError("info.json names no observation.* with numbers")
    total = said.get("total_episodes")
    return _Info(
        float(rate),
        str(said.get("robot_type") or ""),
        total if type(total) is int else None,
        _told_apart(chosen["observation"]),
        _told_apart(chosen["action"]),
        frozenset(features) & {REWARD, SUCCESS},
        tuple(left_out),
    )


def _feature(key: str, said: Any) -> _Feature | None:
    """Return a feature of numbers, or None for images, videos and texts."""
    if not isinstance(said, dict):
        raise MisstepError("it is no JSON object")
    if not _NUMBERS.fullmatch(str(said.get("dtype"))):
        return None
    shape = said.get("shape")
    if not isinstance(shape, list) or not all(type(n) is int and n > 0 for n in shape):
        raise MisstepError(f"shape is {shape!r}: it lists positive whole numbers")
    width = math.prod(shape)
    if width > _WIDEST:
        raise MisstepError(f"shape {shape} is too large")
    names = _names(said.get("names"), width) or _made_names(key, width)
    return _Feature(key, width, tuple(Column(name, "") for name in names))


def _names(said: Any, width: int) -> list[str] | None:
    """Return the names of the numbers in a feature, in whichever of the usual forms they are."""
    if isinstance(said, dict):
        if all(type(place) is int for place in said.values()):
            said = sorted(said, key=lambda name: said[name])
        elif len(said) == 1:
            said = next(iter(said.values()))
    if isinstance(said, list) and len(said) == 1 and isinstance(said[0], list):
        said = said[0]
    if not isinstance(said, list) or len(said) != width:
        return None
    return [str(name) for name in said] if len({str(name) for name in said}) == width else None


def _made_names(key: str, width: int) -> list[str]:
    stem = key.removeprefix("observation.")
    return [stem] if width == 1 else [f"{stem}_{i}" for i in range(width)]


def _told_apart(features: list[_Feature]) -> tuple[_Feature, ...]:
    """Put the key before every name, where two features have a name in common."""
    names = [column.name for feature in features for column in feature.columns]
    if len(set(names)) == len(names):
        return tuple(features)
    return tuple(
        _Feature(f.key, f.width, tuple(Column(f"{f.key}.{c.name}", "") for c in f.columns))
        for f in features
    )


def _tasks(meta: Path) -> dict[int, str]:
    """Return the text of each task."""
    tasks: dict[int, str] = {}
    for line in read_lines(meta / "tasks.jsonl"):
        with damage("tasks.jsonl"):
            said = json.loads(line)
            tasks[int(said["task_index"])] = str(said["task"])
    file = meta / "tasks.parquet"
    if file.is_file():
        with damage("tasks.parquet"):
            with _opened(file) as parquet_file:
                table = parquet_file.read(use_threads=False)
            (texts,) = (name for name in table.column_names if name != "task_index")
            indices = table.column("task_index").to_pylist()
            tasks = dict(zip(indices, map(str, table.column(texts).to_pylist()), strict=True))
    return tasks


def _opened(path: Path) -> "parquet.ParquetFile":
    from pyarrow import parquet

    # Not memory-mapped: a file that is cut off meanwhile would take the process down.
    return parquet.ParquetFile(
        path,
        memory_map=False,
        pre_buffer=False,
        thrift_string_size_limit=2**26,
        thrift_container_size_limit=2**20,
    )


@dataclass
class _Piece:
    """Consecutive rows of one episode."""

    observations: FloatArray
    actions: FloatArray
    times: FloatArray
    frames: FloatArray
    task: int | None
    rewards: FloatArray | None
    successes: FloatArray | None


def _pieces(
    files: Sequence[Path], info: _Info, options: ReadOptions
) -> Iterator[tuple[int, _Piece]]:
    """Yield all rows of all files, with the number of their episode."""
    for done, path in enumerate(files, start=1):
        place = f"{path.parent.name}/{path.name}"
        with damage(place), _opened(path) as file:
            there = set(file.schema_arrow.names)
            wanted = [f.key for f in (*info.observations, *info.actions)]
            wanted += [key for key in (*_INDEX, *info.others) if key in there]
            missing = {*wanted, "episode_index"} - there
            if missing:
                raise MisstepError(f"{place} has no column {min(missing)!r}")
            widths = {f.key: f.width for f in (*info.observations, *info.actions)}
            _check_lengths(path, widths)
            rows = max(1, min(BLOCK_ROWS, _MOST_NUMBERS // sum(widths.values())))
            for batch in file.iter_batches(rows, columns=wanted, use_threads=False):
                yield from _pieces_of(batch, info)
        if options.report is not None:
            options.report(done, len(files))


def _check_lengths(path: Path, widths: dict[str, int]) -> None:
    """Refuse lists that are longer than they have to be: equal numbers take up no space."""
    for part in column_parts(path):
        key = next((key for key in widths if _is_part(part.path, key)), None)
        if key is not None and part.values > part.rows * widths[key]:
            raise MisstepError(
                f"column {key!r} has {part.values} numbers in {part.rows} rows: "
                f"info.json says {widths[key]} in each"
            )


def _is_part(path: str, key: str) -> bool:
    return path == key or path.startswith(f"{key}.")


def _pieces_of(batch: "pa.RecordBatch", info: _Info) -> Iterator[tuple[int, _Piece]]:
    def table(features: tuple[_Feature, ...]) -> FloatArray:
        parts = [_values(batch.column(f.key), f.key, f.width) for f in features]
        return np.concatenate(parts, axis=1) if parts else np.empty((batch.num_rows, 0))

    def column(key: str) -> FloatArray | None:
        return _values(batch.column(key), key, 1)[:, 0] if key in batch.schema.names else None

    observations, actions = table(info.observations), table(info.actions)
    episodes, times, frames = column("episode_index"), column("timestamp"), column("frame_index")
    tasks, rewards, successes = column("task_index"), column(REWARD), column(SUCCESS)
    if episodes is None or not np.isfinite(episodes).all():
        raise MisstepError("an episode_index is missing")
    edges = np.flatnonzero(np.diff(episodes)) + 1
    for rows in np.split(np.arange(len(episodes)), edges):
        if not len(rows):
            continue
        part = slice(int(rows[0]), int(rows[-1]) + 1)
        nothing = np.empty(0)
        task = None if tasks is None or not math.isfinite(tasks[part][0]) else int(tasks[part][0])
        yield (
            int(episodes[part][0]),
            _Piece(
                observations[part],
                actions[part],
                nothing if times is None else times[part],
                nothing if frames is None else frames[part],
                task,
                None if rewards is None else rewards[part],
                None if successes is None else successes[part],
            ),
        )


def _values(array: "pa.Array", key: str, width: int) -> FloatArray:
    """Return a column of numbers or of lists of numbers, shape (b, width); NaN where empty."""
    import pyarrow as pa
    from pyarrow import compute

    rows = len(array)
    array.validate(full=True)
    if isinstance(array, pa.ExtensionArray):
        array = array.storage
    per_row = 1
    while (
        pa.types.is_list(array.type)
        or pa.types.is_large_list(array.type)
        or (pa.types.is_fixed_size_list(array.type))
    ):
        lengths = compute.unique(compute.list_value_length(array)).to_pylist()
        if len(lengths) > 1 or (lengths and not lengths[0]):
            raise MisstepError(f"column {key!r} has lists of different lengths")
        per_row *= lengths[0] if lengths else 1
        array = array.flatten()
    if rows and per_row != width:
        raise MisstepError(f"column {key!r} has {per_row} numbers in a row, info.json says {width}")
    numbers: NDArray[Any] = np.asarray(
        compute.cast(array, pa.float64(), safe=False).to_numpy(zero_copy_only=False)
    )
    return numbers.astype(np.float64).reshape(rows, width)


def _episode(
    info: _Info,
    tasks: dict[int, str],
    annotation: Annotation | None,
    pieces: Iterator[_Piece],
) -> Episode:
    first = next(pieces)
    rows = _EpisodeRows(info.rate, annotation is None or annotation.has_costs)
    if annotation is not None:
        header = annotation.header
        widths = len(header.observation_columns), len(header.action_columns)
        if widths != (first.observations.shape[1], first.actions.shape[1]):
            raise MisstepError("misstep's annotation names other columns than there are")
    else:
        notes = info.left_out
        if info.actions:
            notes += ("the last action left out: the file has no observation after it",)
        task = {"task": tasks[first.task]} if first.task in tasks else {}
        header = Header(
            1 / info.rate,
            tuple(column for f in info.observations for column in f.columns),
            tuple(column for f in info.actions for column in f.columns),
            Provenance(info.robot, task, "", None, "", notes),
        )

    def all_pieces() -> Iterator[_Piece]:
        yield first
        yield from pieces

    return Episode(
        header,
        rows.blocks(all_pieces(), header),
        ending=lambda: annotation.ending if annotation else rows.ending(),
    )


class _EpisodeRows:
    """Turns the rows of one episode into blocks, and remembers what became of it."""

    def __init__(self, rate: float, has_costs: bool) -> None:
        self._rate, self._has_costs = rate, has_costs
        self._rows = 0
        self._start: float | None = None
        self._deviation = 0.0
        self._succeeded: bool | None = None

    def blocks(self, pieces: Iterator[_Piece], header: Header) -> Iterator[Block]:
        held: tuple[FloatArray, FloatArray | None] | None = None
        for piece in pieces:
            self._check(piece)
            actions, costs = piece.actions, None
            if piece.rewards is not None and self._has_costs:
                costs = 0.0 - piece.rewards
            if held is not None:
                actions = np.concatenate([held[0], actions])
                has_both = costs is not None and held[1] is not None
                costs = np.concatenate([held[1], costs]) if has_both else None
            # The last action waits: whether an observation follows, only the next piece tells.
            held = actions[-1:], None if costs is None else costs[-1:]
            yield Block(
                piece.observations,
                actions[:-1] if header.action_columns else np.empty((0, 0)),
                None if costs is None else costs[:-1],
            )

    def _check(self, piece: _Piece) -> None:
        count = len(piece.observations)
        expected = np.arange(self._rows, self._rows + count)
        if len(piece.frames) and not np.array_equal(piece.frames, expected):
            row = int(np.flatnonzero(piece.frames != expected)[0])
            raise MisstepError(
                f"frame_index is {piece.frames[row]:g} where {expected[row]} comes next: rows are "
                "missing or out of order"
            )
        if len(piece.times):
            if self._start is None:
                self._start = float(piece.times[0])
            deviations = np.abs(piece.times - self._start - expected / self._rate)
            self._deviation = max(self._deviation, float(np.max(deviations)))
        if piece.successes is not None:
            self._succeeded = bool(self._succeeded) or bool((piece.successes > 0).any())
        self._rows += count

    def ending(self) -> Ending:
        notes: tuple[str, ...] = ()
        allowed = _TOLERANCE + self._rows / self._rate * 1e-6
        if not self._deviation <= allowed:  # NaN too
            notes = (
                f"times: taken as {self._rate:g} a second, though time stamps are up to "
                f"{self._deviation:.3g} s off",
            )
        if self._succeeded is None:
            return Ending(notes=notes)
        return Ending(Outcome.SUCCESS if self._succeeded else Outcome.FAILURE, notes=notes)
