"""Reading data sets of Minari's; `misstep.formats.minari` says what is taken for what."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from misstep.errors import MisstepError
from misstep.formats.annotation import Annotation, read_annotation
from misstep.formats.format import Block, Ending, Episode, FloatArray, Header, ReadOptions
from misstep.formats.guard import prefixed
from misstep.formats.hdf5.attributes import damage
from misstep.formats.hdf5.foreign_arrays import ForeignArray
from misstep.formats.hdf5.texts import check_texts
from misstep.formats.libraries import library_errors, needed, read_json
from misstep.formats.minari.names import data_folder, located
from misstep.trajectory import Outcome, Provenance

if TYPE_CHECKING:
    from minari import MinariDataset

    from misstep.formats.minari.spaces import Table

_LARGEST_SPACE = 10**6  # numbers
_LARGEST_EPISODE = 2**31  # bytes


def read(path: Path, options: ReadOptions) -> Iterator[Episode]:
    """Read a data set of Minari's; see `misstep.formats.format.Format`.

    Raises
    ------
    MisstepError
        If it is damaged, made by a version that the installed library does not know, or without
        spaces; or it does not say how much time passes between observations and
        ``options.rate`` does not either.
    """
    needed("minari", "a data set of Minari's", "minari")
    from minari import MinariDataset

    folder = data_folder(Path(located(path)))
    metadata = read_json(folder / "metadata.json")
    _check_metadata(metadata)
    with library_errors("metadata.json"):
        dataset = MinariDataset(folder)
    reader = _Reader(folder, dataset, metadata, options)
    total = int(metadata["total_episodes"])
    for index in range(total):
        with prefixed(f"episode_{index}"):
            episode = reader.episode(index)
        yield episode
        if options.report is not None:
            options.report(index + 1, total)


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
        from misstep.formats.minari.spaces import flat

        self._check(index)
        with library_errors("it"):
            (said,) = self._dataset.storage.get_episode_metadata([index])
            (data,) = self._dataset.iterate_episodes([index])
        if not isinstance(said, dict):
            raise MisstepError("what is said of it is no JSON object")
        annotation = _annotation(said)
        observations = flat(self._dataset.observation_space, data.observations, "observation")
        actions = flat(self._dataset.action_space, data.actions, "action")
        rewards = _vector(data.rewards, "rewards")
        steps = said.get("total_steps", len(rewards))
        number = isinstance(steps, int | float | np.number)  # an attribute can be a whole table
        if not number or steps != len(rewards):
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

    with library_errors("it"):
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
    with library_errors(name):
        return np.asarray(values, np.float64).reshape(-1)
