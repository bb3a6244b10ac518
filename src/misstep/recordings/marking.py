"""Marking by hand: what became of an attempt, when it failed, and which part of it is usable.

A mark changes one episode of one of misstep's own files. What the episode was before is kept in a
folder beside the file, and so is the file as it was before the first mark::

    D.h5                 the file, with all marks
    D.h5.history/
      original.h5        the file before the first mark
      0001-episode-3.h5  episode 3 before the first mark
      0002-episode-1.h5  ...

The copy is written before the file, each in a single step. A process killed in between leaves a
copy that is the same as what the file holds; it is recognised by that and passed over. Two
processes must not mark one file at the same time: one of the marks would be lost.
"""

import os
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from misstep.errors import MisstepError
from misstep.formats import FORMATS, format_to_read, load_dataset, save_dataset
from misstep.storage import atomic_write
from misstep.trajectory import Dataset, Outcome, Provenance, Trajectory

ORIGINAL = "original.h5"
_COPY = re.compile(r"(\d+)-episode-(\d+)\.h5", re.ASCII)
_BY_HAND = ", marked by hand"


@dataclass(frozen=True)
class Mark:
    """What a person says about an attempt; None where they say nothing.

    Parameters
    ----------
    outcome : Outcome or None
    failure_time : float or None, s
        When it failed, from the start of the recording as it is. Says that it failed, too.
    usable : tuple of float or None, s
        Start and end of the part to keep, likewise.
    """

    outcome: Outcome | None = None
    failure_time: float | None = None
    usable: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.outcome is None and self.failure_time is None and self.usable is None:
            raise MisstepError("nothing is marked: give an outcome, a failure time or a part")
        if self.failure_time is not None and self.outcome not in (None, Outcome.FAILURE):
            raise MisstepError(
                f"a failure time of {self.failure_time:g} s and the outcome {self.outcome} "
                "contradict each other: leave one out"
            )


class Step(NamedTuple):
    """One mark that can be undone."""

    path: Path
    """The copy of the episode before it."""
    episode: int
    """From 1."""


def marked(trajectory: Trajectory, mark: Mark) -> Trajectory:
    """Return the trajectory as a person says that it is; the provenance notes it.

    Raises
    ------
    MisstepError
        If a time lies outside the recording, or the failure before the usable part.
    """
    changed = trajectory
    if mark.outcome is not None or mark.failure_time is not None:
        changed = _judged(changed, mark)
    if mark.usable is not None:
        changed = _cut(changed, *mark.usable)
    return changed


def mark_episode(path: str | os.PathLike[str], episode: int, mark: Mark) -> Trajectory:
    """Mark one episode of a file, and keep what it was.

    Parameters
    ----------
    path : path
        One of misstep's own files.
    episode : int
        From 1.
    mark : Mark

    Returns
    -------
    Trajectory
        As it is in the file now.

    Raises
    ------
    MisstepError
        If the file cannot be read or written or is of another format, there is no such episode, or
        as `marked`.
    """
    dataset = _load(path)
    before = dataset[_index(dataset, episode)]
    after = marked(before, mark)
    if after == before:
        return after
    folder = history_folder(path)
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise MisstepError(f"cannot keep what {path} was: {folder}: {error.strerror}") from error
    if not (folder / ORIGINAL).exists():
        atomic_write(folder / ORIGINAL, lambda temporary: shutil.copyfile(path, temporary))
    steps = history(path)
    number = 1 + max((_number(step.path) for step in steps), default=0)
    save_dataset(Dataset([before]), folder / f"{number:04}-episode-{episode}.h5")
    save_dataset(_with(dataset, episode, after), path)
    return after


def undo(path: str | os.PathLike[str]) -> int:
    """Take back the last mark of a file.

    Returns
    -------
    episode : int
        From 1: the one that is as it was before.

    Raises
    ------
    MisstepError
        If there is no mark to take back, or the file cannot be read or written.
    """
    dataset = _load(path)
    for step in reversed(history(path)):
        before = load_dataset(step.path)[0]
        same = before == dataset[_index(dataset, step.episode)]
        if not same:
            save_dataset(_with(dataset, step.episode, before), path)
        step.path.unlink()
        if not same:
            return step.episode
    raise MisstepError(f"{path} has no marks to take back")


