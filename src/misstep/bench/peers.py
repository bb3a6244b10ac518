"""The libraries that misstep is measured against, in an environment of their own.

Each is installed by itself, at the version that ``peers.txt`` pins, so that one that cannot be had
costs no other. scikit-learn, on which misstep stands, can be measured where misstep is installed if
all else fails.

PyPR is of 2012 and for Python 2. Its sources are converted where they are installed: the grammar by
fissix, and then the few names that NumPy has dropped since.
"""

import hashlib
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from misstep.errors import MisstepError
from misstep.storage import make_folder, write_text

PINS = Path(__file__).parent / "peers.txt"


class Peer(NamedTuple):
    """A library to measure against."""

    name: str
    module: str
    """Its module in `misstep.bench.contenders`."""
    requirements: tuple[str, ...] = ()
    """What pip installs; nothing for what runs in misstep's own environment."""


MISSTEP = Peer("misstep", "misstep_itself")
PLAIN_NUMPY = Peer("plain NumPy", "plain_numpy")
SCIKIT_LEARN = Peer("scikit-learn", "scikit_learn", ("scikit-learn",))
GMR = Peer("gmr", "gmr_library", ("gmr",))
PYPR = Peer("PyPR", "pypr_library", ("numpy", "fissix", "PyPR"))
POMEGRANATE = Peer("pomegranate", "pomegranate_library", ("pomegranate",))

# Python 2 to 3 is fissix's work; this is NumPy 1 to 2, and a comparison that meant `is`.
_DROPPED = (
    (r"np\.NaN\b", "np.nan"),
    (r"np\.linalg\.linalg\.", "np.linalg."),
    (r"True - (np\.isnan\(\w+\))", r"~\1"),
    (r"pdf==None", "pdf is None"),
)


class Found(NamedTuple):
    """Where a contender runs, or why it does not."""

    peer: Peer
    python: Path | None
    reason: str = ""


def cache_folder() -> Path:
    """Return the folder in the user's cache in which peers are kept from one bench to the next."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    made_of = PINS.read_bytes() + sys.version.encode()
    return Path(base) / "misstep" / f"peers-{hashlib.sha256(made_of).hexdigest()[:12]}"


def find_peers(
    folder: Path, wanted: tuple[Peer, ...], report: Callable[[str], object]
) -> Iterator[Found]:
    """Yield where each wanted contender runs; install those that are not in `folder` yet.

    Parameters
    ----------
    folder : Path
        An environment (``venv``), or where to make one.
    wanted : tuple of Peer
    report : callable
        Told of each that is about to be installed.

    Raises
    ------
    MisstepError
        If the folder cannot be made.
    """
    for peer in wanted:
        if not peer.requirements:
            yield Found(peer, Path(sys.executable))
            continue
        try:
            _install(folder, peer, report)
        except _InstallError as failure:
            reason = f"{peer.name} could not be installed: {failure}"
            if peer is SCIKIT_LEARN:
                where = "measured where misstep is installed instead"
                yield Found(peer, Path(sys.executable), f"{reason}; {where}")
            else:
                yield Found(peer, None, f"{reason}; left out")
        else:
            yield Found(peer, _python(folder))


class _InstallError(Exception):
    """What pip or another program said when it failed."""


def _python(folder: Path) -> Path:
    return folder / ("Scripts" if os.name == "nt" else "bin") / "python"


def _install(folder: Path, peer: Peer, report: Callable[[str], object]) -> None:
    done = folder / f"{peer.module}.installed"
    if done.exists():
        return
    report(f"installing {peer.name}")
    if not _python(folder).exists():
        make_folder(folder.parent)
        _call(sys.executable, "-m", "venv", str(folder))
    quiet = ("--quiet", "--disable-pip-version-check", "--retries", "1", "--timeout", "20")
    pip = (str(_python(folder)), "-m", "pip", "install", *quiet, "-c", str(PINS))
    _call(*pip, *peer.requirements)
    if peer is PYPR:
        _convert(folder)
    write_text(done, "")


def _convert(folder: Path) -> None:
    """Convert PyPR's mixtures to Python 3 where they are installed; the rest stays as it is."""
    python = str(_python(folder))
    where = "import sysconfig; print(sysconfig.get_path('purelib'))"
    package = Path(_call(python, "-c", where).strip()) / "pypr"
    parts = [package / "clustering", package / "preprocessing"]
    _call(python, "-m", "fissix", "-w", "-n", "--no-diffs", *map(str, parts))
    for path in (file for part in parts for file in part.glob("*.py")):
        write_text(path, modernise(path.read_text(encoding="utf-8")))


def modernise(text: str) -> str:
    """Return a source of PyPR, in Python 3 already, as today's NumPy understands it."""
    for old, new in _DROPPED:
        text = re.sub(old, new, text)
    return text


def _call(*words: str) -> str:
    """Run a program and return what it prints.

    Raises
    ------
    _InstallError
        If it fails: with the first error that it tells, or else its last line.
    """
    try:
        done = subprocess.run(  # noqa: S603 - our own words
            words, capture_output=True, text=True, check=False
        )
    except OSError as error:
        raise MisstepError(f"cannot run {words[0]}: {error.strerror}") from error
    if done.returncode:
        lines = [line.strip() for line in (done.stdout + done.stderr).splitlines() if line.strip()]
        errors = [line.removeprefix("ERROR: ") for line in lines if line.startswith("ERROR: ")]
        raise _InstallError([*errors, *lines[-1:], f"{words[0]} ended with {done.returncode}"][0])
    return done.stdout
