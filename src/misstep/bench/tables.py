"""The tables of a bench, the same for the page and for the documentation.

A table is a heading, a sentence, names of columns, and rows of texts; what a document has no rows
for gives no table.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from misstep.bench.results import SAME

Row = Mapping[str, Any]

_LONGEST_ERROR = 40
_VERDICTS = {True: "reached", False: "missed", None: "not measured"}


class Table(NamedTuple):
    """A table that is ready to be shown."""

    name: str
    """That of its plot, if it has one."""
    title: str
    about: str
    columns: tuple[str, ...]
    rows: list[tuple[str, ...]]


def tables_of(document: Mapping[str, Any]) -> list[Table]:
    """Return all tables of a document as in ``bench.json``."""
    rows: Sequence[Row] = document["rows"]
    made = [
        _targets(document["targets"]),
        _scans(rows),
        _defaults(rows),
        _fits(rows),
        _queries(rows),
        _right_k(rows),
        _growth(document["slopes"]),
        _own(rows),
        _memory(rows),
        _machine(document["rates"]),
    ]
    return [table for table in made if table.rows]


def _targets(targets: Sequence[Row]) -> Table:
    return Table(
        "targets",
        "Targets",
        "What misstep set out to reach, and what this run measured.",
        ("what", "wanted", "measured", ""),
        [(t["what"], t["wanted"], number(t["measured"]), _VERDICTS[t["reached"]]) for t in targets],
    )


def _scans(rows: Sequence[Row]) -> Table:
    return _side_by_side(
        "scan",
        "A scan over K = 1 … 10, the same starts and iterations",
        "Seconds in which every contender runs the same number of EM iterations from the same "
        "start for each K, and computes the log-likelihood that BIC needs.",
        [r for r in rows if r["task"] == "em-scan"],
    )


def _defaults(rows: Sequence[Row]) -> Table:
    return Table(
        "defaults",
        "A scan over K = 1 … 10 with each library's own defaults",
        "Own starts, restarts, tolerance and bounds; the data hold four overlapping components.",
        ("N", "d", "contender", "threads", "chosen K", "seconds", "× scikit-learn"),
        [
            (*_size(r), r["contender"], number(r["threads"]), number(r["k"]), *_seconds(r))
            for r in rows
            if r["task"] == "bic-scan"
        ],
    )


def _fits(rows: Sequence[Row]) -> Table:
    return _side_by_side(
        "em",
        "One fit from the same start",
        "Seconds of the same number of iterations from the same start, without floors.",
        [r for r in rows if r["task"] == "em"],
    )


def _side_by_side(name: str, title: str, about: str, rows: Sequence[Row]) -> Table:
    """One line for each piece of work, one column for each contender."""
    contenders = list(dict.fromkeys(r["contender"] for r in rows))
    lines: dict[tuple[str, ...], dict[str, Row]] = {}
    for r in rows:
        lines.setdefault((*_size(r), number(r["threads"])), {})[r["contender"]] = r
    made = []
    for work, by in lines.items():
        ours = by.get("misstep", {})
        told = (ours.get(what) for what in ("ratio_to_sklearn", "bare_seconds", "times_bare"))
        times = (_told_seconds(by[c]) if c in by else "–" for c in contenders)
        made.append((*work, *times, *map(number, told)))
    about += (
        f" “misstep ×” is how many times faster than scikit-learn it is, “bare” the seconds that "
        f"the operations and bytes take at the rates that this machine reached in the same run. "
        f"The log-likelihoods per sample differ by less than {SAME:.0e}, or else the difference "
        f"from misstep's stands beside the time."
    )
    return Table(
        name,
        title,
        about,
        ("N", "d", "threads", *contenders, "misstep ×", "bare", "misstep over bare"),
        made,
    )


def _told_seconds(r: Row) -> str:
    difference = r["log_likelihood_difference"]
    if r["error"] or difference is None or abs(difference) < SAME:
        return _seconds(r)[0]
    return f"{_seconds(r)[0]} (Δ {difference:.0e})"


def _queries(rows: Sequence[Row]) -> Table:
    return Table(
        "query",
        "Which action now?",
        "Condition the mixture on one state, choose ε, and climb to the mode of the donut mixture "
        "from the previous action, along a path of states, up to the step that would gain less "
        "than 1e-9 of log density. The others stop at densities: over theirs climbs a Newton "
        "ascent in NumPy, a handful of calls a state, to the same end. “agree” is the share of "
        "modes within 5 % of a standard deviation of misstep's; ascents that took different sides "
        "of a ridge once stay there.",
        ("d", "K", "contender", "median µs", "p99 µs", "× PyPR", "× gmr", "agree", "bare µs"),
        [
            (
                number(r["d"]),
                number(r["k"]),
                r["contender"],
                *(("–", _error(r)) if r["error"] else (number(r["p50_us"]), number(r["p99_us"]))),
                number(r["ratio_to_pypr"]),
                number(r["ratio_to_gmr"]),
                number(r["agreement"]),
                number(1e6 * r["bare_seconds"] if r["bare_seconds"] else None),
            )
            for r in rows
            if r["task"] == "query"
        ],
    )


def _right_k(rows: Sequence[Row]) -> Table:
    return Table(
        "right-k",
        "The right number of components",
        "Random mixtures of 2 to 6 components that overlap by less than 5 %, in 2 to 5 columns, "
        "6,000 samples each; everything by default, K = 1 … 10 by minimum BIC. Slow libraries try "
        "fewer.",
        ("contender", "right", "of", "share", "95 % interval", "seconds each"),
        [
            (
                r["contender"],
                number(r["right"]),
                number(r["tried"]),
                f"{100 * r['right'] / r['tried']:.1f} %",
                " – ".join(f"{100 * limit:.0f}" for limit in r["interval_95"]) + " %",
                number(r["seconds"] / r["tried"]),
            )
            for r in rows
            if r["right"] is not None
        ],
    )


def _growth(slopes: Sequence[Row]) -> Table:
    names = {"n": "samples N", "k": "components K", "d": "columns d"}
    contenders = dict.fromkeys(s["contender"] for s in slopes)
    power = {(s["contender"], s["along"]): s["slope"] for s in slopes}
    return Table(
        "growth",
        "How the cost of a fit grows",
        "The slope of log cost against log size: cost goes like size to this power.",
        ("contender", *names.values()),
        [(c, *(number(power.get((c, along))) for along in names)) for c in contenders],
    )


def _own(rows: Sequence[Row]) -> Table:
    names = {
        "trial": "one trial, simulated: 30 s at 50 Hz, donut policy",
        "refit": "one refit of the donut learner after four demonstrations",
        "paper": "the whole paper, `misstep reproduce --seeds 1`, compiled code cached",
        "paper, first time": "the whole paper, the run before that one",
    }
    return Table(
        "own",
        "A trial, a refit, a paper",
        "What a user waits for.",
        ("what", "seconds"),
        [(names[r["task"]], _error(r) or number(r["seconds"])) for r in rows if r["task"] in names],
    )


def _memory(rows: Sequence[Row]) -> Table:
    return Table(
        "memory",
        "Peak memory of a fit",
        "By how much one fit raised what its process holds, beyond the data themselves.",
        ("N", "d", "contender", "MiB"),
        [
            (*_size(r), r["contender"], _error(r) or number((r["n_bytes"] or 0) / 2**20))
            for r in rows
            if r["task"] == "memory"
        ],
    )


def _machine(rates: Sequence[Row]) -> Table:
    return Table(
        "machine",
        "What the machine reached",
        "In the same run: a copy that fits no cache, multiply-adds in registers, and the "
        "polynomial exponential that the mixture uses.",
        ("threads", "copy GB/s", "Gflop/s", "exponentials, 10⁹/s"),
        [
            (
                number(r["threads"]),
                *(
                    number(r[name] / 1e9)
                    for name in ("bytes_per_second", "flops_per_second", "exps_per_second")
                ),
            )
            for r in rates
        ],
    )


def _size(r: Row) -> tuple[str, str]:
    return number(r["n"]), number(r["d"])


def _seconds(r: Row) -> tuple[str, str]:
    return _error(r) or number(r["seconds"]), number(r["ratio_to_sklearn"])


def _error(r: Row) -> str:
    """Return why there is no figure, short; the whole of it is in ``bench.json``."""
    text = r["error"] or ""
    return text if len(text) <= _LONGEST_ERROR else f"{text[:_LONGEST_ERROR]}…"


def number(value: float | None) -> str:
    """Return a number with three digits that count, whole numbers whole."""
    if value is None:
        return "–"
    if isinstance(value, int) or abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.3g}"
