"""What made an output: the version of the package and the command that was typed."""

import os
import sys
from importlib.metadata import version
from pathlib import Path

__version__ = version("misstep")


def command_line() -> tuple[str, ...]:
    """Return the command of this process, without the place where it is installed."""
    program, *arguments = sys.argv or [""]
    path = Path(program)
    name = path.parent.name if path.name == "__main__.py" else path.name  # python -m misstep
    # Names of files need not be texts, and what is written down has to be.
    return tuple(os.fsencode(word).decode(errors="replace") for word in (name, *arguments))
