"""What the page can take with it: recordings in every format, runs, and a replay in one file."""

import tempfile
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from misstep.errors import MisstepError
from misstep.formats import FORMATS
from misstep.live.packing import PACKED
from misstep.live.worker import Worker
from misstep.trajectory import Trajectory

MOST_UPLOADED = 64 * 2**20
"""Bytes of a file that is dropped in."""


def show_formats() -> list[dict[str, Any]]:
    """Return the formats in which recordings can be downloaded."""
    return [
        {"name": name, "description": entry.description, "suffix": _suffix(name)}
        for name, entry in FORMATS.loaded()[0].items()
        if entry.write is not None
    ]


def upload_suffix(name: str) -> str:
    """Return the suffix by which a file that is dropped in is read.

    Only the suffix of its name is ever used, and only one that a format knows.

    Raises
    ------
    MisstepError
        If no format goes by it.
    """
    suffix = Path(name).suffix.lower()
    files = [entry for entry in FORMATS.loaded()[0].values() if not entry.is_folder]
    known = sorted({PACKED, *(s for e in files for s in (*e.suffixes, *e.read_suffixes))})
    if suffix not in known:
        raise MisstepError(
            f"a file {suffix or 'without a suffix'} is not known here; known are: "
            f"{', '.join(known)}"
        )
    return suffix


@asynccontextmanager
async def written(
    worker: Worker, attempts: Sequence[Trajectory], format_name: str
) -> AsyncIterator[Path]:
    """Write attempts in a format, for as long as the context lasts.

    Raises
    ------
    MisstepError
        If there is no such format or it cannot hold them.
    """
    if format_name not in {shown["name"] for shown in show_formats()}:
        raise MisstepError("there is no such format to download")
    with tempfile.TemporaryDirectory(prefix="misstep-") as folder:
        # The job takes the format from the folder's name, as the suffix can be of several.
        target = Path(folder) / format_name / f"attempts{_own_suffix(format_name)}"
        target.parent.mkdir()
        made = await worker.do("write", attempts=list(attempts), out=str(target))
        yield Path(made)


@asynccontextmanager
async def packed(worker: Worker, folder: Path) -> AsyncIterator[Path]:
    """Pack a folder, for as long as the context lasts."""
    with tempfile.TemporaryDirectory(prefix="misstep-") as place:
        made = await worker.do("zip", folder=str(folder), out=str(Path(place) / folder.name))
        yield Path(made)


def _own_suffix(name: str) -> str:
    suffixes = FORMATS[name].suffixes
    return suffixes[0] if suffixes else ""


def _suffix(name: str) -> str:
    return PACKED if FORMATS[name].is_folder else _own_suffix(name)
