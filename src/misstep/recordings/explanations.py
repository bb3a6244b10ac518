"""What would explain a recording better: another reading of its columns, a parameter, a rate.

Each is tried on rows of all episodes together, and kept if it leaves much less unexplained of how
the joints without a motor accelerate.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from misstep.errors import MisstepError
from misstep.parameters import parameter_table
from misstep.recordings.readings import Reading, Rows, rate_in_words, readings
from misstep.systems import System
from misstep.systems.mechanics import Mechanics

Array = NDArray[np.float64]

# Above this there is nothing to look for.
PERFECT = 0.9999
# Another explanation has to leave so much less unexplained, and a parameter to change so much.
BETTER, CHANGED = 3.0, 0.01
# Of explanations about as good, the one with the fewest changes.
AS_GOOD = 1.5
MOST_FITS = 3
# What leaves more than this unexplained is no explanation, however bad the statement is.
MOST_UNEXPLAINED = 0.5
# Parameters are looked for within this factor of their typical size.
PARAMETER_RANGE, PARAMETER_GRID = 30.0, 15
MOST_MINIMA = 2


@dataclass(frozen=True, eq=False)
class Better:
    """A reading, and mechanics, that leave less unexplained.

    Parameters
    ----------
    reading : Reading
    mechanics : Mechanics
    change : str
        What would have to be otherwise, in words.
    kind : str
        As `misstep.recordings.equations.Fit` has it.
    value : float or None
        Of a parameter or a rate, in its unit.
    """

    reading: Reading
    mechanics: Mechanics
    change: str
    kind: str
    value: float | None = None


def compare(
    rows: Rows, mechanics: Mechanics, reading: Reading
) -> tuple[list[float], list[float | None]]:
    """Return the rms residual [m/s² or rad/s²] and R² of each joint without a motor.

    The residual is that of the rows as they were recorded, not in the units of the reading; R² is
    None where nothing moves.
    """
    if not len(rows.positions):
        return [0.0] * len(mechanics.free), [None] * len(mechanics.free)
    read = reading(rows)
    recorded = read.accelerations[:, mechanics.free]
    expected = mechanics.free_accelerations(read.positions, read.velocities, read.accelerations)
    left = ((recorded - expected) ** 2).mean(axis=0)
    spread = recorded.var(axis=0)
    shares = [1.0 - a / b if b > 1e-12 else None for a, b in zip(left, spread, strict=True)]
    # As it was recorded, not in the units of the reading.
    scale = np.abs(reading.accelerations[mechanics.free])
    return list(np.sqrt(left) / scale), shares


def better_fits(
    rows: Rows, system: System, mechanics: Mechanics, slopes: Array, dt: float, *, noise: float
) -> list[Better]:
    """Return what leaves less unexplained in all episodes together, best first.

    Parameters
    ----------
    rows : Rows
        Of all episodes, in which nothing hits anything.
    system : System
        With the parameters that somebody states.
    mechanics : Mechanics
        Of that system.
    slopes : ndarray, shape (k,)
        Change of each position per change that its velocity says; NaN where none was recorded.
    dt : float, s
    noise : float
        Share of the variance of the accelerations that is noise, which nothing explains.
    """
    as_stated = Reading.as_stated(len(mechanics.positions))
    present = _unexplained(rows, mechanics, as_stated)
    # Noise stays whatever the explanation, and would leave none much better.
    enough = max(1.0 - PERFECT, BETTER * noise)
    if present <= enough:
        return []
    tried = list(readings(slopes, mechanics, dt))
    left = [_unexplained(rows, mechanics, reading) for reading in tried]
    good = [i for i, value in enumerate(left) if value <= AS_GOOD * min(left)]
    best = min(good, key=lambda i: (len(tried[i].changes), left[i]))
    reading, found = as_stated, []
    if left[best] < min(present / BETTER, MOST_UNEXPLAINED):
        reading, present = tried[best], left[best]
        kinds = [kind for kind, _ in reading.changes]
        change = " and ".join(text for _, text in reading.changes)
        found.append(Better(reading, mechanics, change, kinds[0]))
    if present <= enough:
        return found
    fits = _parameter_fits(rows, system, mechanics, reading, present)
    if np.isnan(slopes).any():
        fits = _rate_fits(rows, mechanics, reading, present, dt) + fits
    least = min((value for value, _ in fits), default=0.0)
    return [fit for value, fit in fits if value <= BETTER * least][:MOST_FITS] + found


def _unexplained(rows: Rows, mechanics: Mechanics, reading: Reading) -> float:
    """Return the largest share of a free joint's acceleration that is left unexplained."""
    shares = compare(rows, mechanics, reading)[1]
    most = max((1.0 - share for share in shares if share is not None), default=0.0)
    return most if math.isfinite(most) else math.inf  # of a mass of 10³⁰⁸ kg


