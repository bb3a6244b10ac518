"""What a command has left behind, file by file, so that two folders can be compared.

A trace says all that a file holds but for the times that nobody could make twice. Making one reads
the file to its end with misstep's own readers: a file that is damaged has no trace.
"""

import csv
import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from misstep import MisstepError, Trajectory, load_dataset
from misstep.locks import LOCK
from misstep.robot.log import read_log
from misstep.study.table import TIMING

Trace = dict[str, Any]
"""What each file holds, by its path within the folder."""

_TIMES = {*TIMING, "timing", "url", "command"}
"""Names of what may differ: times, a free port, and that one command began what another ended."""


def trace(folder: Path) -> Trace:
    """Return what a folder holds, temporary files and the name of who drives it left out.

    Raises
    ------
    MisstepError
        If a file is damaged, by its name.
    """
    found: Trace = {}
    for parent, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not _is_temporary(name)]
        for name in names:
            path = Path(parent, name)
            if not _is_temporary(name) and name != LOCK:
                found[str(path.relative_to(folder))] = _trace_file(path)
    return found


def left_over(folder: Path) -> list[str]:
    """Return the temporary files and folders below a folder."""
    return sorted(
        str(Path(parent, name).relative_to(folder))
        for parent, folders, names in os.walk(folder)
        for name in (*folders, *names)
        if _is_temporary(name)
    )


def trajectory_trace(trajectory: Trajectory) -> str:
    """Return what a trajectory holds but for when it was made."""
    origin = trajectory.provenance
    held = (
        _digest(trajectory.observations),
        _digest(trajectory.actions),
        None if trajectory.costs is None else _digest(trajectory.costs),
        trajectory.dt,
        trajectory.observation_columns,
        trajectory.action_columns,
        str(trajectory.outcome),
        trajectory.failure_step,
        (origin.system, sorted(origin.parameters.items()), origin.demonstrator, origin.seed),
    )
    return hashlib.sha256(repr(held).encode()).hexdigest()


def _is_temporary(name: str) -> bool:
    return name.startswith(".") and name.endswith(".tmp")


def _trace_file(path: Path) -> Any:
    reader = _READERS.get(path.suffix, _read_bytes)
    try:
        return reader(path)
    except Exception as error:  # whatever a reader raises, the file is damaged
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise MisstepError(f"{path.name} is damaged: {reason}") from error


def _read_trajectories(path: Path) -> list[str]:
    return [trajectory_trace(trajectory) for trajectory in load_dataset(path)]


def _read_arrays(path: Path) -> dict[str, str]:
    with np.load(path, allow_pickle=False) as archive:
        return {name: _digest(archive[name]) for name in archive.files if name not in _TIMES}


def _read_json(path: Path) -> Any:
    return _timeless(json.loads(path.read_text(encoding="utf-8")))


def _read_table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file, strict=True))
    if any(None in row or None in row.values() for row in rows):
        raise ValueError("a row is cut")
    return [{k: v for k, v in row.items() if k not in _TIMES} for row in rows]


def _read_page(path: Path) -> str:
    if not path.read_text(encoding="utf-8").rstrip().endswith("</html>"):
        raise ValueError("the end of the page is missing")
    return "a whole page"


def _read_picture(path: Path) -> tuple[int, int]:
    with Image.open(path) as picture:
        picture.load()
        return picture.size


def _read_log(path: Path) -> str:
    """Go through a log: one that was cut by a kill ends with its last whole record."""
    list(read_log(path)[1])
    return "a log"


def _read_bytes(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _timeless(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {k: _timeless(v) for k, v in value.items() if k not in _TIMES}
    return [_timeless(item) for item in value] if isinstance(value, list) else value


def _digest(array: Any) -> str:
    array = np.ascontiguousarray(array)
    return f"{array.dtype} {array.shape} {hashlib.sha256(array.tobytes()).hexdigest()}"


_READERS = {
    ".h5": _read_trajectories,
    ".npz": _read_arrays,
    ".json": _read_json,
    ".csv": _read_table,
    ".html": _read_page,
    ".png": _read_picture,
    ".log": _read_log,
}
