"""The cart-pole on Gazebo's physics: `misstep.systems.CartPole` with another engine inside."""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, ClassVar

import numpy as np

from misstep.parameters import ParameterValue
from misstep.robot.gazebo.world import World
from misstep.systems import CartPole, CartPoleParameters


@dataclass(frozen=True)
class CartPoleGazeboParameters(CartPoleParameters):
    """What can be set on a `CartPoleGazebo`: what can be set on a `CartPole`."""

    owner: ClassVar[str] = "cartpole-gazebo"


class CartPoleGazebo(CartPole):
    """Keep a pole upright by pushing the cart that it is hinged to, in Gazebo's physics.

    **Observation, action, reward, start, failure, success, end, info, parameters**: those of
    `CartPole`.

    The engine is Gazebo's own, ignition-physics with DART, stepped without Gazebo around it. It
    integrates with semi-implicit Euler where `CartPole` uses fourth-order Runge-Kutta: give it a
    `physics_step` ten times as short for the same accuracy. The stops at the ends of the rail are
    DART's. Needs `make gazebo`.

    Raises
    ------
    MisstepError
        As `CartPole`; also if the bridge to Gazebo has not been built, or a step of the physics
        is not a number of nanoseconds.

    Notes
    -----
    Version 1.
    """

    system_id: ClassVar[str] = "cartpole-gazebo"
    parameters_type: ClassVar[type[CartPoleParameters]] = CartPoleGazeboParameters

    def __init__(self, render_mode: str | None = None, **parameters: ParameterValue) -> None:
        super().__init__(render_mode, **parameters)
        self._world = World(_sdf(self.model, self.parameters), self._timestep)

    def set_state(self, x: float, x_dot: float, theta: float, theta_dot: float) -> None:
        """Start an episode at a given state, in m, m/s, rad, rad/s; errors as in `CartPole`."""
        super().set_state(x, x_dot, theta, theta_dot)
        self._world.set_state(np.array([x, theta]), np.array([x_dot, theta_dot]))

    def _advance(self, force: float) -> None:
        """Simulate one control period in which the action `force` [N] is sent."""
        self._pending.append(force)
        late = self._late_substeps
        if late:
            self._world.step(np.array([self._force, 0.0]), late)
        self._force = self._pending.popleft()
        self._world.step(np.array([self._force, 0.0]), self._substeps - late)
        self._qpos[:], self._qvel[:] = self._world.state()

    def close(self) -> None:
        """Release the world, and what `render` holds."""
        super().close()
        self._world.close()


def _sdf(model: Any, p: Mapping[str, ParameterValue]) -> str:
    """Return the model as an SDF text, with the masses of MuJoCo's model of it."""
    across, _, along = model.body_inertia[model.body("pole").id]
    text = files("misstep.robot.gazebo").joinpath("cartpole.sdf").read_text(encoding="utf-8")
    values = {**p, "across": float(across), "along": float(along)}
    for name, value in values.items():
        text = text.replace(f"{{{name}}}", repr(value))
    return text