def _parameter_fits(
    rows: Rows, system: System, mechanics: Mechanics, reading: Reading, present: float
) -> list[tuple[float, Better]]:
    """Return how each parameter alone would fit better, with what it leaves unexplained."""
    fits = []
    units = {row.name: row.unit for row in parameter_table(system.parameters_type)}
    for name, typical in mechanics.typical.items():

        def left(log_factor: float, name: str = name, typical: float = typical) -> float:
            changed = _changed(system, name, typical * float(np.exp(log_factor)))
            return np.inf if changed is None else _unexplained(rows, changed, reading)

        stated = float(system.parameters[name])
        best, value = _minimum(left, typical, stated)
        value = _or_none(system, name, value, typical, rows, reading, best)
        changed = _changed(system, name, value)
        if changed is None or best >= min(present / BETTER, MOST_UNEXPLAINED):
            continue
        if abs(value - stated) <= CHANGED * max(abs(stated), 1e-12):
            continue
        unit = units[name]
        text = f"{name} {value:.3g} {unit} instead of {stated:.3g} {unit}"
        change = " and ".join([text for _, text in reading.changes] + [text])
        fits.append((best, Better(reading, changed, change, "parameter", value)))
    return fits


def _or_none(
    system: System,
    name: str,
    value: float,
    typical: float,
    rows: Rows,
    reading: Reading,
    best: float,
) -> float:
    """Return 0 for the smallest of values if that is as good: no damping."""
    if value > 2.0 * typical / PARAMETER_RANGE:
        return value
    without = _changed(system, name, 0.0)
    good = without is not None and _unexplained(rows, without, reading) <= AS_GOOD * best
    return 0.0 if good else value


def _rate_fits(
    rows: Rows, mechanics: Mechanics, reading: Reading, present: float, dt: float
) -> list[tuple[float, Better]]:
    """Return how another rate would fit, where velocities were not recorded."""

    def left(log_factor: float) -> float:
        changed = reading.with_rate(float(np.exp(log_factor)), "", of_velocities=True)
        return _unexplained(rows, mechanics, changed)

    best, factor = _minimum(left, 1.0, 1.0)
    if best >= min(present / BETTER, MOST_UNEXPLAINED) or abs(factor - 1.0) <= CHANGED:
        return []
    changed = reading.with_rate(factor, rate_in_words(factor, dt), of_velocities=True)
    change = " and ".join(text for _, text in changed.changes)
    return [(best, Better(changed, mechanics, change, "rate", factor / dt))]


def _minimum(left: Callable[[float], float], typical: float, stated: float) -> tuple[float, float]:
    """Return the least of `left(log(value / typical))` and the value there.

    Of several minima about as low, the one nearest to the value that was stated.
    """
    end = np.log(PARAMETER_RANGE)
    grid = np.linspace(-end, end, PARAMETER_GRID)
    values = np.array([left(point) for point in grid])
    around = np.concatenate([[np.inf], values, [np.inf]])
    minima = [(np.inf, stated or typical)]
    dips = np.flatnonzero((values < around[:-2]) & (values <= around[2:]))
    for i in dips[np.argsort(values[dips])][:MOST_MINIMA]:
        bounds = (grid[max(i - 1, 0)], grid[min(i + 1, len(grid) - 1)])
        found = minimize_scalar(left, bounds=bounds, method="bounded", options={"xatol": 1e-4})
        minima.append((float(found.fun), typical * float(np.exp(found.x))))
    least = min(value for value, _ in minima)
    near = [minimum for minimum in minima if minimum[0] <= AS_GOOD * least]
    return min(near, key=lambda minimum: abs(np.log(minimum[1] / (stated or typical))))


def _changed(system: System, name: str, value: float) -> Mechanics | None:
    """Return the mechanics with another parameter; None where the system does not allow it."""
    try:
        return system.mechanics(**{name: value})
    except MisstepError:
        return None
