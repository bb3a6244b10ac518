"""Recordings are held against the equations of the system that somebody says was driven.

`check_recorded` does so with a data set, by what its provenance says; `Beginnings` with recordings
of any size on their way from one file to another: it keeps the beginning of each episode, and that
is checked.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.formats.format import Block, Episode, Header
from misstep.recordings.equations import EquationCheck, check_equations, explained
from misstep.recordings.motion import FEWEST_ROWS
from misstep.systems import JUDGE_PARAMETERS, SYSTEMS, System, recorded_system
from misstep.trajectory import Outcome, Trajectory

MOST_EPISODES = 100
"""Episodes that are checked, at most: the first ones."""
MOST_ROWS, MOST_ROWS_TOGETHER = 50_000, 500_000
"""Rows that are kept of each episode on its way, and of all together."""
MOST_FINDINGS = 2
"""Findings of an episode that are told in words; of more the number."""
MOST_LISTED = 10
"""Numbers of episodes that are listed."""


@dataclass(frozen=True)
class Checked:
    """What the equations say of some recordings.

    Parameters
    ----------
    checks : tuple of EquationCheck
        Empty where there was nothing to check: no system is named, or it has no such equations.
    reason : str
        Why nothing was checked though there is something to check; else empty.
    """

    checks: tuple[EquationCheck, ...] = ()
    reason: str = ""

    def lines(self) -> list[str]:
        """Return what the equations say, in words: a line if all is well, else some an episode."""
        lines = [f"the equations were not checked: {self.reason}"] if self.reason else []
        for column in dict.fromkeys(check.column for check in self.checks):
            lines += _told([check for check in self.checks if check.column == column])
        wrong = [c for c in self.checks if c.r_squared is not None and not c.holds]
        doubtful = [c for c in self.checks if c.holds and c.fits]
        for checks, what in (
            (wrong, "does not obey the equations as they are stated"),
            (doubtful, "agrees much better with another statement"),
        ):
            if checks:
                lines.append(
                    f"warning: the recording {what} ({_numbers(checks)}): settle units, signs and "
                    "parameters before anything is learned from it"
                )
        return lines

    def as_json(self) -> dict[str, Any]:
        """Return all of it as plain dictionaries, lists, numbers and texts; episodes from 1."""
        return {
            "equations": [
                {
                    **asdict(check),
                    "episode": check.episode + 1,
                    "holds": check.holds,
                    "sentences": list(check.sentences),
                }
                for check in self.checks
            ],
            "equations_not_checked_because": self.reason,
        }


def check_recorded(trajectories: Sequence[Trajectory]) -> Checked:
    """Hold trajectories against the systems that their provenance names.

    Only simulations are built, since a file may name anything (`recorded_system`).

    Parameters
    ----------
    trajectories : sequence of Trajectory
        Such as a `Dataset`. The first `MOST_EPISODES` are checked.
    """
    checked: list[EquationCheck] = []
    reasons: list[str] = []

    def stated(pair: tuple[int, Trajectory]) -> tuple[str, str, float]:
        source = pair[1].provenance
        return source.system, repr(sorted(source.parameters.items())), pair[1].dt

    numbered = list(enumerate(trajectories[:MOST_EPISODES]))
    for (name, _, _), group in groupby(numbered, key=stated):
        members = list(group)
        if name not in SYSTEMS or SYSTEMS[name].mechanics is System.mechanics:
            continue
        judges = {row.name for row in JUDGE_PARAMETERS}
        said = members[0][1].provenance.parameters
        try:
            system = recorded_system(name, {k: v for k, v in said.items() if k not in judges})
        except MisstepError as error:
            reasons.append(str(error))
            continue
        some = _check(members, system)
        checked += some.checks
        reasons += [some.reason] if some.reason else []
    return Checked(tuple(checked), "; ".join(dict.fromkeys(reasons)))


class Beginnings:
    """Keeps the beginnings of episodes that pass, to be checked when all have passed.

    Parameters
    ----------
    system : System or None
        That was driven; None: nothing is kept.
    """

    def __init__(self, system: System | None) -> None:
        self._system = system
        self._kept: list[tuple[Header, list[NDArray[np.float64]]]] = []
        self._left = MOST_ROWS_TOGETHER

    def keeping(self, episode: Episode) -> Episode:
        """Return the episode; its rows are kept as they pass."""
        if self._system is None or len(self._kept) >= MOST_EPISODES or not self._left:
            return episode
        tables: list[NDArray[np.float64]] = []
        self._kept.append((episode.header, tables))

        def blocks() -> Iterator[Block]:
            left = min(MOST_ROWS, self._left)
            for block in episode.blocks:
                if left > 0:
                    tables.append(block.observations[:left].copy())
                    left -= len(tables[-1])
                    self._left -= len(tables[-1])
                yield block

        return replace(episode, blocks=blocks())

    def check(self) -> Checked:
        """Check what was kept."""
        if self._system is None:
            return Checked()
        system = self._system
        if any(header.dt is None for header, _ in self._kept):
            return Checked(reason="the rows have uneven times: bring them to one clock")
        recorded = [
            (number, _trajectory(header, np.concatenate(tables), system))
            for number, (header, tables) in enumerate(self._kept)
            if sum(map(len, tables)) > 1
        ]
        checked: list[EquationCheck] = []
        for _, group in groupby(recorded, key=lambda pair: pair[1].dt):
            some = _check(list(group), system)
            if some.reason:
                return some
            checked += some.checks
        return Checked(tuple(checked))


def _told(checks: Sequence[EquationCheck]) -> list[str]:
    """Return lines on the equation of one joint: one for all episodes of which the same is true."""
    lines = []
    alike: dict[tuple[bool, tuple[str, ...]], list[EquationCheck]] = {}
    for check in checks:
        if check.r_squared is None:
            lines.append(f"{_numbers([check])}: {check.sentences[0]}")
        else:
            key = check.holds, tuple(fit.change for fit in check.fits)
            alike.setdefault(key, []).append(check)
    lines += [_verdict(members, len(checks)) for members in alike.values()]
    for check in checks:
        # How far a force is beyond its limit matters where it is inferred, and is noted there.
        sentences = [finding.sentence for finding in check.findings if finding.kind != "limit"]
        if len(sentences) > MOST_FINDINGS:
            rest = len(sentences) - MOST_FINDINGS
            sentences[MOST_FINDINGS:] = [f"and {rest} more such findings"]
        lines += [f"{_numbers([check])}: {sentence}" for sentence in sentences]
    return lines


def _verdict(checks: Sequence[EquationCheck], total: int) -> str:
    where = f"in all {total} episodes" if len(checks) == total > 1 else f"in {_numbers(checks)}"
    first = checks[0]
    line = (
        f"the equation of {first.column} {'holds' if first.holds else 'does not hold'} {where}: "
        f"R² {_least(c.r_squared for c in checks)}, residual at most "
        f"{max(c.residual for c in checks):.3g} {first.unit}"
    )
    better = [
        f"{fit.change} (R² {_least(c.fits[i].r_squared for c in checks)})"
        for i, fit in enumerate(first.fits)
    ]
    return explained(line, first.holds, better)


def _least(shares: Iterable[float | None]) -> str:
    """Return the smallest of some R², rounded down; in full where it matters."""
    least = min(share for share in shares if share is not None)
    digits = 4 if least > 0.99 else 2
    return f"at least {math.floor(least * 10**digits) / 10**digits:.{digits}f}"


def _numbers(checks: Sequence[EquationCheck]) -> str:
    """Return which episodes: ``"episodes 1, 3"``; of many the first."""
    numbers = list(dict.fromkeys(str(check.episode + 1) for check in checks))
    listed = ", ".join(numbers[:MOST_LISTED]) + (", ..." if len(numbers) > MOST_LISTED else "")
    return f"episode{'s' if len(numbers) > 1 else ''} {listed}"


def _check(numbered: Sequence[tuple[int, Trajectory]], system: System) -> Checked:
    """Check recordings of one system and rate, each with its number from 0."""
    try:
        system.unwrapped.mechanics()
    except MisstepError:  # there is nothing that could be checked
        return Checked()
    long = [(n, t) for n, t in numbered if len(t.observations) >= FEWEST_ROWS]
    if not long:
        return Checked(reason=f"every episode is shorter than {FEWEST_ROWS} rows")
    try:
        with np.errstate(all="ignore"):  # a file may state masses of 10³⁰⁸ kg: nothing fits them
            checks = check_equations([trajectory for _, trajectory in long], system)
    except MisstepError as error:
        return Checked(reason=str(error))
    if not all(math.isfinite(c.residual) and math.isfinite(c.r_squared or 0.0) for c in checks):
        return Checked(reason=f"{system.system_id} is beyond reckoning with its stated parameters")
    return Checked(tuple(replace(check, episode=long[check.episode][0]) for check in checks))


def _trajectory(header: Header, observations: NDArray[np.float64], system: System) -> Trajectory:
    """Return observations as a trajectory; of its actions nothing is known, nor does it matter."""
    columns = system.action_columns
    return Trajectory(
        observations=observations,
        actions=np.zeros((len(observations) - 1, len(columns))),
        dt=header.dt or 0.0,
        observation_columns=header.observation_columns,
        action_columns=columns,
        provenance=header.provenance,
        outcome=Outcome.UNKNOWN,
    )
