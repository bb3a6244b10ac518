"""What a format is, and the form in which recordings pass between formats: block by block.

A recording can be larger than memory. So a reader hands on episodes, and an episode its rows in
blocks of any size, one after the other; a writer takes them as they come. Only what is short is
known beforehand, the `Header`; what became of the attempt is known after the last block, the
`Ending`.

::

    read(path, options) -> Episode, Episode, ...        write(path, episodes)
                             |
                             header, block, block, ..., ending()

Row t of the actions is what was applied at row t of the observations. A format is one module and
one line of registration; it imports what it needs (pyarrow, rosbags) when it is used.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.parameters import LARGEST
from misstep.trajectory import Column, Outcome, Provenance, Trajectory

FloatArray = NDArray[np.float64]

BLOCK_ROWS = 8192
"""Rows that a reader hands on at a time, about: enough for speed, little memory."""

LARGEST_IN_MEMORY = 2**31
"""Bytes that an episode may take up where it has to be in memory as a whole."""


@dataclass(frozen=True)
class Header:
    """What is known of an episode before its first row.

    Parameters
    ----------
    dt : float or None, s
        Time between observations; None where the rows carry times of their own.
    observation_columns : tuple of n Column
    action_columns : tuple of m Column
        Empty where no actions were recorded.
    provenance : Provenance
        Empty texts for what the file does not say.
    """

    dt: float | None
    observation_columns: tuple[Column, ...]
    action_columns: tuple[Column, ...]
    provenance: Provenance


@dataclass(frozen=True, eq=False)
class Block:
    """Consecutive rows of an episode.

    Over a whole episode there are T + 1 observations, T actions and T costs. One block may hold
    more rows of one than of another, or none of them. The arrays are float64 and nobody changes
    them in place.

    Parameters
    ----------
    observations : ndarray, shape (b, n), each column in its unit
        NaN where the file has no number; see `ReadOptions.keep_nan`.
    actions : ndarray, shape (a, m), each column in its unit
        Shape (0, 0) where no actions were recorded.
    costs : ndarray, shape (c,), or None
        Cost of each step, in the task's own unit; None in every block where none were recorded.
    times : ndarray, shape (b,), s, or None
        Time of each observation, strictly increasing over the episode; in every block where the
        header's dt is None, and else None.
    """

    observations: FloatArray
    actions: FloatArray
    costs: FloatArray | None = None
    times: FloatArray | None = None


@dataclass(frozen=True)
class Ending:
    """What is known of an episode after its last row.

    Parameters
    ----------
    outcome : Outcome
    failure_step : int or None
        First observation at which the failure predicate holds, 0 .. T.
    notes : tuple of str
        What was found to be inferred or changed on the way, to be added to the provenance's.
    """

    outcome: Outcome = Outcome.UNKNOWN
    failure_step: int | None = None
    notes: tuple[str, ...] = ()


def _row(row: int) -> str:
    return f"row {row}"


@dataclass(frozen=True, eq=False)
class Episode:
    """One recorded attempt on its way from one file to another.

    Parameters
    ----------
    header : Header
    blocks : iterator of Block
        Can be gone through once, and before the reader is asked for its next episode: asked
        earlier, the reader skips the rest.
    ending : callable
        ``ending() -> Ending``, after the last block.
    where : callable
        ``where(row) -> str``: where a row of the observations, from 0, is in the file, such as
        ``"line 7"``; for messages.
    """

    header: Header
    blocks: Iterator[Block]
    ending: Callable[[], Ending] = Ending
    where: Callable[[int], str] = field(default=_row)

    @classmethod
    def of(cls, trajectory: Trajectory) -> "Episode":
        """Return a trajectory as an episode of one block."""
        header = Header(
            trajectory.dt,
            trajectory.observation_columns,
            trajectory.action_columns,
            trajectory.provenance,
        )
        block = Block(trajectory.observations, trajectory.actions, trajectory.costs)
        ending = Ending(trajectory.outcome, trajectory.failure_step)
        return cls(header, iter([block]), lambda: ending)

    def trajectory(self) -> Trajectory:
        """Return the whole episode in memory; it can be called once, in place of the blocks.

        Raises
        ------
        MisstepError
            If no actions were recorded, the rows have no common dt, or what was recorded is no
            trajectory: too few rows, values that are not finite.
        """
        header = self.header
        if not header.action_columns:
            raise MisstepError(
                "no actions were recorded: name their columns with --actions, or convert it with "
                "--infer-actions first"
            )
        if header.dt is None:
            raise MisstepError(
                "its rows have uneven times: convert it with --to-rate to one clock first"
            )
        block, ending = joined(self), self.ending()
        notes = (*header.provenance.notes, *ending.notes)
        return Trajectory(
            observations=block.observations,
            actions=block.actions,
            dt=header.dt,
            observation_columns=header.observation_columns,
            action_columns=header.action_columns,
            provenance=replace(header.provenance, notes=notes),
            outcome=ending.outcome,
            costs=block.costs,
            failure_step=ending.failure_step,
        )


def joined(episode: Episode) -> Block:
    """Return all blocks of an episode as one, in memory.

    Raises
    ------
    MisstepError
        If it has no block, or takes up more than `LARGEST_IN_MEMORY` bytes.
    """
    blocks, n_bytes = [], 0
    for block in episode.blocks:
        n_bytes += block.observations.nbytes + block.actions.nbytes
        if n_bytes > LARGEST_IN_MEMORY:
            raise MisstepError(
                f"it takes up more than {LARGEST_IN_MEMORY} bytes in memory: cut it, or bring it "
                "to a lower rate with `misstep convert --to-rate`"
            )
        blocks.append(block)
    if not blocks:
        raise MisstepError("an episode has no rows")
    costs = [block.costs for block in blocks if block.costs is not None]
    times = [block.times for block in blocks if block.times is not None]
    return Block(
        np.concatenate([block.observations for block in blocks]),
        np.concatenate([block.actions for block in blocks]),
        np.concatenate(costs) if costs else None,
        np.concatenate(times) if times else None,
    )


@dataclass(frozen=True)
class ReadOptions:
    """What a user says about a file that does not say it itself. A reader uses what it needs.

    Parameters
    ----------
    observations : tuple of str or None
        Names, in the file, of the columns that are observations, in their order: of a table its
        columns, of a bag ``/topic.field``. Readers that need no telling may ignore it: whoever
        asked picks and renames columns afterwards. None: all that are not something else.
    actions : tuple of str or None
        Names of those that are actions. None: what the file itself says are actions.
    time : str or None
        Name of the column of times.
    time_unit : str
        Its unit, ``"s"``, ``"ms"``, ``"us"`` or ``"ns"``; empty: what the file says, or seconds.
    episode : str or None
        Name of the column that changes from one episode to the next.
    rate : float or None, Hz
        Rows a second, where the file does not say; it stands over a column of times that was not
        asked for.
    named : bool or None
        Whether the first row of a table names its columns; None: look.
    only : str or None
        Name of the part of the episodes to read, where a file has such names: a filter key of
        robomimic's.
    keep_nan : bool
        Hand on NaN where there is no number, rather than refuse it: for who wants to report gaps.
    report : callable or None
        ``report(done, total)``, to be called now and then, in bytes or in any other count.

    Raises
    ------
    MisstepError
        If the rate is not positive and finite.
    """

    observations: tuple[str, ...] | None = None
    actions: tuple[str, ...] | None = None
    time: str | None = None
    time_unit: str = ""
    episode: str | None = None
    rate: float | None = None
    named: bool | None = None
    only: str | None = None
    keep_nan: bool = False
    report: Callable[[int, int], None] | None = None

    def __post_init__(self) -> None:
        if self.rate is not None and not 0 < self.rate <= LARGEST:
            raise MisstepError(f"the rate is {self.rate}: it has to be positive, in Hz")


Read = Callable[[Path, ReadOptions], Iterator[Episode]]
Write = Callable[[Path, Iterable[Episode]], None]


def _nothing_is_lost(header: Header) -> Sequence[str]:
    return ()


def _recognises_nothing(path: Path) -> bool:
    return False


@dataclass(frozen=True)
class Format:
    """How to read and write one kind of file, or folder of files.

    Parameters
    ----------
    description : str
        What it is, in a few words, for ``misstep list formats``.
    suffixes : tuple of str
        The suffixes that are its own, in lower case, each with its dot: a file to be written
        under such a name is written in this format. No two formats have a suffix in common.
    read : callable or None
        ``read(path, options) -> iterator of Episode``, one after the other, block by block.
        Raises MisstepError for whatever is wrong with the file, also on the way. None where it
        only writes.
    write : callable or None
        ``write(path, episodes)``, in a single step: the old file or the new one, never half. It
        never holds an episode whole. Raises MisstepError for what it cannot write. None where it
        only reads.
    append : callable or None
        ``append(path, trajectory)``, in a single step, to a file that exists; None: the file is
        written anew with one more.
    losses : callable
        ``losses(header) -> lines``: what a file of this format cannot hold of such an episode, a
        line each: ``"the seed"``. By default nothing is lost.
    read_suffixes : tuple of str
        Suffixes of another format under which files of this one are found as well.
    is_folder : bool
        Whether it is a folder rather than a file.
    recognise : callable
        ``recognise(path) -> bool``: whether an existing file under one of `suffixes` or
        `read_suffixes`, or a folder, is of this format. Those with the suffix of their own are
        asked first. Says False, and raises nothing, where it cannot tell.
    extra : str
        The optional dependency that it needs, ``"parquet"`` for ``misstep[parquet]``.
    """

    description: str
    suffixes: tuple[str, ...]
    read: Read | None
    write: Write | None
    append: Callable[[Path, Trajectory], None] | None = None
    losses: Callable[[Header], Sequence[str]] = _nothing_is_lost
    read_suffixes: tuple[str, ...] = ()
    is_folder: bool = False
    recognise: Callable[[Path], bool] = _recognises_nothing
    extra: str = ""
