"""What the worker's process does: learn, fit, read what was dropped in, write what is downloaded.

Each job takes plain values and paths that the server has made, never a name from the page.
"""

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from misstep.errors import MisstepError
from misstep.formats import FORMATS, load_dataset, save_dataset
from misstep.learners import Task
from misstep.learning import learn, resume
from misstep.live.narration import tell_trial
from misstep.live.packing import PACKED, unpacked
from misstep.live.picture import show_mixture, show_recording, show_summary, still_columns, to_json
from misstep.runs import Run, load_config, load_run
from misstep.systems import System, make_system, recorded_system
from misstep.systems.recorded import system_kind
from misstep.trajectory import Dataset, Trajectory

MOST_STEPS = 300_000
"""Of all recordings in a file that is dropped in: 100 minutes at 50 Hz."""

Tell = Callable[[str, Any], None]
"""``tell(kind, value)``: tell the server something while the job goes on."""
Ask = Callable[[], str]
"""Wait until the server says how to go on: ``"next"`` or ``"halt"``."""


_NOTHING: Mapping[str, Any] = {}


class _HaltError(Exception):
    """A person has stopped the learning."""


def describe(
    tell: Tell,
    ask: Ask,
    *,
    attempts: str,
    system: str = "",
    parameters: Mapping[str, Any] = _NOTHING,
) -> str:
    """Return the mixture of what was recorded, as JSON; ``null`` where there is none.

    Here and below, `system` and `parameters` are what the server was started with: what a
    recording or a run says beyond that builds simulations alone.
    """
    dataset = load_dataset(attempts)
    origin = dataset[0].provenance
    typed = origin.system == system
    given = _given(parameters, system) if typed else {}
    driven = recorded_system(origin.system, origin.parameters, given, typed=typed)
    chosen = [c.name for c in driven.observation_columns if c.name not in still_columns(dataset)]
    if not chosen:
        return to_json(None)
    task = Task.of(driven, chosen)
    return to_json(show_mixture(task, tuple(dataset), None, np.random.default_rng(0)))


def learn_by_trial(
    tell: Tell,
    ask: Ask,
    *,
    system: str,
    parameters: Mapping[str, Any],
    attempts: str,
    learner: str,
    state: Sequence[str],
    max_trials: int,
    seed: int,
    out: str,
) -> str:
    """Learn from what was recorded, in a run folder; tell every trial, and wait after each."""
    driven = make_system(system, **parameters)
    dataset = load_dataset(attempts)
    tell("started", None)
    try:
        run = learn(
            driven,
            dataset,
            learner,
            state=tuple(state),
            max_trials=max_trials,
            seed=seed,
            out=out,
            on_trial=_teller(driven, tell, ask),
        )
    except _HaltError:
        return "halted"
    return "succeeded" if run.succeeded else "finished"


def resume_by_trial(
    tell: Tell,
    ask: Ask,
    *,
    folder: str,
    system: str = "",
    parameters: Mapping[str, Any] = _NOTHING,
) -> str:
    """Go on with a run that was interrupted; what was tried is told first."""
    run, driven = _opened(tell, folder, system, parameters)
    try:
        resume(run, system=driven, on_trial=_teller(driven, tell, ask))
    except _HaltError:
        return "halted"
    return "succeeded" if run.succeeded else "finished"


def show_run(
    tell: Tell,
    ask: Ask,
    *,
    folder: str,
    system: str = "",
    parameters: Mapping[str, Any] = _NOTHING,
) -> str:
    """Tell every trial of a run."""
    run, _ = _opened(tell, folder, system, parameters)
    if run.succeeded:
        return "succeeded"
    return "finished" if run.finished else "halted"


