"""Tables on stdout: whole words and whole numbers, however narrow the terminal is.

Cells are broken at blanks alone. What still does not fit is printed as several tables below one
another, each beginning with the first column.
"""

import sys
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice

_WIDTH_OF_A_FILE = 240


def print_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table; columns whose name starts with ``>`` are set to the right."""
    from rich.console import Console

    cells = [[name.lstrip(">") for name in columns], *rows]
    console = Console(markup=False, emoji=False, highlight=False)
    width = console.width if sys.stdout.isatty() else _WIDTH_OF_A_FILE
    least = [max(map(_longest_word, column)) for column in zip(*cells, strict=True)]
    for group in _groups(least, width):
        _print([columns[i] for i in group], [[row[i] for i in group] for row in cells], width)


def _groups(least: Sequence[int], width: int) -> Iterator[list[int]]:
    """Yield which columns go together, each at least so wide: the first one and some others."""
    group = [0]
    for i in range(1, len(least)):
        together = [*group, i]
        if len(group) > 1 and _total([least[k] for k in together]) > width:
            yield group
            together = [0, i]
        group = together
    yield group


def _print(names: Sequence[str], cells: Sequence[Sequence[str]], width: int) -> None:
    from rich.box import SIMPLE
    from rich.cells import cell_len
    from rich.console import Console
    from rich.table import Table

    by_column = list(zip(*cells, strict=True))
    widths = [max(map(_longest_word, column)) for column in by_column]
    for i, column in enumerate(by_column):  # what room is left, from the left
        spare = max(0, width - _total(widths))
        widths[i] += min(spare, max(map(cell_len, column)) - widths[i])
    table = Table(box=SIMPLE, pad_edge=False)
    for name, header, wide in zip(names, cells[0], widths, strict=True):
        justify = "right" if name.startswith(">") else "left"
        table.add_column(header, justify=justify, width=wide)  # type: ignore[arg-type]
    for row in islice(cells, 1, None):
        table.add_row(*row)
    # One word alone can be wider than the terminal: then the terminal breaks the line.
    wide = max(width, _total(widths))
    Console(markup=False, emoji=False, highlight=False, width=wide).print(table)


def _longest_word(cell: str) -> int:
    from rich.cells import cell_len

    return max(map(cell_len, cell.split()), default=0)


def _total(widths: Sequence[int]) -> int:
    """Return how wide a table is: a gap of three between columns, and one at either edge."""
    return sum(widths) + 3 * len(widths) - 1
