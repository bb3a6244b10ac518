"""Does a recording obey the system's equations? Where no action enters them, it must.

No motor turns the hinge of a cart-pole: how the pole accelerates follows from the cart's motion,
whatever pushed the cart. So the parameters, signs and units that somebody states can be held
against a recording before anything is learned from it, also one without actions. In general: at
the joints without a motor the generalised forces of inverse dynamics must vanish.

motion → acceleration expected at the free joints → R² against the one recorded; where it is poor,
each thing that people get wrong is tried in turn: units, signs, the zero of an angle, the rate, a
parameter.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.optimize import minimize_scalar

from misstep.errors import MisstepError
from misstep.parameters import parameter_table
from misstep.recordings.inverse_dynamics import findings_of
from misstep.recordings.motion import Finding, Joints, Motion
from misstep.systems import System
from misstep.systems.mechanics import Mechanics
from misstep.trajectory import Trajectory

Array = NDArray[np.float64]

GOOD = 0.95
"""R² from which on the equations are taken to hold."""

# Above this there is nothing to look for.
PERFECT = 0.9999
# Another explanation has to leave so much less unexplained, and a parameter to change so much.
BETTER, CHANGED = 3.0, 0.01
# Of explanations about as good, the one with the fewest changes.
AS_GOOD = 1.5
MOST_FITS = 3
# Rows of an episode that R² is taken over, and of all episodes together that other explanations
# are tried on.
EPISODE_ROWS, SAMPLE_ROWS = 2000, 400
# An acceleration this many times the 95th percentile is a blow, and no test of an equation.
BLOW = 6.0
# The check can do with less detail than an action, and so with less noise.
SMOOTHING = 0.01  # s, on either side
# A velocity that differs by less than this from the change of its position is that.
SLOPE_TOLERANCE = 0.05
# Parameters are looked for within this factor of their typical size.
PARAMETER_RANGE, PARAMETER_GRID = 30.0, 15
MOST_MINIMA = 2
_DEGREE = np.pi / 180.0


@dataclass(frozen=True)
class Fit:
    """Something else that the recording agrees with better.

    Parameters
    ----------
    change : str
        What would have to be otherwise: ``"half_length 0.8 m instead of 1 m"``.
    kind : str
        ``"units"``, ``"mapping"``, ``"rate"`` or ``"parameter"``.
    r_squared : float
        Of the episode, with the change.
    value : float or None
        Of a parameter or a rate, in its unit.
    """

    change: str
    kind: str
    r_squared: float
    value: float | None = None


@dataclass(frozen=True)
class EquationCheck:
    """How one episode agrees with the equation of one joint without a motor.

    Parameters
    ----------
    episode : int
    column : str
        The joint's position.
    unit : str
        Of its acceleration.
    residual : float
        Root mean square of recorded minus expected acceleration, in `unit`.
    r_squared : float or None
        Share of the acceleration's variance that the equation explains; None where nothing moves.
    fits : tuple of Fit
        What would explain it better, best first.
    findings : tuple of Finding
        Bad samples, blows, stops; velocities that do not belong to their positions.
    """

    episode: int
    column: str
    unit: str
    residual: float
    r_squared: float | None
    fits: tuple[Fit, ...]
    findings: tuple[Finding, ...]

    @property
    def holds(self) -> bool:
        """Whether the equation explains at least 95 % of the acceleration's variance."""
        return self.r_squared is not None and self.r_squared >= GOOD

    @property
    def sentences(self) -> tuple[str, ...]:
        """What was found, a sentence each."""
        return (self._verdict, *(finding.sentence for finding in self.findings))

    @property
    def _verdict(self) -> str:
        if self.r_squared is None:
            return f"{self.column} does not accelerate: its equation cannot be checked"
        verdict = (
            f"the equation of {self.column} {'holds' if self.holds else 'does not hold'}: "
            f"R² {_share(self.r_squared)}, residual {self.residual:.3g} {self.unit}"
        )
        better = ", or ".join(f"{fit.change} (R² {_share(fit.r_squared)})" for fit in self.fits)
        if better:
            return f"{verdict}; it fits better with {better}"
        if not self.holds:
            return f"{verdict}; no unit, sign, zero, rate or parameter that was tried explains it"
        return verdict


