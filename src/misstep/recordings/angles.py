"""Angles: a turn is taken out of a recording before it is filtered, and put back after.

An angle that is kept within one turn jumps where it leaves the turn: from π to -π, or from 2π to
0. To a filter that is a blow. Columns in rad or deg are angles; a step of more than half a turn
between two rows is such a jump. The first one tells where the recorded turn lies.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from misstep.formats.format import Block, Ending, Episode, FloatArray
from misstep.trajectory import Column
from misstep.units import TURNS

Convention = Literal["recorded", "wrapped", "unwrapped"]


class Turns:
    """Takes turns out of the rows of one episode, block by block, and puts them back.

    Parameters
    ----------
    columns : sequence of n Column
    """

    def __init__(self, columns: Sequence[Column]) -> None:
        self._periods = np.array([TURNS.get(column.unit, np.inf) for column in columns])
        self._last: FloatArray | None = None  # the last row, as recorded
        self._offset = np.zeros(len(columns))  # what was added to it
        self._middle = np.full(len(columns), np.nan)  # of the recorded turn, once there was a jump

    def unwrap(self, table: FloatArray) -> FloatArray:
        """Return the next rows, shape (b, n), without jumps."""
        if not np.isfinite(self._periods).any() or not len(table):
            return table
        before = table[:1] if self._last is None else self._last
        rows = np.concatenate([before, table])
        jumps = np.round(np.diff(rows, axis=0) / self._periods)
        for column in np.flatnonzero(jumps.any(axis=0) & np.isnan(self._middle)):
            row = int(np.flatnonzero(jumps[:, column])[0])
            half = self._periods[column] / 2.0
            self._middle[column] = half * np.round(rows[row : row + 2, column].mean() / half)
        turns = np.where(jumps != 0.0, -jumps * self._finite_periods(), 0.0)
        offsets = self._offset + np.cumsum(turns, axis=0)
        self._last, self._offset = table[-1:], offsets[-1]
        return table + offsets

    def rewrap(self, table: FloatArray) -> FloatArray:
        """Return rows within the turn that was recorded; as they are where none ever jumped."""
        jumped = np.isfinite(self._middle)
        if not jumped.any():
            return table
        wrapped = table.copy()
        part, period = table[:, jumped], self._periods[jumped]
        wrapped[:, jumped] = part - period * np.round((part - self._middle[jumped]) / period)
        return wrapped

    def wrap(self, table: FloatArray) -> FloatArray:
        """Return rows with angles within half a turn of zero, the positive half turn included."""
        periods = self._finite_periods()
        turned = table - periods * np.ceil(table / np.where(periods, periods, 1.0) - 0.5)
        inside = (np.abs(table) <= periods / 2.0) & (table != -periods / 2.0)
        return np.where(inside | (periods == 0.0), table, turned)

    def _finite_periods(self) -> FloatArray:
        return np.where(np.isfinite(self._periods), self._periods, 0.0)


def with_angles(episode: Episode, convention: Convention) -> Episode:
    """Return the episode with its angles in one convention.

    Parameters
    ----------
    episode : Episode
    convention : "recorded", "wrapped" or "unwrapped"
        As they are; within half a turn of zero; or without jumps. What changes is noted.
    """
    if convention == "recorded":
        return episode
    turns = Turns(episode.header.observation_columns)
    change: Callable[[FloatArray], FloatArray]
    change = turns.wrap if convention == "wrapped" else turns.unwrap
    changed = False

    def blocks() -> Iterator[Block]:
        nonlocal changed
        for block in episode.blocks:
            observations = change(block.observations)
            changed |= not np.array_equal(observations, block.observations)
            yield replace(block, observations=observations)

    def ending() -> Ending:
        ended = episode.ending()
        note = f"angles: {convention}, by whole turns"
        return replace(ended, notes=(*ended.notes, note)) if changed else ended

    return replace(episode, blocks=blocks(), ending=ending)
