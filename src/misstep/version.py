"""What made an output: the version of the package and the command that was typed."""

import sys
from importlib.metadata import version
from pathlib import Path

__version__ = version("misstep")


def command_line() -> tuple[str, ...]:
    """Return the command of this process, without the place where it is installed."""
    program, *arguments = sys.argv or [""]
    return (Path(program).name, *arguments)
