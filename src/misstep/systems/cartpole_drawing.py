"""What a cart-pole looks like: in three dimensions with OpenGL, or as a flat sketch without.

Both show the same: the cart on a rail with a mark every 0.1 m and a longer one every 0.5 m, the
pole (red when it has fallen), the force as an arrow that starts at the cart and points where it
pushes. The picture follows the cart. All proportions are in units of the pole's half-length, so
that a small pole looks like a large one.
"""

import math
from collections.abc import Iterator, Mapping

import mujoco
import numpy as np
from numpy.typing import NDArray

from misstep.parameters import ParameterValue, build_parameters
from misstep.systems.cartpole import CartPoleParameters, cartpole_spec
from misstep.systems.drawing import (
    BLUE,
    DARK,
    FLOOR,
    GREY,
    LIGHT,
    MARK,
    ORANGE,
    RED,
    STEEL,
    STOP,
    Canvas,
    Sketch,
    light,
    rgba,
)
from misstep.systems.offscreen import Offscreen, Scene

RAIL, CART, WHEEL, HINGE, POLE, FALLEN, FORCE = STEEL, DARK, GREY, LIGHT, BLUE, RED, ORANGE

# In units of the half-length.
CART_HALF_LENGTH, CART_HALF_HEIGHT = 0.38, 0.16
WHEEL_RADIUS, WHEEL_OFFSET = 0.09, 0.22
POLE_RADIUS, HINGE_RADIUS = 0.05, 0.08
RAIL_HEIGHT, RAIL_HALF_THICKNESS = -0.32, 0.075
STOP_HALF_LENGTH, STOP_HALF_HEIGHT = 0.05, 0.16
FLOOR_HEIGHT, FLOOR_HALF_DEPTH = -2.35, 1.5
ARROW_LENGTH, ARROW_THICKNESS = 1.5, 0.07  # length at the largest force
VIEW_CENTRE, VIEW_HEIGHT = -0.1, 5.0

MARKS_PER_METRE, MARKS_PER_LONG_MARK = 10, 5
_MOST_MARKS = 150  # more than this in view are too dense to see


class _CartPoleView:
    """What the two drawings have in common: the parameters and what follows from them."""

    columns: tuple[str, ...] = ("x", "theta")
    action_column = "force"
    slow_motion = 1.0
    hold = 0.0

    @staticmethod
    def caption(
        observation: Mapping[str, float], action: Mapping[str, float], time: float
    ) -> list[tuple[str, str, str]]:
        """Return name, value and unit of what is written beside the picture."""
        return [
            ("angle", f"{math.degrees(observation['theta']):+.1f}", "°"),
            ("force", f"{action['force']:+.1f}", "N"),
            ("time", f"{time:.2f}", "s"),
        ]

    def __init__(self, parameters: Mapping[str, ParameterValue], width: int, height: int) -> None:
        self.p = build_parameters(CartPoleParameters, "cartpole", parameters)
        self.unit = self.p.half_length
        self.width, self.height = width, height
        self._half_view = 0.5 * VIEW_HEIGHT * self.unit * width / height

    def pole_colour(self, theta: float) -> str:
        return FALLEN if abs(theta) > math.radians(self.p.fall_angle_deg) else POLE

    def arrow(self, force: float) -> tuple[float, float]:
        """Return start and end of the arrow, relative to the cart [m]; equal without a force."""
        share = max(-1.0, min(1.0, force / self.p.force_limit))
        start = math.copysign(CART_HALF_LENGTH + 0.05, force) * self.unit
        return start, start + share * ARROW_LENGTH * self.unit

    def stop_centre(self) -> float:
        """Return how far from the middle [m] a stop stands: the cart's end touches it."""
        return self.p.rail + (CART_HALF_LENGTH + STOP_HALF_LENGTH) * self.unit

    def marks(self, x: float) -> Iterator[tuple[float, bool]]:
        """Yield the place [m] of each mark in view from `x`, and whether it is a long one."""
        reach = 1.1 * self._half_view
        if not reach * MARKS_PER_METRE < MARKS_PER_LONG_MARK * _MOST_MARKS:
            return  # even the long ones would be too dense
        first = math.ceil((x - reach) * MARKS_PER_METRE)
        last = math.floor((x + reach) * MARKS_PER_METRE)
        short_ones = last - first < _MOST_MARKS
        for k in range(first, last + 1):
            place, long = k / MARKS_PER_METRE, k % MARKS_PER_LONG_MARK == 0
            if abs(place) <= self.stop_centre() and (long or short_ones):
                yield place, long


