"""What a reader hands on is checked in one place, and its errors are told with file and episode.

A reader says what is wrong and need not know how it is called: whoever goes through its episodes
here gets blocks that fit the header, and errors that begin with ``cannot read FILE: episode_3:``.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from misstep.errors import MisstepError
from misstep.formats.format import Block, Ending, Episode, Header
from misstep.trajectory import column_listing


@contextmanager
def prefixed(words: str) -> Iterator[None]:
    """Let a MisstepError begin with `words` and a colon."""
    try:
        yield
    except MisstepError as error:
        raise MisstepError(f"{words}: {error}") from error


def guarded(path: Path, episodes: Iterator[Episode], *, keep_nan: bool) -> Iterator[Episode]:
    """Pass on the episodes of a file, each guarded.

    Parameters
    ----------
    path : Path
        Of the file, for messages.
    episodes : iterator of Episode
        As a reader made them.
    keep_nan : bool
        Pass on NaN.

    Raises
    ------
    MisstepError
        What the reader raises; and if blocks do not fit their header, an episode does not hold
        T + 1 observations of T >= 1 actions, times do not increase, a value is not finite, or the
        failure step is none of its observations.
    """
    with prefixed(f"cannot read {path}"):
        for index, episode in enumerate(episodes):
            yield _guard(path, index, episode, keep_nan)


def _guard(path: Path, index: int, episode: Episode, keep_nan: bool) -> Episode:
    words = f"cannot read {path}: episode_{index}"
    check = _Check(episode, keep_nan)

    def blocks() -> Iterator[Block]:
        with prefixed(words):
            for block in episode.blocks:
                check.block(block)
                yield block
            check.end()

    def ending() -> Ending:
        with prefixed(words):
            ended = episode.ending()
            check.ending(ended)
            return ended

    return replace(episode, blocks=blocks(), ending=ending)


class _Check:
    """Checks the blocks of one episode as they pass."""

    def __init__(self, episode: Episode, keep_nan: bool) -> None:
        self._header, self._where, self._keep_nan = episode.header, episode.where, keep_nan
        self._rows = self._actions = self._costs = 0
        self._last_time = -np.inf
        self._has_costs = False

    def block(self, block: Block) -> None:
        self._table(block.observations, self._rows, "observation")
        if self._header.action_columns or block.actions.size:
            self._table(block.actions, self._actions, "action")
        self._costs_of(block)
        self._times_of(block)
        self._rows += len(block.observations)
        self._actions += len(block.actions)

    def _table(self, table: np.ndarray, first: int, kind: str) -> None:
        columns = getattr(self._header, f"{kind}_columns")
        if table.ndim != 2 or table.shape[1] != len(columns):
            raise MisstepError(
                f"{kind}s has shape {table.shape}: there are {len(columns)} {kind} columns"
            )
        if self._keep_nan or np.isfinite(table).all():
            return
        row, column = np.argwhere(~np.isfinite(table))[0]
        raise MisstepError(
            f"{self._where(first + row)}, {kind} column {columns[column].name!r} is "
            f"{table[row, column]}: every value has to be finite"
        )

    def _costs_of(self, block: Block) -> None:
        if block.costs is None:
            return
        if not self._keep_nan and not np.isfinite(block.costs).all():
            row = int(np.flatnonzero(~np.isfinite(block.costs))[0])
            raise MisstepError(
                f"{self._where(self._costs + row)}, the cost is {block.costs[row]}: every value "
                "has to be finite"
            )
        self._has_costs = True
        self._costs += len(block.costs)

    def _times_of(self, block: Block) -> None:
        if (block.times is None) != (self._header.dt is not None):
            raise MisstepError("rows carry times exactly where there is no common dt")
        if block.times is None or len(block.times) == 0:
            return
        unknown = np.flatnonzero(~np.isfinite(block.times))
        if len(unknown):
            row = int(unknown[0])
            raise MisstepError(
                f"{self._where(self._rows + row)}: the time is {block.times[row]} s: every time "
                "has to be finite"
            )
        steps = np.diff(block.times, prepend=self._last_time)
        if not (steps > 0).all():
            row = int(np.flatnonzero(steps <= 0)[0])
            before = block.times[row - 1] if row else self._last_time
            raise MisstepError(
                f"{self._where(self._rows + row)}: time {block.times[row]} s comes after {before} "
                "s: times have to increase; name the column that numbers the episodes with "
                "--episode if several are in one file"
            )
        self._last_time = block.times[-1]

    def end(self) -> None:
        if self._rows < 2:
            raise MisstepError(f"it has {self._rows} rows: an episode needs at least 2")
        counts = {"actions": self._actions} if self._header.action_columns else {}
        if self._has_costs:
            counts["costs"] = self._costs
        for name, count in counts.items():
            if count != self._rows - 1:
                raise MisstepError(
                    f"it has {self._rows} observations but {count} {name}: an episode of T "
                    f"{name} holds T + 1 observations"
                )

    def ending(self, ending: Ending) -> None:
        step = ending.failure_step
        if step is not None and not 0 <= step < self._rows:
            raise MisstepError(
                f"failure_step is {step}, but there are {self._rows} observations, from 0: were "
                "rows taken out after it was written?"
            )


def check_same_kind(index: int, header: Header, first: Header) -> None:
    """Check that an episode has the columns and dt of the first one of a file.

    Raises
    ------
    MisstepError
        If it has not.
    """
    if header.dt != first.dt:
        raise MisstepError(
            f"episode_{index} has dt {header.dt} s but episode_0 has {first.dt} s: all episodes "
            "of a file have the same; bring them to one clock with --to-rate"
        )
    for field in ("observation_columns", "action_columns"):
        here, there = column_listing(getattr(header, field)), column_listing(getattr(first, field))
        if here != there:
            raise MisstepError(
                f"episode_{index} has {field} {here} but episode_0 has {there}: all episodes of a "
                "file have the same columns"
            )
