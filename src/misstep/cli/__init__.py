"""The command line, ``misstep``: one file a group of commands.

    app.py            the commands put together, and what becomes of errors
    streams.py        what is printed through
    options.py        options that several commands share, and how their texts are read
    output.py         JSON files, and what must not be written over
    table.py          tables on stdout
    memory.py         whether what went wrong did so for want of memory
    progress.py       a progress bar on a terminal, lines elsewhere
    interruption.py   what to do after a Ctrl-C
    record.py         demonstrate
    learn.py          learn, resume
    live.py           live
    serve.py          serve, explain
    robot.py          drive, offer
    ros.py            ros1, ros2
    evaluate.py       evaluate
    inspect.py        inspect
    mark.py           mark
    convert.py        convert
    reproduce.py      reproduce
    study.py          study
    bench.py          bench
    catalogue.py      list

A command imports what it needs when it runs: ``misstep --help`` must not wait for the physics and
the compiled loops. It returns its exit code. This file itself imports next to nothing, so that a
Ctrl-C finds somebody who knows what to do from the first moment on.
"""

import sys
from collections.abc import Sequence

from misstep.cli.interruption import ending_at_once
from misstep.cli.memory import OUT_OF_MEMORY, has_room

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    arguments : sequence of str, optional
        Words after ``misstep``; those that the process was started with if left out.

    Returns
    -------
    int
        The exit code.
    """
    try:
        with ending_at_once():
            from misstep.cli.app import run
    except Exception:  # libraries that are refused memory raise anything
        if has_room():
            raise
        print("misstep:", OUT_OF_MEMORY, file=sys.stderr)
        return 2
    return run(list(sys.argv[1:] if arguments is None else arguments))
