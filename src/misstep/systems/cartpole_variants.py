"""Harder tasks on the same cart-pole: `CartPole` with other defaults, under names of their own."""

import math
from dataclasses import dataclass
from typing import ClassVar

from misstep.parameters import other_default
from misstep.systems.cartpole import CartPole, CartPoleParameters

_BASE = CartPoleParameters


@dataclass(frozen=True)
class CartPoleRailParameters(CartPoleParameters):
    """What can be set on a `CartPoleRail`."""

    rail: float = other_default(_BASE, "rail", 3.0)
    track_limit: float = other_default(_BASE, "track_limit", 2.4)
    duration: float = other_default(_BASE, "duration", 60.0)

    owner: ClassVar[str] = "cartpole-rail"


class CartPoleRail(CartPole):
    """Keep a pole upright for a minute without leaving a short track.

    A `CartPole` in everything but these defaults:

    ===============  =======  ====  ========================================================
    name             default  unit  meaning
    ===============  =======  ====  ========================================================
    ``rail``         3.0      m     from the middle to each stop; out of the way, beyond the track
    ``track_limit``  2.4      m     leaving the track is a failure
    ``duration``     60.0     s     length of an episode
    ===============  =======  ====  ========================================================

    **Version history**

    - v1 (``misstep/CartPoleRail-v1``): first version.
    """

    system_id: ClassVar[str] = "cartpole-rail"
    typed_only: ClassVar[frozenset[str] | None] = frozenset()
    parameters_type: ClassVar[type[CartPoleParameters]] = CartPoleRailParameters


@dataclass(frozen=True)
class CartPoleSwingUpParameters(CartPoleParameters):
    """What can be set on a `CartPoleSwingUp`."""

    rail: float = other_default(_BASE, "rail", 2.4)
    force_limit: float = other_default(_BASE, "force_limit", 10.0)
    duration: float = other_default(_BASE, "duration", 10.0)
    start_angle: float = other_default(_BASE, "start_angle", math.pi)
    fall_angle_deg: float = other_default(_BASE, "fall_angle_deg", 180.0)
    track_limit: float = other_default(_BASE, "track_limit", 2.4)
    upright_time: float = other_default(_BASE, "upright_time", 5.0)

    owner: ClassVar[str] = "cartpole-swingup"


class CartPoleSwingUp(CartPole):
    """Swing a hanging pole up and keep it upright, on a short rail.

    A `CartPole` in everything but these defaults:

    =====================  =======  ====  ==================================================
    name                   default  unit  meaning
    =====================  =======  ====  ==================================================
    ``rail``               2.4      m     from the middle to each stop
    ``force_limit``        10.0     N     largest force, to either side
    ``duration``           10.0     s     length of an episode
    ``start_angle``        π        rad   mean angle at the start: hanging
    ``fall_angle_deg``     180.0    deg   falling is no failure
    ``track_limit``        2.4      m     running into a stop is a failure
    ``upright_time``       5.0      s     success is to be upright this long at the end
    =====================  =======  ====  ==================================================

    The pole is upright within ``upright_angle_deg``, 12°, and starts within ``start_spread``,
    0.05 rad, of hanging.

    **Version history**

    - v1 (``misstep/CartPoleSwingUp-v1``): first version.
    """

    system_id: ClassVar[str] = "cartpole-swingup"
    typed_only: ClassVar[frozenset[str] | None] = frozenset()
    parameters_type: ClassVar[type[CartPoleParameters]] = CartPoleSwingUpParameters
