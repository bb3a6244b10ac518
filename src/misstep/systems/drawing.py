"""What every drawing of a system needs: colours, light, and a flat canvas measured in metres."""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw

SKY_ABOVE, SKY_BELOW = "#e1e9f0", "#fbfcfd"
FLOOR, STEEL, MARK, STOP = "#c9d3dd", "#77838f", "#f4f6f8", "#a34a44"
DARK, GREY, LIGHT = "#2b3442", "#566273", "#f4f6f8"
BLUE, RED, ORANGE, GREEN = "#2f6db5", "#c8402f", "#f07f2b", "#2f8f5b"

Point = tuple[float, float]


class Canvas:
    """A flat picture of a vertical plane.

    Parameters
    ----------
    width, height : int, px
    view_height : float, m
        Height of what is seen.
    centre : (float, float), m
        x and z in the middle of the picture.
    """

    _FINER = 2  # drawn this much larger and then reduced, for smooth edges

    def __init__(self, width: int, height: int, view_height: float, centre: Point) -> None:
        self._size = width * self._FINER, height * self._FINER
        self._scale = self._size[1] / view_height
        self._centre = centre
        self._image = Image.new("RGB", self._size, SKY_BELOW)
        self._pen = ImageDraw.Draw(self._image)

    def _pixel(self, x: float, z: float) -> Point:
        (width, height), (centre_x, centre_z) = self._size, self._centre
        return (
            0.5 * width + (x - centre_x) * self._scale,
            0.5 * height - (z - centre_z) * self._scale,
        )

    def box(self, left: float, top: float, right: float, bottom: float, colour: str) -> None:
        """Fill a rectangle with sides along x and z."""
        (x0, y0), (x1, y1) = self._pixel(left, top), self._pixel(right, bottom)
        self._pen.rectangle((min(x0, x1), y0, max(x0, x1), y1), fill=colour)

    def polygon(self, corners: Sequence[Point], colour: str) -> None:
        """Fill a polygon."""
        self._pen.polygon([self._pixel(*corner) for corner in corners], fill=colour)

    def disc(self, centre: Point, radius: float, colour: str) -> None:
        """Fill a circle."""
        x, z = centre
        (x0, y0), (x1, y1) = (
            self._pixel(x - radius, z + radius),
            self._pixel(x + radius, z - radius),
        )
        self._pen.ellipse((x0, y0, x1, y1), fill=colour)

    def line(self, start: Point, end: Point, width: float, colour: str) -> None:
        """Draw a thick line with a round end."""
        ends = [self._pixel(*start), self._pixel(*end)]
        self._pen.line(ends, fill=colour, width=round(width * self._scale))
        self.disc(end, width / 2, colour)

    def arrow(self, start: Point, end: Point, thickness: float, colour: str) -> None:
        """Draw an arrow; its head is twice as wide as its shaft and 1.5 `thickness` long."""
        tail, tip = np.array(start), np.array(end)
        length = float(np.linalg.norm(tip - tail))
        along = (tip - tail) / length
        across = 0.5 * thickness * np.array([-along[1], along[0]])
        neck = tip - min(length, 1.5 * thickness) * along
        self.polygon(
            [tuple(p) for p in (tail + across, neck + across, neck - across, tail - across)], colour
        )
        self.polygon([tuple(p) for p in (neck + 2 * across, tip, neck - 2 * across)], colour)

    def picture(self) -> NDArray[np.uint8]:
        """Return the picture, shape (height, width, 3)."""
        return np.asarray(self._image.reduce(self._FINER))


class Sketch:
    """A flat drawing, on a `Canvas` of its own for each picture."""

    def close(self) -> None:
        """Nothing is held."""


def light(spec: Any) -> None:
    """Light a `mujoco.MjSpec` from the camera and from above, before a seamless backdrop."""
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
        rgb1=rgba(SKY_ABOVE)[:3],
        rgb2=rgba(SKY_BELOW)[:3],
        width=128,
        height=128,
    )


def rgba(colour: str, opacity: float = 1.0) -> list[float]:
    """Return red, green, blue and opacity, each in 0 .. 1."""
    return [channel / 255 for channel in ImageColor.getrgb(colour)] + [opacity]
