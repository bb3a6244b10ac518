"""What pip installs: everything that runs, and nothing but what is in the wheel."""

import hashlib
import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

from misstep import __version__

ROOT = Path(__file__).parents[1]


def run(*command, **options):
    """Run a command that has to succeed, and return what it printed."""
    done = subprocess.run(command, capture_output=True, text=True, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def built(kind, source, folder):
    """Build a ``"wheel"`` or ``"sdist"`` offline and return its path."""
    run(sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", folder, cwd=source)
    (path,) = Path(folder).glob("*.whl" if kind == "wheel" else "*.tar.gz")
    return path


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    return built("wheel", ROOT, tmp_path_factory.mktemp("wheel"))


def contents(wheel):
    """Return the digest of every file in a wheel by its name."""
    with zipfile.ZipFile(wheel) as archive:
        return {name: hashlib.sha256(archive.read(name)).digest() for name in archive.namelist()}


def test_the_wheel_holds_every_file_of_the_package(wheel):
    package = ROOT / "src" / "misstep"
    files = {
        path.relative_to(ROOT / "src").as_posix()
        for path in package.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert {Path(name).suffix for name in files} > {".py", ".xml", ".html", ".css", ".js", ".srv"}
    in_wheel = {name for name in contents(wheel) if not name.partition("/")[0].endswith("-info")}
    assert in_wheel == files


def test_the_source_distribution_builds_the_same_wheel(wheel, tmp_path):
    archive = built("sdist", ROOT, tmp_path)
    with tarfile.open(archive) as source:
        source.extractall(tmp_path, filter="data")
    again = built("wheel", archive.with_name(archive.name.removesuffix(".tar.gz")), tmp_path / "w")
    assert again.name == wheel.name
    assert contents(again) == contents(wheel)


@pytest.fixture(scope="module")
def environment(wheel, tmp_path_factory):
    """Install the wheel alone into a new environment and return the folder of its programs.

    What it depends on is found, but not installed, where it is for these tests.
    """
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, symlinks=True)
    python = folder / "bin" / "python"
    site = sysconfig.get_path("purelib", vars={"base": folder, "platbase": folder})
    (Path(site) / "dependencies.pth").write_text(sysconfig.get_path("purelib"), encoding="utf-8")
    pip = sys.executable, "-m", "pip", "--python", python
    run(*pip, "install", "--no-index", "--no-deps", "--ignore-installed", wheel)
    return folder / "bin"


def test_it_runs_outside_of_its_source(environment, tmp_path):
    """The README's example, first of all."""
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    outside = {"cwd": tmp_path, "env": clean}
    where = "import misstep; print(misstep.__file__)"
    assert str(environment.parent) in run(environment / "python", "-c", where, **outside)
    assert run(environment / "misstep", "--version", **outside).strip() == f"misstep {__version__}"
    listed = run(environment / "misstep", "list", "systems", **outside)
    assert "cartpole: " in listed
    assert "flipup: " in listed
    (example,) = re.findall(
        r"```python\n(import misstep.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.S
    )
    printed = run(environment / "python", "-W", "error", "-c", example, **outside)
    assert "1 trials, success: True" in printed
