"""Run notebooks from the top and keep what they show.

After a change of a notebook: ``python scripts/notebooks.py examples/*.ipynb``. With ``--out`` the
outputs go to another folder, where `tests/test_examples.py` compares them with what was kept.
"""

import argparse
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import nbformat
from nbclient import NotebookClient
from traitlets.config import Config


def executed(path: Path) -> nbformat.NotebookNode:
    """Return a notebook with fresh outputs of all its cells."""
    notebook = nbformat.read(path, as_version=4)
    with TemporaryDirectory() as sockets:  # of the file system: nobody else can use them
        client = NotebookClient(
            notebook,
            config=Config(KernelManager={"transport": "ipc", "ip": str(Path(sockets) / "kernel")}),
            resources={"metadata": {"path": str(path.parent)}},
            timeout=300,  # s a cell
            record_timing=False,
            coalesce_streams=True,
        )
        return client.execute()


def main() -> int:
    """Run what the command line names; return the exit code."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("notebooks", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, help="folder for them; default: where they are")
    options = parser.parse_args()
    for path in options.notebooks:
        nbformat.write(executed(path), (options.out or path.parent) / path.name)
    return 0


if __name__ == "__main__":
    sys.exit(main())
