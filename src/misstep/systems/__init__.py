"""Systems to fail on and to learn: simulated here with MuJoCo, a robot elsewhere.

>>> from misstep.systems import make_system
>>> system = make_system("cartpole", pole_mass=0.2)
>>> system.parameters["pole_mass"]
0.2
"""

import gymnasium

from misstep.parameters import ParameterRow, ParameterValue, parameter_table
from misstep.registry import Registry
from misstep.systems.cartpole import CartPole, CartPoleParameters
from misstep.systems.system import System

__all__ = [
    "SYSTEMS",
    "CartPole",
    "CartPoleParameters",
    "System",
    "list_systems",
    "make_system",
]

SYSTEMS: Registry[type[System]] = Registry("system", "misstep.systems")
SYSTEMS.register(CartPole.system_id)(CartPole)

gymnasium.register(id="misstep/CartPole-v1", entry_point="misstep.systems.cartpole:CartPole")


def make_system(name: str, /, **parameters: ParameterValue) -> System:
    """Build a system by name.

    Parameters
    ----------
    name : str
        One of `list_systems`.
    **parameters
        The system's own parameters, in the units that `list_systems` states.

    Raises
    ------
    MisstepError
        If there is no such system or parameter, or a value is of the wrong type or out of range.
    """
    return SYSTEMS[name](**parameters)


def list_systems() -> dict[str, list[ParameterRow]]:
    """Return the table of parameters (name, default, unit, meaning) of every system by name."""
    return {name: parameter_table(SYSTEMS[name].parameters_type) for name in SYSTEMS}
