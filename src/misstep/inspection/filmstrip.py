"""Six pictures of an attempt around its point of no return, side by side."""

import io

import numpy as np
from matplotlib import colors
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from misstep.blame import Blame
from misstep.inspection.figures import BLAME_COLOURS
from misstep.plots import MODEL
from misstep.trajectory import Trajectory

PICTURES = 6
WIDTH, HEIGHT = 480, 270
# Below each picture a bar in the colour of the blame.
_BAR, _SPACE = 10, 8
# The strip begins this long before the point of no return, as a share of what came before it, but
# at most so many times what came after it.
_BEFORE, _TIMES_AFTER = 1.0, 4.0


def draw_filmstrip(trajectory: Trajectory, blame: Blame) -> bytes:
    """Return a PNG of an attempt: four pictures up to the point of no return, and two after it.

    Raises
    ------
    MisstepError
        If there is no drawing of the system, or a column that it needs is missing.
    """
    from misstep.systems.rendering import Painter

    source = trajectory.provenance
    width = PICTURES * (WIDTH + _SPACE) - _SPACE
    strip = Image.new("RGB", (width, HEIGHT + _BAR), "white")
    pen = ImageDraw.Draw(strip)
    steps = shown_steps(trajectory, blame)
    with Painter(source.system, source.parameters, width=WIDTH, height=HEIGHT) as painter:
        for place, step in enumerate(steps):
            picture = painter.paint_step(trajectory, int(step))
            left = place * (WIDTH + _SPACE)
            strip.paste(Image.fromarray(picture), (left, 0))
            acted = min(step, trajectory.n_steps - 1)
            colour = colors.to_hex(BLAME_COLOURS(float(blame.blame[acted])))
            pen.rectangle((left, HEIGHT, left + WIDTH - 1, HEIGHT + _BAR - 1), fill=colour)
            if step == _lost(trajectory, blame):
                pen.rectangle((left, 0, left + WIDTH - 1, HEIGHT - 1), outline=MODEL, width=4)
    buffer = io.BytesIO()
    strip.save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()


def shown_steps(trajectory: Trajectory, blame: Blame) -> NDArray[np.intp]:
    """Return the observations that are shown, in order; all along where nothing was lost."""
    lost, last = _lost(trajectory, blame), trajectory.n_steps
    if lost is None:
        return np.linspace(0, last, PICTURES).round().astype(np.intp)
    end = last if trajectory.failure_step is None else trajectory.failure_step
    first = max(0, round(lost - min(_BEFORE * lost, _TIMES_AFTER * (end - lost))))
    before = np.linspace(first, lost, PICTURES - 2)
    after = np.linspace(lost, end, 3)[1:]
    return np.concatenate([before, after]).round().astype(np.intp)


def _lost(trajectory: Trajectory, blame: Blame) -> int | None:
    if blame.point_of_no_return is None:
        return None
    return round(blame.point_of_no_return / trajectory.dt)