def check_equations(trajectories: Iterable[Trajectory], system: System) -> list[EquationCheck]:
    """Hold recordings against those equations of a system that no action enters.

    Parameters
    ----------
    trajectories : iterable of Trajectory
        Such as a `Dataset`; their actions do not matter. With the system's columns, of which
        velocities may be missing.
    system : System
        With the parameters that somebody states.

    Returns
    -------
    checks : list of EquationCheck
        One for each episode and joint without a motor; empty where every joint has one.

    Raises
    ------
    MisstepError
        If the system cannot be run backwards, or a recording is not of it: see
        `misstep.recordings.inverse_dynamics.inverse_dynamics`.

    Notes
    -----
    What no free joint feels cannot be checked without the actions: for a cart-pole the mass of
    the cart, and that of the pole as long as its inertia is that of a rod.
    """
    system = system.unwrapped
    mechanics = system.mechanics()
    if not len(mechanics.free):
        return []
    recordings = [_Recording.of(trajectory, system, mechanics) for trajectory in trajectories]
    fits = _better_fits(recordings, system, mechanics)
    return [
        check
        for episode, recording in enumerate(recordings)
        for check in _checks(episode, recording, system, mechanics, fits)
    ]


@dataclass(frozen=True, eq=False)
class _Rows:
    """Positions, velocities, accelerations (T, k) of the joints."""

    positions: Array
    velocities: Array
    accelerations: Array

    def at(self, rows: Any) -> "_Rows":
        return _Rows(self.positions[rows], self.velocities[rows], self.accelerations[rows])


@dataclass(frozen=True, eq=False)
class _Recording:
    """One episode: its motion, which rows of it can test an equation, and what was found."""

    dt: float
    rows: _Rows
    usable: NDArray[np.bool_]
    noise: Array
    slopes: Array
    """Change of each position per change that its velocity says; NaN where there is none."""
    findings: tuple[Finding, ...]
    blows: tuple[Finding, ...]

    @classmethod
    def of(cls, trajectory: Trajectory, system: System, mechanics: Mechanics) -> "_Recording":
        dt = trajectory.dt
        joints = Joints.of(trajectory.observations, trajectory.observation_columns, dt, system)
        width = joints.half_width(dt)
        smooth = max(width, round(SMOOTHING / dt))
        smooth = smooth if smooth > 1 and 4 * smooth < len(joints.positions) else width
        motion = joints.motion(dt, smooth)
        rows = _Rows(motion.positions, motion.velocities, motion.accelerations)
        slopes = np.array(
            [
                _slope(np.diff(joints.positions[:, j]) / dt, recorded)
                for j, recorded in enumerate(joints.velocities)
            ]
        )
        blows = findings_of(joints.motion(dt, width), system, dt)
        usable = _usable(motion, mechanics, smooth, dt)
        return cls(dt, rows, usable, motion.noise, slopes, joints.findings, blows)


@dataclass(frozen=True, eq=False)
class _Reading:
    """Another way to read the columns: positions · s + offset, velocities · v, accelerations · a.

    `changes` says in words what is read differently, each with its kind.
    """

    positions: Array
    offsets: Array
    velocities: Array
    accelerations: Array
    changes: tuple[tuple[str, str], ...] = ()

    @classmethod
    def as_stated(cls, k: int) -> "_Reading":
        return cls(np.ones(k), np.zeros(k), np.ones(k), np.ones(k))

    def __call__(self, rows: _Rows) -> _Rows:
        return _Rows(
            self.positions * rows.positions + self.offsets,
            self.velocities * rows.velocities,
            self.accelerations * rows.accelerations,
        )

    def with_joint(
        self, j: int, scale: float, offset: float, *changes: tuple[str, str]
    ) -> "_Reading":
        """Read joint j in another unit, with another sign or zero as well."""
        scales = np.ones(len(self.positions))
        scales[j] = scale
        offsets = scales * self.offsets
        offsets[j] += offset
        return _Reading(
            scales * self.positions,
            offsets,
            scales * self.velocities,
            scales * self.accelerations,
            self.changes + changes,
        )

    def with_rate(self, factor: float, change: str, *, of_velocities: bool) -> "_Reading":
        """Read it as recorded at `factor` times the rate; recorded velocities are right already."""
        return replace(
            self,
            velocities=self.velocities * (factor if of_velocities else 1.0),
            accelerations=self.accelerations * (factor**2 if of_velocities else factor),
            changes=(*self.changes, ("rate", change)),
        )


