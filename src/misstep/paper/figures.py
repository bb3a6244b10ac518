"""The paper's figures 1 to 25 from our own runs, and a few that the paper lacks.

`FIGURES` maps the name of a file to what draws it. The first seed gives the figures of single runs;
the extra ones show all seeds.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from misstep import plots
from misstep.mixture import Donut, DonutMixture, DonutShape
from misstep.paper.costs import HORIZONS
from misstep.paper.diagrams import data_exchange, pendulum
from misstep.paper.experiments import EXPLORATIONS, VARIANTS
from misstep.paper.modes import action_grid
from misstep.paper.printed import TABLE_1, TABLE_2
from misstep.paper.results import Results
from misstep.runs import Run
from misstep.storage import atomic_write
from misstep.systems.rendering import Painter
from misstep.trajectory import Trajectory

Array = NDArray[np.float64]

Draw = Callable[[Results], Figure]


def draw(name: str, folder: Path, results: Results) -> None:
    """Draw one figure into ``NAME.png`` and ``NAME.pdf``."""
    with plots.style():
        figure = FIGURES[name](results)
        for suffix in ("png", "pdf"):
            # Without a date, the same results give the same file.
            metadata = {"CreationDate": None} if suffix == "pdf" else {}
            atomic_write(
                folder / f"{name}.{suffix}",
                lambda path, m=metadata: figure.savefig(path, metadata=m),  # type: ignore[misc]
            )


def _donut_family(results: Results) -> Figure:
    figure, axes = plots.new_figure()
    grid = np.linspace(-5, 5, 601)[:, None]
    colours = mpl.colormaps["viridis"](np.linspace(0.0, 0.85, 6))
    for exploration, colour in zip(np.linspace(0, 1, 6), colours, strict=True):
        donut = Donut([0.0], [[1.0]], DonutShape.of(float(exploration), d=1))
        axes.plot(grid[:, 0], donut.pdf(grid), color=colour, lw=1.8, label=f"ε = {exploration:.1f}")
    axes.set(xlabel="action, in standard deviations", ylabel="density", ylim=(0, None))
    axes.legend()
    return figure


def _overview(results: Results) -> Figure:
    """One picture of the whole: a failure, what is learned from it, what is tried next."""
    run = results.runs["without-reward"]
    figure = Figure(figsize=(9.6, 4.6))
    grid = figure.add_gridspec(2, 12, height_ratios=(1, 1.55))
    demonstration = run.demonstrations[0]
    angle = np.abs(np.degrees(demonstration.column("theta")))
    for index, beyond in enumerate((2.0, 20.0, 60.0, 120.0)):
        axes = figure.add_subplot(grid[0, 3 * index : 3 * index + 3])
        axes.imshow(_picture(demonstration, int(np.argmax(angle > beyond)), 480, 270))
        axes.set_axis_off()
        if index == 0:
            axes.set_title("a demonstration that fails")
    titles = (
        "the mixture of four failures",
        "a donut: made-up data, 90°",
        "what is tried after ten trials",
    )
    panels = [figure.add_subplot(grid[1, 4 * i : 4 * i + 4]) for i in range(3)]
    for axes, title in zip(panels, titles, strict=True):
        axes.set_title(title)
    _draw_exploration(panels[0], run, 1)
    _draw_donut(panels[1], results.synthetic.policies[0].donut_at([90.0]))
    _draw_exploration(panels[2], run, EXPLORATIONS)
    return figure


def _picture(trajectory: Trajectory, t: int, width: int, height: int) -> NDArray[np.uint8]:
    """Return the picture of a trajectory at step `t`, shape (height, width, 3)."""
    source = trajectory.provenance
    with Painter(source.system, source.parameters, width=width, height=height) as painter:
        return painter.paint_step(trajectory, t)


def _simulation(results: Results) -> Figure:
    trajectory = results.runs["without-reward"].demonstrations[0]
    t = int(np.argmax(np.abs(trajectory.column("theta")) > np.radians(25)))
    figure, axes = plots.new_figure(6.4, 3.6)
    axes.imshow(_picture(trajectory, t, 960, 540))
    axes.set_axis_off()
    return figure


def _synthetic_donut(angle: float, results: Results) -> Figure:
    figure, axes = plots.new_figure()
    donut = results.synthetic.policies[0].donut_at([angle])
    _draw_donut(axes, donut)
    axes.set_title(f"θ = {angle:g}°, ε = {donut.exploration:.2f}")
    return figure


def _draw_donut(axes: Axes, donut: DonutMixture) -> None:
    grid = action_grid(donut.conditional)
    dense = donut.pdf(grid[:, None])
    seen = grid[dense > 1e-3 * dense.max()]
    plots.plot_donut(axes, donut, np.linspace(seen[0], seen[-1], 801))
    axes.set(xlabel="force [N]", ylabel="density")


def _synthetic_samples(results: Results, explorations: int) -> Array:
    attempts = results.synthetic.demonstrations + results.synthetic.explorations[:explorations]
    columns = [np.column_stack([t.column("theta")[:-1], t.actions[:, 0]]) for t in attempts]
    return np.concatenate(columns)


def _synthetic_data(results: Results) -> Figure:
    figure, axes = plots.new_figure()
    mixture = results.synthetic.policies[0].mixture
    plots.plot_mixture(axes, mixture, _synthetic_samples(results, 0))
    axes.set(xlabel="θ [deg]", ylabel="force [N]", xticks=range(-180, 181, 90))
    return figure


def _synthetic_exploration(number: int, results: Results) -> Figure:
    figure, axes = plots.new_figure()
    mixture = results.synthetic.policies[number - 1].mixture
    plots.plot_mixture(axes, mixture, _synthetic_samples(results, number - 1))
    # The paper: exploration 1 green, 2 blue, 3 pink.
    colours = (plots.EXPLORATION, "#1f5fd1", "#e0479e")
    shown = zip(results.synthetic.explorations[:number], colours, strict=False)
    for index, (trajectory, colour) in enumerate(shown, start=1):
        axes.plot(
            trajectory.column("theta")[:-1],
            trajectory.actions[:, 0],
            color=colour,
            lw=1.6,
            label=f"exploration {index}",
        )
    axes.set(xlabel="θ [deg]", ylabel="force [N]", xticks=range(-180, 181, 90))
    axes.legend(loc="upper center", ncols=3)
    return figure


def _exploration(variant: str, number: int, results: Results) -> Figure:
    figure, axes = plots.new_figure()
    _draw_exploration(axes, results.runs[variant], number)
    return figure


def _draw_exploration(axes: Axes, run: Run, number: int) -> None:
    """Draw the model that exploration `number` was made with, and that exploration."""
    policy = run.policies[number - 1]
    task = policy.task  # type: ignore[attr-defined]
    attempts = [*run.demonstrations, *run.trials[: number - 1]]
    # θ in degrees; whatever other column the state has is not shown.
    index = task.state.index("theta")
    scale = np.ones(len(task.state) + 1)
    scale[index] = np.degrees(1.0)
    mixture = plots.scaled_mixture(policy.mixture, list(scale))  # type: ignore[attr-defined]
    samples = np.concatenate([task.joint(t) for t in attempts]) * scale
    trial = task.joint(run.trials[number - 1]) * scale
    plots.plot_mixture(axes, mixture, samples, trial, (index, len(task.state)))
    axes.set(xlabel="θ [deg]", ylabel="force [N]", xticks=range(-180, 181, 90))
    axes.set_xlim(-230, 230)
    # An ellipse may reach far beyond all data; the data decide what is shown.
    furthest = 1.4 * max(np.abs(samples[:, -1]).max(), np.abs(trial[:, -1]).max())
    axes.set_ylim(-furthest, furthest)
    axes.legend(loc="upper left")


def _demonstration_costs(results: Results) -> Figure:
    figure, axes = plots.new_figure(6.4, 3.0)
    costs = results.demonstration_costs("without-reward")[0]
    plots.plot_costs(axes, costs, HORIZONS, plots.SERIES[0])
    _mark_paper(axes, TABLE_1)
    axes.set_xlabel("demonstration")
    axes.legend(ncols=4, loc="lower left", bbox_to_anchor=(0, 1))
    return figure


def _exploration_costs(variant: str, results: Results) -> Figure:
    figure, axes = plots.new_figure(8.2, 3.0)
    run = results.cells[variant][0]
    plots.plot_costs(axes, run.exploration_costs, HORIZONS, plots.EXPLORATION)
    if variant == "without-reward":
        _mark_paper(axes, TABLE_2)
    best = run.demonstration_costs[:, 0].min()
    axes.axhline(best, color=plots.INK, lw=1, ls=":", label="best demonstration, 30 s")
    axes.set_xlabel("exploration")
    axes.legend(ncols=5, loc="lower left", bbox_to_anchor=(0, 1))
    return figure


def _mark_paper(axes: Axes, table: Array) -> None:
    numbers = np.arange(1, len(table) + 1)
    for column in range(len(HORIZONS)):
        axes.plot(
            numbers + (column - 1) * plots.BAR_STEP,
            table[:, column],
            "_",
            ms=9,
            mew=2.2,
            color=plots.PAPER,
            label="paper" if column == 0 else None,
        )


def _distribution(results: Results) -> Figure:
    """Table II as distributions: every number over all seeds, and the paper's."""
    figure, axes = plots.new_figure(8.6, 6.4, nrows=3, sharex=True)
    costs = results.costs("without-reward")
    for column, (axis, horizon) in enumerate(zip(axes, HORIZONS, strict=True)):
        _spread(axis, costs[:, :, column], TABLE_2[:, column])
        axis.set_title(f"first {horizon:g} s")
        axis.set_ylabel("cost [deg]")
    axes[-1].set_xlabel("exploration")
    axes[0].legend(ncols=3, loc="lower right", bbox_to_anchor=(1, 1))
    return figure