class CartPoleScene(_CartPoleView, Scene):
    """A cart-pole in three dimensions.

    Parameters
    ----------
    parameters : mapping
        Of the cart-pole, see `CartPoleParameters`; what is left out is at its default.
    width, height : int, px

    Raises
    ------
    NoOpenGLError
        If there is no OpenGL to draw with.
    """

    def __init__(self, parameters: Mapping[str, ParameterValue], width: int, height: int) -> None:
        super().__init__(parameters, width, height)
        spec = cartpole_spec(self.p)
        light(spec)
        self._build(spec)
        self._screen = Offscreen(spec, width, height)
        field_of_view = math.radians(self._screen.model.vis.global_.fovy)
        camera = self._screen.camera
        camera.azimuth, camera.elevation = 90.0, -10.0
        camera.distance = 0.5 * VIEW_HEIGHT * self.unit / math.tan(0.5 * field_of_view)

    def _build(self, spec: mujoco.MjSpec) -> None:
        box, capsule, cylinder = (
            mujoco.mjtGeom.mjGEOM_BOX,
            mujoco.mjtGeom.mjGEOM_CAPSULE,
            mujoco.mjtGeom.mjGEOM_CYLINDER,
        )
        u, reach = self.unit, self.stop_centre()
        # How near and far is drawn follows from the extent, which a long rail must not blow up.
        spec.stat.extent = 6.0 * u
        world, cart, pole = spec.worldbody, spec.body("cart"), spec.body("pole")
        rail_z = RAIL_HEIGHT * u
        world.add_geom(
            type=box,
            size=[reach + 12.0 * u, FLOOR_HALF_DEPTH * u, 0.05 * u],
            pos=[0, 0, (FLOOR_HEIGHT - 0.05) * u],
            rgba=rgba(FLOOR),
        )
        world.add_geom(
            type=box,
            size=[reach + 0.1 * u, 0.1 * u, RAIL_HALF_THICKNESS * u],
            pos=[0, 0, rail_z],
            rgba=rgba(RAIL),
        )
        for side in (-1, 1):
            world.add_geom(
                type=box,
                size=[STOP_HALF_LENGTH * u, 0.15 * u, STOP_HALF_HEIGHT * u],
                pos=[side * reach, 0, rail_z + STOP_HALF_HEIGHT * u],
                rgba=rgba(STOP),
            )
            wheel_x, wheel_z = side * WHEEL_OFFSET * u, -CART_HALF_HEIGHT * u
            cart.add_geom(
                type=cylinder,
                size=[WHEEL_RADIUS * u, 0, 0],
                fromto=[wheel_x, -0.21 * u, wheel_z, wheel_x, 0.21 * u, wheel_z],
                rgba=rgba(WHEEL),
            )
        cart.add_geom(
            type=box,
            size=[CART_HALF_LENGTH * u, 0.2 * u, CART_HALF_HEIGHT * u],
            rgba=rgba(CART),
        )
        pole.add_geom(
            name="pole",
            type=capsule,
            size=[POLE_RADIUS * u, 0, 0],
            fromto=[0, -0.28 * u, 0, 0, -0.28 * u, 2.0 * u],
            rgba=rgba(POLE),
        )
        pole.add_geom(
            type=cylinder,
            size=[HINGE_RADIUS * u, 0, 0],
            fromto=[0, -0.2 * u, 0, 0, -0.345 * u, 0],
            rgba=rgba(HINGE),
        )

    def draw(
        self, observation: Mapping[str, float], action: Mapping[str, float]
    ) -> NDArray[np.uint8]:
        """Return a picture, shape (height, width, 3), of x [m], theta [rad] and force [N]."""
        x, theta, force = observation["x"], observation["theta"], action["force"]
        u, screen = self.unit, self._screen
        screen.data.qpos[:] = x, theta
        screen.model.geom("pole").rgba = rgba(self.pole_colour(theta))
        screen.camera.lookat[:] = x, 0.0, VIEW_CENTRE * u
        screen.look()
        for place, long in self.marks(x):
            half_height = (0.7 if long else 0.35) * RAIL_HALF_THICKNESS * u
            top = (RAIL_HEIGHT + 0.7 * RAIL_HALF_THICKNESS) * u
            screen.add_box(
                (0.014 * u, 0.005 * u, half_height),
                (place, -0.1 * u, top - half_height),
                rgba(MARK),
            )
        start, end = self.arrow(force)
        if start != end:
            screen.add_arrow(
                (x + start, -0.3 * u, 0.0),
                (x + end, -0.3 * u, 0.0),
                ARROW_THICKNESS * u,
                rgba(FORCE),
            )
        return screen.picture()


