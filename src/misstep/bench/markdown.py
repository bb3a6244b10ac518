"""The tables of a bench as Markdown, for ``docs/performance.md``."""

from collections.abc import Mapping
from typing import Any

from misstep.bench.tables import Table, tables_of


def write_markdown(document: Mapping[str, Any]) -> str:
    """Return the text of the page, from a document as in ``bench.json``."""
    parts = ["# Performance", introduction(document)]
    for table in tables_of(document):
        parts += [f"## {table.title}", table.about, _table(table)]
    return "\n\n".join(parts) + "\n"


def introduction(document: Mapping[str, Any]) -> str:
    """Say when, on what, and what is missing."""
    machine = document["machine"]
    quick = " with `--quick`, which decides nothing" if document["quick"] else ""
    lines = [
        f"Measured on {document['date']} by `misstep bench`{quick}, all in one run, with misstep "
        f"{document['version']}: {machine['cores']} cores of {machine['processor']}, "
        f"{machine['memory_gib']} GiB, {machine['system']}, Python {machine['python']}, NumPy "
        f"{machine['numpy']}, Numba {machine['numba']}. A time is the least of several: whatever "
        "else the machine does can only add to it."
    ]
    lines += [f"{reason}." for reason in document["missing"].values()]
    return " ".join(lines)


def _table(table: Table) -> str:
    lines = [table.columns, tuple("---" for _ in table.columns), *table.rows]
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines
    )
