"""One kill after the other: start, wait for the instant, strike, look at what is left, go on.

What is looked at after each:

- everything that was told to be finished is there, and every file opens;
- each file under its final name holds what that of an uninterrupted command holds, or the old one;
- temporary files are left only where nothing could have taken them away;
- the command has ended with the right exit code and one line that says why, and so have all the
  processes that it had started;
- the command that goes on ends well, with the files of a command that was never interrupted.
"""

import os
import re
import shutil
import signal
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from deaths import FULL, INTERRUPT, KILL, MEMORY, READ_ONLY, TERMINATE, WAYS, relieve, strike
from jobs import Counts, Job, Visitor
from nursery import Child, Nursery
from traces import Trace, left_over, trace

from misstep import MisstepError

PATIENCE = 90.0  # s, after which a command hangs
_DRAWS = 50
_REHEARSALS = 2

_PROGRESS = re.compile(r"(trial|studying|converting) \d+/\d+: ")
_GOODBYES: dict[str, tuple[tuple[int, ...], str]] = {
    KILL: ((-9,), ""),
    TERMINATE: ((143,), r"misstep: terminated\b.*"),
    INTERRUPT: ((130,), r"misstep: interrupted\b.*"),
    FULL: ((2,), r"misstep: error: .*cannot (write|make) .*(No space left on|the disk is full).*"),
    READ_ONLY: ((2,), r"misstep: error: .*cannot (write|make|add) .*Permission denied.*"),
    MEMORY: ((2,), r"misstep: error: .*memory.*"),
}
"""Exit codes and the one line on stderr."""

_OTHERS = re.compile(r"^OpenBLAS|^Process SpawnProcess|in spawn_main", re.MULTILINE)

_TOLD = {
    FULL: r"cannot (write|make).*No space left on device",
    READ_ONLY: r"cannot (write|make).*Permission denied",
    MEMORY: r"memory",
}
"""What a command that serves tells whom it serves, instead of ending."""


@dataclass
class Rehearsal:
    """What an uninterrupted command leaves, and how long it takes."""

    whole: Trace
    code: int
    seconds: dict[bool, float]
    """Usual duration, s: from a cold start (True) and from the nursery."""


@dataclass
class Kill:
    """What came of one kill. Flaws are told in words; there should be none."""

    number: int
    job: str
    command: str
    way: str
    cold: bool
    instant: float
    """Seconds from the start."""
    code: int | None = None
    said: str = ""
    begun: bool = True
    """Whether misstep was at work, and not Python still starting."""
    ended_by_itself: bool = False
    """Whether the command got to its end all the same."""
    others_spoke: bool = False
    """Whether, refused memory, a library in C ended the process, or a process that was still
    starting beside it said why it could not."""
    told: Counts = field(default_factory=dict)
    kept: Counts = field(default_factory=dict)
    seconds_to_end: float = 0.0
    began_again: bool = False
    """Whether nothing had begun that could be gone on with."""
    lost: list[str] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)
    left: list[str] = field(default_factory=list)
    goodbye: list[str] = field(default_factory=list)
    differs: list[str] = field(default_factory=list)

    @property
    def flaws(self) -> list[str]:
        """Everything that should not be."""
        return [*self.lost, *self.broken, *self.left, *self.goodbye, *self.differs]

    def to_json(self) -> dict[str, Any]:
        """Return it as plain values."""
        return asdict(self)