@dataclass(frozen=True, eq=False)
class _Better:
    """A reading, and mechanics, that leave less unexplained."""

    reading: _Reading
    mechanics: Mechanics
    change: str
    kind: str
    value: float | None = None


def _checks(
    episode: int,
    recording: _Recording,
    system: System,
    mechanics: Mechanics,
    better: Sequence[_Better],
) -> Iterator[EquationCheck]:
    rows = _thinned(recording.rows.at(recording.usable), EPISODE_ROWS)
    as_stated = _Reading.as_stated(len(mechanics.positions))
    residuals, shares = _compare(rows, mechanics, as_stated)
    others = [_compare(rows, other.mechanics, other.reading)[1] for other in better]
    units = {column.name: column.unit for column in system.observation_columns}
    for f, joint in enumerate(mechanics.free):
        share = shares[f]
        fits = tuple(
            Fit(other.change, other.kind, r_squared[f] or 0.0, other.value)
            for other, r_squared in zip(better, others, strict=True)
            if _is_better(r_squared[f], share)
        )
        name = mechanics.positions[joint]
        # Where units are wrong, forces mean nothing.
        blows = recording.blows if share is not None and share >= GOOD else ()
        stated = _velocity_findings(recording, mechanics)
        yield EquationCheck(
            episode,
            name,
            f"{units[name]}/s²",
            residuals[f],
            share,
            fits,
            (*stated, *recording.findings, *blows),
        )


def _is_better(r_squared: float | None, stated: float | None) -> bool:
    return (
        r_squared is not None and stated is not None and 1.0 - r_squared < (1.0 - stated) / BETTER
    )


def _compare(
    rows: _Rows, mechanics: Mechanics, reading: _Reading
) -> tuple[list[float], list[float | None]]:
    """Return the rms residual and R² (None where nothing moves) of each free joint."""
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


def _better_fits(
    recordings: Sequence[_Recording], system: System, mechanics: Mechanics
) -> list[_Better]:
    """Return what leaves less unexplained in all recordings together, best first."""
    rows = _sample(recordings)
    as_stated = _Reading.as_stated(len(mechanics.positions))
    present = _unexplained(rows, mechanics, as_stated)
    # Noise stays whatever the explanation, and would leave none much better.
    enough = max(1.0 - PERFECT, BETTER * _noise_share(recordings, rows, mechanics))
    if present <= enough:
        return []
    slopes = np.median([recording.slopes for recording in recordings], axis=0)
    readings = list(_readings(slopes, mechanics, recordings[0].dt))
    left = [_unexplained(rows, mechanics, reading) for reading in readings]
    good = [i for i, value in enumerate(left) if value <= AS_GOOD * min(left)]
    best = min(good, key=lambda i: (len(readings[i].changes), left[i]))
    reading, found = as_stated, []
    if left[best] < present / BETTER:
        reading, present = readings[best], left[best]
        kinds = [kind for kind, _ in reading.changes]
        change = " and ".join(text for _, text in reading.changes)
        found.append(_Better(reading, mechanics, change, kinds[0]))
    if present <= enough:
        return found
    fits = _parameter_fits(rows, system, mechanics, reading, present)
    if np.isnan(slopes).any():
        fits = _rate_fits(rows, mechanics, reading, present, recordings[0].dt) + fits
    least = min((value for value, _ in fits), default=0.0)
    return [fit for value, fit in fits if value <= BETTER * least][:MOST_FITS] + found