def _calibration(results: Results) -> Figure:
    """Where table I's twelve numbers fall among our demonstrations."""
    names = list(results.calibrations)
    figure, axes = plots.new_figure(8.2, 1.1 + 1.5 * len(names), nrows=len(names), squeeze=False)
    for name, axis in zip(names, axes[:, 0], strict=True):
        costs = results.calibrations[name]
        for column in range(len(HORIZONS)):
            low, high = np.percentile(costs[:, column], [2.5, 97.5])
            axis.plot(
                [low, high],
                [column] * 2,
                color=plots.DATA,
                lw=9,
                solid_capstyle="round",
                alpha=0.5,
                label="ours, 95 %" if column == 0 else None,
            )
            axis.plot(
                costs[:, column],
                np.full(len(costs), column),
                "|",
                color=plots.SERIES[0],
                ms=7,
                alpha=0.6,
                label="our demonstrations" if column == 0 else None,
            )
            axis.plot(
                TABLE_1[:, column],
                np.full(4, column + 0.3),
                "v",
                color=plots.PAPER,
                ms=6,
                label="table I" if column == 0 else None,
            )
        axis.set_yticks(range(3), [f"{h:g} s" for h in HORIZONS])
        axis.set_ylim(-0.5, 2.7)
        axis.set_title(f"physics {name}")
    axes[0, 0].legend(ncols=3, loc="lower right", bbox_to_anchor=(1, 1))
    axes[-1, 0].set_xlabel("cost of a demonstration [deg]")
    return figure


