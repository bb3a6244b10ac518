"""The page of an inspection: one self-contained HTML file."""

import base64
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from markupsafe import Markup

from misstep.errors import MisstepError
from misstep.inspection.figures import draw_blame
from misstep.inspection.filmstrip import draw_filmstrip
from misstep.inspection.inspect import Inspection, Progress
from misstep.pages import render_page
from misstep.version import __version__

MOST_PICTURES = 40
"""Attempts that get pictures; of the others there are the sentences."""


class _Attempt(NamedTuple):
    """One attempt as the template wants it."""

    number: int
    sentence: str
    outcome: str
    method: str
    found: bool
    signals: Markup
    film: Markup | None


def render_inspection(inspection: Inspection, progress: Progress = lambda done, total: None) -> str:
    """Return the page.

    Parameters
    ----------
    inspection : Inspection
    progress : callable
        ``progress(done, total)`` is called with the attempts drawn.
    """
    attempts = []
    total = min(len(inspection.blames), MOST_PICTURES)
    for index in range(total):
        progress(index, total)
        attempts.append(_attempt(inspection, index))
    progress(total, total)
    return render_page(
        "inspection/page.html.j2",
        name=Path(inspection.file).name,
        inspection=inspection,
        episodes=inspection.episodes,
        columns=inspection.columns,
        equations=inspection.equations if any(inspection.equations.lines()) else None,
        attempts=attempts,
        others=inspection.sentences[total:],
        outcomes={
            outcome: sum(e.outcome == outcome for e in inspection.episodes)
            for outcome in ("success", "failure", "unknown")
        },
        who=_distinct(e.demonstrator for e in inspection.episodes),
        systems=_distinct(e.system for e in inspection.episodes),
        times=sorted(_distinct(e.recorded for e in inspection.episodes)),
        rates=sorted({e.rate for e in inspection.episodes if e.rate is not None}),
        notes=_distinct(note for e in inspection.episodes for note in e.notes),
        version=__version__,
    )


def _attempt(inspection: Inspection, index: int) -> _Attempt:
    if inspection.dataset is None:
        raise ValueError("without a data set there are no attempts")
    trajectory, blame = inspection.dataset[index], inspection.blames[index]
    try:
        film = _picture(draw_filmstrip(trajectory, blame))
    except MisstepError:  # nobody can draw the system
        film = None
    return _Attempt(
        index + 1,
        blame.sentence,
        str(trajectory.outcome),
        blame.method,
        blame.danger is not None,
        _picture(draw_blame(trajectory, blame)),
        film,
    )


def _picture(png: bytes) -> Markup:
    content = base64.b64encode(png).decode("ascii")
    return Markup(f"data:image/png;base64,{content}")  # noqa: S704 - base64 is inert


def _distinct(texts: Iterable[str]) -> list[str]:
    """Return the texts that are not empty, each once."""
    return list(dict.fromkeys(text for text in texts if text))
