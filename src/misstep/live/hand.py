"""A person's hand at the tip of the pole, while the learned policy balances it.

The hand is a spring between the tip and where the mouse is. Held against a force F at its tip, a
pole of weight W stands still only while it leans by atan(2F/W), so the spring is bounded to what a
good policy can lean against; a tap is short and may be stronger.
"""

import math
from typing import Any

from misstep.systems import CartPole, System

_STIFFNESS = 2.0  # of its largest force, for each length of the pole
_HELD = 0.16  # times the pole's weight: 18 degrees
_TAPPED = 0.5  # times the pole's weight
_TAP = 0.12  # s


class Hand:
    """What pushes the pole of a cart-pole; nothing on any other system.

    Parameters
    ----------
    system : System
    """

    def __init__(self, system: System) -> None:
        inside: Any = system.unwrapped
        self._system = inside if isinstance(inside, CartPole) else None
        self._place: float | None = None
        self._left = 0
        self._side = 0.0
        if self._system is not None:
            p = self._system.parameters
            self._half = float(p["half_length"])
            self._weight = float(p["pole_mass"]) * 9.81
            self._body = self._system.model.body("pole").id

    @property
    def place(self) -> float | None:
        """Where the hand is, m; None when it lets go."""
        return self._place

    def hold(self, x: float | None) -> None:
        """Hold the tip with a spring that ends at x [m], or let go."""
        self._place = x

    def poke(self, side: float) -> None:
        """Push for a moment, with a share from −1 to 1 of the largest force of a tap."""
        if self._system is not None:
            self._side = side
            self._left = max(1, round(_TAP / self._system.dt))

    def act(self) -> None:
        """Have the force work during the next control period."""
        if self._system is None:
            return
        x, _, theta, _ = self._system.state
        force = 0.0
        if self._place is not None:
            tip = x + 2.0 * self._half * math.sin(theta)
            share = _STIFFNESS * (self._place - tip) / (2.0 * self._half)
            force = _HELD * self._weight * max(-1.0, min(1.0, share))
        elif self._left:
            self._left -= 1
            force = _TAPPED * self._weight * self._side
        # At the tip: a force at the centre of mass, and its moment about that.
        outside = self._system.data.xfrc_applied[self._body]
        outside[0] = force
        outside[4] = force * self._half * math.cos(theta)
