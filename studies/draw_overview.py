"""Draw the picture at the top of the README: four failures, and what two learners make of them.

    python studies/draw_overview.py docs/images/overview.png

Runs the README's ten lines, and the same with the paper's learner, both with seed 0.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure, SubFigure

from misstep import Trajectory, demonstrate, learn, make_system, plots
from misstep.systems.rendering import Painter

FRAMES = 4
SIDE = 288  # pixels


def main(path: Path) -> None:
    """Make the runs and draw them."""
    system = make_system("cartpole")
    failures = demonstrate(system, by="noisy", n=4, seed=0)
    donut, fall = (
        learn(system, failures, learner, state=("theta", "theta_dot"), max_trials=4, seed=0)
        for learner in ("donut", "fall")
    )
    [success] = fall.trials
    ends = [(attempt, attempt.n_steps) for attempt in failures]
    tried = [(attempt, attempt.n_steps) for attempt in donut.trials]
    balanced = [(success, int(t)) for t in np.linspace(0, success.n_steps, FRAMES)]
    size = {"width": 2 * SIDE, "height": SIDE}
    with plots.style(), Painter("cartpole", system.parameters, **size) as painter:
        figure = Figure(figsize=(10.4, 3.6))
        figure.get_layout_engine().set(h_pad=0.04)
        parts = figure.subfigures(1, 3, wspace=0.03)
        draw(parts[0], painter, "four demonstrations, all failed", ends)
        draw(parts[1], painter, "the paper explores away from them", tried)
        draw(parts[2], painter, "misstep balances it at once", balanced)
        figure.savefig(path)


def draw(
    part: SubFigure, painter: Painter, title: str, shown: Sequence[tuple[Trajectory, int]]
) -> None:
    """Draw some attempts: pictures of their last moments above, the angle over time below."""
    grid = part.add_gridspec(2, FRAMES, height_ratios=(1, 1.9))
    for index, (attempt, step) in enumerate(shown):
        axes = part.add_subplot(grid[0, index])
        around_the_cart = slice(SIDE * 2 // 3), slice(SIDE * 2 // 3, SIDE * 4 // 3)
        axes.imshow(painter.paint_step(attempt, step)[around_the_cart])
        axes.set(xticks=[], yticks=[])
        axes.set_xlabel(f"{step * attempt.dt:.1f} s", fontsize=8)
        axes.spines[:].set_visible(False)
    part.suptitle(title, x=0.165, ha="left", fontsize=10, fontweight="bold", color=plots.INK)
    axes = part.add_subplot(grid[1, :])
    for attempt in {id(attempt): attempt for attempt, _ in shown}.values():
        time = attempt.dt * np.arange(attempt.n_steps + 1)
        angle = np.degrees(attempt.column("theta"))
        end = plots.EXPLORATION if attempt.failure_step is None else plots.MODEL
        axes.plot(time, angle, color=end, linewidth=1.1)
        axes.plot(time[-1], angle[-1], "o", color=end, markersize=5, clip_on=False)
    axes.axhspan(-30, 30, color=plots.FAINT, alpha=0.15, linewidth=0, zorder=0)
    axes.set(xlabel="time [s]", ylabel="lean [deg]", ylim=(-38, 38), yticks=(-30, 0, 30))
    axes.set_xlim(0, None)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
