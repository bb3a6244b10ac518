"""Actions that a recording lacks, from the motion: inverse dynamics where the system is known.

positions, velocities → accelerations → forces at the joints (MuJoCo's `mj_inverse`) → actions,
clipped to what the actuators can do. Where no system is known, the velocities themselves stand for
the actions: they are the paper's ξ̇.

An action is the mean force over its step. So the mean of the actions over a longer step is the
action of that step, and a recording is brought to a lower rate after this, not before.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.formats.format import Block, Ending, Episode, Header
from misstep.recordings.motion import Finding, Joints, Motion
from misstep.systems import System
from misstep.systems.mechanics import Mechanics
from misstep.trajectory import Column
from misstep.units import TURNS

Array = NDArray[np.float64]

# A force this far beyond the limits is no push of the actuator but a blow, or a wrong parameter.
JOLT = 1.5
# Blows this close to each other are one.
JOLT_GAP = 0.05  # s
# Nearer than this share of its range to a stop, a joint may be held by it.
NEAR_STOP = 0.001
ARRIVAL = 0.02  # s
# Stops give way a little; further beyond than this share of the range there is none.
BEYOND_STOP = 0.01
# Rows of a long recording that are worked on at a time, and that two such parts have in common.
CHUNK_ROWS = 100_000
MARGIN_ROWS = 300
_MOST_NOTES = 5


@dataclass(frozen=True, eq=False)
class InferredActions:
    """Actions that explain a motion.

    Parameters
    ----------
    actions : ndarray, shape (T, m), in the units of the system's action columns
        Clipped to the system's action space.
    forces : ndarray, shape (T, m)
        The same before clipping.
    motion : Motion
        What they were inferred from.
    findings : tuple of Finding
        Bad samples, blows, stops and forces beyond the limits.
    """

    actions: Array
    forces: Array
    motion: Motion
    findings: tuple[Finding, ...]


def inverse_dynamics(
    observations: Array,
    columns: Sequence[Column],
    dt: float,
    system: System,
    *,
    half_width: int | None = None,
) -> InferredActions:
    """Infer the actions of a recording of a known system.

    Parameters
    ----------
    observations : ndarray, shape (T + 1, n), each column in its unit
        Recorded at a high rate, such as 1 kHz.
    columns : sequence of n Column
        Found by their names. A position that turns may be wrapped or not; velocities that were not
        recorded are differences of the positions. Other columns do not matter.
    dt : float, s
        Time between observations; need not be the system's.
    system : System
        With its own parameters: masses, lengths, frictions, limits.
    half_width : int, optional
        Rows on either side to smooth over; as many as the noise needs if left out.

    Returns
    -------
    InferredActions

    Raises
    ------
    MisstepError
        If the system cannot be run backwards, a column is missing or in another unit, there are
        fewer than 8 rows, or a value is not finite.

    Notes
    -----
    A joint against its stop is held by it with a force that the motion does not tell: an action
    inferred there is not the one applied. It is named among the findings.
    """
    mechanics = system.unwrapped.mechanics()
    joints = Joints.of(observations, columns, dt, system)
    width = joints.half_width(dt) if half_width is None else half_width
    motion = joints.motion(dt, width)
    forces = _forces(motion, mechanics, dt)
    space: Any = system.action_space
    actions = np.clip(forces, space.low, space.high)
    findings = (*motion.findings, *_blows(forces, motion, system, mechanics, dt))
    return InferredActions(actions, forces, motion, findings)


def findings_of(motion: Motion, system: System, dt: float) -> tuple[Finding, ...]:
    """Return the blows, the stops and the forces beyond the limits in a motion of a system."""
    mechanics = system.unwrapped.mechanics()
    return _blows(_forces(motion, mechanics, dt), motion, system, mechanics, dt)


def inferring_actions(episode: Episode, system: System) -> Episode:
    """Infer the actions of an episode of a known system on its way, in bounded memory.

    Velocities of the system that were not recorded are added, as the change of their positions.

    Parameters
    ----------
    episode : Episode
        Whatever actions it has are replaced.
    system : System

    Returns
    -------
    Episode
        With the system's action columns, and as of this system. The notes of its ending say what
        was inferred and what was found.

    Raises
    ------
    MisstepError
        As `inverse_dynamics`, or if the rows have no common dt; some of it on the way.
    """
    dt = _even_dt(episode.header)
    columns, found = episode.header.observation_columns, _Found(system)
    missing = _Missing.of(columns, system)

    def blocks() -> Iterator[Block]:
        half_width: int | None = None
        for part in _overlapping(episode.blocks, columns):
            inferred = inverse_dynamics(
                part.observations, columns, dt, system, half_width=half_width
            )
            half_width = inferred.motion.half_width
            found.add(inferred, part, dt)
            whole = missing.added(part.observations, inferred.motion)
            yield Block(whole[part.own_rows], inferred.actions[part.own], part.costs)

    provenance = replace(
        episode.header.provenance, system=system.system_id, parameters=system.parameters
    )
    header = replace(
        episode.header,
        observation_columns=missing.all_columns,
        action_columns=system.action_columns,
        provenance=provenance,
    )
    return replace(
        episode,
        header=header,
        blocks=blocks(),
        ending=lambda: _with_notes(episode.ending(), (*missing.notes, *found.notes(dt))),
    )


@dataclass(frozen=True, eq=False)
class _Missing:
    """The velocities of a system that a recording lacks.

    `joints` are those whose velocity is missing. With them at its end, column `order[i]` of the
    table becomes column i of `all_columns`: as the system has them, where they are all there.
    """

    joints: list[int]
    order: list[int]
    all_columns: tuple[Column, ...]

    @classmethod
    def of(cls, columns: Sequence[Column], system: System) -> "_Missing":
        velocities = system.unwrapped.mechanics().velocities
        recorded = {column.name for column in columns}
        joints = [j for j, name in enumerate(velocities) if name not in recorded]
        known = {column.name: column for column in system.observation_columns}
        everything = [*columns, *(known[velocities[j]] for j in joints)]
        order = list(range(len(everything)))
        names = [column.name for column in everything]
        if joints and set(names) == set(known):
            order = [names.index(name) for name in known]
        return cls(joints, order, tuple(everything[i] for i in order))

    @property
    def notes(self) -> tuple[str, ...]:
        """What is to be noted."""
        recorded = len(self.order) - len(self.joints)
        pairs = zip(self.order, self.all_columns, strict=True)
        names = ", ".join(column.name for place, column in pairs if place >= recorded)
        return (f"{names}: not recorded, the change of their positions",) if names else ()

    def added(self, observations: Array, motion: Motion) -> Array:
        """Return observations (T + 1, n) with the missing columns."""
        if not self.joints:
            return observations
        middle = motion.velocities[:, self.joints]  # of each step
        between = 0.5 * (middle[1:] + middle[:-1])
        velocities = np.concatenate([middle[:1], between, middle[-1:]])
        return np.concatenate([observations, velocities], axis=1)[:, self.order]


def inferring_velocities(episode: Episode, names: Sequence[str] | None = None) -> Episode:
    """Take the velocities of an episode on its way for its actions: the paper's ξ̇.

    An action leads from one observation exactly to the next: o[t+1] = o[t] + dt · a[t].

    Parameters
    ----------
    episode : Episode
        Whatever actions it has are replaced.
    names : sequence of str, optional
        Observation columns whose velocities to take; all if left out. Those in rad or deg wrap.

    Returns
    -------
    Episode
        With an action column ``NAME_dot`` for each, in its unit per second.

    Raises
    ------
    MisstepError
        If there is no such column, or the rows have no common dt.
    """
    dt, columns = _even_dt(episode.header), episode.header.observation_columns
    known = [column.name for column in columns]
    chosen = known if names is None else list(names)
    for name in chosen:
        if name not in known:
            raise MisstepError(
                f"there is no observation column {name!r}; there are: {', '.join(known)}"
            )
    indices = [known.index(name) for name in chosen]
    periods = np.array([TURNS.get(columns[i].unit, 0.0) for i in indices])

    def blocks() -> Iterator[Block]:
        last = np.empty((0, len(columns)))
        for block in episode.blocks:
            rows = np.concatenate([last, block.observations])
            steps = np.diff(rows[:, indices], axis=0)
            turns = np.divide(steps, periods, out=np.zeros_like(steps), where=periods > 0)
            velocities = (steps - np.round(turns) * periods) / dt
            last = rows[-1:]
            yield replace(block, actions=velocities)

    note = "actions: not recorded, the velocities of " + ", ".join(chosen)
    actions = tuple(
        Column(f"{columns[i].name}_dot", f"{columns[i].unit or '1'}/s") for i in indices
    )
    return replace(
        episode,
        header=replace(episode.header, action_columns=actions),
        blocks=blocks(),
        ending=lambda: _with_notes(episode.ending(), (note,)),
    )


@dataclass(frozen=True, eq=False)
class _Part:
    """Rows of a recording, with those before and after that smoothing wants to see.

    `own_rows` and `own` are the observations and actions that this part is to hand on, and
    `start` is its first row in the episode.
    """

    observations: Array
    costs: Array | None
    own_rows: slice
    own: slice
    start: int


def _overlapping(blocks: Iterator[Block], columns: Sequence[Column]) -> Iterator[_Part]:
    """Yield the rows in parts that overlap; an episode of one part has nothing before or after."""
    rows, before, start = np.empty((0, len(columns))), 0, 0
    costs: list[Array] = []

    def part(last: bool) -> _Part:
        end = len(rows) if last else len(rows) - MARGIN_ROWS
        joined = np.concatenate(costs) if costs else None
        costs.clear()
        # The action between the last own row and the next row belongs to this part.
        return _Part(rows, joined, slice(before, end), slice(before, end - last), start)

    for block in blocks:
        rows = np.concatenate([rows, block.observations])
        if block.costs is not None:
            costs.append(block.costs)
        if len(rows) - before >= CHUNK_ROWS + MARGIN_ROWS:
            yield part(last=False)
            dropped = len(rows) - 2 * MARGIN_ROWS
            rows, start, before = rows[dropped:], start + dropped, MARGIN_ROWS
    yield part(last=True)


class _Found:
    """What was found in the parts of an episode, to be said once at its end."""

    def __init__(self, system: System) -> None:
        self._system = system
        self._findings: list[Finding] = []
        self._half_width = 0
        self._steps = 0
        self._clipped = 0
        self._largest = 0.0

    def add(self, inferred: InferredActions, part: _Part, dt: float) -> None:
        """Add what was found in the own rows of a part."""
        self._half_width = inferred.motion.half_width
        forces, actions = inferred.forces[part.own], inferred.actions[part.own]
        self._steps += len(forces)
        self._clipped += int(np.any(forces != actions, axis=1).sum())
        self._largest = max(self._largest, float(np.abs(forces).max(initial=0.0)))
        for finding in inferred.findings:
            row = 0 if finding.time is None else round(finding.time / dt)
            if part.own_rows.start <= row < part.own_rows.stop:
                self._findings.append(_later(finding, part.start * dt))

    def notes(self, dt: float) -> tuple[str, ...]:
        """Return the notes for the provenance."""
        name = self._system.system_id
        width = 2 * self._half_width + 1
        how = (
            f"velocities smoothed over {1000 * width * dt:.3g} ms (Savitzky-Golay)"
            if self._half_width
            else "velocities not smoothed"
        )
        notes = [f"actions: not recorded, inferred by inverse dynamics of {name}, {how}"]
        if self._clipped:
            share = 100.0 * self._clipped / max(1, self._steps)
            notes.append(
                f"actions: clipped to what {name} can do in {share:.2g} % of the steps; "
                f"the largest inferred was {self._largest:.4g} {_unit(self._system)}".rstrip()
            )
        told = [finding for finding in self._findings if finding.kind != "limit"]
        notes += [f"actions: {finding.sentence}" for finding in told[:_MOST_NOTES]]
        if len(told) > _MOST_NOTES:
            notes.append(f"actions: and {len(told) - _MOST_NOTES} more such findings")
        return tuple(notes)


def _later(finding: Finding, offset: float) -> Finding:
    """Return a finding of a part with the time in the episode, in its sentence too."""
    if finding.time is None or offset == 0:
        return finding
    before, after = f"{finding.time:.3f} s", f"{finding.time + offset:.3f} s"
    sentence = finding.sentence.replace(f"at {before}", f"at {after}")
    return replace(finding, sentence=sentence, time=finding.time + offset)


def _with_notes(ending: Ending, notes: tuple[str, ...]) -> Ending:
    return replace(ending, notes=(*ending.notes, *notes))


def _even_dt(header: Header) -> float:
    if header.dt is None:
        raise MisstepError(
            "its rows have uneven times: actions are inferred from a recording on one clock"
        )
    return header.dt


def _forces(motion: Motion, mechanics: Mechanics, dt: float) -> Array:
    """Return the actions (T, m) that explain a motion, not clipped."""
    forces = mechanics.actions(
        mechanics.inverse(motion.positions, motion.velocities, motion.accelerations)
    )
    late = min(round(mechanics.delay / dt), len(forces) - 1)
    # The last actions have not come to act yet; nobody knows more of them than the one before.
    return np.concatenate([forces[late:], np.repeat(forces[-1:], late, axis=0)])


def _blows(
    forces: Array, motion: Motion, system: System, mechanics: Mechanics, dt: float
) -> tuple[Finding, ...]:
    """Return when a joint hit its stop, when else there was a blow, and what is beyond limits."""
    held = np.zeros(len(forces), dtype=bool)
    found = []
    for j, (low, high) in enumerate(mechanics.stops):
        near = NEAR_STOP * (high - low) if np.isfinite(high - low) else 0.0
        positions = motion.positions[:, j]
        there = (positions < low + near) | (positions > high - near)
        for start, end in _runs(there, round(JOLT_GAP / dt)):
            held[max(0, start - round(JOLT_GAP / dt)) : end + round(JOLT_GAP / dt)] = True
            found.append(_at_stop(j, slice(start, end), motion, system, mechanics, dt))
    return (*found, *_beyond(forces, held, system, dt))


def _at_stop(
    j: int, rows: slice, motion: Motion, system: System, mechanics: Mechanics, dt: float
) -> Finding:
    units = {column.name: column.unit for column in system.observation_columns}
    name, velocity = mechanics.positions[j], mechanics.velocities[j]
    positions = motion.positions[rows, j]
    # The stop may have begun to brake it already.
    arrival = motion.velocities[max(0, rows.start - round(ARRIVAL / dt)) : rows.start + 1, j]
    speed = float(arrival[np.argmax(np.abs(arrival))])
    low, high = mechanics.stops[j]
    beyond = max(float(positions.max()) - high, low - float(positions.min()))
    stop = high if positions[0] > 0.5 * (low + high) else low
    if beyond > BEYOND_STOP * (high - low):
        how = f"goes beyond its stop, {stop:+.4g} {units[name]}, by {beyond:.3g} {units[name]}"
        why = "the stop is somewhere else"
    else:
        how = f"comes to its stop, {stop:+.4g} {units[name]},"
        why = "what the stop does cannot be told from what the actuator does"
    return Finding(
        "stop",
        f"{name} {how} at {rows.start * dt:.3f} s with {speed:+.3g} {units[velocity]}, and is "
        f"there for {(rows.stop - rows.start) * dt:.3g} s: {why}",
        rows.start * dt,
        speed,
    )


def _beyond(forces: Array, held: NDArray[np.bool_], system: System, dt: float) -> Iterator[Finding]:
    """Yield the blows away from stops, and how often the other forces are beyond the limits."""
    space: Any = system.action_space
    reach = np.maximum(np.abs(space.low), np.abs(space.high))
    for i, column in enumerate(system.action_columns):
        share = np.where(held, 0.0, np.abs(forces[:, i]) / reach[i])
        beyond = share > 1.0
        for start, end in _runs(share > JOLT, round(JOLT_GAP / dt)):
            row = start + int(np.argmax(share[start:end]))
            beyond[start:end] = False
            size = float(forces[row, i])
            yield Finding(
                "jolt",
                f"the motion at {row * dt:.3f} s wants {column.name} {size:+.4g} {column.unit}, "
                f"{share[row]:.1f} times the limit: a collision, a bad sample or wrong parameters",
                row * dt,
                size,
            )
        if beyond.any():
            size = float(np.abs(forces[beyond, i]).max())
            yield Finding(
                "limit",
                f"{column.name} is beyond its limit of {reach[i]:.4g} {column.unit} in "
                f"{100 * beyond.mean():.2g} % of the steps, by at most "
                f"{size - reach[i]:.3g} {column.unit}",
                None,
                size,
            )


def _runs(flags: NDArray[np.bool_], gap: int = 0) -> list[tuple[int, int]]:
    """Return start and end of each run of true values; gaps of up to `gap` do not end one."""
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0))
    runs: list[tuple[int, int]] = []
    for start, end in edges.reshape(-1, 2).tolist():
        if runs and start - runs[-1][1] <= gap:
            start = runs.pop()[0]
        runs.append((start, end))
    return runs


def _unit(system: System) -> str:
    return system.action_columns[0].unit
