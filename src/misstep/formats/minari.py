"""Data sets of Farama's Minari, through its own library: https://minari.farama.org.

A data set is a folder with ``data/metadata.json``, and the episodes beside that in HDF5, Arrow or
Parquet. Its name, such as ``cartpole/failed-v0``, is its place under Minari's folder of data sets
(``MINARI_DATASETS_PATH``, or ``~/.minari/datasets``): ``minari:cartpole/failed-v0`` stands for
that place. Nothing is ever downloaded.

Reading: the numbers of the observation space, however nested, are the observations, those of the
action space the actions; images and texts are left out, and noted. Costs are the rewards with the
sign turned. An episode whose infos hold ``success`` succeeded if that is ever true, and failed if
not. Minari does not know how much time passes between observations: for data sets of others that
has to be said.

Writing: one `Box` of observations and one of actions, both float64. Infos hold ``success`` (true
at the end of a success) and ``failure`` (true from the failure step on), T + 1 each; what Minari
has no place for stands in the metadata of each episode under ``misstep``. Rewards are the costs
with the sign turned, zero where none were recorded.

The library handles an episode whole, so here one has to fit into memory. It also imports whatever
a data set names as its environment if that lacks spaces; such a data set is refused.
"""

import json
import math
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from misstep.errors import MisstepError
from misstep.formats.annotation import Annotation, read_annotation
from misstep.formats.folders import write_folder
from misstep.formats.foreign_arrays import ForeignArray
from misstep.formats.format import (
    Block,
    Ending,
    Episode,
    FloatArray,
    Format,
    Header,
    ReadOptions,
    joined,
)
from misstep.formats.guard import prefixed
from misstep.formats.hdf5_attributes import damage
from misstep.formats.hdf5_texts import check_texts
from misstep.formats.steps import uniform
from misstep.trajectory import Outcome, Provenance

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.dataset.minari_storage import MinariStorage

    from misstep.formats.minari_spaces import Table

SCHEME = "minari:"

_LARGEST_METADATA = 2**26  # bytes
_LARGEST_SPACE = 10**6  # numbers
_LARGEST_EPISODE = 2**31  # bytes
_ARROW_ROWS = 2**15  # that the library reads back of an episode
_LONGEST_TEXT = 64000  # bytes of an attribute in HDF5
_SPARE = 2**24  # bytes of free disk that writing leaves


def located(path: str | os.PathLike[str]) -> str | os.PathLike[str]:
    """Return the folder of a data set given by its name, ``minari:ID``; any other path as it is.

    Raises
    ------
    MisstepError
        If the name leads out of Minari's folder.
    """
    text = os.fspath(path)
    if not text.startswith(SCHEME):
        return path
    name = text.removeprefix(SCHEME)
    if not name or Path(name).is_absolute() or ".." in Path(name).parts:
        raise MisstepError(f"{text}: name a data set, such as minari:cartpole/failed-v0")
    return _root() / name


def _root() -> Path:
    told = os.environ.get("MINARI_DATASETS_PATH")
    return Path(told) if told else Path.home() / ".minari" / "datasets"


def _data_folder(path: Path) -> Path:
    """Return the folder with the metadata, whether the data set's folder was given or that."""
    inner = path / "data"
    return inner if (inner / "metadata.json").is_file() else path


def recognise(path: Path) -> bool:
    """Say whether a folder is a data set of Minari's."""
    try:
        metadata = _metadata(_data_folder(Path(located(path))))
    except (MisstepError, OSError):
        return False
    return "data_format" in metadata and "total_episodes" in metadata


@contextmanager
def _library_errors(what: str) -> Iterator[None]:
    """Tell in one line whatever Minari raises over a damaged data set."""
    try:
        yield
    except MisstepError:
        raise
    except Exception as error:  # assertions, KeyError, ArrowInvalid ...: it expects no damage
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MisstepError(f"{what} cannot be read by minari ({reason[:300]})") from error


def _installed() -> None:
    try:
        import minari  # noqa: F401
    except ImportError as error:
        raise MisstepError(
            "Minari's data sets need its library: pip install 'misstep[minari]'"
        ) from error


# Reading


