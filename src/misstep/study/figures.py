"""Pictures of a study: how fast runs succeed, and in which trial."""

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from misstep.plots import FAINT, INK, SERIES, style
from misstep.storage import atomic_write, make_folder
from misstep.study.table import Measured

_WIDTH = 9.6
_COLUMNS = 3
_DASHES = ("-", "--", ":")


class Pictures(NamedTuple):
    """The pictures of one group of cases."""

    curves: Path
    histogram: Path


def draw_all(folder: Path, measured: Sequence[Measured]) -> dict[str, Pictures]:
    """Draw and return the pictures by group of cases."""
    make_folder(folder)
    groups: dict[str, list[Measured]] = {}
    for entry in measured:
        groups.setdefault(entry.cell.case.group, []).append(entry)
    pictures = {}
    for number, (group, entries) in enumerate(groups.items(), start=1):
        pictures[group] = Pictures(
            folder / f"curves_{number}.png", folder / f"histogram_{number}.png"
        )
        with style():
            _save(_draw_curves(entries), pictures[group].curves)
            _save(_draw_histogram(entries), pictures[group].histogram)
    return pictures


def learning_curve(needed: Sequence[int | None], most: int) -> NDArray[np.float64]:
    """Return the share of runs that have succeeded after 0 .. `most` trials, shape (most + 1,).

    Parameters
    ----------
    needed : sequence of int or None
        Trials to success of each run.
    most : int
    """
    trials = np.array([np.inf if k is None else k for k in needed])
    return np.array([np.mean(trials <= n) for n in range(most + 1)])


def _row(entry: Measured) -> str:
    case, learner = entry.cell.case, entry.cell.learner.label
    return f"{learner}, {case.variant}" if case.variant else learner


def _needed(entries: Sequence[Measured]) -> list[int | None]:
    return [e.result.trials_to_success for e in entries if e.result.status != "lost"]


def _draw_curves(entries: Sequence[Measured]) -> Figure:
    """One panel a demonstrator, one line a learner or variant."""
    panels = list(dict.fromkeys(e.cell.demonstrator.label for e in entries))
    lines = list(dict.fromkeys(map(_row, entries)))
    looks = dict(zip(lines, _looks(len(lines)), strict=True))
    columns = min(_COLUMNS, len(panels))
    rows = -(-len(panels) // columns)
    legend_rows = -(-len(lines) // _COLUMNS)
    figure = Figure(figsize=(_WIDTH, 2.4 * rows + 0.2 * legend_rows))
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for ax in axes.flat[len(panels) :]:
        ax.set_visible(False)
    for ax, panel in zip(axes.flat, panels, strict=False):
        for line in lines:
            chosen = [e for e in entries if e.cell.demonstrator.label == panel and _row(e) == line]
            needed, most = _needed(chosen), max((e.cell.case.max_trials for e in chosen), default=0)
            if needed:
                colour, dash = looks[line]
                curve = 100 * learning_curve(needed, most)
                ax.step(range(most + 1), curve, where="post", color=colour, ls=dash, lw=1.6)
        ax.set_title(panel)
        ax.set_ylim(-3, 103)
        ax.set_xlim(0, None)
        ax.xaxis.set_major_locator(MaxNLocator(5, integer=True, steps=(1, 2, 5, 10)))
        ax.tick_params(labelbottom=True)
        ax.set_xlabel("trials")
    figure.supylabel("runs that have succeeded [%]", fontsize=9, color=INK)
    handles = [axes.flat[0].plot([], [], color=c, ls=d, lw=1.6)[0] for c, d in looks.values()]
    figure.legend(handles, lines, loc="outside lower center", ncols=min(_COLUMNS, len(lines)))
    return figure


def _draw_histogram(entries: Sequence[Measured]) -> Figure:
    """One row of bars a learner or variant, over all demonstrators."""
    lines = list(dict.fromkeys(map(_row, entries)))
    most = max(e.cell.case.max_trials for e in entries)
    figure = Figure(figsize=(_WIDTH, 0.5 * len(lines) + 0.8))
    axes = figure.subplots(len(lines), 1, squeeze=False, sharex=True)[:, 0]
    for ax, line in zip(axes, lines, strict=True):
        needed = _needed([e for e in entries if _row(e) == line])
        counts = [sum(k == n for k in needed) for n in range(1, most + 1)]
        failed = sum(k is None for k in needed)
        shares = 100 * np.array([*counts, failed]) / max(1, len(needed))
        colours = [SERIES[4]] * most + [SERIES[1]]
        ax.bar([*range(1, most + 1), most + 2], shares, color=colours, width=0.8)
        ax.set_ylim(0, 100)
        ax.set_yticks([])
        ax.grid(False)
        ax.spines["left"].set_visible(False)
        ax.set_ylabel(line, rotation=0, ha="right", va="center", fontsize=8)
        for x, share in zip([*range(1, most + 1), most + 2], shares, strict=True):
            if share >= 0.5:
                inside = share > 70
                ax.annotate(
                    f"{share:.0f}",
                    (x, share),
                    xytext=(0, -1 if inside else 1),
                    textcoords="offset points",
                    ha="center",
                    va="top" if inside else "bottom",
                    fontsize=7,
                    color="white" if inside else FAINT,
                )
    ticks = sorted({1, *range(5, most + 1, 5), most})
    axes[-1].set_xticks([*ticks, most + 2], [*map(str, ticks), "none"])
    axes[-1].set_xlabel("trial of the first success, % of runs")
    return figure


def _looks(n: int) -> list[tuple[str, str]]:
    """Return a colour and a dash pattern for each of n lines, distinct for up to 15."""
    looks = [(colour, dash) for dash, colour in product(_DASHES, SERIES)]
    return [looks[i % len(looks)] for i in range(n)]


def _save(figure: Figure, path: Path) -> None:
    atomic_write(path, lambda temporary: figure.savefig(temporary, metadata={"Software": None}))
