"""How misstep draws mixtures, donuts and costs; one look for every picture.

Only the outermost rooms import this module: nothing inside needs matplotlib.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from numpy.typing import NDArray

from misstep.mixture import DonutMixture, GaussianMixture

Array = NDArray[np.float64]

INK = "#2b3442"
FAINT = "#9aa5b1"
DATA = "#8fa3bf"
MODEL = "#d1495b"
EXPLORATION = "#2a9d4e"
"""The latest exploration is green, as in the paper."""
PAPER = "#e09f3e"
BAR_STEP = 0.27
"""Between the bars of one trajectory in `plot_costs`, one a horizon; the middle one is at 0."""
SERIES = ("#33658a", "#d1495b", "#7b4b94", "#e09f3e", "#2a9d4e")

_STYLE: Any = {
    "figure.dpi": 100,
    "savefig.dpi": 130,
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.grid": True,
    "grid.color": "#e6eaee",
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "figure.constrained_layout.use": True,
    "svg.hashsalt": "misstep",
    "pdf.fonttype": 42,
}


@contextmanager
def style() -> Iterator[None]:
    """Draw in misstep's look inside the block."""
    with mpl.rc_context(_STYLE):
        yield


def new_figure(width: float = 5.2, height: float = 3.4, **subplots: Any) -> tuple[Figure, Any]:
    """Return a figure of a size in inches and its axes, not tied to any window."""
    figure = Figure(figsize=(width, height))
    return figure, figure.subplots(**subplots)


def scaled_mixture(mixture: GaussianMixture, scale: Sequence[float]) -> GaussianMixture:
    """Return the mixture of the columns multiplied by `scale`: degrees instead of radians."""
    s = np.array(scale)
    return GaussianMixture.from_parameters(
        mixture.weights_, mixture.means_ * s, mixture.covariances_ * np.outer(s, s)
    )


def plot_mixture(
    axes: Axes,
    mixture: GaussianMixture,
    samples: Array,
    exploration: Array | None = None,
    columns: tuple[int, int] = (0, 1),
) -> None:
    """Draw data, 3-σ ellipses, and over them the current exploration in green.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
    mixture : GaussianMixture
        Fitted on the columns of `samples`.
    samples : ndarray, shape (N, d)
    exploration : ndarray, shape (T, d), optional
    columns : tuple of int
        The two columns to show.
    """
    i, j = columns
    axes.plot(samples[:, i], samples[:, j], ".", ms=2, color=DATA, alpha=0.5, rasterized=True)
    if exploration is not None:
        axes.plot(
            exploration[:, i],
            exploration[:, j],
            ".",
            ms=3,
            color=EXPLORATION,
            rasterized=True,
            label="exploration",
        )
    for ellipse in mixture.to_ellipse(3.0, columns):
        for width, colour in ((2.6, "white"), (1.4, MODEL)):
            axes.add_patch(
                Ellipse(
                    ellipse.centre,
                    ellipse.width,
                    ellipse.height,
                    angle=ellipse.angle,
                    fill=False,
                    lw=width,
                    color=colour,
                )
            )
    axes.plot(mixture.means_[:, i], mixture.means_[:, j], "+", ms=7, mew=1.6, color=MODEL)


def plot_donut(axes: Axes, donut: DonutMixture, grid: Array) -> None:
    """Draw a donut mixture over a scalar action, and the Gaussian mixture that it came from."""
    plain = DonutMixture(donut.conditional, exploration=0.0)
    axes.fill_between(grid, plain.pdf(grid[:, None]), color=DATA, alpha=0.35, lw=0, label="GMM")
    axes.plot(grid, donut.pdf(grid[:, None]), color=MODEL, lw=1.8, label="DMM")
    axes.axvline(donut.mode()[0], color=EXPLORATION, lw=1.2, ls="--", label="best mode")
    axes.set_ylim(bottom=0)
    axes.legend()


def plot_costs(axes: Axes, costs: Array, horizons: Sequence[float], colour: str = INK) -> None:
    """Draw one bar a trajectory; the horizons (30 s, 15 s, 7.5 s) are nested bars."""
    numbers = np.arange(1, len(costs) + 1)
    shades = (0.25, 0.55, 1.0)
    for column, (horizon, shade) in enumerate(zip(horizons, shades, strict=True)):
        axes.bar(
            numbers + (column - 1) * BAR_STEP,
            costs[:, column],
            width=0.26,
            color=colour,
            alpha=shade,
            label=f"{horizon:g} s",
        )
    axes.set_xticks(numbers)
    axes.grid(axis="x", visible=False)
    axes.set_ylabel("cost [deg]")