def _unexplained(rows: _Rows, mechanics: Mechanics, reading: _Reading) -> float:
    """Return the largest share of a free joint's acceleration that is left unexplained."""
    shares = _compare(rows, mechanics, reading)[1]
    return max((1.0 - share for share in shares if share is not None), default=0.0)


def _noise_share(recordings: Sequence[_Recording], rows: _Rows, mechanics: Mechanics) -> float:
    """Return the least share of a free joint's acceleration that is noise."""
    noise = np.median([recording.noise for recording in recordings], axis=0)[mechanics.free]
    spread = rows.accelerations[:, mechanics.free].var(axis=0)
    return float(np.min(noise**2 / np.maximum(spread, 1e-12)))


def _sample(recordings: Sequence[_Recording]) -> _Rows:
    """Return evenly spaced usable rows of all recordings."""
    parts = [recording.rows.at(recording.usable) for recording in recordings]
    together = _Rows(
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("positions", "velocities", "accelerations")
        )
    )
    return _thinned(together, SAMPLE_ROWS)


def _thinned(rows: _Rows, most: int) -> _Rows:
    """Return at most `most` of the rows, evenly spaced."""
    count = len(rows.positions)
    return rows.at(np.linspace(0, count - 1, min(count, most)).astype(int))


def _readings(slopes: Array, mechanics: Mechanics, dt: float) -> Iterator[_Reading]:
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
        scale = (-1.0 if flipped else 1.0) * (_DEGREE if degrees else 1.0)
        yield j, scale, np.pi if hanging else 0.0, changes


def _of_distance(j: int, name: str) -> Iterator[_Option]:
    yield j, 1.0, 0.0, []
    for unit, size in (("cm", 0.01), ("mm", 0.001)):
        yield j, size, 0.0, [("units", f"{name} in {unit}")]


def _consistent(slopes: Array, mechanics: Mechanics, dt: float) -> Iterator[_Reading]:
    """Yield readings in which velocities are those of their positions."""
    k = len(slopes)
    as_stated = _Reading.as_stated(k)
    wrong = [j for j in range(k) if abs(slopes[j] - 1.0) > SLOPE_TOLERANCE]
    if not wrong:
        yield as_stated
        return
    if _one_rate(slopes):
        factor = 1.0 / float(slopes.mean())
        yield as_stated.with_rate(factor, _rate(factor, dt), of_velocities=False)
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


def _parameter_fits(
    rows: _Rows, system: System, mechanics: Mechanics, reading: _Reading, present: float
) -> list[tuple[float, _Better]]:
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
        if changed is None or best >= present / BETTER:
            continue
        if abs(value - stated) <= CHANGED * max(abs(stated), 1e-12):
            continue
        unit = units[name]
        text = f"{name} {value:.3g} {unit} instead of {stated:.3g} {unit}"
        change = " and ".join([text for _, text in reading.changes] + [text])
        fits.append((best, _Better(reading, changed, change, "parameter", value)))
    return fits


def _or_none(
    system: System,
    name: str,
    value: float,
    typical: float,
    rows: _Rows,
    reading: _Reading,
    best: float,
) -> float:
    """Return 0 for the smallest of values if that is as good: no damping."""
    if value > 2.0 * typical / PARAMETER_RANGE:
        return value
    without = _changed(system, name, 0.0)
    good = without is not None and _unexplained(rows, without, reading) <= AS_GOOD * best
    return 0.0 if good else value


def _rate_fits(
    rows: _Rows, mechanics: Mechanics, reading: _Reading, present: float, dt: float
) -> list[tuple[float, _Better]]:
    """Return how another rate would fit, where velocities were not recorded."""

    def left(log_factor: float) -> float:
        changed = reading.with_rate(float(np.exp(log_factor)), "", of_velocities=True)
        return _unexplained(rows, mechanics, changed)

    best, factor = _minimum(left, 1.0, 1.0)
    if best >= present / BETTER or abs(factor - 1.0) <= CHANGED:
        return []
    changed = reading.with_rate(factor, _rate(factor, dt), of_velocities=True)
    change = " and ".join(text for _, text in changed.changes)
    return [(best, _Better(changed, mechanics, change, "rate", factor / dt))]


