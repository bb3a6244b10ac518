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
from PIL import Image, ImageColor, ImageDraw

from misstep.parameters import ParameterValue, build_parameters
from misstep.systems.cartpole import CartPoleParameters, cartpole_spec
from misstep.systems.offscreen import Offscreen

SKY_ABOVE, SKY_BELOW = "#e1e9f0", "#fbfcfd"
FLOOR, RAIL, MARK, STOP = "#c9d3dd", "#77838f", "#f4f6f8", "#a34a44"
CART, WHEEL, HINGE = "#2b3442", "#566273", "#f4f6f8"
POLE, FALLEN, FORCE = "#2f6db5", "#c8402f", "#f07f2b"

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

COLUMNS = ("x", "theta")
ACTION_COLUMN = "force"


class _CartPoleView:
    """What the two drawings have in common: the parameters and what follows from them."""

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
        first = math.ceil((x - reach) * MARKS_PER_METRE)
        last = math.floor((x + reach) * MARKS_PER_METRE)
        short_ones = last - first < _MOST_MARKS
        for k in range(first, last + 1):
            place, long = k / MARKS_PER_METRE, k % MARKS_PER_LONG_MARK == 0
            if abs(place) <= self.stop_centre() and (long or short_ones):
                yield place, long


class CartPoleScene(_CartPoleView):
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
        _light(spec)
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
            rgba=_rgba(FLOOR),
        )
        world.add_geom(
            type=box,
            size=[reach + 0.1 * u, 0.1 * u, RAIL_HALF_THICKNESS * u],
            pos=[0, 0, rail_z],
            rgba=_rgba(RAIL),
        )
        for side in (-1, 1):
            world.add_geom(
                type=box,
                size=[STOP_HALF_LENGTH * u, 0.15 * u, STOP_HALF_HEIGHT * u],
                pos=[side * reach, 0, rail_z + STOP_HALF_HEIGHT * u],
                rgba=_rgba(STOP),
            )
            wheel_x, wheel_z = side * WHEEL_OFFSET * u, -CART_HALF_HEIGHT * u
            cart.add_geom(
                type=cylinder,
                size=[WHEEL_RADIUS * u, 0, 0],
                fromto=[wheel_x, -0.21 * u, wheel_z, wheel_x, 0.21 * u, wheel_z],
                rgba=_rgba(WHEEL),
            )
        cart.add_geom(
            type=box,
            size=[CART_HALF_LENGTH * u, 0.2 * u, CART_HALF_HEIGHT * u],
            rgba=_rgba(CART),
        )
        pole.add_geom(
            name="pole",
            type=capsule,
            size=[POLE_RADIUS * u, 0, 0],
            fromto=[0, -0.28 * u, 0, 0, -0.28 * u, 2.0 * u],
            rgba=_rgba(POLE),
        )
        pole.add_geom(
            type=cylinder,
            size=[HINGE_RADIUS * u, 0, 0],
            fromto=[0, -0.2 * u, 0, 0, -0.345 * u, 0],
            rgba=_rgba(HINGE),
        )

    def draw(
        self, observation: Mapping[str, float], action: Mapping[str, float]
    ) -> NDArray[np.uint8]:
        """Return a picture, shape (height, width, 3), of x [m], theta [rad] and force [N]."""
        x, theta, force = observation["x"], observation["theta"], action[ACTION_COLUMN]
        u, screen = self.unit, self._screen
        screen.data.qpos[:] = x, theta
        screen.model.geom("pole").rgba = _rgba(self.pole_colour(theta))
        screen.camera.lookat[:] = x, 0.0, VIEW_CENTRE * u
        screen.look()
        for place, long in self.marks(x):
            half_height = (0.7 if long else 0.35) * RAIL_HALF_THICKNESS * u
            top = (RAIL_HEIGHT + 0.7 * RAIL_HALF_THICKNESS) * u
            screen.add_box(
                (0.014 * u, 0.005 * u, half_height),
                (place, -0.1 * u, top - half_height),
                _rgba(MARK),
            )
        start, end = self.arrow(force)
        if start != end:
            screen.add_arrow(
                (x + start, -0.3 * u, 0.0),
                (x + end, -0.3 * u, 0.0),
                ARROW_THICKNESS * u,
                _rgba(FORCE),
            )
        return screen.picture()

    def close(self) -> None:
        """Give back what OpenGL holds."""
        self._screen.close()


