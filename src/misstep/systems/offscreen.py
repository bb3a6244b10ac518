"""Pictures of a MuJoCo model without a window.

Software OpenGL spends its time on pixels, so shadows and reflections are off. Which OpenGL is used
follows ``MUJOCO_GL`` where the user has set it; on Linux without a display it is EGL, chosen here
and not in the environment, so that it does not matter who imported MuJoCo first.
"""

import atexit
import os
import sys
import warnings
import weakref
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from misstep.errors import reason_of

_SAMPLES = 4  # per pixel, for smooth edges
_MAX_GEOMS = 500
# Why OpenGL failed, once it has: a second attempt can abort the process inside of MuJoCo.
_failures: list[str] = []
_IDENTITY = np.eye(3).ravel()


class NoOpenGLError(RuntimeError):
    """OpenGL does not work here; the message is the reason."""


class Offscreen:
    """Draws a MuJoCo model into memory.

    Parameters
    ----------
    spec : mujoco.MjSpec
        Compiled here, after the size of the picture has been written into it.
    width, height : int, px

    Attributes
    ----------
    model : mujoco.MjModel
    data : mujoco.MjData
        Its state is what is drawn.
    camera : mujoco.MjvCamera

    Raises
    ------
    NoOpenGLError
        If there is no OpenGL to draw with.
    """

    def __init__(self, spec: Any, width: int, height: int) -> None:
        spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
        spec.visual.quality.offsamples = _SAMPLES
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.camera = mujoco.MjvCamera()
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._options = mujoco.MjvOption()
        self._scene = mujoco.MjvScene(self.model, _MAX_GEOMS)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[flag] = False
        self._pixels = np.empty((height, width, 3), np.uint8)

        self._context, self._renderer = _open(self.model, width, height)
        # Free with the object, or else at exit. The exit hook is registered here, after the one
        # that terminates EGL, because hooks run in reverse: OpenGL must outlive its contexts.
        self._free = weakref.finalize(self, _release, self._context, self._renderer)
        self._free.atexit = False
        atexit.register(self._free)

    def look(self) -> None:
        """Take over the state and the camera; what was added to the last picture is gone."""
        mujoco.mj_forward(self.model, self.data)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            self.model, self.data, self._options, None, self.camera, everything, self._scene
        )

    def add_box(self, half_sizes: Sequence[float], centre: Sequence[float], rgba: Any) -> None:
        """Add a box [m] that belongs to this picture alone."""
        self._add(mujoco.mjtGeom.mjGEOM_BOX, half_sizes, centre, rgba)

    def add_arrow(
        self, start: Sequence[float], end: Sequence[float], thickness: float, rgba: Any
    ) -> None:
        """Add an arrow [m] that belongs to this picture alone."""
        arrow = mujoco.mjtGeom.mjGEOM_ARROW
        geom = self._add(arrow, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), rgba)
        mujoco.mjv_connector(geom, arrow, thickness, np.array(start), np.array(end))
        geom.size[2] *= 2.0  # MuJoCo draws an arrow half as long as its size says

    def _add(self, kind: Any, size: Sequence[float], centre: Sequence[float], rgba: Any) -> Any:
        geom = self._scene.geoms[self._scene.ngeom]
        mujoco.mjv_initGeom(
            geom, kind, np.array(size), np.array(centre), _IDENTITY, np.array(rgba, np.float32)
        )
        self._scene.ngeom += 1
        return geom

    def picture(self) -> NDArray[np.uint8]:
        """Return the picture, shape (height, width, 3)."""
        self._context.make_current()
        mujoco.mjr_render(self._rect, self._scene, self._renderer)
        mujoco.mjr_readPixels(self._pixels, None, self._rect, self._renderer)
        return self._pixels[::-1].copy()  # OpenGL counts rows from below

    def close(self) -> None:
        """Give back what OpenGL holds."""
        atexit.unregister(self._free)
        self._free()


class Scene:
    """A drawing in three dimensions; what it is of, it says itself."""

    _screen: Offscreen

    def close(self) -> None:
        """Give back what OpenGL holds."""
        self._screen.close()


def _open(model: Any, width: int, height: int) -> tuple[Any, Any]:
    if _failures:
        raise NoOpenGLError(_failures[0])
    try:
        with warnings.catch_warnings():
            # Without a display GLFW warns, twice, before MuJoCo raises what is told here.
            warnings.filterwarnings("ignore", module="glfw")
            context = _context_type()(width, height)
            context.make_current()
            renderer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
    # A missing library, driver or display surfaces as almost any kind of exception.
    except Exception as error:
        _failures.append(reason_of(error))
        raise NoOpenGLError(_failures[0]) from error
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, renderer)
    return context, renderer


def _context_type() -> Any:
    headless = sys.platform == "linux" and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )
    if headless and not os.environ.get("MUJOCO_GL"):
        from mujoco.egl import GLContext
    else:
        from mujoco import gl_context

        if not hasattr(gl_context, "GLContext"):
            raise NoOpenGLError(f"MUJOCO_GL is {os.environ.get('MUJOCO_GL')!r}")
        GLContext = gl_context.GLContext
    return GLContext


def _release(context: Any, renderer: Any) -> None:
    context.make_current()
    renderer.free()
    context.free()
