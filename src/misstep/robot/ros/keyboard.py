"""A person who pushes with the keys of a terminal, as the paper's author first tried."""

import numpy as np
from numpy.typing import NDArray

from misstep.robot.keys import ReadKey

LEFT, RIGHT = "a", "d"
_PUSH = 0.12  # s that one key press lasts: a held key repeats faster


class KeyboardPolicy:
    """Pushes to the left or right while a key is held.

    Parameters
    ----------
    read_key : callable
        See `misstep.robot.keys`.
    force : float
        Of a key, in the action's unit.
    dt : float, s
        Control period.
    """

    def __init__(self, read_key: ReadKey, force: float, dt: float) -> None:
        self._read_key, self._force = read_key, force
        self._steps = max(1, round(_PUSH / dt))
        self.reset()

    def reset(self) -> None:
        """Let go of every key."""
        self._push, self._left = 0.0, 0

    def __call__(self, observation: NDArray[np.float64], /) -> NDArray[np.float64]:
        """Return the push, shape (1,)."""
        self._left -= 1
        if self._left <= 0:
            self._push = 0.0
        while key := self._read_key(0.0):
            if key in (LEFT, RIGHT):
                self._push = self._force if key == RIGHT else -self._force
                self._left = self._steps
        return np.array([self._push])
