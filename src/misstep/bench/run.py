"""`misstep bench`: everything in one run, and what it leaves behind.

bench.json       every row, the ratios, the machine
performance.md   the table for the documentation
bench.html       plots and tables on one page
figures/         the plots
"""

import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numba

from misstep.bench import figures, page, results
from misstep.bench.hardware import Rates, describe_machine, measure_rates
from misstep.bench.markdown import write_markdown
from misstep.bench.measuring import Measuring, Step
from misstep.bench.own import measure_paper, measure_trial_and_refit
from misstep.bench.peers import (
    GMR,
    MISSTEP,
    PLAIN_NUMPY,
    POMEGRANATE,
    PYPR,
    SCIKIT_LEARN,
    Found,
    cache_folder,
    find_peers,
)
from misstep.bench.plan import FULL, QUICK, Plan
from misstep.bench.results import Row
from misstep.bench.worker import Worker
from misstep.storage import make_folder, write_json, write_text
from misstep.version import __version__, command_line
from misstep.workers import Progress, silent

_PAPER_LIMIT = 180.0


@dataclass(frozen=True)
class Bench:
    """What was measured."""

    date: str
    quick: bool
    machine: dict[str, Any]
    rates: tuple[Rates, ...]
    rows: tuple[Row, ...]
    slopes: tuple[results.Slope, ...]
    targets: tuple[results.Target, ...]
    missing: dict[str, str]
    """Why a contender was not measured, or not where it should have been."""

    def to_json(self) -> dict[str, Any]:
        """Return everything as JSON can say it."""
        return {
            "version": __version__,
            "command": list(command_line()),
            "date": self.date,
            "quick": self.quick,
            "machine": self.machine,
            "rates": [rate._asdict() for rate in self.rates],
            "rows": [results.to_json(row) for row in self.rows],
            "slopes": [slope._asdict() for slope in self.slopes],
            "targets": [target._asdict() for target in self.targets],
            "missing": self.missing,
        }


def run_bench(
    out: Path,
    *,
    quick: bool = False,
    pomegranate: bool = False,
    peers: Path | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> Bench:
    """Measure misstep and its peers, and write what was found.

    Parameters
    ----------
    out : Path
        Folder for everything.
    quick : bool
        A look in a minute or two; no target is judged on it alone.
    pomegranate : bool
        Measure pomegranate too: it stands on PyTorch, gigabytes to download.
    peers : Path, optional
        The environment of the peers, or where to make it; in the user's cache if left out.
    seed : int
        Same seed, same data and starts.
    progress : callable
        Called with how much is done, how much there is, and what was done last.

    Returns
    -------
    Bench

    Raises
    ------
    MisstepError
        If a folder cannot be made or written to.
    """
    make_folder(out / "figures")
    plan = QUICK if quick else FULL
    progress(0, 1, "measuring the machine")
    rates = {threads: measure_rates(threads) for threads in _possible(plan.threads)}
    wanted = (MISSTEP, PLAIN_NUMPY, SCIKIT_LEARN, GMR, PYPR, *([POMEGRANATE] * pomegranate))
    found = list(find_peers(peers or cache_folder(), wanted, lambda doing: progress(0, 1, doing)))
    rows = _measure(plan, found, rates, seed, progress)
    bench = Bench(
        date=datetime.now(UTC).date().isoformat(),
        quick=quick,
        machine=describe_machine(),
        rates=tuple(rates.values()),
        rows=tuple(rows),
        slopes=tuple(results.slopes(rows)),
        targets=tuple(results.targets(rows)),
        missing={f.peer.name: f.reason for f in found if f.reason},
    )
    _write(out, bench)
    return bench


def _possible(threads: Sequence[int]) -> list[int]:
    """Return the numbers of threads that this machine has cores for."""
    return [n for n in threads if n <= numba.config.NUMBA_NUM_THREADS]


def _measure(
    plan: Plan, found: Sequence[Found], rates: dict[int, Rates], seed: int, progress: Progress
) -> list[Row]:
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        workers = {
            (f.peer, threads): stack.enter_context(Worker(f.peer, f.python, threads, Path(folder)))
            for f in found
            for threads in rates
            if f.python is not None
        }
        there = [f.peer for f in found if f.python is not None]
        measuring = Measuring(plan, there, workers, rates, seed)
        steps: list[Step] = list(measuring.steps())
        total = len(steps) + 1 + plan.paper
        rows: list[Row] = []
        for done, step in enumerate(steps):
            progress(done, total, step.title)
            row = step.run()
            rows += [] if row is None else [row]
    progress(len(steps), total, "misstep, trial and refit")
    rows += measure_trial_and_refit(plan.repeats, seed)
    if plan.paper:
        progress(len(steps) + 1, total, "misstep, the whole paper")
        rows += measure_paper(_PAPER_LIMIT)
    progress(total, total, "")
    return results.compare(rows)


def _write(out: Path, bench: Bench) -> None:
    document = bench.to_json()
    write_json(out / "bench.json", document)
    write_text(out / "performance.md", write_markdown(document))
    pictures = figures.draw_all(out / "figures", document)
    write_text(out / "bench.html", page.render(document, pictures))
