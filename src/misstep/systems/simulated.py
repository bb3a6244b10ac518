"""What the systems that MuJoCo simulates have in common: clock, model, and picture."""

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, NamedTuple, Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError, reason_of
from misstep.systems.system import System

SHORTEST_STEP = 1e-6
"""Of a simulation, s; shorter ones take for ever."""
LONGEST_TIME = 1e9
"""Of an episode, or of waiting in one, s: thirty years."""


class Clock(Protocol):
    """Parameters, a frozen dataclass, that say how time is cut."""

    @property
    def control_rate(self) -> float:
        """Actions per second, Hz."""

    @property
    def physics_step(self) -> float:
        """Longest step of the simulation, s."""


class Look(NamedTuple):
    """What a picture shows, in the units of the columns."""

    observation: Mapping[str, float]
    action: Mapping[str, float]
    verdict: str = ""
    """``"success"``, ``"failure"``, or empty before the end."""


class Simulated(System):
    """A system that MuJoCo simulates.

    Parameters
    ----------
    p : dataclass
        Its parameters, `control_rate` and `physics_step` among them.
    spec : mujoco.MjSpec
        Its model with the parameters set.
    render_mode : {None, "rgb_array"}

    Raises
    ------
    MisstepError
        If there is no such render mode, or MuJoCo finds the model's numbers impossible.
    """

    def __init__(self, p: Any, spec: Any, render_mode: str | None) -> None:
        if render_mode not in (None, "rgb_array"):
            raise MisstepError(
                f"{self.system_id}: render_mode is {render_mode!r}; there is: 'rgb_array'"
            )
        self.render_mode = render_mode
        self.parameters = asdict(p)
        self.metadata = {**self.metadata, "render_fps": round(p.control_rate)}
        self.dt = 1.0 / p.control_rate
        self.model = compiled(spec, self.system_id)
        self.data = mujoco.MjData(self.model)
        self._substeps = substeps(p)
        self._painter: Any = None
        self._over = True
        self._t = 0

    @abstractmethod
    def _look(self) -> Look:
        """Return what a picture of the present state shows."""

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture of the true state, shape (360, 640, 3), with ``"rgb_array"``."""
        if self.render_mode is None:
            return None
        if self._painter is None:
            # Drawing needs OpenGL, which simulating does not.
            from misstep.systems.rendering import Painter

            self._painter = Painter(self.system_id, self.parameters)
        observation, action, verdict = self._look()
        picture: NDArray[np.uint8] = self._painter.paint(
            observation, action, self._t * self.dt, verdict
        )
        return picture

    def close(self) -> None:
        """Release what `render` holds."""
        if self._painter is not None:
            self._painter.close()
            self._painter = None


def substeps(p: Clock) -> int:
    """Return into how many equal steps a control period is cut, none above `physics_step`."""
    # The margin keeps 0.02 s / 0.01 s at 2 in floating point.
    return max(1, math.ceil(1.0 / (p.control_rate * p.physics_step) - 1e-9))


def compiled(spec: Any, owner: str) -> Any:
    """Return the model of MuJoCo that a specification describes.

    Parameters
    ----------
    spec : mujoco.MjSpec
    owner : str
        The system's name, for messages.

    Raises
    ------
    MisstepError
        If MuJoCo finds its numbers impossible: a mass or an inertia too small to move.
    """
    try:
        return spec.compile()
    except ValueError as error:
        raise MisstepError(
            f"{owner}: MuJoCo cannot build it with these parameters: {reason_of(error)}"
        ) from error
