"""Draw the ROS graph of docs/robot.md: docs/images/ros_graph.png.

python studies/draw_ros_graph.py [FILE]
"""

import sys
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from misstep import plots

FILE = Path(__file__).parents[1] / "docs" / "images" / "ros_graph.png"
WIDTH, HEIGHT = 2.5, 1.3
NODES = {
    "robot": (0.2, "/simulation\nor a robot, or Gazebo", plots.SERIES[0]),
    "controller": (5.2, "/controller\ndemonstrates, judges,\nrecords", plots.SERIES[3]),
    "exploration": (10.2, "/exploration\nguard, policy,\nlearner", plots.SERIES[2]),
}
BOTTOM = 1.9


def main() -> None:
    """Draw it."""
    file = Path(sys.argv[1]) if len(sys.argv) > 1 else FILE
    with plots.style():
        figure, axes = plots.new_figure(9.6, 3.0)
        axes.set_axis_off()
        axes.set(xlim=(0, 12.9), ylim=(0.75, 4.7))
        for left, text, colour in NODES.values():
            box(axes, left, text, colour)
        arrow(axes, 2.7, 5.2, 2.9, "joint_states", "sensor_msgs/JointState, 1 kHz")
        arrow(axes, 5.2, 2.7, 2.2, "effort_controller/command", "std_msgs/Float64", below=True)
        arrow(axes, 7.7, 10.2, 2.9, "exploration/explore", "state, 50 Hz")
        arrow(axes, 10.2, 7.7, 2.2, "the command that answers", "or a refusal", below=True)
        unasked = FancyArrowPatch(
            (11.4, BOTTOM + HEIGHT),
            (1.5, BOTTOM + HEIGHT),
            connectionstyle="arc3,rad=0.2",
            arrowstyle="-|>",
            mutation_scale=13,
            color=plots.MODEL,
            lw=1.4,
            ls="--",
        )
        axes.add_patch(unasked)
        axes.text(
            6.45,
            4.35,
            "controller silent: the safe effort, unasked",
            ha="center",
            fontsize=8,
            color=plots.MODEL,
        )
        for left, text in (
            (0.2, "service  simulation/reset\n(a robot is put back by hand)"),
            (5.2, "writes  demonstrations.h5\nand a bag of each attempt"),
            (
                10.2,
                "services  connect, start, mark,\nstop, clear, status\nwrites  the run and its log",
            ),
        ):
            axes.text(left, BOTTOM - 0.25, text, va="top", fontsize=8)
        figure.savefig(file)
    print(file)


def box(axes: Axes, left: float, text: str, colour: str) -> None:
    """Draw a node."""
    shape = "round,pad=0,rounding_size=0.15"
    axes.add_patch(
        FancyBboxPatch(
            (left, BOTTOM), WIDTH, HEIGHT, boxstyle=shape, fc=colour, ec="none", alpha=0.18
        )
    )
    name, _, rest = text.partition("\n")
    axes.text(left + WIDTH / 2, BOTTOM + 0.95, name, ha="center", va="center", weight="bold")
    axes.text(left + WIDTH / 2, BOTTOM + 0.42, rest, ha="center", va="center", fontsize=8)


def arrow(
    axes: Axes, start: float, end: float, y: float, name: str, kind: str, below: bool = False
) -> None:
    """Draw what flows from one node to another, with its name and type."""
    axes.add_patch(
        FancyArrowPatch((start, y), (end, y), arrowstyle="-|>", mutation_scale=13, color=plots.INK)
    )
    middle = (start + end) / 2
    first, second = (y - 0.12, y - 0.42) if below else (y + 0.42, y + 0.12)
    vertical = "top" if below else "bottom"
    axes.text(middle, first, name, ha="center", va=vertical, fontsize=8, weight="bold")
    axes.text(middle, second, kind, ha="center", va=vertical, fontsize=7, color=plots.INK)


if __name__ == "__main__":
    main()
