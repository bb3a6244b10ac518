"""Systems to fail on and to learn: simulated here with MuJoCo, a robot elsewhere.

>>> from misstep.systems import make_system
>>> system = make_system("cartpole", pole_mass=0.2)
>>> system.parameters["pole_mass"]
0.2
"""

from typing import Any

import gymnasium

from misstep.judges import Judge
from misstep.parameters import ParameterRow, ParameterValue, parameter_table
from misstep.registry import Registry
from misstep.systems.basket import Basket, BasketParameters
from misstep.systems.cartpole import CartPole, CartPoleParameters
from misstep.systems.cartpole_variants import CartPoleRail, CartPoleSwingUp
from misstep.systems.flipup import FlipUp, FlipUpParameters
from misstep.systems.gymnasium_adapter import (
    PREFIX,
    GymParameters,
    GymSystem,
    make_gym_system,
)
from misstep.systems.judged import JUDGE_PARAMETERS, Judged
from misstep.systems.recorded import recorded_system
from misstep.systems.striking import StrikingSystem
from misstep.systems.system import System

__all__ = [
    "JUDGE_PARAMETERS",
    "SYSTEMS",
    "Basket",
    "BasketParameters",
    "CartPole",
    "CartPoleParameters",
    "CartPoleRail",
    "CartPoleSwingUp",
    "FlipUp",
    "FlipUpParameters",
    "GymParameters",
    "GymSystem",
    "Judged",
    "StrikingSystem",
    "System",
    "list_systems",
    "make_system",
    "recorded_system",
]

SYSTEMS: Registry[type[System]] = Registry("system", "misstep.systems")
for _system in (CartPole, CartPoleRail, CartPoleSwingUp, FlipUp, Basket):
    SYSTEMS.register(_system.system_id)(_system)

gymnasium.register(id="misstep/CartPole-v1", entry_point="misstep.systems.cartpole:CartPole")
_VARIANTS = "misstep.systems.cartpole_variants"
gymnasium.register(id="misstep/CartPoleRail-v1", entry_point=f"{_VARIANTS}:CartPoleRail")
gymnasium.register(id="misstep/CartPoleSwingUp-v1", entry_point=f"{_VARIANTS}:CartPoleSwingUp")
gymnasium.register(id="misstep/FlipUp-v1", entry_point="misstep.systems.flipup:FlipUp")
gymnasium.register(id="misstep/Basket-v1", entry_point="misstep.systems.basket:Basket")


def make_system(name: str, /, **parameters: ParameterValue | Judge) -> System:
    """Build a system by name.

    Parameters
    ----------
    name : str
        One of `list_systems`, or ``"gym:"`` and the id of a Gymnasium environment.
    **parameters
        The system's own parameters, in the units that `list_systems` states. Of any system also
        ``success``, ``failure``, ``hold`` [s] and ``cost``: then it is a `Judged` one.

    Raises
    ------
    MisstepError
        If there is no such system or parameter, a value is of the wrong type or out of range, or a
        formula cannot be read.

    Examples
    --------
    >>> strict = make_system("cartpole", failure="abs(theta) > 20deg or abs(x) > 1m")
    >>> strict.parameters["failure"]
    'abs(theta) > 20deg or abs(x) > 1m'
    """
    judges = {row.name for row in JUDGE_PARAMETERS}
    judge: dict[str, Any] = {key: parameters[key] for key in parameters if key in judges}
    own: dict[str, Any] = {key: parameters[key] for key in parameters if key not in judges}
    if name.startswith(PREFIX):
        return make_gym_system(name, judge, own)
    system = SYSTEMS[name](**own)
    return Judged(system, **judge) if judge else system


def list_systems() -> dict[str, list[ParameterRow]]:
    """Return the table of parameters (name, default, unit, meaning) of every system by name."""
    kinds = SYSTEMS.loaded()[0]
    return {name: parameter_table(kind.parameters_type) for name, kind in kinds.items()}
