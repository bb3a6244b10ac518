"""What a command leaves behind: a JSON file, and attempts in a table on stdout."""

import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from misstep.cli.table import print_table
from misstep.errors import MisstepError
from misstep.storage import is_stream, write_json
from misstep.trajectory import Trajectory
from misstep.version import __version__, command_line


def check_output_file(path: Path | None, option: str, *inputs: Path) -> None:
    """Make sure that a file can be written, before hours of work are spent on what goes in.

    Parameters
    ----------
    path : Path or None
    option : str
        What names it on the command line.
    *inputs : Path
        What the command reads: a result must not take the place of a recording.

    Raises
    ------
    MisstepError
        If it is a folder, one of the inputs or another recording, or no file can be made where it
        should go.
    """
    if path is None:
        return
    if path.is_dir():
        raise MisstepError(f"{option} {path} is a folder: name a file")
    if path.exists() and any(other.exists() and path.samefile(other) for other in inputs):
        raise MisstepError(f"{option} {path} is what is read, and would be lost: name another file")
    if is_stream(path):
        if not os.access(path, os.W_OK):
            raise MisstepError(f"{option} {path}: it cannot be written to; name another file")
        return
    if path.exists() and _is_recording(path):
        raise MisstepError(f"{option} {path} is a recording, and would be lost: name another file")
    _check_folder(path, option)


def check_new_recording(path: Path, option: str, *, force: bool) -> None:
    """Make sure that a recording can be written, and that none is lost that is still wanted.

    Raises
    ------
    MisstepError
        If it exists and need not be replaced, is a folder, or cannot be made.
    """
    if path.is_dir():
        raise MisstepError(f"{option} {path} is a folder: name a file")
    if is_stream(path):
        return
    _check_folder(path, option)
    if path.exists() and not force:
        raise MisstepError(f"{option} {path} exists already: choose another name, or add --force")


def _is_recording(path: Path) -> bool:
    from misstep.formats import format_to_read

    try:
        return format_to_read(path).read is not None
    except MisstepError:
        return False


def _check_folder(path: Path, option: str) -> None:
    try:
        tempfile.TemporaryFile(dir=path.parent).close()
    except OSError as error:
        raise MisstepError(
            f"{option} {path}: cannot write to the folder {path.parent}: {error.strerror}; "
            "choose one that exists and can be written to"
        ) from error


def write_result(path: Path | None, result: Mapping[str, object]) -> None:
    """Write a command's result as JSON, with the version and the command that it came from."""
    if path is not None:
        origin = {"version": __version__, "command": list(command_line())}
        write_json(path, {**origin, **result})


def print_attempts(name: str, attempts: Sequence[Trajectory]) -> None:
    """Print one line an attempt: how long it took, what became of it, when it failed, its cost."""
    columns = (name, ">duration [s]", "outcome", ">failed at [s]", ">mean cost")
    rows = [
        (
            str(number),
            f"{attempt.duration:.2f}",
            str(attempt.outcome),
            formatted(attempt.failure_time, ".2f"),
            formatted(attempt.mean_cost, ".4g"),
        )
        for number, attempt in enumerate(attempts, start=1)
    ]
    print_table(columns, rows)


def formatted(value: float | None, form: str) -> str:
    """Return a number of a table, such as in the form ``".2f"``; a dash where there is none."""
    return "-" if value is None else format(value, form)