def _variants(results: Results) -> Figure:
    """Every variant's 30 s cost over the seeds, beside the demonstrations'."""
    names = list(results.cells)
    groups = [results.demonstration_costs("without-reward")[:, :, 0].mean(axis=1)]
    groups += [results.costs(name)[:, :, 0].mean(axis=1) for name in names]
    labels = ["demonstrations", *(VARIANTS[name].title for name in names)]
    figure, axes = plots.new_figure(8.2, 0.8 + 0.3 * len(labels))
    positions = -np.arange(len(labels))
    for position, group, label in zip(positions, groups, labels, strict=True):
        colour = plots.INK if label == "demonstrations" else plots.SERIES[0]
        axes.plot(group, np.full(len(group), position), "|", color=colour, ms=9, alpha=0.45)
        axes.plot(group.mean(), position, "o", color=colour, ms=6)
    axes.axvline(
        TABLE_2[:, 0].mean(), color=plots.PAPER, lw=1.5, ls="--", label="the paper's explorations"
    )
    axes.axvline(
        TABLE_1[:, 0].mean(), color=plots.PAPER, lw=1.5, ls=":", label="the paper's demonstrations"
    )
    axes.set_yticks(positions, labels)
    axes.set_xlabel("mean cost over 30 s [deg]; a mark a seed, the dot is their mean")
    axes.legend(ncols=2, loc="lower left", bbox_to_anchor=(0, 1))
    return figure


