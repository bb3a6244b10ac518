"""Libraries of other projects: whether they are installed, and what they raise over damage."""

import importlib
import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from misstep.errors import MisstepError, reason_of
from misstep.storage import check_regular

_LONGEST_REASON = 300  # characters
_LARGEST_JSON = 2**26  # bytes


def needed(module: str, what: str, extra: str) -> Any:
    """Import a module that not everybody has, and return it.

    Parameters
    ----------
    module : str
        Its full name, ``"pyarrow.parquet"``.
    what : str
        Who needs it: ``"Parquet"``.
    extra : str
        The optional dependency that brings it.

    Raises
    ------
    MisstepError
        If it is not installed; it says how to get it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        library = module.partition(".")[0]
        raise MisstepError(
            f"{what} needs the library {library}: pip install 'misstep[{extra}]'"
        ) from error


@contextmanager
def library_errors(what: str) -> Iterator[None]:
    """Tell in one line whatever a library raises over a damaged file."""
    try:
        yield
    except MisstepError:
        raise
    except Exception as error:  # assertions, struct.error, KeyError ...: it expects no damage
        reason = reason_of(error)
        raise MisstepError(f"{what} cannot be read ({reason[:_LONGEST_REASON]})") from error


def parquet_writer(path: Path, schema: Any, **options: Any) -> Any:
    """Return a `pyarrow.parquet.ParquetWriter` that tells only once that the disk is full.

    Arrow's own, when it is let go after a write has failed, tries once more to end the file, and
    Python prints the traceback of that.
    """
    from pyarrow import parquet

    class Writer(parquet.ParquetWriter):
        def __del__(self) -> None:
            with suppress(OSError):
                super().__del__()

    return Writer(path, schema, **options)


def read_json(path: Path) -> dict[str, Any]:
    """Return what a file of JSON says.

    Raises
    ------
    MisstepError
        If it is missing, too large, or no JSON object.
    """
    check_regular(path)
    try:
        if path.stat().st_size > _LARGEST_JSON:
            raise MisstepError(f"{path.name} is too large to be one")
        said = json.loads(path.read_bytes())
    except OSError as error:
        raise MisstepError(f"{path.name}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise MisstepError(f"{path.name} is no JSON ({error})") from error
    if not isinstance(said, dict):
        raise MisstepError(f"{path.name} is no JSON object")
    return said
