"""Tiny jobs of the commands that end by themselves: `learn`, `study`, `convert`.

A job lays out a folder, says the words of its command, and afterwards what was told to be finished
and what is there. Whatever a job makes is the same every time, so each file that lies under its
final name has to be that of an uninterrupted command, or the one from before.
"""

import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from nursery import Child
from traces import Trace

from misstep import demonstrate, load_run, make_system, save_dataset
from misstep.study import load_study
from misstep.study.cells import CellResult, cell_file

LEARNERS = ("donut", "random-linear", "fall")
RUN, INPUT, RESULT = "RUN", "D.h5", "result.json"

_STUDY = """
[study]
name = "crash"
seeds = 2
max_trials = 3
tests = 1
videos = false

[[case]]
name = "balance"
system = "cartpole"
set = { duration = 2 }
state = ["theta", "theta_dot"]
demonstrators = ["weak"]
demonstrations = 3
learners = ["random-linear", "fall", "mean"]
"""

Counts = dict[str, int]
"""How many trials, runs, episodes, ... there are."""


class Visitor(Protocol):
    """Somebody who talks to a command that serves, in a thread of its own."""

    told: Counts
    """What the visitor was told to be finished."""
    problems: list[str]
    """What the visitor was told to have gone wrong."""

    def is_done(self) -> bool:
        """Return whether the visitor has nothing more to say."""

    def close(self) -> None:
        """End it."""


class Job:
    """One command on one tiny task."""

    command = ""
    serves = False
    """Whether it goes on when something has gone wrong, until it is stopped."""
    ends = True
    """Whether it ends by itself when all is done."""

    def __init__(self, name: str, source: Path) -> None:
        self.name = f"{self.command} {name}".strip()
        self.source = source

    def lay_out(self, folder: Path) -> None:
        """Put into an empty folder what the command needs."""
        shutil.copy(self.source / INPUT, folder / INPUT)

    def words(self, outside: Path) -> list[str]:
        """Return the words of the command; `outside` is for what is not to be struck."""
        raise NotImplementedError

    def visit(self, outside: Path, child: Child) -> Visitor | None:
        """Talk to the command, if it is of those that are talked to."""
        return None

    def told(self, child: Child) -> Counts:
        """Return what the command has told to be finished."""
        raise NotImplementedError

    def kept(self, folder: Path) -> Counts:
        """Return what is there, each opened; raise MisstepError if one does not open."""
        raise NotImplementedError

    def going_on(self, folder: Path, outside: Path) -> list[str]:
        """Return the words of the command that ends what was begun."""
        return self.words(outside)

    def is_right(self, path: str, held: Any, before: Trace, whole: Trace) -> bool:
        """Say whether a file holds what it may hold after a crash."""
        return any(path in t and t[path] == held for t in (before, whole))

    def comparable(self, held: Trace) -> Trace:
        """Return what has to be the same as in an uninterrupted command."""
        return held


class LearnJob(Job):
    """Eight trials of a learner."""

    command = "learn"

    def words(self, outside: Path) -> list[str]:
        """Return the words of the command."""
        learner = self.name.split()[-1]
        return (
            f"learn cartpole --from {INPUT} --learner {learner} --state theta,theta_dot "
            f"--max-trials 8 --keep-going --out {RUN} --json {RESULT}"
        ).split()

    def told(self, child: Child) -> Counts:
        """Return how many trials were reported."""
        return {"trials": _last_number(r"^trial (\d+)/", child.err)}

    def kept(self, folder: Path) -> Counts:
        """Return how many trials there are."""
        return {"trials": trials_of(folder / RUN)}

    def going_on(self, folder: Path, outside: Path) -> list[str]:
        """Resume the run; begin it again where it had not begun."""
        if (folder / RUN / "run.json").exists():
            return ["resume", RUN, "--json", RESULT]
        return self.words(outside)