class Campaign:
    """Kills commands.

    Parameters
    ----------
    nursery : Nursery
    disk : Path or None
        A small disk, for `FULL`; without one nothing can be killed so.
    ground : Path
        A folder on a usual disk, for all else.
    seed : int

    Attributes
    ----------
    ways : list of str
        Those of `WAYS` that can be had here.
    """

    def __init__(self, nursery: Nursery, disk: Path | None, ground: Path, seed: int) -> None:
        self._nursery, self._disk, self._ground, self._seed = nursery, disk, ground, seed
        self.ways = [way for way in WAYS if way != FULL or disk is not None]
        self._rehearsals: dict[str, Rehearsal] = {}
        self._before: dict[str, Trace] = {}

    def rehearse(self, job: Job, *, cold: bool) -> Rehearsal:
        """Run a job uninterrupted a few times: what it leaves has to be the same each time.

        Parameters
        ----------
        job : Job
        cold : bool
            Once from a cold start too, so that it can be killed there.

        Raises
        ------
        MisstepError
            If it fails or is not the same.
        """
        wholes, codes, seconds = [], set(), {False: [], True: []}  # type: ignore[var-annotated]
        for start in (*[True] * cold, *[False] * _REHEARSALS):
            folder, outside = self._lay_out(job, self._ground)
            self._before[job.name] = trace(folder)
            started = time.monotonic()
            child = self._nursery.start(job.words(outside), folder, outside / "said", cold=start)
            visitor = job.visit(outside, child)
            _await(job, child, visitor)
            seconds[start].append(time.monotonic() - started)
            _dismiss(job, child, visitor)
            if visitor is not None and visitor.problems:
                raise MisstepError(f"{job.name}: {visitor.problems[0]}; {child.err}")
            codes.add(child.code)
            wholes.append(trace(folder))
        first = job.comparable(wholes[0])
        differing = [p for whole in wholes for p in _differing(job.comparable(whole), first)]
        if len(codes) != 1 or differing:
            raise MisstepError(f"{job.name} is not the same every time: {codes}, {differing}")
        usual = {start: median(values) for start, values in seconds.items() if values}
        rehearsal = Rehearsal(wholes[0], int(codes.pop() or 0), usual)
        self._rehearsals[job.name] = rehearsal
        return rehearsal

    def kill(self, number: int, job: Job, way: str, *, cold: bool) -> Kill:
        """Kill a job once at an instant that is drawn over its usual duration."""
        rng = np.random.default_rng([self._seed, number])
        rehearsal = self._rehearsals[job.name]
        for _ in range(_DRAWS):
            instant = float(rng.uniform(0.0, rehearsal.seconds[cold]))
            done = Kill(number, job.name, job.command, way, cold, instant)
            if self._strike(done, job, rng):
                return done
        raise MisstepError(f"{job.name} always ended before it was struck")

    def _strike(self, done: Kill, job: Job, rng: np.random.Generator) -> bool:
        """Do it; return whether the command was still there to be struck."""
        place = self._disk if done.way == FULL and self._disk is not None else self._ground
        folder, outside = self._lay_out(job, place)
        words = job.words(outside)
        child = self._nursery.start(words, folder, outside / "said", cold=done.cold)
        visitor = job.visit(outside, child)
        try:
            if child.wait(done.instant):
                return False
            struck = time.monotonic()
            try:
                done.begun = child.has_begun()
                strike(done.way, child, folder, rng)
            except (FileNotFoundError, ProcessLookupError):  # it has ended at this very moment
                return False
            _await(job, child, visitor, done.way)
            relieve(done.way, child, folder)
            told_off = child.code is None and job.serves
            _dismiss(job, child, visitor)
            done.seconds_to_end = time.monotonic() - struck
            done.code, done.said = child.code, _said(child)
            done.told = {**job.told(child), **(visitor.told if visitor is not None else {})}
            self._look(done, job, folder)
            self._hear(done, job, child, visitor, told_off=told_off)
        finally:
            child.bury()
        self._go_on(done, job, folder, outside)
        return True

    def _lay_out(self, job: Job, place: Path) -> tuple[Path, Path]:
        """Return an empty folder with what the job needs, and one beside it."""
        folder, outside = place / "folder", self._ground / "outside"
        for path in (folder, outside):
            if path.exists():
                shutil.rmtree(path)
            path.mkdir()
        job.lay_out(folder)
        return folder, outside

    def _look(self, done: Kill, job: Job, folder: Path) -> None:
        """See whether everything is there, and whole."""
        before, whole = self._before[job.name], self._rehearsals[job.name].whole
        try:
            held = trace(folder)
            done.kept = job.kept(folder)
        except MisstepError as error:
            done.broken.append(str(error))
            return
        for path, value in held.items():
            if not job.is_right(path, value, before, whole):
                done.broken.append(f"{path} is neither the old one nor the new one")
        for path in before:
            if path not in held:
                done.lost.append(f"{path} is gone")
        for what, count in done.told.items():
            if done.kept[what] < count:
                done.lost.append(f"{count} {what} were reported, {done.kept[what]} are there")
        # What a full disk or an interrupt leaves can be taken away, and has to be. From a folder
        # without rights nothing can be taken away, by a process that was killed nothing at all.
        left = left_over(folder)
        if left and done.way not in (KILL, READ_ONLY) and (done.code or 0) >= 0:
            done.left.append(f"left behind: {', '.join(left)}")

    def _hear(
        self, done: Kill, job: Job, child: Child, visitor: Visitor | None, *, told_off: bool
    ) -> None:
        """See whether the command said well why it ended."""
        if child.code is None:
            done.goodbye.append(f"it hangs: {PATIENCE:g} s after {done.way} it has not ended")
            return
        normal = self._rehearsals[job.name].code
        codes, line = _GOODBYES[done.way]
        if told_off:
            # It went on: whoever it served was told, and then somebody ended it as usual.
            # What could not be kept is tried once more then, and told if it is in vain again.
            (code, *_), line = _GOODBYES[TERMINATE]
            codes, line = (code, *codes), f"{line}|{_GOODBYES[done.way][1]}"
            for problem in visitor.problems if visitor is not None else ():
                if not re.search(_TOLD[done.way], problem):
                    done.goodbye.append(f"it was told: {problem}")
            done.ended_by_itself = not (visitor and visitor.problems)
        elif child.code == normal and not done.said:
            done.ended_by_itself = True
            return
        elif not done.begun:
            return
        elif done.way == MEMORY and (child.code < 0 or _OTHERS.search(done.said)):
            done.others_spoke = True
            return
        lines = done.said.splitlines()
        if child.code not in codes:
            done.goodbye.append(f"exit code {child.code} after {done.way}: {done.said[-3000:]}")
        elif len(lines) != bool(line) or not re.fullmatch(line, done.said.strip()):
            done.goodbye.append(f"it said: {done.said[-2000:]}")
        end = time.monotonic() + 10.0
        while child.processes() and time.monotonic() < end:
            time.sleep(0.005)
        if child.processes():
            done.goodbye.append("a process that it had started goes on")

    def _go_on(self, done: Kill, job: Job, folder: Path, outside: Path) -> None:
        """Have the command go on to its end, and compare."""
        rehearsal = self._rehearsals[job.name]
        words = job.going_on(folder, outside)
        done.began_again = not words or words == job.words(outside)
        if not words:
            return
        child = self._nursery.start(words, folder, outside / "said", cold=False)
        child.wait(PATIENCE)
        child.bury()
        if _said(child):
            done.differs.append(f"going on ended with {child.code}: {_said(child)[-300:]}")
            return
        try:
            found, wanted = job.comparable(trace(folder)), job.comparable(rehearsal.whole)
        except MisstepError as error:
            done.differs.append(str(error))
            return
        for path in _differing(found, wanted):
            done.differs.append(f"{path} differs from that of an uninterrupted command")


def _await(job: Job, child: Child, visitor: Visitor | None, way: str = "") -> None:
    """Wait until the command has ended, or whoever it serves has nothing more to say."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end and not child.wait(PATIENCE if visitor is None else 0.005):
        if visitor is not None and visitor.is_done():
            done = job.ends and not visitor.problems
            child.wait(PATIENCE if done or way in (KILL, TERMINATE, INTERRUPT) else 2.0)
            return


def _dismiss(job: Job, child: Child, visitor: Visitor | None) -> None:
    """End what serves and goes on, as somebody would who has seen what is wrong."""
    if job.serves and child.code is None:
        os.kill(child.pid, signal.SIGTERM)
        child.wait(PATIENCE)
    if visitor is not None:
        visitor.close()


def _differing(one: Trace, other: Trace) -> list[str]:
    return [path for path in sorted({*one, *other}) if one.get(path) != other.get(path)]


def _said(child: Child) -> str:
    """Return what a command said on stderr but for its progress."""
    return "\n".join(line for line in child.err.splitlines() if not _PROGRESS.match(line))
