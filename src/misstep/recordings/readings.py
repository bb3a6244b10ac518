"""Other ways to read the columns of a recording: units, signs, zeros and rates that people mix up.

A position may be in degrees or millimetres, run the other way, or be zero where the pole hangs; a
velocity may be in another unit than its position; the rate may be another one. Each combination is
a `Reading`: how positions, velocities and accelerations would follow from those stated.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from misstep.systems.mechanics import Mechanics

Array = NDArray[np.float64]

SLOPE_TOLERANCE = 0.05
"""A velocity that differs by less than this share from the change of its position is that."""
DEGREE = np.pi / 180.0


@dataclass(frozen=True, eq=False)
class Rows:
    """How the joints of a system moved.

    Parameters
    ----------
    positions : ndarray, shape (T, k), m or rad
    velocities : ndarray, shape (T, k), m/s or rad/s
    accelerations : ndarray, shape (T, k), m/s² or rad/s²
    """

    positions: Array
    velocities: Array
    accelerations: Array

    def at(self, rows: Any) -> "Rows":
        """Return some of the rows, by their indices or a mask."""
        return Rows(self.positions[rows], self.velocities[rows], self.accelerations[rows])


@dataclass(frozen=True, eq=False)
class Reading:
    """Another way to read the columns: positions · p + offset, velocities · v, accelerations · a.

    Parameters
    ----------
    positions, velocities, accelerations : ndarray, shape (k,)
        What those recorded are multiplied by.
    offsets : ndarray, shape (k,), m or rad
        Added to the positions.
    changes : tuple of (str, str)
        What is read differently: its kind, as `misstep.recordings.equations.Fit` has it, and words.
    """

    positions: Array
    offsets: Array
    velocities: Array
    accelerations: Array
    changes: tuple[tuple[str, str], ...] = ()

    @classmethod
    def as_stated(cls, k: int) -> "Reading":
        """Return the reading of k joints in which everything is as somebody states it."""
        return cls(np.ones(k), np.zeros(k), np.ones(k), np.ones(k))

    def __call__(self, rows: Rows) -> Rows:
        """Return rows as they are in this reading."""
        return Rows(
            self.positions * rows.positions + self.offsets,
            self.velocities * rows.velocities,
            self.accelerations * rows.accelerations,
        )

    def with_joint(
        self, j: int, scale: float, offset: float, *changes: tuple[str, str]
    ) -> "Reading":
        """Read joint j in another unit, with another sign or zero as well."""
        scales = np.ones(len(self.positions))
        scales[j] = scale
        offsets = scales * self.offsets
        offsets[j] += offset
        return Reading(
            scales * self.positions,
            offsets,
            scales * self.velocities,
            scales * self.accelerations,
            self.changes + changes,
        )

    def with_rate(self, factor: float, change: str, *, of_velocities: bool) -> "Reading":
        """Read it as recorded at `factor` times the rate; recorded velocities are right already."""
        return replace(
            self,
            velocities=self.velocities * (factor if of_velocities else 1.0),
            accelerations=self.accelerations * (factor**2 if of_velocities else factor),
            changes=(*self.changes, ("rate", change)),
        )


def readings(slopes: Array, mechanics: Mechanics, dt: float) -> Iterator[Reading]:
    """Yield every combination of units, signs and zeros that people use."""
    options = [
        list(_of_angle(j, mechanics.positions)) if turns else list(_of_distance(j, name))
        for j, (name, turns) in enumerate(zip(mechanics.positions, mechanics.turns, strict=True))
    ]
    for base in _consistent(slopes, mechanics, dt):
        for choice in product(*options):
            reading = base
            for j, scale, offset, changes in choice:
                reading = reading.with_joint(j, scale, offset, *changes)
            yield reading


_Option = tuple[int, float, float, list[tuple[str, str]]]
"""Joint, scale, offset, and what that is in words."""


def _of_angle(j: int, names: Sequence[str]) -> Iterator[_Option]:
    # Where only relative signs matter, nobody knows whose is wrong.
    name, any_of = names[j], " or ".join([names[j], *(n for n in names if n != names[j])])
    for degrees, flipped, hanging in product((False, True), repeat=3):
        changes = []
        if degrees:
            changes.append(("units", f"{name} in deg"))
        if flipped:
            changes.append(("mapping", f"{any_of} with the opposite sign"))
        if hanging:
            changes.append(("mapping", f"the zero of {name} half a turn away"))
        scale = (-1.0 if flipped else 1.0) * (DEGREE if degrees else 1.0)
        yield j, scale, np.pi if hanging else 0.0, changes


def _of_distance(j: int, name: str) -> Iterator[_Option]:
    yield j, 1.0, 0.0, []
    for unit, size in (("cm", 0.01), ("mm", 0.001)):
        yield j, size, 0.0, [("units", f"{name} in {unit}")]


def _consistent(slopes: Array, mechanics: Mechanics, dt: float) -> Iterator[Reading]:
    """Yield readings in which velocities are those of their positions."""
    k = len(slopes)
    as_stated = Reading.as_stated(k)
    wrong = [j for j in range(k) if abs(slopes[j] - 1.0) > SLOPE_TOLERANCE]
    if not wrong:
        yield as_stated
        return
    if one_rate(slopes):
        factor = 1.0 / float(slopes.mean())
        yield as_stated.with_rate(factor, rate_in_words(factor, dt), of_velocities=False)
    for choice in product((False, True), repeat=len(wrong)):
        reading = as_stated
        for j, trust_position in zip(wrong, choice, strict=True):
            scales, velocity = np.ones(k), mechanics.velocities[j]
            if trust_position:
                scales[j] = slopes[j]
                change = ("units", f"{velocity} times {slopes[j]:.4g}")
                reading = replace(
                    reading,
                    velocities=reading.velocities * scales,
                    accelerations=reading.accelerations * scales,
                    changes=(*reading.changes, change),
                )
            else:
                scales[j] = 1.0 / slopes[j]
                change = ("units", f"{mechanics.positions[j]} times {scales[j]:.4g}")
                reading = replace(
                    reading,
                    positions=reading.positions * scales,
                    changes=(*reading.changes, change),
                )
        yield reading


def one_rate(slopes: Array) -> bool:
    """Return whether all velocities are off by one factor, as by a wrong rate."""
    return bool(
        len(slopes) > 1
        and np.isfinite(slopes).all()
        and (slopes > 0).all()
        and np.ptp(slopes) < SLOPE_TOLERANCE * slopes.mean()
    )


def rate_in_words(factor: float, dt: float) -> str:
    """Say that a recording with time dt [s] between rows was made at `factor` times that rate."""
    return f"a rate of {factor / dt:.4g} Hz instead of {1.0 / dt:.4g} Hz"
