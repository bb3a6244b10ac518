"""Make docstrings Markdown: a griffe extension for the API reference.

Docstrings here are numpydoc, whose tables are those of reStructuredText.
"""

import inspect
import re
from importlib import import_module
from typing import Any

import griffe

_RULE = re.compile(r"^ *=+(?: +=+)+ *$")


class Docstrings(griffe.Extension):
    """Turns tables between ``====`` lines into those of Markdown, and ``::`` into ``:``."""

    def on_object(self, *, obj: Any, **_: Any) -> None:
        """Change the docstring of one object."""
        if obj.docstring is None:
            return
        if "<parameters>" in obj.docstring.value:  # filled in when the class is made
            obj.docstring.value = inspect.getdoc(getattr(import_module(obj.module.path), obj.name))
        # A hyphen in a type would be taken for a minus.
        obj.docstring.value = markdown(obj.docstring.value.replace("array-like", "array_like"))


def markdown(docstring: str) -> str:
    """Return a docstring with its tables and literal blocks in Markdown."""
    lines, made = docstring.splitlines(), []
    while lines:
        line = lines.pop(0)
        if _RULE.match(line):
            end = next(
                i
                for i, other in enumerate(lines)
                if _RULE.match(other) and not "".join(lines[i + 1 : i + 2]).strip()
            )
            made += _table(line, lines[:end])
            del lines[: end + 1]
        else:
            made.append(re.sub(r"::$", ":", line) if line != "::" else "")
    return "\n".join(made)


def _table(rule: str, lines: list[str]) -> list[str]:
    starts = [match.start() for match in re.finditer("=+", rule)]
    ends = [*starts[1:], None]
    rows: list[list[str]] = []
    for line in lines:
        if _RULE.match(line):
            if len(rows) == 1:
                rows.append(["---"] * len(starts))
            continue
        cells = [line[start:end].strip() for start, end in zip(starts, ends, strict=True)]
        if cells[0]:
            rows.append(cells)
        else:  # a line that goes on with the row above
            rows[-1] = [f"{a} {b}".strip() for a, b in zip(rows[-1], cells, strict=True)]
    indent = " " * starts[0]
    return ["", *(f"{indent}| {' | '.join(row)} |" for row in rows), ""]
