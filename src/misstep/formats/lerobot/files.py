"""What reading and writing data sets of LeRobot's have in common."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from misstep.errors import MisstepError, reason_of
from misstep.formats.libraries import read_json

REWARD, DONE, SUCCESS = "next.reward", "next.done", "next.success"

_LONGEST_LINE = 2**28  # characters


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
    except (
        pa.ArrowException,
        ArithmeticError,
        KeyError,
        OSError,
        RecursionError,
        TypeError,
        ValueError,
    ) as error:
        reason = reason_of(error)
        raise MisstepError(f"{what} is damaged ({reason[:300]})") from error


def read_lines(path: Path) -> Iterator[str]:
    """Yield the lines of a text file; none if it is not there."""
    if not path.is_file():
        return
    with damage(path.name), open(path, encoding="utf-8") as file:
        while line := file.readline(_LONGEST_LINE):
            yield line
