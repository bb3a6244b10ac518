"""`inspect_file`: read a recording of any format once, summarise it, and find where it went wrong.

A file that does not hold trajectories (values are missing, times are uneven, there are no actions)
is summarised all the same; why nothing can be said about its attempts is told instead.
"""

import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from misstep.blame import ActionLimits, Blame, action_limits, find_blame, sentences
from misstep.errors import MisstepError
from misstep.formats import Episode, Header, ReadOptions, read_episodes
from misstep.formats.format import LARGEST_IN_MEMORY, joined
from misstep.inspection.summary import ColumnSummary, EpisodeSummary, Tally, fingerprint
from misstep.recordings.checking import Checked, check_recorded
from misstep.trajectory import Dataset, Trajectory

Progress = Callable[[int, int], None]
"""``report(done, total)``."""


@dataclass(frozen=True)
class Inspection:
    """What was found in a file.

    Parameters
    ----------
    file : str
    episodes : tuple of EpisodeSummary
    columns : tuple of ColumnSummary
        Observations, then actions.
    dataset : Dataset or None
        None where the file does not hold trajectories.
    limits : ActionLimits or None
    blames : tuple of Blame
        One an episode; empty where nothing can be said.
    reason : str
        Why not, if so.
    equations : Checked
        Whether the attempts obey the equations of the system that their provenance names.
    """

    file: str
    episodes: tuple[EpisodeSummary, ...]
    columns: tuple[ColumnSummary, ...]
    dataset: Dataset | None
    limits: ActionLimits | None
    blames: tuple[Blame, ...]
    reason: str
    equations: Checked

    @property
    def sentences(self) -> list[str]:
        """Where each attempt went wrong, in words."""
        return sentences(self.blames, "episode")

    def as_json(self) -> dict[str, Any]:
        """Return all of it as plain dictionaries, lists, numbers and texts."""
        blames: list[Blame | None] = [*self.blames] or [None] * len(self.episodes)
        return {
            "file": self.file,
            "episodes": [
                {**asdict(episode), "oddities": episode.oddities, **_blame_as_json(blame)}
                for episode, blame in zip(self.episodes, blames, strict=True)
            ],
            "columns": [asdict(column) for column in self.columns],
            "action_limits": None
            if self.limits is None
            else {
                "low": self.limits.low.tolist(),
                "high": self.limits.high.tolist(),
                "source": self.limits.source,
            },
            "no_blame_because": self.reason,
            **self.equations.as_json(),
        }


def inspect_file(
    path: str | os.PathLike[str],
    *,
    format: str | None = None,
    options: ReadOptions | None = None,
    seed: int = 0,
    progress: Progress = lambda done, total: None,
) -> Inspection:
    """Inspect a recording.

    Parameters
    ----------
    path : path
        Of any format that misstep reads.
    format : str, optional
        Name of the format; by default what the content and the suffix say.
    options : ReadOptions, optional
        What the file does not say itself.
    seed : int
        Of the fits. Same seed, same result.
    progress : callable
        ``progress(done, total)`` is called with the attempts looked into.

    Raises
    ------
    MisstepError
        If the file cannot be read, or its episodes have different columns.
    """
    collected = _Collected()
    wanted = replace(options or ReadOptions(), keep_nan=True)
    for episode in read_episodes(path, wanted, format):
        collected.add(episode)
    dataset, limits, reason = collected.dataset()
    blames: tuple[Blame, ...] = ()
    if dataset is not None and limits is not None:
        blames = find_blame(dataset, limits=limits, seed=seed, progress=progress)
    return Inspection(
        os.fspath(path),
        tuple(collected.episodes),
        tuple(collected.columns(limits)),
        dataset,
        limits,
        blames,
        reason,
        Checked() if dataset is None else check_recorded(dataset),
    )


class _Collected:
    """The episodes of a file, as they are read."""

    def __init__(self) -> None:
        self.episodes: list[EpisodeSummary] = []
        self._first: Header | None = None
        self._trajectories: list[Trajectory] = []
        self._n_bytes = 0
        self._reason = ""
        self._seen: dict[bytes, int] = {}

    def add(self, episode: Episode) -> None:
        header, number = episode.header, len(self.episodes) + 1
        block, ending = joined(episode), episode.ending()
        if self._first is None:
            self._first = header
            self._observed = Tally(header.observation_columns, "observation")
            self._done = Tally(header.action_columns, "action")
        elif _names(header) != _names(self._first):
            raise MisstepError(
                f"episode {number} has the columns {_names(header)} but episode 1 has "
                f"{_names(self._first)}: inspect them in separate files"
            )
        mark = fingerprint(block)
        summary = EpisodeSummary.of(number, header, block, ending, self._seen.get(mark))
        self._seen.setdefault(mark, number)
        self.episodes.append(summary)
        self._observed.add(block.observations)
        if header.action_columns:
            self._done.add(block.actions)
        if self._reason:
            return
        whole = Episode(header, iter([block]), lambda: ending)
        self._n_bytes += block.observations.nbytes + block.actions.nbytes
        try:
            self._trajectories.append(whole.trajectory())
        except MisstepError as error:
            self._reason = f"episode {number}: {error}"
        if self._n_bytes > LARGEST_IN_MEMORY:
            self._reason = f"it takes up more than {LARGEST_IN_MEMORY} bytes in memory"
        if self._reason:
            self._trajectories.clear()  # nobody wants them any more

    def dataset(self) -> tuple[Dataset | None, ActionLimits | None, str]:
        """Return the trajectories and the limits of their actions, or why there are none."""
        if self._reason:
            return None, None, self._reason
        try:
            dataset = Dataset(self._trajectories)
        except MisstepError as error:
            return None, None, str(error)
        try:
            return dataset, action_limits(dataset), ""
        except MisstepError as error:
            return dataset, None, str(error)

    def columns(self, limits: ActionLimits | None) -> list[ColumnSummary]:
        if self._first is None:
            return []
        ends = None if limits is None or not limits.known else (limits.low, limits.high)
        return [*self._observed.summaries(), *self._done.summaries(ends)]


def _names(header: Header) -> str:
    columns = (*header.observation_columns, *header.action_columns)
    return ", ".join(f"{c.name} [{c.unit}]" if c.unit else c.name for c in columns)


def _blame_as_json(blame: Blame | None) -> dict[str, Any]:
    if blame is None:
        names = ("danger", "disagreement", "departure", "blame", "fault", "method", "sentence")
        return {"point_of_no_return": None, **dict.fromkeys(names)}

    def listed(values: Any) -> list[float] | None:
        return None if values is None else np.round(values, 4).tolist()

    return {
        "point_of_no_return": blame.point_of_no_return,
        "danger": listed(blame.danger),
        "disagreement": listed(blame.disagreement),
        "departure": listed(blame.departure),
        "blame": listed(blame.blame),
        "fault": None if blame.fault is None else blame.fault._asdict(),
        "method": blame.method,
        "sentence": blame.sentence,
    }
