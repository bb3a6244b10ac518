"""Does a recording obey the system's equations? Where no action enters them, it must.

No motor turns the hinge of a cart-pole: how the pole accelerates follows from the cart's motion,
whatever pushed the cart. So the parameters, signs and units that somebody states can be held
against a recording before anything is learned from it, also one without actions. In general: at
the joints without a motor the generalised forces of inverse dynamics must vanish.

motion → acceleration expected at the free joints → R² against the one recorded; where it is poor,
each thing that people get wrong is tried in turn: units, signs, the zero of an angle, the rate, a
parameter.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from misstep.recordings.explanations import BETTER, Better, better_fits, compare
from misstep.recordings.inverse_dynamics import findings_of
from misstep.recordings.motion import Finding, Joints, Motion
from misstep.recordings.readings import (
    DEGREE,
    SLOPE_TOLERANCE,
    Reading,
    Rows,
    one_rate,
    rate_in_words,
)
from misstep.systems import System
from misstep.systems.mechanics import Mechanics
from misstep.trajectory import Trajectory

Array = NDArray[np.float64]

GOOD = 0.95
"""R² from which on the equations are taken to hold."""

# Rows of an episode that R² is taken over, and of all episodes together that other explanations
# are tried on.
EPISODE_ROWS, SAMPLE_ROWS = 2000, 400
# An acceleration this many times the 95th percentile is a blow, and no test of an equation.
BLOW = 6.0
# The check can do with less detail than an action, and so with less noise.
SMOOTHING = 0.01  # s, on either side
# What rises so evenly, as a share of its steps, is no motion but a clock.
CLOCK_TOLERANCE = 0.01


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
        Share of the acceleration's variance that the equation explains; None where nothing moves,
        or only in blows and beyond the stops.
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
        return self.r_squared is not None and bool(self.r_squared >= GOOD)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What was found, a sentence each."""
        return (self._verdict, *(finding.sentence for finding in self.findings))

    @property
    def _verdict(self) -> str:
        if self.r_squared is None:
            return (
                f"{self.column} does not accelerate where nothing is hit: its equation cannot be "
                "checked"
            )
        verdict = (
            f"the equation of {self.column} {'holds' if self.holds else 'does not hold'}: "
            f"R² {_share(self.r_squared)}, residual {self.residual:.3g} {self.unit}"
        )
        better = [f"{fit.change} (R² {_share(fit.r_squared)})" for fit in self.fits]
        return explained(verdict, self.holds, better)


def explained(verdict: str, holds: bool, better: Sequence[str]) -> str:
    """Return a verdict with what fits better, or that nothing explains what does not hold."""
    if better:
        return f"{verdict}; it fits better with {', or '.join(better)}"
    if not holds:
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
    rows = _sample(recordings)
    fits = better_fits(
        rows,
        system,
        mechanics,
        np.median([recording.slopes for recording in recordings], axis=0),
        recordings[0].dt,
        noise=_noise_share(recordings, rows, mechanics),
    )
    return [
        check
        for episode, recording in enumerate(recordings)
        for check in _checks(episode, recording, system, mechanics, fits)
    ]


@dataclass(frozen=True, eq=False)
class _Recording:
    """One episode: its motion, which rows of it can test an equation, and what was found."""

    dt: float
    rows: Rows
    usable: NDArray[np.bool_]
    noise: Array
    slopes: Array
    """Change of each position per change that its velocity says; NaN where there is none."""
    findings: tuple[Finding, ...]
    blows: tuple[Finding, ...]
    clock: int | None
    """The joint whose position rises like a clock, if one does."""

    @classmethod
    def of(cls, trajectory: Trajectory, system: System, mechanics: Mechanics) -> "_Recording":
        dt = trajectory.dt
        joints = Joints.of(trajectory.observations, trajectory.observation_columns, dt, system)
        width = joints.half_width(dt)
        smooth = max(width, round(SMOOTHING / dt))
        smooth = smooth if smooth > 1 and 4 * smooth < len(joints.positions) else width
        motion = joints.motion(dt, smooth)
        rows = Rows(motion.positions, motion.velocities, motion.accelerations)
        slopes = np.array(
            [
                _slope(np.diff(joints.positions[:, j]) / dt, recorded)
                for j, recorded in enumerate(joints.velocities)
            ]
        )
        blows = findings_of(joints.motion(dt, width), system, dt)
        usable = _usable(motion, mechanics, smooth, dt)
        clock = next((j for j, c in enumerate(joints.positions.T) if _is_clock(c)), None)
        return cls(dt, rows, usable, motion.noise, slopes, joints.findings, blows, clock)


