"""What basket looks like: in three dimensions with OpenGL, or as a flat sketch without.

The catapult stands on a post, the effector above its short arm; the arrow beside it is its
velocity. On the floor there is a mark every 0.1 m from the pivot, and a longer one every
0.5 m. When the ball has flown out of the picture, the picture grows to hold it.
"""

import itertools
import math
from collections.abc import Mapping

import mujoco
import numpy as np
from numpy.typing import NDArray

from misstep.parameters import ParameterValue, build_parameters
from misstep.systems.basket import BasketParameters, basket_spec, start_height, struck_arm_length
from misstep.systems.drawing import (
    BLUE,
    DARK,
    FLOOR,
    GREY,
    MARK,
    ORANGE,
    RED,
    STEEL,
    Canvas,
    Point,
    Sketch,
    light,
    rgba,
)
from misstep.systems.offscreen import Offscreen, Scene
from misstep.systems.striking_drawing import StrikingView, add_arrow, add_rod

ARROW_LENGTH, ARROW_THICKNESS, ARROW_OFFSET = 0.18, 0.008, 0.06  # m
ROD = 0.3  # m
MARGIN = 0.12  # m, around what has to be seen
FLOOR_SHARE = 0.12  # of the picture's height is below the floor's edge
MARKS_PER_METRE, MARKS_PER_LONG_MARK, LAST_MARK = 10, 5, 40
WALL_OPACITY = 0.2

_COLUMN_OF_JOINT = {
    "stroke": "position",
    "lever": "lever_angle",
    "ball_x": "ball_x",
    "ball_z": "ball_z",
}


class _BasketView(StrikingView):
    columns: tuple[str, ...] = ("position", "velocity", "lever_angle", "ball_x", "ball_z")
    up = -1.0
    longest_arrow = ARROW_LENGTH

    def __init__(self, parameters: Mapping[str, ParameterValue], width: int, height: int) -> None:
        self.p: BasketParameters = build_parameters(BasketParameters, "basket", parameters)
        self.width, self.height = width, height
        self._left = -self.p.ball_arm - MARGIN
        self._right = self.p.basket_distance + self.p.basket_half_width + MARGIN
        self._top = self.p.pivot_height + start_height(self.p) + 0.5 * ROD

    def view(self, ball_x: float, ball_z: float) -> tuple[float, Point]:
        """Return the height of the view and its centre, m, so that everything is in it."""
        left, right = min(self._left, ball_x - MARGIN), max(self._right, ball_x + MARGIN)
        top = max(self._top, ball_z + MARGIN)
        height = max((right - left) * self.height / self.width, top / (1.0 - FLOOR_SHARE))
        return height, (0.5 * (left + right), (0.5 - FLOOR_SHARE) * height)

    def tip(self, position: float) -> Point:
        """Return the centre of the effector's tip, m."""
        return self.p.effector_offset, self.p.pivot_height + start_height(self.p) - position

    def velocity_arrow(self, position: float, velocity: float) -> tuple[Point, Point]:
        """Return start and end of the arrow beside the effector, m."""
        x, z = self.tip(position)
        return self.arrow((x + ARROW_OFFSET, z + 0.6 * ARROW_LENGTH), velocity)


