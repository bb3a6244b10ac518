"""Bring a reproduction of the paper into the documentation: its claims, its tables, three figures.

misstep reproduce --out out/full --seeds 30
python scripts/docs_paper.py out/full
"""

import shutil
import sys
from pathlib import Path

from misstep.storage import read_json, write_json

DOCS = Path(__file__).parents[1] / "docs"
FIGURES = ("distribution", "variants", "figure_02")


def main(folder: Path) -> None:
    """Write docs/assets/paper.json and docs/images/paper-*.png."""
    document = read_json(folder / "tables.json")
    kept = {name: document[name] for name in ("version", "parameters", "tables", "claims")}
    write_json(DOCS / "assets" / "paper.json", kept)
    for name in FIGURES:
        source = folder / "figures" / f"{name}.png"
        shutil.copyfile(source, DOCS / "images" / f"paper-{name.replace('_', '-')}.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