class StudyJob(Job):
    """Six runs, tables, figures and a page."""

    command = "study"

    def lay_out(self, folder: Path) -> None:
        """Write the specification."""
        (folder / "study.toml").write_text(_STUDY)

    def words(self, outside: Path) -> list[str]:
        """Return the words of the command."""
        return f"study study.toml --out {RUN} --workers 1 --json {RESULT}".split()

    def told(self, child: Child) -> Counts:
        """Return how many runs were reported."""
        return {"runs": _last_number(r"^studying (\d+)/", child.err)}

    def kept(self, folder: Path) -> Counts:
        """Return how many runs have a result."""
        files = [cell_file(folder / RUN, c) for c in load_study(folder / "study.toml").cells]
        return {"runs": sum(CellResult.load(f).status == "done" for f in files if f.exists())}

    def going_on(self, folder: Path, outside: Path) -> list[str]:
        """Resume the study; begin it again where it had not begun."""
        if (folder / RUN / "study.json").exists():
            return ["resume", RUN, "--json", RESULT]
        return self.words(outside)


@dataclass(frozen=True)
class Conversion:
    """From what to what, and whether something is there already."""

    given: str
    wanted: str
    options: str = ""
    replaces: bool = False


CONVERSIONS = {
    "csv to a new file": Conversion("D.csv", "OUT.h5", "--rate 50 --to-rate 25"),
    "over an old file": Conversion(INPUT, "OUT.h5", "--to-rate 25", replaces=True),
    "to a new folder": Conversion(INPUT, "OUT", "--format lerobot --allow-loss"),
    "over an old folder": Conversion(
        INPUT, "OUT", "--format minari --allow-loss --to-rate 25", replaces=True
    ),
}


class ConvertJob(Job):
    """A conversion, onto nothing or onto a target that exists."""

    command = "convert"

    def __init__(self, name: str, source: Path) -> None:
        super().__init__(name, source)
        self.conversion = CONVERSIONS[name]

    def lay_out(self, folder: Path) -> None:
        """Put the input there, and the old target."""
        given, wanted = self.conversion.given, self.conversion.wanted
        shutil.copy(self.source / "large" / given, folder / given)
        if self.conversion.replaces:
            old = self.source / "old" / wanted
            (shutil.copytree if old.is_dir() else shutil.copy)(old, folder / wanted)

    def words(self, outside: Path) -> list[str]:
        """Return the words of the command."""
        asked = self.conversion
        return ["convert", asked.given, asked.wanted, "--force", *asked.options.split()]

    def told(self, child: Child) -> Counts:
        """Return whether the conversion was reported."""
        return {"conversions": int(" steps" in child.out)}

    def kept(self, folder: Path) -> Counts:
        """Return whether there is a target; that it is whole is looked at apart."""
        wanted = folder / self.conversion.wanted
        if self.conversion.replaces and not wanted.exists():
            return {"conversions": 0, "lost targets": 1}
        return {"conversions": int(wanted.exists())}


def make_sources(folder: Path) -> None:
    """Make what all jobs start from: some recordings, and old targets of conversions."""
    system = make_system("cartpole", duration=2.0)
    save_dataset(demonstrate(system, by="weak", n=3, seed=0), folder / INPUT)
    large = folder / "large"
    large.mkdir()
    shown = demonstrate(make_system("cartpole", duration=4.0), by="random", n=40, seed=1)
    save_dataset(shown, large / INPUT)
    save_dataset(shown, large / "D.csv")
    (folder / "old").mkdir()
    other = demonstrate(system, by="bang-bang", n=2, seed=2)
    save_dataset(other, folder / "old" / "OUT.h5")
    save_dataset(other, folder / "old" / "OUT", "minari")


def trials_of(folder: Path) -> int:
    """Return how many trials a run holds; none where it has not begun."""
    return len(load_run(folder).trials) if (folder / "run.json").exists() else 0


def _last_number(pattern: str, text: str) -> int:
    return max(map(int, re.findall(pattern, text, re.MULTILINE)), default=0)