def _checks(
    episode: int,
    recording: _Recording,
    system: System,
    mechanics: Mechanics,
    better: Sequence[Better],
) -> Iterator[EquationCheck]:
    rows = _thinned(recording.rows.at(recording.usable), EPISODE_ROWS)
    as_stated = Reading.as_stated(len(mechanics.positions))
    residuals, shares = compare(rows, mechanics, as_stated)
    others = [compare(rows, other.mechanics, other.reading)[1] for other in better]
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


def _is_clock(positions: Array) -> bool:
    """Return whether positions rise evenly from the first row to the last."""
    steps = np.diff(positions)
    return bool(steps.min() > 0.0 and np.ptp(steps) < CLOCK_TOLERANCE * steps.mean())


def _slope(changes: Array, recorded: Array | None) -> float:
    """Return the change of a position per change that its velocity says; NaN if unknown."""
    if recorded is None:
        return np.nan
    velocities = 0.5 * (recorded[1:] + recorded[:-1])
    moving = np.abs(velocities) > np.sqrt(np.mean(velocities**2))
    if not moving.any():
        return 1.0
    return float(np.median(changes[moving] / velocities[moving]))


def _velocity_findings(recording: _Recording, mechanics: Mechanics) -> list[Finding]:
    """Say which velocities are not the change of their positions."""
    if recording.clock is not None:
        name = mechanics.positions[recording.clock]
        sentence = f"{name} rises evenly from row to row, as times do: name the column with --time"
        return [Finding("mapping", sentence, None, None)]
    slopes = recording.slopes
    wrong = [j for j in range(len(slopes)) if abs(slopes[j] - 1.0) > SLOPE_TOLERANCE]
    if wrong and one_rate(slopes):
        factor = 1.0 / float(slopes.mean())
        sentence = (
            f"all positions change {1.0 / factor:.4g} times as fast as their velocities say: "
            f"{rate_in_words(factor, recording.dt)}"
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
        (1.0 / DEGREE, "one is in degrees, the other in radians"),
        (DEGREE, "one is in radians, the other in degrees"),
        (-1.0 / DEGREE, "one is in degrees, the other in radians, with the opposite sign"),
        (-DEGREE, "one is in radians, the other in degrees, with the opposite sign"),
        (1000.0, "one is in mm, the other in m"),
        (0.001, "one is in m, the other in mm"),
        (100.0, "one is in cm, the other in m"),
        (0.01, "one is in m, the other in cm"),
    )
    for value, reason in reasons:
        if abs(slope / value - 1.0) < SLOPE_TOLERANCE:
            return f": {reason}"
    return ""


def _share(r_squared: float) -> str:
    return f"{r_squared:.4f}" if r_squared > 0.99 else f"{r_squared:.2f}"


def _noise_share(recordings: Sequence[_Recording], rows: Rows, mechanics: Mechanics) -> float:
    """Return the least share of a free joint's acceleration that is noise; 0 without rows."""
    if not len(rows.accelerations):
        return 0.0
    noise = np.median([recording.noise for recording in recordings], axis=0)[mechanics.free]
    spread = rows.accelerations[:, mechanics.free].var(axis=0)
    return float(np.min(noise**2 / np.maximum(spread, 1e-12)))


def _sample(recordings: Sequence[_Recording]) -> Rows:
    """Return evenly spaced usable rows of all recordings."""
    parts = [recording.rows.at(recording.usable) for recording in recordings]
    together = Rows(
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("positions", "velocities", "accelerations")
        )
    )
    return _thinned(together, SAMPLE_ROWS)


def _thinned(rows: Rows, most: int) -> Rows:
    """Return at most `most` of the rows, evenly spaced."""
    count = len(rows.positions)
    return rows.at(np.linspace(0, count - 1, min(count, most)).astype(int))
