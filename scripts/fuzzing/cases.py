"""One case: its generator, what was handed in, and what became of it."""

import traceback
import warnings
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator

from misstep.errors import MisstepError

LONGEST_LINE = 4000
"""Characters of an error message; more is nothing to read."""


@dataclass
class Case:
    """One hostile input on its way.

    Parameters
    ----------
    rng : Generator
        From which everything about the case is drawn.
    given : dict of str to bytes or str
        What was handed in, by name; the attempt fills it in, for whoever wants to keep it.
    """

    rng: Generator
    given: dict[str, bytes | str] = field(default_factory=dict)


Attempt = Callable[[Case], bool]
"""Draws a hostile input and hands it in; returns whether it was taken, rather than refused."""


class Target(NamedTuple):
    """One place where input of others comes in.

    Attributes
    ----------
    name : str
    cases : int
        In a full campaign.
    open : callable
        ``open(folder) -> attempt``: makes what the attempts need, in an empty folder.
    """

    name: str
    cases: int
    open: Callable[[Path], Attempt]


class Verdict(NamedTuple):
    """What became of a case.

    Attributes
    ----------
    kind : str
        ``"taken"``, ``"refused"`` or ``"finding"``.
    message : str
        Of the refusal, or what was found.
    """

    kind: str
    message: str


def case_of(target: Target, seed: int, index: int) -> Case:
    """Return a case; the same for the same target, seed and index."""
    return Case(np.random.default_rng([seed, zlib.crc32(target.name.encode()), index]))


def tried(attempt: Attempt, case: Case) -> Verdict:
    """Try a case, and judge what comes of it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return Verdict("taken" if attempt(case) else "refused", "")
    except MisstepError as error:
        return _of_refusal(str(error))
    except Exception as error:
        return Verdict("finding", _told(error))


def _of_refusal(message: str) -> Verdict:
    if not message or len(message.splitlines()) != 1:
        return Verdict("finding", f"a refusal of other than one line: {message[:500]!r}")
    if not message.isprintable():
        return Verdict("finding", f"a refusal that no terminal should show: {message[:500]!r}")
    if len(message) > LONGEST_LINE:
        return Verdict("finding", f"a refusal of {len(message)} characters: {message[:500]!r}")
    return Verdict("refused", message)


def _told(error: Exception) -> str:
    """Return an error in one line, with where it came from, innermost first."""
    places = [
        f"{Path(frame.filename).name}:{frame.lineno}"
        for frame in reversed(traceback.extract_tb(error.__traceback__))
    ]
    reason = " ".join(str(error).split())[:300]
    return f"{type(error).__name__}: {reason} (at {' < '.join(places[:8])})"


def kept(case: Case, folder: Path) -> list[Path]:
    """Write what was handed in to a folder; return the files."""
    files = []
    for name, content in case.given.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        data: Any = content
        path.write_bytes(data if isinstance(data, bytes) else data.encode("utf-8", "replace"))
        files.append(path)
    return files
