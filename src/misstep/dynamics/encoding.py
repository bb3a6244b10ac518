"""How a model sees a state: angles as sine and cosine, everything else standardised.

An angle that wraps has no mean and no distance; its sine and cosine have both. Actions are seen in
[−1, 1], the actuator's range.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Encoding:
    """Map from states and actions to what a model is fitted on.

    Parameters
    ----------
    angles : ndarray of bool, shape (n,)
        Which columns wrap around, in rad.
    mean, scale : ndarray, shape (n,)
        Of the other columns; 0 and 1 for angles.
    action_low, action_high : ndarray, shape (m,)
        The actuator's limits.
    """

    angles: NDArray[np.bool_]
    mean: Array
    scale: Array
    action_low: Array
    action_high: Array

    @classmethod
    def of(
        cls, states: Array, angles: NDArray[np.bool_], action_low: Array, action_high: Array
    ) -> Self:
        """Return the encoding that standardises `states` (N, n)."""
        scale = states.std(axis=0)
        # A column that never varies stays finite, at zero.
        scale[angles | (scale < 1e-12)] = 1.0
        return cls(
            angles, np.where(angles, 0.0, states.mean(axis=0)), scale, action_low, action_high
        )

    def encode(self, states: Array) -> Array:
        """Return the encoded states (N, n + number of angles); cosine follows sine."""
        columns = []
        for i, angle in enumerate(self.angles):
            if angle:
                columns += [np.sin(states[:, i]), np.cos(states[:, i])]
            else:
                columns.append((states[:, i] - self.mean[i]) / self.scale[i])
        return np.stack(columns, axis=1)

    def encode_actions(self, actions: Array) -> Array:
        """Return actions (…, m) in [−1, 1]."""
        encoded: Array = 2.0 * (actions - self.action_low) / self._range - 1.0
        return encoded

    def decode_actions(self, encoded: Array) -> Array:
        """Return the actions (…, m) of encoded ones, in the actuator's unit."""
        actions: Array = self.action_low + 0.5 * (encoded + 1.0) * self._range
        return actions

    @property
    def _range(self) -> Array:
        return self.action_high - self.action_low


def wrapped_differences(before: Array, after: Array, angles: NDArray[np.bool_]) -> Array:
    """Return `after` − `before` (N, n), angles the short way round."""
    change = after - before
    change[:, angles] = (change[:, angles] + np.pi) % (2.0 * np.pi) - np.pi
    return change
