"""Compile the bridge to Gazebo's physics: `make gazebo`, `python -m misstep.robot.gazebo.build`.

One C++ file, a compiler and pkg-config. The library goes into the Python environment, under a name
that changes with its source, so that an old one is never taken for a new one.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from importlib.resources import as_file, files
from pathlib import Path

from misstep.errors import MisstepError

PACKAGES = (
    "g++ pkg-config libignition-physics-dev libignition-physics5-dartsim-plugin5 libsdformat-dev"
)
"""Debian packages that are needed."""

_LIBRARIES = ("ignition-physics5-sdf", "ignition-plugin1-loader", "sdformat12")
_SOURCE = "world.cpp"


def library_path() -> Path:
    """Return where the compiled bridge is, or will be."""
    source = files("misstep.robot.gazebo").joinpath(_SOURCE).read_bytes()
    digest = hashlib.sha256(source).hexdigest()[:16]
    return Path(sys.prefix) / "lib" / "misstep" / f"gazebo-{digest}.so"


def build() -> Path:
    """Compile the bridge, unless it is there, and return its path.

    Raises
    ------
    MisstepError
        If a compiler, Gazebo's libraries or a place to write is missing.
    """
    path = library_path()
    if path.exists():
        return path
    compiler = shutil.which("g++")
    if compiler is None or shutil.which("pkg-config") is None:
        raise MisstepError(f"no compiler: apt-get install {PACKAGES}")
    flags = _run(["pkg-config", "--cflags", "--libs", *_LIBRARIES]).split()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise MisstepError(f"cannot write to {path.parent}: {error.strerror}") from error
    with (
        as_file(files("misstep.robot.gazebo").joinpath(_SOURCE)) as source,
        tempfile.TemporaryDirectory(dir=path.parent) as folder,
    ):
        made = Path(folder) / path.name
        options = ["-std=c++17", "-O2", "-Wall", "-shared", "-fPIC"]
        _run([compiler, *options, "-o", str(made), str(source), *flags])
        os.replace(made, path)
    return path


def _run(command: list[str]) -> str:
    done = subprocess.run(command, capture_output=True, text=True)  # noqa: S603 - our own words
    if done.returncode:
        reason = (done.stderr.strip() or "it says nothing").splitlines()[-1]
        raise MisstepError(f"{command[0]} fails: {reason}: apt-get install {PACKAGES}")
    return done.stdout


if __name__ == "__main__":
    try:
        print(build())
    except MisstepError as error:
        sys.exit(f"misstep: error: {error}")
