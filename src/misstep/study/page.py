"""The page of a study: one self-contained HTML file."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

from misstep.pages import data_url, render_page
from misstep.study.cells import VIDEO_SECONDS, Video
from misstep.study.figures import Pictures
from misstep.study.spec import Choice, Study, settings
from misstep.study.table import ROBUST, Measured, Summary
from misstep.version import __version__

MAX_ERRORS = 50

# From no success over half of the runs to all of them; the reports' red, amber and green.
_SCALE = ((0.0, (251, 224, 226)), (0.5, (253, 240, 213)), (1.0, (200, 234, 211)))


class Film(NamedTuple):
    """A video, or the reason why there is none."""

    video: Video
    reason: str


def render(
    study: Study,
    measured: Sequence[Measured],
    rows: Sequence[Summary],
    pictures: Mapping[str, Pictures],
    films: Sequence[Film],
) -> str:
    """Return the page.

    Parameters
    ----------
    study : Study
    measured : sequence of Measured
    rows : sequence of Summary
    pictures : mapping
        By group of cases.
    films : sequence of Film
    """
    failed = [entry for entry in measured if entry.result.error]
    groups: dict[str, list[Summary]] = {}
    for row in rows:
        groups.setdefault(row.group, []).append(row)
    return render_page(
        "study/report.html.j2",
        study=study,
        version=__version__,
        cells=len(measured),
        seconds=sum(entry.result.seconds_of_interaction for entry in measured),
        computing=sum(entry.result.timing.wall_seconds for entry in measured),
        succeeded=sum(entry.result.trials_to_success is not None for entry in measured),
        groups=[_Group(name, study, entries, pictures[name]) for name, entries in groups.items()],
        films=[
            {
                "cell": film.video.cell,
                "url": "" if film.reason else data_url(film.video.path),
                "reason": film.reason,
            }
            for film in films
        ],
        video_seconds=VIDEO_SECONDS,
        robust=ROBUST,
        failed=failed[:MAX_ERRORS],
        failures=len(failed),
        colour=rate_colour,
        settings=settings,
    )


class _Group:
    """One case of the file, with its variants, as the template wants it."""

    def __init__(
        self, name: str, study: Study, rows: Sequence[Summary], pictures: Pictures
    ) -> None:
        self.name = name
        self.cases = [case for case in study.cases if case.group == name]
        self.rows = rows
        self.demonstrators = list(dict.fromkeys(row.demonstrator for row in rows))
        self.lines = list(dict.fromkeys(row.row for row in rows))
        self.at = {(row.row, row.demonstrator): row for row in rows}
        self.curves, self.histogram = data_url(pictures.curves), data_url(pictures.histogram)
        self.varied = any(case.variant for case in self.cases)

    @property
    def common(self) -> str:
        """The parameters that all variants share."""
        first = self.cases[0].parameters
        shared = {
            name: value
            for name, value in first.items()
            if all(case.parameters.get(name) == value for case in self.cases)
        }
        return settings(shared)

    @property
    def choices(self) -> tuple[Choice, ...]:
        """The learners."""
        return self.cases[0].learners


def rate_colour(rate: float) -> str:
    """Return the background of a success rate, as CSS."""
    for (low, left), (high, right) in pairwise(_SCALE):
        if rate <= high:
            share = (rate - low) / (high - low)
            mixed = (round(a + share * (b - a)) for a, b in zip(left, right, strict=True))
            return f"rgb({', '.join(map(str, mixed))})"
    raise ValueError(f"rate is {rate}: it must be from 0 to 1")