class CartPoleSketch(_CartPoleView):
    """A cart-pole as a flat drawing; takes the place of `CartPoleScene` without OpenGL."""

    _FINER = 2  # drawn this much larger and then reduced, for smooth edges

    def draw(
        self, observation: Mapping[str, float], action: Mapping[str, float]
    ) -> NDArray[np.uint8]:
        """Return a picture, shape (height, width, 3), of x [m], theta [rad] and force [N]."""
        x, theta, force = observation["x"], observation["theta"], action[ACTION_COLUMN]
        self._image = Image.new(
            "RGB", (self.width * self._FINER, self.height * self._FINER), SKY_BELOW
        )
        self._pen = ImageDraw.Draw(self._image)
        self._x = x
        u, reach = self.unit, self.stop_centre()
        self._box(-reach - 2 * u, FLOOR_HEIGHT * u, reach + 2 * u, -10 * u, FLOOR)
        rail_top = (RAIL_HEIGHT + RAIL_HALF_THICKNESS) * u
        rail_bottom = (RAIL_HEIGHT - RAIL_HALF_THICKNESS) * u
        self._box(-reach - 0.1 * u, rail_top, reach + 0.1 * u, rail_bottom, RAIL)
        for place, long in self.marks(x):
            length = (1.4 if long else 0.7) * RAIL_HALF_THICKNESS * u
            self._box(place - 0.014 * u, rail_top, place + 0.014 * u, rail_top - length, MARK)
        for side in (-reach, reach):
            half = STOP_HALF_LENGTH * u
            top = (RAIL_HEIGHT + 2 * STOP_HALF_HEIGHT) * u
            self._box(side - half, top, side + half, rail_bottom, STOP)
        self._draw_cart(x)
        tip = (x + 2 * u * math.sin(theta), 2 * u * math.cos(theta))
        self._line((x, 0.0), tip, 2 * POLE_RADIUS * u, self.pole_colour(theta))
        self._disc((x, 0.0), HINGE_RADIUS * u, HINGE)
        self._draw_arrow(x, force)
        return np.asarray(self._image.reduce(self._FINER))

    def close(self) -> None:
        """Nothing is held."""

    def _draw_cart(self, x: float) -> None:
        u = self.unit
        for side in (-1, 1):
            wheel = (x + side * WHEEL_OFFSET * u, -CART_HALF_HEIGHT * u)
            self._disc(wheel, WHEEL_RADIUS * u, WHEEL)
        half_length, half_height = CART_HALF_LENGTH * u, CART_HALF_HEIGHT * u
        self._box(x - half_length, half_height, x + half_length, -half_height, CART)

    def _draw_arrow(self, x: float, force: float) -> None:
        start, end = self.arrow(force)
        if start == end:
            return
        thickness = 2 * ARROW_THICKNESS * self.unit
        head = math.copysign(min(abs(end - start), 1.5 * thickness), force)
        neck = x + end - head
        half = thickness / 2
        self._box(x + start, half, neck, -half, FORCE)
        corners = [(neck, thickness), (x + end, 0.0), (neck, -thickness)]
        self._pen.polygon([self._pixel(*corner) for corner in corners], fill=FORCE)

    def _pixel(self, x: float, z: float) -> tuple[float, float]:
        scale = self._FINER * self.height / (VIEW_HEIGHT * self.unit)
        middle_x, middle_z = 0.5 * self.width * self._FINER, 0.5 * self.height * self._FINER
        return middle_x + (x - self._x) * scale, middle_z - (z - VIEW_CENTRE * self.unit) * scale

    def _box(self, left: float, top: float, right: float, bottom: float, colour: str) -> None:
        (x0, y0), (x1, y1) = self._pixel(left, top), self._pixel(right, bottom)
        self._pen.rectangle((min(x0, x1), y0, max(x0, x1), y1), fill=colour)

    def _disc(self, centre: tuple[float, float], radius: float, colour: str) -> None:
        x, z = centre
        (x0, y0), (x1, y1) = (
            self._pixel(x - radius, z + radius),
            self._pixel(x + radius, z - radius),
        )
        self._pen.ellipse((x0, y0, x1, y1), fill=colour)

    def _line(
        self, start: tuple[float, float], end: tuple[float, float], width: float, colour: str
    ) -> None:
        pixels = width * self._FINER * self.height / (VIEW_HEIGHT * self.unit)
        self._pen.line([self._pixel(*start), self._pixel(*end)], fill=colour, width=round(pixels))
        self._disc(end, width / 2, colour)


def _light(spec: mujoco.MjSpec) -> None:
    """Light the scene from the camera and from above, before a seamless backdrop."""
    spec.visual.global_.fovy = 30.0
    headlight = spec.visual.headlight
    headlight.ambient, headlight.diffuse, headlight.specular = [0.55] * 3, [0.35] * 3, [0.0] * 3
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        dir=[0.2, 0.3, -1.0],
        diffuse=[0.4] * 3,
        specular=[0.0] * 3,
        castshadow=False,
    )
    spec.add_texture(
        name="backdrop",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=_rgba(SKY_ABOVE)[:3],
        rgb2=_rgba(SKY_BELOW)[:3],
        width=128,
        height=128,
    )


def _rgba(colour: str) -> list[float]:
    return [channel / 255 for channel in ImageColor.getrgb(colour)] + [1.0]
