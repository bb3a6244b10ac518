"""The short table of a study in Markdown, all demonstrators and variants together."""

from collections.abc import Iterable

from misstep.study.table import Measured, Rate, Summary, pooled

_TOLD = (
    "nothing",
    "success or not",
    "when it failed",
    "the cost",
    "the cost, and models the system",
)
"""What a learner of each rung is told of an attempt."""

_COLUMNS = (
    "task",
    "learner",
    "is told",
    "succeeded (95 %)",
    "on the first trial",
    "median trials",
    "tests survived",
)


def short_table(measured: Iterable[Measured]) -> str:
    """Return one line a case and learner."""
    lines, previous = [_row(_COLUMNS), "|---" * len(_COLUMNS) + "|\n"], ""
    for row in pooled(measured):
        task = "" if row.group == previous else row.group
        lines.append(_line(task, row))
        previous = row.group
    return "".join(lines)


def _line(task: str, row: Summary) -> str:
    low, high = row.success.interval_95
    return _row(
        (
            task,
            f"`{row.learner}`",
            _TOLD[row.rung],
            f"{row.success.successes} of {row.success.n} ({100 * low:.0f}–{100 * high:.0f} %)",
            str(row.first_trial.successes),
            "–" if row.median_trials is None else str(row.median_trials),
            _share(row.tests),
        )
    )


def _row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |\n"


def _share(rate: Rate) -> str:
    return f"{100 * rate.value:.1f} %" if rate.n else "–"
