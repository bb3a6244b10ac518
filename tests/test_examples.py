"""The examples run and show what they are kept with; the README has the same code as the first."""

import re
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

ROOT = Path(__file__).parents[1]
QUICKSTART = ROOT / "examples" / "quickstart.py"
NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))


def test_the_quickstart_runs(tmp_path):
    done = subprocess.run(
        [sys.executable, "-W", "error", str(QUICKSTART)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    expected = r"1 trials, success: True\nthe last policy balances from \d+% of starts, .*\n"
    assert re.fullmatch(expected, done.stdout), done.stdout


def shown(notebook):
    """Return what each cell of code prints, and how many pictures it draws."""
    cells = [cell.outputs for cell in notebook.cells if cell.cell_type == "code"]
    return [
        (
            "".join(output.text for output in outputs if output.output_type == "stream"),
            sum(len(output.get("data", {}).get("image/png", "")) > 10_000 for output in outputs),
        )
        for outputs in cells
    ]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_shows_what_it_is_kept_with(path, tmp_path):
    done = subprocess.run(
        [sys.executable, "-W", "error", "scripts/notebooks.py", str(path), "--out", str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    kept, fresh = (nbformat.read(folder / path.name, 4) for folder in (path.parent, tmp_path))
    nbformat.validate(kept)
    assert shown(kept) == shown(fresh)
    text, pictures = zip(*shown(kept), strict=True)
    assert any(text)
    assert sum(pictures) == sum("plt.show()" in cell.source for cell in kept.cells)


def test_there_are_notebooks():
    assert len(NOTEBOOKS) >= 3


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
