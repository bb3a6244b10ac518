"""The examples run as scripts, and the README shows the same code as the first."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
QUICKSTART = ROOT / "examples" / "quickstart.py"

# What each prints when it has done what it says.
PRINTED = {
    "quickstart": r"1 trials, success: True\nthe last policy balances from \d+% of starts, .*\n",
    "idea": r"\d components, chosen by minimum BIC\n(.* N\n){3}picture in idea.png\n",
    "own_system": r"\[.*\]\n(failure after .*\n){4}\d+ trials, success: True\n\d+ of 10 .*\n",
}


def test_there_is_an_expectation_of_each_example():
    assert {path.stem for path in (ROOT / "examples").glob("*.py")} == set(PRINTED)


@pytest.mark.parametrize("name", PRINTED)
def test_example_runs(name, tmp_path, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "Agg")
    done = subprocess.run(
        [sys.executable, "-W", "error", str(ROOT / "examples" / f"{name}.py")],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(PRINTED[name], done.stdout), done.stdout
    for picture in re.findall(r"picture in (\S+)", done.stdout):
        assert (tmp_path / picture).stat().st_size > 10_000


def test_readme_shows_the_quickstart():
    code = QUICKSTART.read_text(encoding="utf-8").split('"""', 2)[2].strip()
    assert code in (ROOT / "README.md").read_text(encoding="utf-8")


def test_readme_names_files_that_exist():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    named = re.findall(r"`((?:src|studies|examples|docs)/[\w/.]+)`", text)
    named += re.findall(r"\]\(([\w/.]+)\)", text)
    assert len(named) >= 5
    for name in named:
        assert (ROOT / name).exists(), name