def read(path: Path, options: ReadOptions) -> Iterator[Episode]:
    """Read a data set of Minari's; see `misstep.formats.format.Format`.

    Raises
    ------
    MisstepError
        If it is damaged, made by a version that the installed library does not know, or without
        spaces; or it does not say how much time passes between observations and
        ``options.rate`` does not either.
    """
    _installed()
    from minari import MinariDataset

    folder = _data_folder(Path(located(path)))
    metadata = _metadata(folder)
    _check_metadata(metadata)
    with _library_errors("metadata.json"):
        dataset = MinariDataset(folder)
    reader = _Reader(folder, dataset, metadata, options)
    total = int(metadata["total_episodes"])
    for index in range(total):
        with prefixed(f"episode_{index}"):
            episode = reader.episode(index)
        yield episode
        if options.report is not None:
            options.report(index + 1, total)


def _metadata(folder: Path) -> dict[str, Any]:
    path = folder / "metadata.json"
    try:
        if path.stat().st_size > _LARGEST_METADATA:
            raise MisstepError("metadata.json is too large to be one")
        metadata = json.loads(path.read_bytes())
    except OSError as error:
        raise MisstepError(f"metadata.json: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise MisstepError(f"metadata.json is no JSON ({error})") from error
    if not isinstance(metadata, dict):
        raise MisstepError("metadata.json is no JSON object")
    return metadata


def _check_metadata(metadata: dict[str, Any]) -> None:
    if metadata.get("data_format") not in ("hdf5", "arrow", "parquet"):
        raise MisstepError(
            f"metadata.json says data_format {metadata.get('data_format')!r}: hdf5, arrow and "
            "parquet are known"
        )
    total = metadata.get("total_episodes")
    if type(total) is not int or total < 1:
        raise MisstepError(f"metadata.json says total_episodes {total!r}: at least 1 is needed")
    for name in ("observation_space", "action_space"):
        if not isinstance(metadata.get(name), str):
            raise MisstepError(
                f"metadata.json does not say the {name.replace('_', ' ')}: it would have to come "
                "from the environment, which is not run; give the data set its spaces in Minari"
            )
        with damage(name):
            _check_space(json.loads(metadata[name]))


def _check_space(space: Any) -> None:
    """Refuse a space that would take much memory to be made."""
    if isinstance(space, list):
        for part in space:
            _check_space(part)
    elif isinstance(space, dict):
        shape = space.get("shape", [])
        if isinstance(shape, list) and math.prod(shape) > _LARGEST_SPACE:
            raise MisstepError(f"a space of shape {shape} is too large")
        _check_space(list(space.values()))


class _Reader:
    """Reads the episodes of one data set."""

    def __init__(
        self,
        folder: Path,
        dataset: "MinariDataset",
        metadata: dict[str, Any],
        options: ReadOptions,
    ) -> None:
        self._folder, self._dataset = folder, dataset
        self._metadata, self._options = metadata, options
        self._texts_are_checked = False

    def episode(self, index: int) -> Episode:
        from misstep.formats.minari_spaces import flat

        self._check(index)
        with _library_errors("it"):
            (said,) = self._dataset.storage.get_episode_metadata([index])
            (data,) = self._dataset.iterate_episodes([index])
        annotation = _annotation(said)
        observations = flat(self._dataset.observation_space, data.observations, "observation")
        actions = flat(self._dataset.action_space, data.actions, "action")
        rewards = _vector(data.rewards, "rewards")
        steps = said.get("total_steps", len(rewards))
        if steps != len(rewards):
            raise MisstepError(
                f"total_steps is {steps}, but minari reads {len(rewards)}: it is damaged, or "
                "longer than Minari's arrow storage can read"
            )
        infos = data.infos if isinstance(data.infos, dict) else {}
        block = Block(
            observations.values,
            actions.values,
            0.0 - rewards if annotation is None or annotation.has_costs else None,
        )
        if annotation is not None:
            header, ending = annotation.header, annotation.ending
        else:
            header = self._header(said, observations, actions, infos)
            ending = _ending(infos)
        return Episode(header, iter([block]), lambda: ending)

    def _header(
        self, said: dict[str, Any], observations: "Table", actions: "Table", infos: dict[str, Any]
    ) -> Header:
        if self._options.rate is None:
            raise MisstepError(
                "a data set of Minari's does not say how many observations there are a second: "
                "say it with --rate"
            )
        left_out = [*observations.left_out, *actions.left_out]
        left_out += [f"info {name}" for name in infos if name not in ("success", "failure")]
        seed = said.get("seed")
        provenance = Provenance(
            _environment(self._metadata),
            {},
            str(self._metadata.get("algorithm_name", "")),
            seed if isinstance(seed, int) and seed >= 0 else None,
            "",
            tuple(f"{what} left out" for what in left_out),
        )
        return Header(1 / self._options.rate, observations.columns, actions.columns, provenance)

    def _check(self, index: int) -> None:
        """Make sure that reading an episode takes no more memory than it may, and no crash."""
        if self._metadata["data_format"] == "arrow":
            _check_arrow(self._folder / str(index))
        if self._metadata["data_format"] != "hdf5":
            return
        file_path = self._folder / "main_data.hdf5"
        with damage("main_data.hdf5"), h5py.File(file_path, "r") as file:
            group = file.get(f"episode_{index}")
            if not isinstance(group, h5py.Group):
                raise MisstepError("there is no such episode in main_data.hdf5")
            has_texts = _check_group(group, [_LARGEST_EPISODE])
        if has_texts and not self._texts_are_checked:
            check_texts(file_path)
            self._texts_are_checked = True


def _check_group(group: h5py.Group, room: list[int]) -> bool:
    """Check all that lies in a group, `room` bytes at most; return whether it has texts."""
    has_texts = any(_is_variable(group.attrs.get_id(name).dtype) for name in group.attrs)
    for name in group:
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise MisstepError(f"{name} is a link to elsewhere: only plain members are read")
        member = group[name]
        room[0] -= member.nbytes if isinstance(member, h5py.Dataset) else 1000
        if room[0] < 0:
            raise MisstepError(f"it takes up more than {_LARGEST_EPISODE} bytes")
        if isinstance(member, h5py.Group):
            has_texts |= _check_group(member, room)
        elif isinstance(member, h5py.Dataset) and _is_variable(member.dtype):
            has_texts = True
        elif isinstance(member, h5py.Dataset) and member.dtype.kind in "fiub" and member.shape:
            ForeignArray(group, name).check()
    return has_texts


def _is_variable(kind: np.dtype[Any]) -> bool:
    text = h5py.check_string_dtype(kind)
    return h5py.check_vlen_dtype(kind) is not None or (text is not None and text.length is None)


def _check_arrow(folder: Path) -> None:
    """Check what the library takes on trust, and crashes over."""
    from pyarrow import OSFile, ipc

    with _library_errors("it"):
        size = 0
        for path in sorted(folder.iterdir()):
            if path.name.startswith(("_", ".", "metadata.json")):
                continue
            with OSFile(str(path)) as file:
                batches = ipc.open_file(file)
                for index in range(batches.num_record_batches):
                    batch = batches.get_batch(index)
                    batch.validate(full=True)
                    size += batch.nbytes
                    if size > _LARGEST_EPISODE:
                        raise MisstepError(f"it takes up more than {_LARGEST_EPISODE} bytes")


def _annotation(said: dict[str, Any]) -> Annotation | None:
    text = said.get("misstep")
    if isinstance(text, bytes):
        with damage("misstep's annotation"):
            text = text.decode()
    return read_annotation(text) if isinstance(text, str) else None


def _environment(metadata: dict[str, Any]) -> str:
    """Return the id of the environment, or else the data set's name."""
    text = metadata.get("env_spec")
    if isinstance(text, str):
        with damage("env_spec"):
            said = json.loads(text)
        if isinstance(said, dict) and isinstance(said.get("id"), str):
            return f"gym:{said['id']}"
    return str(metadata.get("dataset_id", ""))


def _ending(infos: dict[str, Any]) -> Ending:
    failed = _flags(infos, "failure")
    step = int(np.argmax(failed)) if failed is not None and failed.any() else None
    succeeded = _flags(infos, "success")
    if succeeded is not None and succeeded.any():
        return Ending(Outcome.SUCCESS, step)
    if step is not None or succeeded is not None:
        return Ending(Outcome.FAILURE, step)
    return Ending()


def _flags(infos: dict[str, Any], name: str) -> "np.ndarray[Any, np.dtype[np.bool_]] | None":
    values = infos.get(name)
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "biuf":
        return None
    flags: np.ndarray[Any, np.dtype[np.bool_]] = values.astype(bool).reshape(len(values), -1)
    return np.asarray(flags.any(axis=1))


def _vector(values: Any, name: str) -> FloatArray:
    with _library_errors(name):
        return np.asarray(values, np.float64).reshape(-1)


# Writing


def write(path: Path, episodes: Iterable[Episode], storage: str = "hdf5") -> None:
    """Write episodes as a data set of Minari's, in a single step.

    Parameters
    ----------
    path : path
        The folder to make, or ``minari:ID``.
    episodes : iterable of Episode
    storage : "hdf5" or "arrow"

    Raises
    ------
    MisstepError
        If an episode has no actions, no common dt, or another kind than the first; there is none;
        the disk has no room; or the folder cannot be written.
    """
    _installed()
    target = Path(located(path))
    if target != path:
        target.parent.mkdir(parents=True, exist_ok=True)  # as Minari makes its namespaces
    write_folder(target, partial(_fill, path=target, episodes=episodes, storage=storage), recognise)


def _fill(folder: Path, path: Path, episodes: Iterable[Episode], storage: str) -> None:
    import minari

    folder.mkdir()
    passing = uniform(path, episodes)
    first = next(passing)
    target = _new_storage(folder / "data", first.header, storage)
    target.update_metadata(
        {
            "dataset_id": _name_of(path),
            "minari_version": minari.__version__,
            "author": {"misstep"},
            "algorithm_name": first.header.provenance.demonstrator,
            "description": f"Recordings of {first.header.provenance.system or 'a system'}, "
            "written by misstep.",
        }
    )
    texts: list[str] = []

    def buffers() -> Iterator[Any]:
        for episode in chain([first], passing):
            with prefixed(f"cannot write {path}: episode_{len(texts)}"):
                buffer, text = _buffer(episode, folder, storage)
            texts.append(text)
            yield buffer

    target.update_episodes(buffers())
    # Of fixed length, because the HDF5 library crashes on damaged texts of variable length.
    kept = [np.bytes_(text.encode()) for text in texts] if storage == "hdf5" else texts
    target.update_episode_metadata([{"misstep": text} for text in kept], range(len(texts)))


def _new_storage(folder: Path, header: Header, storage: str) -> "MinariStorage":
    from gymnasium import spaces
    from minari.dataset.minari_storage import MinariStorage

    observations, actions = (
        spaces.Box(-np.inf, np.inf, (len(columns),), np.float64)
        for columns in (header.observation_columns, header.action_columns)
    )
    return MinariStorage.new(
        folder, observation_space=observations, action_space=actions, data_format=storage
    )


def _name_of(path: Path) -> str:
    """Return the name of a data set: its place under Minari's folder, or its folder's name."""
    target, root = Path(os.path.realpath(path)), Path(os.path.realpath(_root()))
    if target.is_relative_to(root) and target != root:
        return target.relative_to(root).as_posix()
    plain = "".join(letter if letter.isalnum() or letter in "-_" else "-" for letter in target.stem)
    return plain if plain.rpartition("-v")[2].isdigit() else f"{plain}-v0"


def _buffer(episode: Episode, folder: Path, storage: str) -> tuple[Any, str]:
    """Return an episode as the library takes it, and its annotation."""
    from minari.data_collector import EpisodeBuffer

    block = joined(episode)
    ending = episode.ending()
    text = Annotation(episode.header, ending, block.costs is not None).to_text()
    if storage == "hdf5" and len(text.encode()) > _LONGEST_TEXT:
        raise MisstepError(f"what is said of it takes up more than {_LONGEST_TEXT} bytes")
    if storage == "arrow" and len(block.observations) > _ARROW_ROWS:
        raise MisstepError(
            f"it has {len(block.observations)} rows: minari reads no more than {_ARROW_ROWS} back "
            "from arrow; write it with --format minari, in HDF5"
        )
    needed = 4 * (block.observations.nbytes + block.actions.nbytes) + _SPARE
    if shutil.disk_usage(folder).free < needed:
        # The HDF5 library crashes on a disk that is full, so that is kept from happening.
        raise MisstepError("the disk is full, or will be in a moment")
    steps = len(block.actions)
    last_step = np.arange(steps) == steps - 1
    failed_there = ending.outcome is Outcome.FAILURE and ending.failure_step == steps
    rows = np.arange(steps + 1)
    failure = rows >= (math.inf if ending.failure_step is None else ending.failure_step)
    seed = episode.header.provenance.seed
    buffer = EpisodeBuffer(
        seed=seed if seed is not None and seed < 2**63 else None,
        observations=block.observations,
        actions=block.actions,
        rewards=np.zeros(steps) if block.costs is None else -block.costs,
        terminations=last_step & failed_there,
        truncations=last_step & (not failed_there),
        infos={  # lists: the library cannot read arrays of plain numbers back from arrow
            "success": ((rows == steps) & (ending.outcome is Outcome.SUCCESS)).tolist(),
            "failure": failure.tolist(),
        },
    )
    return buffer, text


FORMAT = Format(
    "Minari data set, HDF5 inside",
    (".minari",),
    read,
    write,
    is_folder=True,
    recognise=recognise,
    extra="minari",
)
ARROW = Format(
    "Minari data set, Arrow inside",
    (),
    read,
    partial(write, storage="arrow"),
    is_folder=True,
    extra="minari",
)
