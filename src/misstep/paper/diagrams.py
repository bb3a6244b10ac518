"""The paper's drawings that show no data: the data exchange (figure 1), the pendulum (figure 3)."""

import math

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle, FancyArrowPatch, FancyBboxPatch, Rectangle

from misstep import plots
from misstep.paper.experiments import PHYSICS
from misstep.paper.results import Results


def data_exchange(results: Results) -> Figure:
    """Figure 1: what flows between what, with our names for the paper's nodes."""
    figure, axes = plots.new_figure(8.2, 2.9)
    axes.set_axis_off()
    axes.set(xlim=(0, 11.2), ylim=(0, 4.2))
    _box(axes, (0.1, 1.5), "demonstrator\n(noisy control law)", plots.SERIES[3])
    _box(axes, (3.0, 1.5), "mixture\n(EM, minimum BIC)", plots.SERIES[1])
    _box(axes, (5.9, 1.5), "exploration\n(donut mixture,\ngradient ascent)", plots.SERIES[2])
    _box(axes, (8.8, 1.5), f"cart-pole\n({PHYSICS[results.physics].title})", plots.SERIES[0])
    _arrow(axes, (2.3, 2.1), (3.0, 2.1))
    _arrow(axes, (5.2, 2.1), (5.9, 2.1))
    _arrow(axes, (8.1, 2.4), (8.8, 2.4))
    _arrow(axes, (8.8, 1.8), (8.1, 1.8))
    axes.text(2.65, 2.95, "4 failed\ntrajectories", ha="center", fontsize=8)
    axes.text(5.55, 2.95, "weights, means,\ncovariances", ha="center", fontsize=8)
    axes.text(8.45, 2.95, "force F [N]", ha="center", fontsize=8)
    axes.text(8.45, 1.05, "angle θ [rad]", ha="center", fontsize=8)
    back = FancyArrowPatch(
        (9.9, 1.45),
        (4.1, 1.45),
        connectionstyle="arc3,rad=-0.28",
        arrowstyle="-|>",
        mutation_scale=13,
        color=plots.EXPLORATION,
        lw=1.6,
    )
    axes.add_patch(back)
    axes.text(7.0, 0.1, "each exploration joins the data; refit", ha="center", fontsize=8)
    return figure


def pendulum(results: Results) -> Figure:
    """Figure 3: the cart, the pole, the angle and the force."""
    figure, axes = plots.new_figure(5.2, 3.4)
    axes.set_axis_off()
    axes.set_aspect("equal")
    axes.set(xlim=(-2.6, 2.6), ylim=(-0.75, 2.75))
    axes.plot([-2.5, 2.5], [-0.35, -0.35], color=plots.FAINT, lw=2)
    axes.add_patch(Rectangle((-0.6, -0.2), 1.2, 0.5, color=plots.SERIES[0]))
    for x in (-0.35, 0.35):
        axes.add_patch(Circle((x, -0.22), 0.12, color=plots.INK))
    angle = math.radians(24)
    tip = (2.2 * math.sin(angle), 0.15 + 2.2 * math.cos(angle))
    axes.plot([0, tip[0]], [0.15, tip[1]], color=plots.SERIES[3], lw=7, solid_capstyle="round")
    axes.add_patch(Circle((0, 0.15), 0.08, color=plots.INK))
    axes.plot([0, 0], [0.15, 2.55], color=plots.FAINT, lw=1, ls="--")
    axes.add_patch(Arc((0, 0.15), 2.6, 2.6, theta1=66, theta2=90, color=plots.INK, lw=1.2))
    axes.text(0.3, 1.6, "θ", fontsize=13)
    axes.text(tip[0] / 2 + 0.22, tip[1] / 2, "m, l", fontsize=11)
    axes.text(0, 0.02, "M", fontsize=11, color="white", ha="center", va="center")
    _arrow(axes, (-1.9, 0.05), (-0.65, 0.05))
    axes.text(-1.9, 0.2, "force F", fontsize=11)
    _arrow(axes, (0.0, -0.55), (0.9, -0.55))
    axes.text(1.0, -0.62, "x", fontsize=11)
    return figure


def _box(axes: Axes, corner: tuple[float, float], text: str, colour: str) -> None:
    width, height = 2.2, 1.2
    axes.add_patch(
        FancyBboxPatch(
            corner,
            width,
            height,
            boxstyle="round,pad=0,rounding_size=0.15",
            facecolor=colour,
            edgecolor="none",
            alpha=0.16,
        )
    )
    centre = (corner[0] + width / 2, corner[1] + height / 2)
    axes.text(*centre, text, ha="center", va="center", fontsize=9, color=plots.INK)


def _arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float]) -> None:
    axes.add_patch(
        FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=13, color=plots.INK, lw=1.6)
    )
