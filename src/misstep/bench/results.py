"""What a bench found: one row a measurement, ratios between rows, slopes, and the targets."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from misstep.learning import wilson_interval

SAME = 1e-6
"""Log-likelihoods of a sample that differ by less are the same."""


@dataclass(frozen=True)
class Row:
    """One measurement; what does not apply is None."""

    task: str
    contender: str
    n: int | None = None
    """Samples."""
    d: int | None = None
    """Columns, of state and action together."""
    k: int | None = None
    """Components; of a scan, the one that was chosen."""
    threads: int | None = None
    seconds: float | None = None
    """The least of `repeats`: what else the machine does can only add to it."""
    repeats: int | None = None
    iterations: int | None = None
    p50_us: float | None = None
    p99_us: float | None = None
    ratio_to_sklearn: float | None = None
    """How many times faster than scikit-learn."""
    ratio_to_pypr: float | None = None
    ratio_to_gmr: float | None = None
    log_likelihood: float | None = None
    """Mean over the samples, of the fitted parameters, always computed by the same reference."""
    log_likelihood_difference: float | None = None
    """From misstep's."""
    agreement: float | None = None
    """Share of the modes within 5 % of a standard deviation of misstep's."""
    bare_seconds: float | None = None
    """What the operations and bytes take at this machine's measured rates."""
    n_bytes: int | None = None
    right: int | None = None
    """Random mixtures whose number of components was found, of `tried`."""
    tried: int | None = None
    interval_95: tuple[float, float] | None = None
    error: str | None = None

    @property
    def same_work(self) -> tuple[Any, ...]:
        """What two rows share if they may be compared."""
        k = None if self.task in CHOOSING else self.k
        return self.task, self.n, self.d, k, self.threads, self.tried

    @property
    def times_bare(self) -> float | None:
        """How many times the bare time it took."""
        if not self.bare_seconds:
            return None
        took = self.seconds if self.p50_us is None else self.p50_us * 1e-6
        return None if took is None else took / self.bare_seconds


CHOOSING = ("bic-scan",)
"""Tasks in which contenders choose K."""


class Slope(NamedTuple):
    """How the cost of a fit grows: it goes like (n, k or d) to this power."""

    contender: str
    along: str
    slope: float


class Target(NamedTuple):
    """A number to reach, and what was measured."""

    what: str
    wanted: str
    measured: float | None
    reached: bool | None


def compare(rows: Iterable[Row]) -> list[Row]:
    """Return the rows with their ratios to others that did the same work, and differences."""
    rows = list(rows)
    at = {(row.contender, *row.same_work): row for row in rows}
    compared = []
    for row in rows:
        ours, sklearn, pypr, gmr = (
            at.get((contender, *row.same_work))
            for contender in ("misstep", "scikit-learn", "PyPR", "gmr")
        )
        compared.append(
            replace(
                row,
                ratio_to_sklearn=_ratio(row, sklearn, "seconds"),
                ratio_to_pypr=_ratio(row, pypr, "p50_us"),
                ratio_to_gmr=_ratio(row, gmr, "p50_us"),
                log_likelihood_difference=_difference(row, ours),
            )
        )
    return compared


def _ratio(row: Row, base: Row | None, name: str) -> float | None:
    mine, other = getattr(row, name), getattr(base, name, None)
    return other / mine if mine and other else None


def _difference(row: Row, base: Row | None) -> float | None:
    if base is None or base.log_likelihood is None or row.log_likelihood is None:
        return None
    return row.log_likelihood - base.log_likelihood


def slopes(rows: Iterable[Row]) -> list[Slope]:
    """Fit a line through the logarithms of cost and size, for each contender and direction."""
    rows = list(rows)
    found = []
    for along in ("n", "k", "d"):
        chosen = [row for row in rows if row.task == f"growth-{along}" and row.seconds]
        for contender in dict.fromkeys(row.contender for row in chosen):
            mine = [row for row in chosen if row.contender == contender]
            sizes = np.log([getattr(row, along) for row in mine])
            costs = np.log([row.seconds or math.nan for row in mine])
            if len(mine) > 1:
                found.append(Slope(contender, along, float(np.polyfit(sizes, costs, 1)[0])))
    return found


def count_right(row: Row, chosen: Sequence[int], true: Sequence[int]) -> Row:
    """Return the row of a contender that chose K for many random mixtures."""
    right = sum(a == b for a, b in zip(chosen, true, strict=True))
    return replace(row, right=right, tried=len(true), interval_95=wilson_interval(right, len(true)))


def targets(rows: Iterable[Row]) -> list[Target]:
    """Return the numbers that misstep is to reach, those that these rows can tell."""
    ours = [row for row in rows if row.contender == "misstep"]
    found = []
    for task, n, d, wanted in (
        ("em-scan", 6_000, 2, 20),
        ("em-scan", 30_000, 2, 40),
        ("em-scan", 200_000, 2, 60),
        ("em-scan", 6_000, 5, 8),
        ("em-scan", 6_000, 14, 8),
    ):
        what = (
            f"EM and BIC, K = 1 … 10, N = {n:,}, d = {d}, 2 threads: times faster than scikit-learn"
        )
        same = [r for r in ours if (r.task, r.n, r.d, r.threads) == (task, n, d, 2)]
        found += _at_least(what, wanted, [r.ratio_to_sklearn for r in same])
    for row in (row for row in ours if row.task == "query"):
        where = f"mode of the DMM, d = {row.d}, K = {row.k}"
        found += _at_least(f"{where}: times faster than PyPR", 200, [row.ratio_to_pypr])
        found += _at_least(f"{where}: times faster than gmr", 500, [row.ratio_to_gmr])
        if (row.d, row.k) == (2, 10):
            found += _below(f"{where}: median, µs", 10, [row.p50_us])
    right = [r.right / r.tried for r in ours if r.right is not None and r.tried]
    found += _at_least("share of random mixtures whose K is found", 0.95, right)
    found += _below("one trial of 30 s at 50 Hz, s", 0.1, _seconds(ours, "trial"))
    found += _below("the whole paper, one seed, s", 30, _seconds(ours, "paper"))
    return found


def _seconds(rows: list[Row], task: str) -> list[float | None]:
    return [row.seconds for row in rows if row.task == task]


def _at_least(what: str, wanted: float, values: Sequence[float | None]) -> list[Target]:
    return _judged(what, f"≥ {wanted:g}", values, lambda value: value >= wanted)


def _below(what: str, wanted: float, values: Sequence[float | None]) -> list[Target]:
    return _judged(what, f"< {wanted:g}", values, lambda value: value < wanted)


def _judged(
    what: str, wanted: str, values: Sequence[float | None], reached: Callable[[float], bool]
) -> list[Target]:
    return [
        Target(what, wanted, value, None if value is None else reached(value)) for value in values
    ]


def to_json(row: Row) -> dict[str, Any]:
    """Return a row as JSON can say it."""
    values = asdict(row) | {"times_bare": row.times_bare}
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in values.items()
    }
