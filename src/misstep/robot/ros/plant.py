"""The simulated robot behind the topics: a cart-pole that only knows joints and efforts.

It neither falls nor succeeds, as Gazebo's robots do not: it moves on for ever. It publishes a state
for every step of its physics, or as often as is asked for.
"""

import math
from collections.abc import Mapping

import numpy as np

from misstep.errors import MisstepError
from misstep.parameters import ParameterValue
from misstep.robot.limiter import Limiter
from misstep.robot.limits import Limits, Row
from misstep.systems import make_system

_FOR_EVER = 1e9  # s


class Plant:
    """A cart-pole that is stepped `rate` times a second.

    Parameters
    ----------
    name : str
        One of the cart-poles.
    parameters : mapping
        Of the system.
    rate : float, Hz
        States per second; 0 for one in each step of the physics.

    Attributes
    ----------
    rate : float, Hz
    observation : tuple of n float
        The state as observed.
    efforts : tuple of k float
        On each joint, the rail's and the hinge, in the step before.

    Raises
    ------
    MisstepError
        If there is no such cart-pole or parameter, or `rate` is no multiple of the control rate.
    """

    def __init__(
        self, name: str, parameters: Mapping[str, ParameterValue], rate: float = 0.0
    ) -> None:
        driven = make_system(name, **parameters).unwrapped
        p = driven.parameters
        if "stop_at_fall" not in p:
            raise MisstepError(f"{name} is no cart-pole: there is nothing to simulate on joints")
        control_rate = float(p["control_rate"])
        if not rate:
            steps = math.ceil(1.0 / (control_rate * float(p["physics_step"])) - 1e-9)
            rate = control_rate * max(1, steps)
        if rate < control_rate or abs(rate / control_rate - round(rate / control_rate)) > 1e-9:
            raise MisstepError(
                f"the simulation publishes {rate:g} states a second: it has to be a multiple of "
                f"the control rate, {control_rate:g} Hz"
            )
        self.rate = rate
        for_ever = {"control_rate": rate, "duration": _FOR_EVER, "stop_at_fall": False}
        self.system = make_system(name, **{**p, "upright_time": 0.0, **for_ever})
        self.limits = Limits.of(self.system)
        self._limiter = Limiter(self.limits)
        self.observation: Row = ()
        self.efforts: Row = (0.0, 0.0)
        self.reset(None)

    def reset(self, seed: int | None) -> None:
        """Start as the system does with this seed."""
        observation, _ = self.system.reset(seed=seed)
        self.observation, self.efforts = tuple(observation.tolist()), (0.0, 0.0)

    def step(self, efforts: Row) -> None:
        """Move on by one state with the efforts (m,), held within their limits."""
        self._limiter.move(efforts, self.limits.period)
        observation, _, _, _, info = self.system.step(np.array(self._limiter.action))
        self.observation, self.efforts = tuple(observation.tolist()), (info["force"], 0.0)
