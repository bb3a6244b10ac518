"""One cell of a study: demonstrations, a run from them, and tests of the policy that came out.

A cell depends on nothing but what its `Cell` says. Of repetition r, the demonstrations, the trials
and the tests have one seed each, whatever the case, the demonstrator and the learner: learners are
compared on the same demonstrations.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

import numpy as np
from threadpoolctl import threadpool_limits

from misstep.demonstrators import demonstrate
from misstep.errors import MisstepError
from misstep.learning import evaluate, learn
from misstep.runs import Run
from misstep.storage import read_json
from misstep.study.spec import Cell, simulation
from misstep.systems.rendering import write_video

Status = Literal["done", "error", "lost"]

VIDEO_SECONDS = 10.0
WIDTH, HEIGHT, FPS = 480, 270, 15.0


@dataclass(frozen=True)
class Timing:
    """How long a cell took; differs from one time to the next."""

    computing_seconds: float
    """Of learning alone, without the trials, s."""
    wall_seconds: float
    """Of the whole cell, s."""


@dataclass(frozen=True)
class CellResult:
    """What came of a cell. All but `Timing` is the same on every machine of a kind."""

    status: Status
    error: str = ""
    trials_to_success: int | None = None
    """None without a success, and where the cell ended in an error."""
    seconds_of_interaction: float = 0.0
    """Duration of all trials together, s; up to and including the first success."""
    outcomes: tuple[str, ...] = ()
    failure_times: tuple[float | None, ...] = ()
    """When each trial failed, s."""
    costs: tuple[float | None, ...] = ()
    """Mean cost of a step of each trial."""
    tests: int = 0
    survived: int | None = None
    """Successes of the final policy in `tests` other starts; None if it was not tested."""
    timing: Timing = Timing(0.0, 0.0)

    @classmethod
    def load(cls, path: Path) -> "CellResult":
        """Read a result.

        Raises
        ------
        MisstepError
            If the file is missing or damaged.
        """
        values = read_json(path)
        names = set(cls.__dataclass_fields__)
        damaged = MisstepError(f"{path} is no result of a study: delete it, and it is made again")
        if not isinstance(values, dict) or set(values) != {"cell", *names}:
            raise damaged
        try:
            lists = {name: tuple(values[name]) for name in ("outcomes", "failure_times", "costs")}
            timing = Timing(**values["timing"])
        except TypeError as error:
            raise damaged from error
        return cls(**{name: values[name] for name in names} | lists | {"timing": timing})

    @property
    def summary(self) -> str:
        """What came of it, in a few words."""
        if self.error:
            return f"error: {self.error}" if self.status == "error" else self.error
        if self.trials_to_success is None:
            return f"no success in {len(self.outcomes)} trials"
        return f"success in trial {self.trials_to_success}"

    def to_json(self) -> dict[str, Any]:
        """Return it as plain values."""
        return asdict(self)


def cell_file(out: Path, cell: Cell) -> Path:
    """Return where the result of a cell is kept in the folder of a study."""
    *folders, repetition = cell.key
    names = (quote(str(name), safe="(),= +") for name in folders)
    return out.joinpath("cells", *names, f"{repetition:03d}.json")


def run_cell(cell: Cell) -> CellResult:
    """Run one cell; an error is part of the result."""
    started = time.perf_counter()
    runs: list[Run] = []
    error, survived = "", None
    # One thread: sums come out the same to the last bit, and workers do not crowd each other.
    with threadpool_limits(limits=1):
        try:
            run = _learn(cell, runs.append)
            survived = _test(cell, run) if cell.tests else None
        except MisstepError as raised:
            error = str(raised)
        # A fault in one learner must not cost the other thousand cells; the page shows it.
        except Exception as raised:
            error = f"{type(raised).__name__}: {' '.join(str(raised).split())}"
    trials = runs[-1].trials if runs else []
    return CellResult(
        status="error" if error else "done",
        error=error,
        trials_to_success=None if error else runs[-1].trials_to_success,
        seconds_of_interaction=sum(trial.duration for trial in trials),
        outcomes=tuple(str(trial.outcome) for trial in trials),
        failure_times=tuple(trial.failure_time for trial in trials),
        costs=tuple(trial.mean_cost for trial in trials),
        tests=cell.tests,
        survived=survived,
        timing=Timing(
            computing_seconds=sum(runs[-1].computing_seconds) if runs else 0.0,
            wall_seconds=time.perf_counter() - started,
        ),
    )


@dataclass(frozen=True)
class Video:
    """The first success of a cell, to be filmed."""

    cell: Cell
    path: Path


def write_first_success(video: Video) -> str:
    """Run a cell again and film its first success; return why there is no video, or nothing."""
    with threadpool_limits(limits=1):
        trial = _learn(video.cell, lambda run: None).trials[-1]
    steps = round(VIDEO_SECONDS / trial.dt)
    shown = trial.cut(steps) if steps < trial.n_steps else trial
    title = f"{video.cell.learner.label} on {video.cell.case.name}"
    try:
        write_video(shown, video.path, fps=FPS, width=WIDTH, height=HEIGHT, title=title)
    except MisstepError as error:  # a system of which there is no drawing
        return str(error)
    return ""


def _learn(cell: Cell, on_trial: Callable[[Run], None]) -> Run:
    case = cell.case
    demonstrator: Mapping[str, Any] = cell.demonstrator.parameters
    learner: Mapping[str, Any] = cell.learner.parameters
    system = simulation(case.system, case.parameters)
    shown = demonstrate(
        system,
        cell.demonstrator.name,
        case.demonstrations,
        _seed(cell, 0),
        **demonstrator,
    )
    return learn(
        system,
        shown,
        cell.learner.name,
        state=case.state,
        max_trials=case.max_trials,
        seed=_seed(cell, 1),
        on_trial=on_trial,
        **learner,
    )


def _test(cell: Cell, run: Run) -> int:
    case = cell.case
    system = simulation(case.system, {**case.parameters, **case.test_parameters})
    return evaluate(system, run.policy, episodes=cell.tests, seed=_seed(cell, 2)).successes


def _seed(cell: Cell, purpose: int) -> int:
    """Return the seed of the demonstrations (0), the trials (1) or the tests (2)."""
    stream = np.random.SeedSequence(cell.seed, spawn_key=(cell.repetition, purpose))
    return int(stream.generate_state(1)[0])
