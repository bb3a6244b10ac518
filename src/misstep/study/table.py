"""The tables of a study: one row a cell, and one row a combination of case, demonstrator, learner.

Whoever compares two studies leaves out `TIMING`: all other columns are the same again, whatever
the engine and the number of workers.

A run without a success counts as one that would need more trials than any other. Where a median or
a percentile falls among such runs, it is told as a bound: ``>20``. A run that ended in an error has
not succeeded; a lost one says nothing and is left out of every rate.
"""

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from misstep.learners import LEARNERS
from misstep.learning import wilson_interval
from misstep.storage import write_json, write_text
from misstep.study.cells import CellResult
from misstep.study.spec import Cell

TIMING = ("computing_seconds", "wall_seconds", "median_computing_seconds")
"""Columns that differ from one time to the next."""

ROBUST = 0.95
"""Share of the tests that a robust policy survives."""


class Measured(NamedTuple):
    """A cell and what came of it."""

    cell: Cell
    result: CellResult


class Rate(NamedTuple):
    """A share of runs."""

    successes: int
    n: int

    @property
    def value(self) -> float:
        """Successes of n; 0 of 0 is 0."""
        return self.successes / self.n if self.n else 0.0

    @property
    def interval_95(self) -> tuple[float, float]:
        """Wilson's 95 % interval."""
        return wilson_interval(self.successes, self.n) if self.n else (0.0, 1.0)


class Quantile(NamedTuple):
    """A quantile of times to success, or a bound below it."""

    value: float
    reached: bool

    def __str__(self) -> str:
        return f"{'' if self.reached else '>'}{self.value:g}"


def censored_quantile(times: Sequence[float], succeeded: Sequence[bool], q: float) -> Quantile:
    """Return a quantile of the times to success.

    Parameters
    ----------
    times : sequence of float
        Time to success, or how long a run without success went on.
    succeeded : sequence of bool
    q : float
        From 0 to 1. The smallest time within which a share q of the runs has succeeded.
    """
    index = max(0, math.ceil(q * len(times) - 1e-9) - 1)
    needed = [t if s else math.inf for t, s in zip(times, succeeded, strict=True)]
    value = sorted(needed)[index]
    return Quantile(value, True) if value < math.inf else Quantile(sorted(times)[index], False)


@dataclass(frozen=True)
class Summary:
    """What the repetitions of one combination say together."""

    case: str
    group: str
    variant: str
    system: str
    state: str
    demonstrator: str
    learner: str
    rung: int
    max_trials: int
    runs: int
    errors: int
    lost: int
    success: Rate
    """Runs with a success within `max_trials`."""
    first_trial: Rate
    median_trials: Quantile | None
    p90_trials: Quantile | None
    median_seconds: Quantile | None
    """Of interaction up to the first success, s."""
    tests: Rate
    """Tests that final policies survived."""
    robust: Rate
    """Runs whose final policy survived 95 % of its tests."""
    median_computing_seconds: float

    @property
    def row(self) -> str:
        """Its row in a table of demonstrators: learner, and variant if there is one."""
        return f"{self.learner}, {self.variant}" if self.variant else self.learner

    def values(self) -> dict[str, Any]:
        """Return it flat, quantiles as texts."""
        flat: dict[str, Any] = {}
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if isinstance(value, Rate):
                low, high = value.interval_95
                flat |= {f"{name}_count": value.successes, f"{name}_of": value.n}
                flat |= {f"{name}_rate": value.value, f"{name}_low": low, f"{name}_high": high}
            else:
                flat[name] = str(value) if isinstance(value, Quantile) else value
        return flat

    def to_json(self) -> dict[str, Any]:
        """Return it flat; a quantile that was not reached is null."""
        values = self.values()
        for name in ("median_trials", "p90_trials", "median_seconds"):
            quantile = getattr(self, name)
            values[name] = quantile.value if quantile and quantile.reached else None
        return values