class BasketScene(_BasketView, Scene):
    """Basket in three dimensions.

    Parameters
    ----------
    parameters : mapping
        Of the basket, see `BasketParameters`; what is left out is at its default.
    width, height : int, px

    Raises
    ------
    NoOpenGLError
        If there is no OpenGL to draw with.
    """

    def __init__(self, parameters: Mapping[str, ParameterValue], width: int, height: int) -> None:
        super().__init__(parameters, width, height)
        p = self.p
        spec = basket_spec(p)
        light(spec)
        colours = {
            "floor": FLOOR,
            "struck_arm": DARK,
            "ball_arm": DARK,
            "cup": DARK,
            "outer_lip": DARK,
            "inner_lip": DARK,
            "ball": RED,
            "near_wall": BLUE,
            "far_wall": BLUE,
        }
        for name, colour in colours.items():
            spec.geom(name).rgba = rgba(colour)
        for name in ("left_wall", "right_wall"):
            spec.geom(name).rgba = rgba(BLUE, WALL_OPACITY)
        box, world = mujoco.mjtGeom.mjGEOM_BOX, spec.worldbody
        for y in (-0.045, 0.045):
            world.add_geom(
                type=box,
                pos=[0, y, 0.5 * p.pivot_height],
                size=[0.018, 0.006, 0.5 * p.pivot_height + 0.018],
                rgba=rgba(STEEL),
            )
        world.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            fromto=[0, -0.055, p.pivot_height, 0, 0.055, p.pivot_height],
            size=[0.01, 0, 0],
            rgba=rgba(GREY),
        )
        for k in range(-MARKS_PER_LONG_MARK, LAST_MARK + 1):
            long = k % MARKS_PER_LONG_MARK == 0
            world.add_geom(
                type=box,
                pos=[k / MARKS_PER_METRE, -0.16, 0.0],
                size=[0.003, 0.05 if long else 0.025, 0.001],
                rgba=rgba(MARK),
            )
        add_rod(spec, self.up, ROD)
        self._screen = Offscreen(spec, width, height)
        self._screen.camera.azimuth, self._screen.camera.elevation = 90.0, -5.0

    def draw(
        self, observation: Mapping[str, float], action: Mapping[str, float]
    ) -> NDArray[np.uint8]:
        """Return a picture, shape (height, width, 3), of the columns."""
        screen, position = self._screen, observation["position"]
        for joint, column in _COLUMN_OF_JOINT.items():
            screen.data.joint(joint).qpos[0] = observation[column]
        view_height, (x, z) = self.view(observation["ball_x"], observation["ball_z"])
        field_of_view = math.radians(screen.model.vis.global_.fovy)
        screen.camera.distance = 0.5 * view_height / math.tan(0.5 * field_of_view)
        screen.camera.lookat[:] = x, 0.0, z
        screen.look()
        ends = self.velocity_arrow(position, observation["velocity"])
        add_arrow(screen, ends, 0.0, ARROW_THICKNESS)
        return screen.picture()


class BasketSketch(_BasketView, Sketch):
    """Basket as a flat drawing; takes the place of `BasketScene` without OpenGL."""

    def draw(
        self, observation: Mapping[str, float], action: Mapping[str, float]
    ) -> NDArray[np.uint8]:
        """Return a picture, shape (height, width, 3), of the columns."""
        p, position = self.p, observation["position"]
        ball = observation["ball_x"], observation["ball_z"]
        canvas = Canvas(self.width, self.height, *self.view(*ball))
        canvas.box(-10.0, 0.0, 10.0, -10.0, FLOOR)
        for k in range(-MARKS_PER_LONG_MARK, LAST_MARK + 1):
            x, depth = k / MARKS_PER_METRE, 0.03 if k % MARKS_PER_LONG_MARK == 0 else 0.015
            canvas.box(x - 0.003, 0.0, x + 0.003, -depth, MARK)
        left, right = (p.basket_distance + side * p.basket_half_width for side in (-1, 1))
        canvas.box(left - 0.003, p.basket_height, left + 0.003, 0.0, BLUE)
        canvas.box(right - 0.003, p.basket_height, right + 0.003, 0.0, BLUE)
        canvas.box(left, 0.006, right, 0.0, BLUE)
        canvas.box(-0.018, p.pivot_height, 0.018, 0.0, STEEL)
        self._draw_lever(canvas, observation["lever_angle"])
        canvas.disc(ball, p.ball_radius, RED)
        x, z = self.tip(position)
        canvas.box(x - 0.6 * p.effector_radius, z + ROD, x + 0.6 * p.effector_radius, z, ORANGE)
        canvas.disc((x, z), p.effector_radius, ORANGE)
        start, end = self.velocity_arrow(position, observation["velocity"])
        if start != end:
            canvas.arrow(start, end, 2 * ARROW_THICKNESS, ORANGE)
        return canvas.picture()

    def _draw_lever(self, canvas: Canvas, angle: float) -> None:
        p, bend = self.p, math.radians(self.p.bend_deg)

        def place(x: float, z: float) -> Point:
            """Turn a place on the level lever by its angle, which lowers +x."""
            c, s = math.cos(angle), math.sin(angle)
            return x * c + z * s, p.pivot_height - x * s + z * c

        cup = (-p.ball_arm * math.cos(bend), p.ball_arm * math.sin(bend))
        canvas.line(place(0, 0), place(struck_arm_length(p), 0), 0.012, DARK)
        canvas.line(place(0, 0), place(*cup), 0.012, DARK)
        along, up = (math.cos(bend), -math.sin(bend)), (math.sin(bend), math.cos(bend))

        def in_cup(a: float, b: float) -> Point:
            return place(cup[0] + a * along[0] + b * up[0], cup[1] + a * along[1] + b * up[1])

        corners = ((-0.03, 0.026), (-0.03, -0.003), (0.03, -0.003), (0.03, 0.014))
        for start, end in itertools.pairwise(corners):
            canvas.line(in_cup(*start), in_cup(*end), 0.006, DARK)
        canvas.disc((0.0, p.pivot_height), 0.012, GREY)
