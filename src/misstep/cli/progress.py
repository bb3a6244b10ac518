"""How far a long command has come: a bar on a terminal, a line at a time elsewhere.

Always on stderr: stdout is for the result.
"""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Report = Callable[[int, int, str], None]
"""``report(done, total, detail)``."""


@contextmanager
def progress(doing: str) -> Iterator[Report]:
    """Show progress until the block ends.

    Parameters
    ----------
    doing : str
        What is going on: ``"learning"``.

    Yields
    ------
    callable
        ``report(done, total, detail)``. Where stderr is no terminal, a report without a detail
        prints nothing.
    """
    if not sys.stderr.isatty():
        yield lambda done, total, detail: _print_line(doing, done, total, detail)
        return
    from rich import progress as bars
    from rich.console import Console

    columns = (
        bars.TextColumn("{task.description}", markup=False),
        bars.BarColumn(),
        bars.MofNCompleteColumn(),
        bars.TimeElapsedColumn(),
        bars.TextColumn("{task.fields[detail]}", markup=False),
    )
    with bars.Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(doing, total=None, detail="")
        yield lambda done, total, detail: bar.update(
            task, completed=done, total=total, detail=detail
        )


def _print_line(doing: str, done: int, total: int, detail: str) -> None:
    if detail:
        print(f"{doing} {done}/{total}: {detail}", file=sys.stderr, flush=True)
