"""What the pictures of flip-up and basket have in common: the effector, its arrow, the caption."""

from collections.abc import Mapping
from typing import Any

import mujoco

from misstep.systems.drawing import ORANGE, Point, rgba
from misstep.systems.offscreen import Offscreen
from misstep.systems.striking import StrikingParameters

_ARROW_OPACITY = 0.9
_SLOWEST_ARROW = 0.02  # of v_max


class StrikingView:
    """How a strike is told; a task adds what is struck.

    The arrow beside the effector is its velocity; that of `v_max` is `longest_arrow` [m] long. The
    velocity that was commanded is not drawn: the servo follows it within a control period or two.
    """

    columns: tuple[str, ...]

    action_column = "velocity"
    slow_motion = 10.0  # a strike lasts a tenth of a second
    hold = 1.0
    longest_arrow: float
    up: float  # 1 where the effector strikes upward, -1 where it strikes downward
    p: StrikingParameters

    @staticmethod
    def caption(
        observation: Mapping[str, float], action: Mapping[str, float], time: float
    ) -> list[tuple[str, str, str]]:
        """Return name, value and unit of what is written beside the picture."""
        return [
            ("position", f"{1000 * observation['position']:z.0f}", "mm"),
            ("speed", f"{observation['velocity']:z.2f}", "m/s"),
            ("time", f"{time:.3f}", "s"),
        ]

    def arrow(self, tail: Point, velocity: float) -> tuple[Point, Point]:
        """Return start and end of the arrow of a velocity; equal when it is too slow to see."""
        x, z = tail
        if abs(velocity) < _SLOWEST_ARROW * self.p.v_max:
            return tail, tail
        return tail, (x, z + self.up * self.longest_arrow * velocity / self.p.v_max)


def add_rod(spec: Any, up: float, length: float) -> None:
    """Draw the effector as a rod that comes from where it does not strike."""
    effector = spec.geom("effector")
    effector.rgba = rgba(ORANGE)
    spec.body("effector").add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=[0.6 * float(effector.size[0]), 0, 0],
        fromto=[0, 0, 0, 0, 0, -up * length],
        rgba=rgba(ORANGE),
    )


def add_arrow(screen: Offscreen, ends: tuple[Point, Point], y: float, thickness: float) -> None:
    """Add the arrow to the picture, in the vertical plane at `y`."""
    (x0, z0), (x1, z1) = ends
    if (x0, z0) != (x1, z1):
        colour = rgba(ORANGE, _ARROW_OPACITY)
        screen.add_arrow((x0, y, z0), (x1, y, z1), thickness, colour)
