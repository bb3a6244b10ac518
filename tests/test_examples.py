"""The examples run, and the README shows the same code."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
QUICKSTART = ROOT / "examples" / "quickstart.py"


def test_quickstart_runs():
    done = subprocess.run(
        [sys.executable, "-W", "error", str(QUICKSTART)], capture_output=True, text=True, check=True
    )
    assert re.search(r"\d+ trials, success: (True|False)\n", done.stdout)
    assert re.search(r"balances from \d+% of starts, \d+% to \d+%\n", done.stdout)


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
