"""Where data sets of Minari's lie, and what is one."""

import os
from pathlib import Path

from misstep.errors import MisstepError
from misstep.formats.libraries import read_json

SCHEME = "minari:"


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
    return root() / name


def root() -> Path:
    """Return Minari's folder of data sets."""
    told = os.environ.get("MINARI_DATASETS_PATH")
    return Path(told) if told else Path.home() / ".minari" / "datasets"


def data_folder(path: Path) -> Path:
    """Return the folder with the metadata, whether the data set's folder was given or that."""
    inner = path / "data"
    return inner if (inner / "metadata.json").is_file() else path


def recognise(path: Path) -> bool:
    """Say whether a folder is a data set of Minari's."""
    try:
        metadata = read_json(data_folder(Path(located(path))) / "metadata.json")
    except MisstepError:
        return False
    return "data_format" in metadata and "total_episodes" in metadata
