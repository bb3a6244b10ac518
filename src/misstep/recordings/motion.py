"""How the joints of a system moved, from what was recorded: velocities and accelerations.

An acceleration is a difference of velocities, which multiplies the noise of a sensor by the rate.
So the noise is measured first, and the velocities are smoothed (Savitzky-Golay) over the shortest
window that leaves little of it. A bad sample is no motion: it is found, reported, and bridged.

Everything is meant in the middle of a step, between one observation and the next: there the
difference of the two velocities is the acceleration itself, however the force changes from step
to step.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label, median_filter
from scipy.signal import savgol_coeffs, savgol_filter

from misstep.errors import MisstepError
from misstep.systems import System
from misstep.systems.mechanics import Mechanics
from misstep.trajectory import Column

Array = NDArray[np.float64]

FEWEST_ROWS = 8
# Noise may be this share of an acceleration's own spread.
NOISE_SHARE = 0.01
# More would blur what a person's hand does.
LONGEST_WINDOW = 0.08  # s
_HALF_WIDTHS = (0, 2, 3, 4, 6, 8, 12, 16, 24, 32, 40, 48, 64, 96, 128)
_ORDER = 2  # of the polynomial

# A bad sample lasts at most four rows, and stands out by this many of the usual changes from row
# to row around it, and of the noise; and by this share of the column's range.
_SPIKE_ROWS, _AROUND = 9, 21
_SPIKE_CHANGES, _SPIKE_NOISE, _SPIKE_SHARE = 6.0, 8.0, 0.01


@dataclass(frozen=True)
class Finding:
    """Something about a recording that whoever learns from it should know.

    Parameters
    ----------
    kind : str
        ``"spike"``, ``"jolt"``, ``"stop"``, ``"limit"``, ``"units"``, ``"rate"`` or ``"mapping"``.
    sentence : str
        What it is, in words.
    time : float or None, s
        When, from the start of the episode.
    size : float or None
        How large, in the unit that the sentence names.
    """

    kind: str
    sentence: str
    time: float | None = None
    size: float | None = None


@dataclass(frozen=True, eq=False)
class Motion:
    """The joints of a system in the middle of each of T steps.

    Parameters
    ----------
    positions, velocities, accelerations : ndarray, shape (T, k)
        In m or rad, and per s and s².
    half_width : int
        Rows on either side that were smoothed over; 0: none.
    noise : ndarray, shape (k,), m/s² or rad/s²
        Standard deviation of the noise left on the accelerations.
    findings : tuple of Finding
        The bad samples.
    """

    positions: Array
    velocities: Array
    accelerations: Array
    half_width: int
    noise: Array
    findings: tuple[Finding, ...]


@dataclass(frozen=True, eq=False)
class Joints:
    """What was recorded of the joints: a table of positions, and one of velocities.

    Parameters
    ----------
    positions : ndarray, shape (N, k), m or rad
        Angles not wrapped.
    velocities : list of k ndarray, shape (N,), or None
        None where a joint's velocity was not recorded.
    findings : tuple of Finding
        The bad samples, which are bridged in the tables.
    """

    positions: Array
    velocities: list[Array | None]
    findings: tuple[Finding, ...]

    @classmethod
    def of(
        cls, observations: Array, columns: Sequence[Column], dt: float, system: System
    ) -> "Joints":
        """Find the joints of a system among recorded columns, by their names.

        Raises
        ------
        MisstepError
            If a position is missing, a unit is another one, there are too few rows, or a value is
            not finite.
        """
        mechanics = system.unwrapped.mechanics()
        observations = _checked(observations, columns, dt)
        index = {column.name: i for i, column in enumerate(columns)}
        _check_columns(columns, system, mechanics)
        positions = observations[:, [index[name] for name in mechanics.positions]]
        for turning in np.flatnonzero(mechanics.turns):
            positions[:, turning] = _unwrapped(positions[:, turning])
        findings: list[Finding] = []
        for j, name in enumerate(mechanics.positions):
            positions[:, j], found = bridged(positions[:, j], columns[index[name]], dt)
            findings += found
        velocities: list[Array | None] = []
        for name in mechanics.velocities:
            if name in index:
                values, found = bridged(observations[:, index[name]], columns[index[name]], dt)
                velocities.append(values)
                findings += found
            else:
                velocities.append(None)
        return cls(positions, velocities, tuple(findings))

    def half_width(self, dt: float) -> int:
        """Return over how many rows on either side to smooth: as few as the noise allows."""
        longest = (LONGEST_WINDOW / dt - 1.0) / 2.0
        widths = [m for m in _HALF_WIDTHS if m <= longest and 2 * m < len(self.positions)] or [0]
        for half_width in widths:
            motion = self.motion(dt, half_width)
            if np.all(motion.noise <= NOISE_SHARE * _spread(motion.accelerations)):
                return half_width
        return widths[-1]

    def motion(self, dt: float, half_width: int) -> Motion:
        """Return the motion, smoothed over `half_width` rows on either side."""
        velocities = np.empty_like(self.positions)
        noise = np.empty(len(self.velocities))
        for j, recorded in enumerate(self.velocities):
            values = self.positions[:, j] if recorded is None else recorded
            derivative = int(recorded is None)
            velocities[:, j] = _smooth(values, half_width, derivative, dt)
            gain = _noise_gain(half_width, derivative, dt)
            noise[j] = gain * noise_of(values)
        return Motion(
            0.5 * (self.positions[1:] + self.positions[:-1]),
            0.5 * (velocities[1:] + velocities[:-1]),
            np.diff(velocities, axis=0) / dt,
            half_width,
            noise,
            self.findings,
        )


def noise_of(values: Array) -> float:
    """Return the standard deviation of the noise on a recorded column (N,), in its unit.

    From third differences, in which a smooth motion vanishes and white noise grows by √20.
    """
    differences = np.abs(np.diff(values, 3))
    # Coarsely rounded, most differences can be 0; then a rarer one has to tell.
    for share, deviations in ((50.0, 0.6745), (80.0, 1.2816), (95.0, 1.96)):
        typical = float(np.percentile(differences, share))
        if typical > 0:
            return typical / deviations / np.sqrt(20.0)
    return 0.0


def bridged(values: Array, column: Column, dt: float) -> tuple[Array, list[Finding]]:
    """Replace the bad samples of a recorded column (N,) by straight lines, and name them.

    Parameters
    ----------
    values : ndarray, shape (N,), in the column's unit
    column : Column
    dt : float, s

    Returns
    -------
    values : ndarray, shape (N,)
    findings : list of Finding
    """
    deviation = values - median_filter(values, _SPIKE_ROWS, mode="nearest")
    change = np.abs(np.diff(values, prepend=values[0]))
    usual = median_filter(change, _AROUND, mode="nearest")
    low, high = np.percentile(values, [1.0, 99.0])
    threshold = np.maximum(
        _SPIKE_CHANGES * usual + _SPIKE_NOISE * noise_of(values), _SPIKE_SHARE * (high - low)
    )
    bad = np.abs(deviation) > threshold
    if not bad.any():
        return values, []
    runs, count = label(bad)
    findings = []
    for run in range(1, count + 1):
        rows = np.flatnonzero(runs == run)
        row = int(rows[np.argmax(np.abs(deviation[rows]))])
        size = float(deviation[row])
        if _continues(values, rows, row, 0.5 * abs(size)):
            bad[rows] = False
            continue
        length = f"{len(rows)} samples" if len(rows) > 1 else "one sample"
        findings.append(
            Finding(
                "spike",
                f"{column.name} has a spike of {size:+.3g} {column.unit}".rstrip()
                + f" at {row * dt:.3f} s, of {length}",
                row * dt,
                size,
            )
        )
    if not findings:
        return values, []
    good = np.flatnonzero(~bad)
    mended = values.copy()
    mended[bad] = np.interp(np.flatnonzero(bad), good, values[good])
    return mended, findings


def _continues(values: Array, rows: NDArray[np.intp], row: int, tolerance: float) -> bool:
    """Return whether what comes before or after some rows leads straight to one of them.

    So it does where a motion turns within a few rows, as it may at a low rate.
    """
    before, after = int(rows[0]) - 1, int(rows[-1]) + 1
    expected = []
    if before >= 1:
        expected.append(values[before] + (row - before) * (values[before] - values[before - 1]))
    if after + 1 < len(values):
        expected.append(values[after] + (row - after) * (values[after + 1] - values[after]))
    return any(abs(values[row] - value) < tolerance for value in expected)


def _unwrapped(angles: Array) -> Array:
    """Return angles (N,) without jumps of a full turn, also such as are in degrees after all."""
    if np.abs(angles).max() <= 2.0 * np.pi:
        return np.unwrap(angles)
    # A difference of half a turn between rows is one of 180: no pole turns at 180 rad a row.
    return np.unwrap(angles, period=360.0)


def _smooth(values: Array, half_width: int, derivative: int, dt: float) -> Array:
    if half_width == 0:
        return np.gradient(values, dt) if derivative else values
    smoothed: Array = savgol_filter(values, 2 * half_width + 1, _ORDER, deriv=derivative, delta=dt)
    return smoothed


def _noise_gain(half_width: int, derivative: int, dt: float) -> float:
    """Return the noise of an acceleration per noise of the column it is made of."""
    if half_width:
        filtering = savgol_coeffs(2 * half_width + 1, _ORDER, deriv=derivative, delta=dt)
    else:
        filtering = np.array([0.5, 0.0, -0.5]) / dt if derivative else np.ones(1)
    return float(np.linalg.norm(np.convolve(filtering, [1.0, -1.0]))) / dt


def _spread(values: Array) -> Array:
    low, high = np.percentile(values, [16.0, 84.0], axis=0)
    return np.maximum(0.5 * (high - low), 0.25 * np.std(values, axis=0))


def _checked(observations: Array, columns: Sequence[Column], dt: float) -> Array:
    observations = np.array(observations, dtype=np.float64)
    if observations.ndim != 2 or observations.shape[1] != len(columns):
        raise MisstepError(
            f"the observations have shape {observations.shape} but there are {len(columns)} "
            "columns: one row a time, one column a name"
        )
    if len(observations) < FEWEST_ROWS:
        raise MisstepError(
            f"a recording of {len(observations)} rows is too short to tell how it moved: it needs "
            f"at least {FEWEST_ROWS}"
        )
    if not (np.isfinite(dt) and dt > 0):
        raise MisstepError(f"dt is {dt}: it must be a time in s, above 0")
    for i, column in enumerate(columns):
        wrong = np.flatnonzero(~np.isfinite(observations[:, i]))
        if len(wrong):
            row = int(wrong[0])
            raise MisstepError(
                f"column {column.name!r} is {observations[row, i]} in row {row}: it must be finite"
            )
    return observations


def _check_columns(columns: Sequence[Column], system: System, mechanics: Mechanics) -> None:
    recorded = {column.name: column.unit for column in columns}
    missing = [name for name in mechanics.positions if name not in recorded]
    if missing:
        raise MisstepError(
            f"the positions of {system.system_id} are {', '.join(mechanics.positions)}, but the "
            f"recording has no column {missing[0]!r}; it has: {', '.join(recorded)}"
        )
    for column in system.observation_columns:
        unit = recorded.get(column.name, "")
        moving = column.name in mechanics.positions + mechanics.velocities
        if moving and unit not in ("", column.unit):
            raise MisstepError(
                f"column {column.name!r} is in {unit}, but {system.system_id} has it in "
                f"{column.unit}: convert it first"
            )