def _minimum(left: Callable[[float], float], typical: float, stated: float) -> tuple[float, float]:
    """Return the least of `left(log(value / typical))` and the value there.

    Of several minima about as low, the one nearest to the value that was stated.
    """
    end = np.log(PARAMETER_RANGE)
    grid = np.linspace(-end, end, PARAMETER_GRID)
    values = np.array([left(point) for point in grid])
    around = np.concatenate([[np.inf], values, [np.inf]])
    minima = []
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


def _usable(motion: Motion, mechanics: Mechanics, smooth: int, dt: float) -> NDArray[np.bool_]:
    """Return the rows (T,) in which nothing hits anything."""
    size = np.abs(motion.accelerations)
    blow = (size > BLOW * np.percentile(size, 95.0, axis=0) + BLOW * motion.noise).any(axis=1)
    low, high = mechanics.stops.T
    blow |= ((motion.positions < low) | (motion.positions > high)).any(axis=1)
    for finding in motion.findings:
        if finding.time is not None:
            blow[min(round(finding.time / dt), len(blow) - 1)] = True
    usable: NDArray[np.bool_] = (
        ~binary_dilation(blow, iterations=smooth + 2) if blow.any() else ~blow
    )
    return usable


def _slope(changes: Array, recorded: Array | None) -> float:
    """Return the change of a position per change that its velocity says; NaN if unknown."""
    if recorded is None:
        return np.nan
    velocities = 0.5 * (recorded[1:] + recorded[:-1])
    moving = np.abs(velocities) > np.sqrt(np.mean(velocities**2))
    if not moving.any():
        return 1.0
    return float(np.median(changes[moving] / velocities[moving]))


def _one_rate(slopes: Array) -> bool:
    """Return whether all velocities are off by one factor, as by a wrong rate."""
    return bool(
        len(slopes) > 1
        and np.isfinite(slopes).all()
        and (slopes > 0).all()
        and np.ptp(slopes) < SLOPE_TOLERANCE * slopes.mean()
    )


def _velocity_findings(recording: _Recording, mechanics: Mechanics) -> list[Finding]:
    """Say which velocities are not the change of their positions."""
    slopes = recording.slopes
    wrong = [j for j in range(len(slopes)) if abs(slopes[j] - 1.0) > SLOPE_TOLERANCE]
    if wrong and _one_rate(slopes):
        factor = 1.0 / float(slopes.mean())
        sentence = (
            f"all positions change {1.0 / factor:.4g} times as fast as their velocities say: "
            f"{_rate(factor, recording.dt)}"
        )
        return [Finding("rate", sentence, None, factor / recording.dt)]
    return [
        Finding(
            "units",
            f"{mechanics.positions[j]} changes {slopes[j]:.4g} times as fast as "
            f"{mechanics.velocities[j]} says{_reason(slopes[j])}",
            None,
            float(slopes[j]),
        )
        for j in wrong
    ]


def _reason(slope: float) -> str:
    reasons = (
        (-1.0, "one of them has the opposite sign"),
        (1.0 / _DEGREE, "one is in degrees, the other in radians"),
        (_DEGREE, "one is in radians, the other in degrees"),
        (-1.0 / _DEGREE, "one is in degrees, the other in radians, with the opposite sign"),
        (-_DEGREE, "one is in radians, the other in degrees, with the opposite sign"),
        (1000.0, "one is in mm, the other in m"),
        (0.001, "one is in m, the other in mm"),
        (100.0, "one is in cm, the other in m"),
        (0.01, "one is in m, the other in cm"),
    )
    for value, reason in reasons:
        if abs(slope / value - 1.0) < SLOPE_TOLERANCE:
            return f": {reason}"
    return ""


def _rate(factor: float, dt: float) -> str:
    return f"a rate of {factor / dt:.4g} Hz instead of {1.0 / dt:.4g} Hz"


def _share(r_squared: float) -> str:
    return f"{r_squared:.4f}" if r_squared > 0.99 else f"{r_squared:.2f}"
