"""What flip-up looks like: in three dimensions with OpenGL, or as a flat sketch without.

The block lies over the table's edge, with a light band at the end that is struck. The effector is
a rod with a round tip; the arrow beside it is its velocity.
"""

import math
from collections.abc import Mapping

import mujoco
import numpy as np
from numpy.typing import NDArray

from misstep.parameters import ParameterValue, build_parameters
from misstep.systems.drawing import (
    BLUE,
    GREY,
    LIGHT,
    ORANGE,
    STEEL,
    Canvas,
    Point,
    Sketch,
    light,
    rgba,
)
from misstep.systems.flipup import FlipUpParameters, flipup_spec, start_height
from misstep.systems.offscreen import Offscreen, Scene
from misstep.systems.striking_drawing import StrikingView, add_arrow, add_rod

# In units of the block's length.
VIEW_HEIGHT, VIEW_X, VIEW_Z = 2.2, -0.35, 0.45
TABLE_THICKNESS, LEG, LEG_INSET = 0.33, 0.4, 0.9
BAND_FROM, BAND_TO = 0.36, 0.43  # along the block, from its centre
ROD, ARROW_LENGTH, ARROW_THICKNESS, ARROW_OFFSET = 4.0, 0.6, 0.03, 0.3


class _FlipUpView(StrikingView):
    columns: tuple[str, ...] = ("position", "velocity", "block_angle", "block_x", "block_z")
    up = 1.0

    def __init__(self, parameters: Mapping[str, ParameterValue], width: int, height: int) -> None:
        self.p: FlipUpParameters = build_parameters(FlipUpParameters, "flipup", parameters)
        self.unit = self.p.block_length
        self.longest_arrow = ARROW_LENGTH * self.unit
        self.width, self.height = width, height

    def tip(self, position: float) -> Point:
        """Return the centre of the effector's tip, m."""
        return self.p.effector_offset, start_height(self.p) + position

    def velocity_arrow(self, position: float, velocity: float) -> tuple[Point, Point]:
        """Return start and end of the arrow beside the effector, m."""
        x, z = self.tip(position)
        return self.arrow((x + ARROW_OFFSET * self.unit, z), velocity)


class FlipUpScene(_FlipUpView, Scene):
    """Flip-up in three dimensions.

    Parameters
    ----------
    parameters : mapping
        Of flip-up, see `FlipUpParameters`; what is left out is at its default.
    width, height : int, px

    Raises
    ------
    NoOpenGLError
        If there is no OpenGL to draw with.
    """

    def __init__(self, parameters: Mapping[str, ParameterValue], width: int, height: int) -> None:
        super().__init__(parameters, width, height)
        p, u = self.p, self.unit
        spec = flipup_spec(p)
        light(spec)
        table = spec.geom("table")
        half = 0.5 * TABLE_THICKNESS * u
        table.size, table.pos = (0.4, 1.6 * p.block_depth, half), (-0.4, 0.0, -half)
        table.rgba = rgba(STEEL)
        spec.geom("floor").rgba = rgba(LIGHT, 0.0)  # too far below to be seen
        spec.geom("block").rgba = rgba(BLUE)
        box = mujoco.mjtGeom.mjGEOM_BOX
        spec.body("block").add_geom(
            type=box,
            pos=[0.5 * (BAND_FROM + BAND_TO) * u, 0, 0],
            size=[
                0.5 * (BAND_TO - BAND_FROM) * u,
                0.503 * p.block_depth,
                0.503 * p.block_height,
            ],
            rgba=rgba(LIGHT),
        )
        spec.worldbody.add_geom(
            type=box,
            pos=[-LEG_INSET * u, 0, -2 * half - 2.0 * u],
            size=[0.5 * LEG * u, 0.8 * p.block_depth, 2.0 * u],
            rgba=rgba(GREY),
        )
        add_rod(spec, self.up, ROD * u)
        self._screen = Offscreen(spec, width, height)
        field_of_view = math.radians(self._screen.model.vis.global_.fovy)
        camera = self._screen.camera
        camera.azimuth, camera.elevation = 102.0, -12.0
        camera.distance = 0.5 * VIEW_HEIGHT * u / math.tan(0.5 * field_of_view)
        camera.lookat[:] = VIEW_X * u, 0.0, VIEW_Z * u

    def draw(
        self, observation: Mapping[str, float], action: Mapping[str, float]
    ) -> NDArray[np.uint8]:
        """Return a picture, shape (height, width, 3), of the columns."""
        screen, position = self._screen, observation["position"]
        for joint in ("block_x", "block_z", "block_angle"):
            screen.data.joint(joint).qpos[0] = observation[joint]
        screen.data.joint("stroke").qpos[0] = position
        screen.look()
        ends = self.velocity_arrow(position, observation["velocity"])
        add_arrow(screen, ends, -0.5 * self.p.block_depth, ARROW_THICKNESS * self.unit)
        return screen.picture()


class FlipUpSketch(_FlipUpView, Sketch):
    """Flip-up as a flat drawing; takes the place of `FlipUpScene` without OpenGL."""

    def draw(
        self, observation: Mapping[str, float], action: Mapping[str, float]
    ) -> NDArray[np.uint8]:
        """Return a picture, shape (height, width, 3), of the columns."""
        u, position = self.unit, observation["position"]
        canvas = Canvas(self.width, self.height, VIEW_HEIGHT * u, (VIEW_X * u, VIEW_Z * u))
        bottom = -TABLE_THICKNESS * u
        leg = -LEG_INSET * u
        canvas.box(leg - 0.5 * LEG * u, bottom, leg + 0.5 * LEG * u, -4 * u, GREY)
        canvas.box(-0.8, 0.0, 0.0, bottom, STEEL)
        x, z = self.tip(position)
        radius = self.p.effector_radius
        canvas.box(x - 0.6 * radius, z, x + 0.6 * radius, z - ROD * u, ORANGE)
        canvas.disc((x, z), radius, ORANGE)
        canvas.polygon(self._slice(observation, -0.5 * u, 0.5 * u), BLUE)
        canvas.polygon(self._slice(observation, BAND_FROM * u, BAND_TO * u), LIGHT)
        start, end = self.velocity_arrow(position, observation["velocity"])
        if start != end:
            canvas.arrow(start, end, 2 * ARROW_THICKNESS * u, ORANGE)
        return canvas.picture()

    def _slice(self, observation: Mapping[str, float], start: float, end: float) -> list[Point]:
        """Return the corners of the block between two places along it, m."""
        c, s = math.cos(observation["block_angle"]), math.sin(observation["block_angle"])
        half = 0.5 * self.p.block_height
        return [
            (observation["block_x"] + a * c - b * s, observation["block_z"] + a * s + b * c)
            for a, b in ((start, -half), (end, -half), (end, half), (start, half))
        ]
