"""One world of Gazebo's physics, from an SDF text."""

import ctypes
import os
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.robot.gazebo.build import library_path

PLUGIN = "libignition-physics5-dartsim-plugin.so.5"
"""The engine; the environment variable MISSTEP_GAZEBO_ENGINE names another."""

_NANO = 1e-9
_DOUBLES = ctypes.POINTER(ctypes.c_double)


class World:
    """A world with one model, whose joints have one degree of freedom each.

    Parameters
    ----------
    sdf : str
        An SDF text.
    step : float, s
        Of the physics; Gazebo counts whole nanoseconds.

    Attributes
    ----------
    n_joints : int

    Raises
    ------
    MisstepError
        If the bridge has not been built, the step is not a number of nanoseconds, or Gazebo
        refuses the text.
    """

    def __init__(self, sdf: str, step: float) -> None:
        nanoseconds = round(step / _NANO)
        if abs(nanoseconds * _NANO - step) > 1e-15:
            raise MisstepError(f"Gazebo steps whole nanoseconds, and {step!r} s is none")
        self._library = _library()
        message = ctypes.create_string_buffer(1000)
        plugin = os.environ.get("MISSTEP_GAZEBO_ENGINE", PLUGIN)
        self._world = self._library.misstep_open(
            plugin.encode(), sdf.encode(), nanoseconds, message, len(message)
        )
        if not self._world:
            raise MisstepError(f"Gazebo's physics: {message.value.decode(errors='replace')}")
        self.n_joints = int(self._library.misstep_joint_count(self._world))
        self._positions, self._velocities, self._efforts = np.zeros((3, self.n_joints))
        self._pointers = [
            array.ctypes.data_as(_DOUBLES)
            for array in (self._positions, self._velocities, self._efforts)
        ]

    def set_state(self, positions: NDArray[np.float64], velocities: NDArray[np.float64]) -> None:
        """Put the joints at positions (k,) [m or rad] with velocities (k,)."""
        self._positions[:], self._velocities[:] = positions, velocities
        self._library.misstep_set_state(self._world, *self._pointers[:2])

    def step(self, efforts: NDArray[np.float64], n: int) -> None:
        """Move on by `n` steps with efforts (k,) [N or N·m]."""
        self._efforts[:] = efforts
        self._library.misstep_step(self._world, self._pointers[2], n)

    def state(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions (k,) and velocities (k,); both change with the next call."""
        self._library.misstep_get_state(self._world, *self._pointers[:2])
        return self._positions, self._velocities

    def close(self) -> None:
        """Give the world back."""
        if self._world:
            self._library.misstep_close(self._world)
            self._world = None

    def __del__(self) -> None:
        if getattr(self, "_world", None):
            self.close()


@cache
def _library() -> Any:
    path: Path = library_path()
    if not path.exists():
        raise MisstepError(
            "the bridge to Gazebo's physics is not built: `make gazebo`, or "
            "`python -m misstep.robot.gazebo.build`"
        )
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        raise MisstepError(f"Gazebo's physics cannot be loaded: {error}") from error
    handle, size = ctypes.c_void_p, ctypes.c_size_t
    library.misstep_open.restype = handle
    library.misstep_open.argtypes = (
        *(ctypes.c_char_p, ctypes.c_char_p, ctypes.c_long),
        *(ctypes.c_char_p, size),
    )
    library.misstep_close.argtypes = (handle,)
    library.misstep_joint_count.restype = size
    library.misstep_joint_count.argtypes = (handle,)
    library.misstep_set_state.argtypes = (handle, _DOUBLES, _DOUBLES)
    library.misstep_get_state.argtypes = (handle, _DOUBLES, _DOUBLES)
    library.misstep_step.argtypes = (handle, _DOUBLES, size)
    return library
