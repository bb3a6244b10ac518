"""Texts of variable length in HDF5 files of other projects, read where a crash does no harm.

The HDF5 library crashes, or never returns, on such texts when they are damaged. So a process of
its own reads them, with limits on its memory and time.
"""

import json
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np

from misstep.errors import MisstepError
from misstep.formats.hdf5.attributes import damage

_SECONDS = 60  # on a machine that may do other things, too
_COMPUTING_SECONDS = 20
_LARGEST = 2**24  # bytes of all texts
_LIMITS = """
import os, sys
os.environ["OPENBLAS_NUM_THREADS"] = "1"  # each thread asks for memory in advance
try:
    import resource
    for kind, most in ((resource.RLIMIT_AS, 2**33), (resource.RLIMIT_CPU, int(sys.argv[-1]))):
        hard = resource.getrlimit(kind)[1]
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (most, most))
except ImportError:  # Windows
    pass
"""
_SCRIPT = """
import json
import h5py, numpy
with h5py.File(sys.argv[1], "r") as file:
    owner = file[sys.argv[2]]
    found = owner.attrs[sys.argv[3]] if len(sys.argv) > 4 else owner[()]
texts = [t.decode() if isinstance(t, bytes) else str(t) for t in numpy.atleast_1d(found).ravel()]
sys.stdout.write(json.dumps(texts))
"""
_SCRIPT_ALL = """
import h5py
def visit(_, member):
    dict(member.attrs)
    if isinstance(member, h5py.Dataset) and member.dtype.kind == "O":
        for start in range(0, len(member), 1000):
            member[start : start + 1000]
with h5py.File(sys.argv[1], "r") as file:
    visit("", file)
    file.visititems(visit)
"""


def check_texts(path: Path) -> None:
    """Make sure that all texts of variable length in a file can be read without a crash.

    Raises
    ------
    MisstepError
        If they cannot.
    """
    _run_apart(path, "a text", _SCRIPT_ALL, [])


def read_texts(file: h5py.File, path: Path, name: str, attribute: str | None = None) -> list[str]:
    """Return the texts of an array, or of an attribute of a group, in their order.

    Parameters
    ----------
    file : h5py.File
    path : Path
        Where the file is.
    name : str
        Of the array or the group.
    attribute : str, optional

    Raises
    ------
    MisstepError
        If they are damaged, or no texts.
    """
    what = name if attribute is None else f"attribute {attribute}"
    with damage(what):
        owner = file[name]
        kind = owner.attrs.get_id(attribute).dtype if attribute else owner.dtype
        size = kind.itemsize if attribute else owner.nbytes
        plain = kind.kind == "S" and size <= _LARGEST and (attribute or not owner.chunks)
        if plain and (attribute or not (owner.is_virtual or owner.external)):
            found = owner.attrs[attribute] if attribute else owner[()]
            return [text.decode() for text in np.atleast_1d(found).ravel().tolist()]
    if h5py.check_string_dtype(kind) is None:
        raise MisstepError(f"{what} is no text")
    return _read_apart(path, what, [name] if attribute is None else [name, attribute])


def _read_apart(path: Path, what: str, arguments: list[str]) -> list[str]:
    said = _run_apart(path, what, _SCRIPT, arguments)
    try:
        return [str(text) for text in json.loads(said[:_LARGEST])]
    except ValueError as error:
        raise MisstepError(f"{what} takes up more than {_LARGEST} bytes") from error


def _run_apart(path: Path, what: str, script: str, arguments: list[str]) -> bytes:
    words = [str(path.resolve()), *arguments, str(_COMPUTING_SECONDS)]
    try:
        return subprocess.run(  # noqa: S603 our own interpreter and script
            [sys.executable, "-I", "-c", _LIMITS + script, *words],
            capture_output=True,
            timeout=_SECONDS,
            check=True,
        ).stdout
    except (subprocess.SubprocessError, OSError) as error:
        raise MisstepError(f"{what} is damaged: the HDF5 library cannot read it") from error
