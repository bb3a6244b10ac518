"""What reading and writing data sets of LeRobot's have in common."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from misstep.errors import MisstepError

REWARD, DONE, SUCCESS = "next.reward", "next.done", "next.success"

_LARGEST_TEXT_FILE = 2**28  # bytes


def recognise(path: Path) -> bool:
    """Say whether a folder is a data set of LeRobot's."""
    try:
        info = read_json(path / "meta" / "info.json")
    except MisstepError:
        return False
    return "codebase_version" in info and "features" in info


@contextmanager
def damage(what: str) -> Iterator[None]:
    """Tell what pyarrow and json raise over a damaged file as one line."""
    import pyarrow as pa

    try:
        yield
    except MisstepError:
        raise
    except (pa.ArrowException, OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise MisstepError(f"{what} is damaged ({reason[:300]})") from error


def installed() -> None:
    """Make sure that pyarrow is installed.

    Raises
    ------
    MisstepError
        If it is not; it says how to get it.
    """
    try:
        import pyarrow  # noqa: F401
    except ImportError as error:
        raise MisstepError(
            "LeRobot's data sets need pyarrow: pip install 'misstep[lerobot]'"
        ) from error


def read_json(path: Path) -> dict[str, Any]:
    """Return what a file of JSON says.

    Raises
    ------
    MisstepError
        If it is missing, too large, or no JSON object.
    """
    try:
        if path.stat().st_size > _LARGEST_TEXT_FILE:
            raise MisstepError(f"{path.name} is too large to be one")
        said = json.loads(path.read_bytes())
    except OSError as error:
        raise MisstepError(f"{path.name}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise MisstepError(f"{path.name} is no JSON ({error})") from error
    if not isinstance(said, dict):
        raise MisstepError(f"{path.name} is no JSON object")
    return said


def read_lines(path: Path) -> Iterator[str]:
    """Yield the lines of a text file; none if it is not there."""
    if not path.is_file():
        return
    with damage(path.name), open(path, encoding="utf-8") as file:
        while line := file.readline(_LARGEST_TEXT_FILE):
            yield line
