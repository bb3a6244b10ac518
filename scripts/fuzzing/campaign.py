"""A campaign: slices of every target in turn, until all are done or the time is over."""

import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from fuzzing.cases import Target
from fuzzing.workers import Slice, Worker
from misstep.errors import MisstepError
from misstep.storage import read_json, write_json

_MOST_KEPT = 50  # findings of a target that are told in full
_PAUSE = 0.02  # s

Say = Callable[[str], None]


class Campaign:
    """Counts on the way, kept in a file from which a campaign goes on.

    Parameters
    ----------
    targets : sequence of Target
    seed : int
    cases : int or None
        Of each target; None: as many as each is worth.
    state : Path or None
        JSON file of the counts.

    Raises
    ------
    MisstepError
        If the file counts cases of another seed.
    """

    def __init__(
        self, targets: Sequence[Target], seed: int, cases: int | None, state: Path | None
    ) -> None:
        self._targets, self._seed, self._state = targets, seed, state
        self.counts: dict[str, dict[str, Any]] = {}
        if state is not None and state.exists():
            told = read_json(state)
            if told["seed"] != seed:
                raise MisstepError(f"{state} counts cases of seed {told['seed']}, not of {seed}")
            self.counts = told["targets"]
        for target in targets:
            self.counts.setdefault(target.name, _nothing())
            self.counts[target.name]["planned"] = target.cases if cases is None else cases

    def run(self, workers: int, budget: float, slice_size: int, say: Say) -> None:
        """Try what is left, at most for `budget` seconds."""
        began = time.monotonic()
        waiting = deque(self._slices(slice_size))
        busy: list[Worker] = []
        while waiting or busy:
            over = time.monotonic() - began > budget
            if over:
                waiting.clear()
            while waiting and len(busy) < workers:
                busy.append(Worker(waiting.popleft()))
            for worker in [each for each in busy if each.ended() or over]:
                if over and not worker.ended():
                    worker.kill()
                busy.remove(worker)
                rest = self._count(worker, say)
                if rest is not None and not over:
                    busy.append(Worker(rest))
                self._save()
            time.sleep(_PAUSE)

    @property
    def findings(self) -> int:
        """How many cases ended in another way than they may."""
        return sum(count["findings"] for count in self.counts.values())

    def _slices(self, size: int) -> list[Slice]:
        """Return all slices that are left, so that the targets advance side by side."""
        slices = []
        for target in self._targets:
            count = self.counts[target.name]
            left = [
                (start, min(start + size, stop))
                for first, stop in _gaps(count["done"], count["planned"])
                for start in range(first, stop, size)
            ]
            for number, (start, stop) in enumerate(left):
                place = (number + 1) / len(left)
                slices.append((place, Slice(target, self._seed, start, stop)))
        return [each for _, each in sorted(slices, key=lambda pair: pair[0])]

    def _count(self, worker: Worker, say: Say) -> Slice | None:
        """Add what a worker has done; return what is left of its slice."""
        findings, stop = worker.results()
        work, board = worker.work, worker.board
        count = self.counts[work.target.name]
        count["done"] = _joined([*count["done"], [work.start, stop]])
        count["tried"] = sum(last - first for first, last in count["done"])
        count["taken"] += board.taken
        count["refused"] += board.refused
        count["findings"] += len(findings)
        count["found"] = (count["found"] + findings)[:_MOST_KEPT]
        if board.slowest > count["slowest_s"]:
            count["slowest_s"], count["slowest_case"] = board.slowest, board.slowest_index
        count["peak_bytes"] = max(count["peak_bytes"], board.peak)
        for finding in findings:
            say(f"{work.target.name} --case {finding['case']}: {finding['what']}")
        if stop == work.start:
            return None  # it cannot even be opened
        if stop < work.stop:
            return work._replace(start=stop)
        say(
            f"{work.target.name}: {count['tried']} of {count['planned']} tried, "
            f"{count['taken']} taken, {count['refused']} refused, {count['findings']} findings"
        )
        return None

    def _save(self) -> None:
        if self._state is None:
            return
        total = {
            name: sum(count[name] for count in self.counts.values())
            for name in ("planned", "tried", "taken", "refused", "findings")
        }
        write_json(self._state, {"seed": self._seed, "total": total, "targets": self.counts})


def _joined(intervals: list[list[int]]) -> list[list[int]]:
    """Return intervals in order, with those that touch as one."""
    joined: list[list[int]] = []
    for start, stop in sorted(interval for interval in intervals if interval[0] < interval[1]):
        if joined and start <= joined[-1][1]:
            joined[-1][1] = max(stop, joined[-1][1])
        else:
            joined.append([start, stop])
    return joined


def _gaps(done: list[list[int]], end: int) -> list[tuple[int, int]]:
    """Return what is missing from 0 to `end`."""
    edges = [0, *(edge for interval in done for edge in interval), end]
    pairs = zip(edges[::2], edges[1::2], strict=True)
    return [(start, stop) for start, stop in pairs if start < stop]


def _nothing() -> dict[str, Any]:
    return {
        "planned": 0,
        "done": [],
        "tried": 0,
        "taken": 0,
        "refused": 0,
        "findings": 0,
        "slowest_s": 0.0,
        "slowest_case": -1,
        "peak_bytes": 0,
        "found": [],
    }