def history(path: str | os.PathLike[str]) -> list[Step]:
    """Return the marks of a file that can be taken back, first to last."""
    folder = history_folder(path)
    copies = [m for m in map(_COPY.fullmatch, _names(folder)) if m]
    copies.sort(key=lambda m: int(m[1]))
    return [Step(folder / m[0], int(m[2])) for m in copies]


def history_folder(path: str | os.PathLike[str]) -> Path:
    """Return the folder beside a file that keeps what it was."""
    return Path(f"{os.fspath(path)}.history")


def _names(folder: Path) -> Sequence[str]:
    return os.listdir(folder) if folder.is_dir() else ()


def _number(copy: Path) -> int:
    return int(copy.name.partition("-")[0])


def _load(path: str | os.PathLike[str]) -> Dataset:
    found = format_to_read(path)
    if found is not FORMATS["hdf5"]:
        kind = found.description.partition(";")[0]
        raise MisstepError(
            f"{path} is {kind}, which cannot hold marks: bring it into misstep's own format first, "
            f"with `misstep convert {path} {_beside(Path(path))}`"
        )
    return load_dataset(path, "hdf5")


def _beside(path: Path) -> Path:
    """Return a name for a file of misstep's own beside one of another format."""
    other = path.with_suffix(".h5")
    return other if other != path else path.with_stem(f"{path.stem}-marked")


def _index(dataset: Dataset, episode: int) -> int:
    if not 1 <= episode <= len(dataset):
        raise MisstepError(f"there is no episode {episode}: they are numbered 1 to {len(dataset)}")
    return episode - 1


def _with(dataset: Dataset, episode: int, trajectory: Trajectory) -> Dataset:
    trajectories = list(dataset)
    trajectories[_index(dataset, episode)] = trajectory
    return Dataset(trajectories)


def _judged(trajectory: Trajectory, mark: Mark) -> Trajectory:
    outcome = Outcome.FAILURE if mark.outcome is None else mark.outcome
    step = trajectory.failure_step if outcome is Outcome.FAILURE else None
    if mark.failure_time is not None:
        step = _step(trajectory, mark.failure_time, "the failure time")
    source = trajectory.provenance
    if outcome is not trajectory.outcome:
        source = _noted(source, "outcome", f"{outcome}{_BY_HAND}")
    if step != trajectory.failure_step:
        when = "none" if step is None else f"{step * trajectory.dt:g} s"
        source = _noted(source, "failure time", f"{when}{_BY_HAND}")
    return replace(trajectory, outcome=outcome, failure_step=step, provenance=source)


def _cut(trajectory: Trajectory, start: float, end: float) -> Trajectory:
    first = _step(trajectory, start, "the usable part's start")
    last = _step(trajectory, end, "the usable part's end")
    if first >= last:
        raise MisstepError(
            f"the usable part from {start:g} to {end:g} s holds no action: it has to end at least "
            f"{trajectory.dt:g} s after it starts"
        )
    if (first, last) == (0, trajectory.n_steps):
        return trajectory
    failed = trajectory.failure_step
    if failed is not None and failed < first:
        raise MisstepError(
            f"it failed at {failed * trajectory.dt:g} s, before the usable part from {start:g} s: "
            "mark another failure time or part"
        )
    text = (
        f"usable part: {first * trajectory.dt:g} to {last * trajectory.dt:g} s of "
        f"{trajectory.duration:g} s{_BY_HAND}"
    )
    source = trajectory.provenance
    return replace(
        trajectory,
        observations=trajectory.observations[first : last + 1],
        actions=trajectory.actions[first:last],
        costs=None if trajectory.costs is None else trajectory.costs[first:last],
        failure_step=None if failed is None or failed > last else failed - first,
        provenance=replace(source, notes=(*source.notes, text)),
    )


def _step(trajectory: Trajectory, time: float, what: str) -> int:
    # Half a step of tolerance: a person reads 2.98 s off a table and types 3.
    if not -0.5 * trajectory.dt <= time <= trajectory.duration + 0.5 * trajectory.dt:
        raise MisstepError(
            f"{what} is {time:g} s, but the recording goes from 0 to {trajectory.duration:g} s"
        )
    return min(max(round(time / trajectory.dt), 0), trajectory.n_steps)


def _noted(source: Provenance, what: str, said: str) -> Provenance:
    """Return the provenance with a note in place of an earlier one by hand about the same."""
    others = [n for n in source.notes if not (n.startswith(f"{what}: ") and n.endswith(_BY_HAND))]
    return replace(source, notes=(*others, f"{what}: {said}"))