def summarise(measured: Iterable[Measured]) -> list[Summary]:
    """Return one row a combination, in the order of the study."""
    groups: dict[tuple[str, str, str], list[Measured]] = {}
    for entry in measured:
        groups.setdefault(entry.cell.key[:3], []).append(entry)
    return [_summary(entries) for entries in groups.values()]


def pooled(measured: Iterable[Measured]) -> list[Summary]:
    """Return one row a case of the file and learner, its demonstrators and variants together."""
    groups: dict[tuple[str, str], list[Measured]] = {}
    for entry in measured:
        groups.setdefault((entry.cell.case.group, entry.cell.learner.label), []).append(entry)
    return [
        replace(_summary(entries), case=group, variant="", demonstrator="all")
        for (group, _), entries in groups.items()
    ]


def _summary(entries: Sequence[Measured]) -> Summary:
    cell, n = entries[0].cell, len(entries)
    kept = [entry.result for entry in entries if entry.result.status != "lost"]
    needed = [result.trials_to_success for result in kept]
    tested = [result for result in kept if result.survived is not None]
    survived = [result.survived or 0 for result in tested]
    return Summary(
        case=cell.case.name,
        group=cell.case.group,
        variant=cell.case.variant,
        system=cell.case.system,
        state=" ".join(cell.case.state),
        demonstrator=cell.demonstrator.label,
        learner=cell.learner.label,
        rung=LEARNERS[cell.learner.name].rung,
        max_trials=cell.case.max_trials,
        runs=n,
        errors=sum(result.status == "error" for result in kept),
        lost=n - len(kept),
        success=Rate(sum(k is not None for k in needed), len(kept)),
        first_trial=Rate(sum(k == 1 for k in needed), len(kept)),
        median_trials=_trials(needed, cell.case.max_trials, 0.5),
        p90_trials=_trials(needed, cell.case.max_trials, 0.9),
        median_seconds=_seconds(kept, 0.5),
        tests=Rate(sum(survived), sum(result.tests for result in tested)),
        robust=Rate(
            sum(s >= ROBUST * r.tests for s, r in zip(survived, tested, strict=True)), len(tested)
        ),
        median_computing_seconds=float(
            np.median([r.timing.computing_seconds for r in kept] or [0.0])
        ),
    )


def _trials(needed: Sequence[int | None], most: int, q: float) -> Quantile | None:
    if not needed:
        return None
    return censored_quantile(
        [most if k is None else k for k in needed], [k is not None for k in needed], q
    )


def _seconds(results: Sequence[CellResult], q: float) -> Quantile | None:
    if not results:
        return None
    value, reached = censored_quantile(
        [result.seconds_of_interaction for result in results],
        [result.trials_to_success is not None for result in results],
        q,
    )
    return Quantile(round(value, 6), reached)


def write_tables(out: Path, measured: Sequence[Measured], rows: Sequence[Summary]) -> None:
    """Write ``cells.csv``, ``summary.csv`` and ``summary.json``."""
    write_text(out / "cells.csv", _csv([_cell_row(*entry) for entry in measured]))
    write_text(out / "summary.csv", _csv([row.values() for row in rows]))
    write_json(out / "summary.json", [row.to_json() for row in rows])


def _cell_row(cell: Cell, result: CellResult) -> dict[str, Any]:
    return {
        "case": cell.case.name,
        "system": cell.case.system,
        "state": " ".join(cell.case.state),
        "demonstrator": cell.demonstrator.label,
        "learner": cell.learner.label,
        "rung": LEARNERS[cell.learner.name].rung,
        "repetition": cell.repetition,
        "status": result.status,
        "trials": len(result.outcomes),
        "max_trials": cell.case.max_trials,
        "trials_to_success": result.trials_to_success,
        "seconds_of_interaction": result.seconds_of_interaction,
        "first_failure_time": result.failure_times[0] if result.failure_times else None,
        "first_cost": result.costs[0] if result.costs else None,
        "last_cost": result.costs[-1] if result.costs else None,
        "tests": result.tests,
        "survived": result.survived,
        "error": result.error,
        **asdict(result.timing),
    }


def _csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a table with a header; None is empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
