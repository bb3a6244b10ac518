"""Writing data sets of Minari's; `misstep.formats.minari` says what goes where."""

import math
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from misstep.errors import MisstepError
from misstep.formats.annotation import Annotation
from misstep.formats.folders import write_folder
from misstep.formats.format import Episode, Header, joined
from misstep.formats.guard import prefixed
from misstep.formats.libraries import needed
from misstep.formats.minari.names import located, recognise, root
from misstep.formats.steps import uniform
from misstep.trajectory import Outcome

if TYPE_CHECKING:
    from minari.dataset.minari_storage import MinariStorage

_ARROW_ROWS = 2**15  # that the library reads back of an episode
_LONGEST_TEXT = 64000  # bytes of an attribute in HDF5
_SPARE = 2**24  # bytes of free disk that writing leaves
_REFUSAL = re.compile("error message = '([^']*)'")  # how the HDF5 library tells of a full disk


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
    needed("minari", "a data set of Minari's", "minari")
    target = Path(located(path))
    if target != path:
        target.parent.mkdir(parents=True, exist_ok=True)  # as Minari makes its namespaces
    fill = partial(_fill, path=target, episodes=episodes, storage=storage)
    try:
        write_folder(target, fill, recognise)
    except RuntimeError as error:
        reason = _REFUSAL.search(str(error))
        if reason is None:
            raise
        raise MisstepError(f"cannot write {path}: {reason[1]}") from error


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
    target, datasets = Path(os.path.realpath(path)), Path(os.path.realpath(root()))
    if target.is_relative_to(datasets) and target != datasets:
        return target.relative_to(datasets).as_posix()
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
    room = 4 * (block.observations.nbytes + block.actions.nbytes) + _SPARE
    if shutil.disk_usage(folder).free < room:
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
