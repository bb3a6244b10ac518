"""Files that are counted, in a folder from which a person may take some away."""

import re
from pathlib import Path

_NUMBER = re.compile(r"\d{1,9}", re.ASCII)


def next_number(folder: Path, pattern: str) -> int:
    """Return the number after the largest in the names of files; 0 where there is no file.

    Parameters
    ----------
    folder : Path
        There may be none.
    pattern : str
        Of the names, such as ``"trial_*.h5"``; the first number in each is its own.
    """
    found = [_NUMBER.search(path.name) for path in folder.glob(pattern)]
    return 1 + max((int(number[0]) for number in found if number), default=-1)