def _model_growth(results: Results) -> Figure:
    """How the model's spread and ε change from exploration to exploration."""
    figure, axes = plots.new_figure(8.2, 3.0, ncols=2)
    labels = {"without-reward": "without reward", "with-reward": "with reward"}
    numbers = np.arange(1, EXPLORATIONS + 1)
    for (variant, label), colour in zip(labels.items(), plots.SERIES, strict=False):
        cells = results.cells[variant]
        for axis, field in zip(axes, ("disagreement", "exploration"), strict=True):
            values = np.array([getattr(cell, field) for cell in cells])
            axis.plot(numbers, values.mean(axis=0), "o-", ms=4, color=colour, label=label)
            low, high = np.percentile(values, [2.5, 97.5], axis=0)
            axis.fill_between(numbers, low, high, color=colour, alpha=0.15, lw=0)
    axes[0].set_title("spread of the force, given the state [N]")
    axes[1].set_title("mean exploration ε along the trial")
    axes[1].set_ylim(0, 1)
    for axis in axes:
        axis.set_xlabel("exploration")
        axis.set_ylim(bottom=0)
        axis.set_xticks(numbers)
    axes[0].legend()
    return figure


def _spread(axes: Axes, costs: Array, paper: Array) -> None:
    numbers = np.arange(1, costs.shape[1] + 1)
    low, high = np.percentile(costs, [2.5, 97.5], axis=0)
    axes.vlines(numbers, low, high, color=plots.EXPLORATION, lw=10, alpha=0.2, label="ours, 95 %")
    axes.plot(numbers, costs.mean(axis=0), "o", color=plots.EXPLORATION, ms=5, label="our mean")
    axes.plot(numbers, paper, "_", color=plots.PAPER, ms=14, mew=2.5, label="paper")
    axes.set_xticks(numbers)
    axes.set_ylim(bottom=0)


def _paper_figures() -> dict[str, Draw]:
    drawn: dict[str, Draw] = {
        "figure_01": data_exchange,
        "figure_02": _donut_family,
        "figure_03": pendulum,
        "figure_04": _simulation,
        "figure_05": partial(_synthetic_donut, 0.0),
        "figure_06": partial(_synthetic_donut, 90.0),
        "figure_07": _synthetic_data,
    }
    for number in (1, 2, 3):
        drawn[f"figure_{7 + number:02d}"] = partial(_synthetic_exploration, number)
    shown = (1, 3, 5, 7, 9, 11)
    for offset, number in enumerate(shown):
        drawn[f"figure_{11 + offset}"] = partial(_exploration, "without-reward", number)
    drawn["figure_17"] = _demonstration_costs
    drawn["figure_18"] = partial(_exploration_costs, "without-reward")
    drawn["figure_19"] = partial(_exploration_costs, "with-reward")
    for offset, number in enumerate(shown):
        drawn[f"figure_{20 + offset}"] = partial(_exploration, "with-reward", number)
    return drawn


FIGURES: dict[str, Draw] = {
    "overview": _overview,
    **_paper_figures(),
    "velocity": partial(_exploration, "velocity", EXPLORATIONS),
    "distribution": _distribution,
    "calibration": _calibration,
    "variants": _variants,
    "model_growth": _model_growth,
}
