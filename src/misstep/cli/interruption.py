"""What to do after a Ctrl-C."""

import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def resumable(folder: Path, configuration: str) -> Iterator[None]:
    """Say how to go on when the block is interrupted, once there is something to go on with.

    Parameters
    ----------
    folder : Path
        What `misstep resume` would take.
    configuration : str
        Name of the file in `folder` without which it could not.
    """
    try:
        yield
    except KeyboardInterrupt as interrupt:
        if (folder / configuration).exists():
            resuming = f"`misstep resume {shlex.quote(str(folder))}` goes on"
            raise KeyboardInterrupt(resuming) from interrupt
        raise
