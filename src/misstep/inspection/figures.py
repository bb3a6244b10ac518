"""Pictures of an inspected attempt: its signals over time, and the blame under them."""

import io
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from misstep.blame import Blame
from misstep.plots import DATA, FAINT, INK, MODEL, PAPER, SERIES, style
from misstep.trajectory import Column, Trajectory
from misstep.units import TURNS

Array = NDArray[np.float64]

BLAME_COLOURS = LinearSegmentedColormap.from_list("blame", ["#ffffff", "#f7e3b0", "#d1495b"])
_WIDTH = 9.6
# More columns of one unit than this are drawn without a legend of names.
_MOST_NAMED = 8


def draw_blame(trajectory: Trajectory, blame: Blame) -> bytes:
    """Return a PNG of the signals of an attempt, one panel a unit, and of its blame."""
    panels = _panels(trajectory.observation_columns, trajectory.observations)
    panels += _panels(trajectory.action_columns, trajectory.actions)
    times = np.arange(trajectory.n_steps + 1, dtype=np.float64) * trajectory.dt
    heights = [1.0] * len(panels) + [1.5]
    with style():
        figure = Figure(figsize=(_WIDTH, 0.95 * sum(heights) + 0.5))
        axes = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights, squeeze=False)
        for ax, (columns, values) in zip(axes[:, 0], panels, strict=False):
            _draw_signals(ax, times, columns, values)
            _shade(ax, times, blame.blame)
            _mark(ax, trajectory, blame)
        _draw_curves(axes[-1, 0], times, trajectory, blame)
        axes[-1, 0].set_xlim(0.0, times[-1])
        axes[-1, 0].set_xlabel("time [s]")
        figure.align_ylabels()
        return _png(figure)


def _panels(columns: Sequence[Column], values: Array) -> list[tuple[list[Column], Array]]:
    """Return the columns of each unit together."""
    units = list(dict.fromkeys(column.unit for column in columns))
    chosen = [[i for i, column in enumerate(columns) if column.unit == unit] for unit in units]
    return [([columns[i] for i in indices], values[:, indices]) for indices in chosen]


def _draw_signals(ax: Axes, times: Array, columns: Sequence[Column], values: Array) -> None:
    named = len(columns) <= _MOST_NAMED
    for i, column in enumerate(columns):
        colour = SERIES[i % len(SERIES)] if len(columns) > 1 else INK
        label = column.name if named and len(columns) > 1 else None
        if len(values) < len(times):  # an action is held until the next
            ax.step(
                times,
                np.append(values[:, i], values[-1, i]),
                where="post",
                color=colour,
                lw=1.3,
                label=label,
            )
        else:
            shown = _without_jumps(values[:, i], column)
            ax.plot(times, shown, color=colour, lw=1.3, label=label)
    name = columns[0].name if len(columns) == 1 else f"{len(columns)} columns"
    ax.set_ylabel(f"{name}\n[{columns[0].unit}]" if columns[0].unit else name)
    if named and len(columns) > 1:
        ax.legend(loc="upper left", ncols=len(columns))


def _without_jumps(values: Array, column: Column) -> Array:
    """Return values (T,) with NaN where an angle goes on at the other end of its turn."""
    turn = TURNS.get(column.unit)
    if turn is None:
        return values
    shown = values.copy()
    shown[1:][np.abs(np.diff(values)) > 0.5 * turn] = np.nan
    return shown


def _shade(ax: Axes, times: Array, blame: Array) -> None:
    ax.pcolormesh(
        times,
        [0.0, 1.0],
        blame[None, :],
        cmap=BLAME_COLOURS,
        vmin=0.0,
        vmax=1.0,
        alpha=0.55,
        transform=ax.get_xaxis_transform(),
        zorder=-1,
        rasterized=True,
        linewidth=0,
    )
    ax.grid(visible=False)


def _mark(ax: Axes, trajectory: Trajectory, blame: Blame) -> None:
    if blame.point_of_no_return is not None:
        ax.axvline(blame.point_of_no_return, color=MODEL, lw=1.5)
    if trajectory.failure_time is not None:
        ax.axvline(trajectory.failure_time, color=INK, lw=1.2, ls=":")


def _draw_curves(ax: Axes, times: Array, trajectory: Trajectory, blame: Blame) -> None:
    steps = times[:-1]
    ax.fill_between(steps, blame.blame, color=DATA, alpha=0.3, lw=0, label="blame", step="post")
    if blame.danger is not None:
        ax.plot(times, blame.danger, color=MODEL, lw=1.6, label="danger")
    ax.plot(steps, blame.departure, color=PAPER, lw=1.1, label="departure")
    ax.plot(steps, blame.disagreement, color=FAINT, lw=1.1, ls="--", label="disagreement")
    ax.set_ylim(0.0, 1.05)
    ax.set_ylabel("blame")
    _mark(ax, trajectory, blame)
    if blame.point_of_no_return is not None:
        late = blame.point_of_no_return > 0.6 * times[-1]
        ax.annotate(
            "point of no return",
            (blame.point_of_no_return, 1.05),
            xytext=(-4 if late else 4, 11),
            textcoords="offset points",
            ha="right" if late else "left",
            va="top",
            fontsize=8,
            color=MODEL,
        )
    ax.legend(loc="lower left", bbox_to_anchor=(-0.01, 0.98), ncols=4, borderpad=0.0)


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
