"""Episodes on their way into formats of other projects, which think in steps rather than blocks.

A step is what was seen, what was done, and what was seen next. All episodes of such a file have
actions, one common dt and the same columns; those that have not are refused before they are
written.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from misstep.errors import MisstepError
from misstep.formats.format import Block, Episode, FloatArray, Header
from misstep.formats.guard import check_same_kind, prefixed


class Steps(NamedTuple):
    """Some consecutive steps of an episode.

    Attributes
    ----------
    observations : ndarray, shape (b, n)
        Before each step.
    next_observations : ndarray, shape (b, n)
        After each step.
    actions : ndarray, shape (b, m)
    costs : ndarray, shape (b,), or None
        None where none were recorded.
    """

    observations: FloatArray
    next_observations: FloatArray
    actions: FloatArray
    costs: FloatArray | None


def steps_of(blocks: Iterable[Block]) -> Iterator[Steps]:
    """Yield the steps of an episode as its blocks come; at least one step at a time."""
    observations = actions = costs = None
    for block in blocks:
        observations = _joined(observations, block.observations)
        actions = _joined(actions, block.actions)
        if block.costs is not None:
            costs = _joined(costs, block.costs)
        count = min(len(observations) - 1, len(actions))
        if costs is not None:
            count = min(count, len(costs))
        if count < 1:
            continue
        yield Steps(
            observations[:count],
            observations[1 : count + 1],
            actions[:count],
            None if costs is None else costs[:count],
        )
        observations, actions = observations[count:], actions[count:]
        costs = None if costs is None else costs[count:]


def _joined(left: FloatArray | None, rows: FloatArray) -> FloatArray:
    return rows if left is None or not len(left) else np.concatenate([left, rows])


def uniform(path: Path, episodes: Iterable[Episode]) -> Iterator[Episode]:
    """Yield episodes that all have actions, a common dt and the same columns.

    Raises
    ------
    MisstepError
        On the way, if one has not; in the end, if there was none.
    """
    first: Header | None = None
    for index, episode in enumerate(episodes):
        first = first or episode.header
        with prefixed(f"cannot write {path}"):
            _check(index, episode.header, first)
        yield episode
    if first is None:
        raise MisstepError(f"cannot write {path}: there is no episode to write")


def dt_of(header: Header) -> float:
    """Return the time between observations, s, of an episode that `uniform` passed.

    Raises
    ------
    MisstepError
        If it has none.
    """
    if header.dt is None:
        raise MisstepError(
            "it has uneven times, which this format cannot hold: bring it to one clock with "
            "--to-rate"
        )
    return header.dt


def _check(index: int, header: Header, first: Header) -> None:
    with prefixed(f"episode_{index}"):
        dt_of(header)
        if not header.action_columns:
            raise MisstepError(
                "it has no actions, which this format has to have: name their columns with "
                "--actions, or infer them with --infer-actions"
            )
    check_same_kind(index, header, first)