class CartPoleSketch(_CartPoleView, Sketch):
    """A cart-pole as a flat drawing; takes the place of `CartPoleScene` without OpenGL."""

    def draw(
        self, observation: Mapping[str, float], action: Mapping[str, float]
    ) -> NDArray[np.uint8]:
        """Return a picture, shape (height, width, 3), of x [m], theta [rad] and force [N]."""
        x, theta, force = observation["x"], observation["theta"], action["force"]
        u, reach = self.unit, self.stop_centre()
        centre = (x, VIEW_CENTRE * u)
        canvas = Canvas(self.width, self.height, VIEW_HEIGHT * u, centre)
        canvas.box(-reach - 2 * u, FLOOR_HEIGHT * u, reach + 2 * u, -10 * u, FLOOR)
        rail_top = (RAIL_HEIGHT + RAIL_HALF_THICKNESS) * u
        rail_bottom = (RAIL_HEIGHT - RAIL_HALF_THICKNESS) * u
        canvas.box(-reach - 0.1 * u, rail_top, reach + 0.1 * u, rail_bottom, RAIL)
        for place, long in self.marks(x):
            length = (1.4 if long else 0.7) * RAIL_HALF_THICKNESS * u
            canvas.box(place - 0.014 * u, rail_top, place + 0.014 * u, rail_top - length, MARK)
        for side in (-reach, reach):
            half = STOP_HALF_LENGTH * u
            top = (RAIL_HEIGHT + 2 * STOP_HALF_HEIGHT) * u
            canvas.box(side - half, top, side + half, rail_bottom, STOP)
        self._draw_cart(canvas, x)
        tip = (x + 2 * u * math.sin(theta), 2 * u * math.cos(theta))
        canvas.line((x, 0.0), tip, 2 * POLE_RADIUS * u, self.pole_colour(theta))
        canvas.disc((x, 0.0), HINGE_RADIUS * u, HINGE)
        start, end = self.arrow(force)
        if start != end:
            canvas.arrow((x + start, 0.0), (x + end, 0.0), 2 * ARROW_THICKNESS * u, FORCE)
        return canvas.picture()

    def _draw_cart(self, canvas: Canvas, x: float) -> None:
        u = self.unit
        for side in (-1, 1):
            wheel = (x + side * WHEEL_OFFSET * u, -CART_HALF_HEIGHT * u)
            canvas.disc(wheel, WHEEL_RADIUS * u, WHEEL)
        half_length, half_height = CART_HALF_LENGTH * u, CART_HALF_HEIGHT * u
        canvas.box(x - half_length, half_height, x + half_length, -half_height, CART)