def _opened(
    tell: Tell, folder: str, name: str, parameters: Mapping[str, Any]
) -> tuple[Run, System]:
    """Load a run and its system, and tell its demonstrations and trials."""
    system = load_config(Path(folder)).make_system(_given(parameters, name), typed=name)
    run = load_run(folder, system=system)
    tell("demonstrations", to_json([show_recording(t) for t in run.demonstrations]))
    for number in range(1, len(run.trials) + 1):
        tell("trial", trial_picture(run, system, number))
    return run, system


def read_upload(
    tell: Tell, ask: Ask, *, path: str, system: str, parameters: Mapping[str, Any]
) -> list[Trajectory]:
    """Read a recording that was dropped in; it has to fit the system."""
    driven = make_system(system, **parameters)
    source = Path(path)
    if source.suffix == PACKED:
        source = unpacked(source)
    dataset = load_dataset(source)
    steps = sum(trajectory.n_steps for trajectory in dataset)
    if steps > MOST_STEPS:
        raise MisstepError(
            f"it holds {steps} steps and at most {MOST_STEPS} are taken at once: use `misstep "
            "learn` on the command line"
        )
    shown = [[c.name for c in cs] for cs in (dataset.observation_columns, dataset.action_columns)]
    wanted = [[c.name for c in cs] for cs in (driven.observation_columns, driven.action_columns)]
    if shown != wanted:
        raise MisstepError(
            f"its columns are {', '.join(shown[0] + shown[1])}, but {system} has "
            f"{', '.join(wanted[0] + wanted[1])}: rename them with `misstep convert`"
        )
    if dataset.observation_columns != driven.observation_columns:
        raise MisstepError("its columns have other units: convert them with `misstep convert`")
    if abs(dataset.dt - driven.dt) > 1e-9 * driven.dt:
        raise MisstepError(
            f"it has one step every {dataset.dt:g} s and {system} one every {driven.dt:g} s: "
            "change its rate with `misstep convert --to-rate`"
        )
    return list(dataset)


def write_download(tell: Tell, ask: Ask, *, attempts: Sequence[Trajectory], out: str) -> str:
    """Write attempts in the format `out` goes by, zipped where that is a folder."""
    target = Path(out)
    format_name = target.parent.name
    save_dataset(Dataset(attempts), target, format_name)
    if not FORMATS[format_name].is_folder:
        return out
    return shutil.make_archive(out, "zip", target)


def zip_folder(tell: Tell, ask: Ask, *, folder: str, out: str) -> str:
    """Pack a folder."""
    path = Path(folder)
    return shutil.make_archive(out, "zip", path.parent, path.name)


def trial_picture(run: Run, system: System, number: int) -> dict[str, str]:
    """Return what the page is shown of a trial: a summary and the whole of it, both as JSON."""
    config = run.config
    trial, policy = run.trials[number - 1], run.policies[number - 1]
    task = Task.of(system, config.state)
    before = (*run.demonstrations, *run.trials[: number - 1])
    sentence = tell_trial(number, trial, system, config.learner, policy)
    summary = {**show_summary(trial), "number": number, "sentence": sentence}
    rng = np.random.default_rng(number)
    whole = {
        **show_recording(trial),
        **summary,
        "computing_seconds": round(run.computing_seconds[number - 1], 4),
        "model": show_mixture(task, before, policy, rng),
    }
    return {"summary": to_json(summary), "whole": to_json(whole)}


def _teller(system: System, tell: Tell, ask: Ask) -> Callable[[Run], None]:
    def on_trial(run: Run) -> None:
        tell("trial", trial_picture(run, system, len(run.trials)))
        if not run.finished and ask() == "halt":
            raise _HaltError

    return on_trial


def _given(parameters: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Return the server's parameters where a file may not say its own."""
    return {} if name and system_kind(name).typed_only == frozenset() else parameters


JOBS: dict[str, Callable[..., Any]] = {
    "describe": describe,
    "learn": learn_by_trial,
    "resume": resume_by_trial,
    "show_run": show_run,
    "read": read_upload,
    "write": write_download,
    "zip": zip_folder,
}
"""What the server can have done, by name."""
