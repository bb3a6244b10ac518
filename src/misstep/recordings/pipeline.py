"""The way of a recording from the file that it was made in to the one that it is learned from.

read -> columns -> one clock -> actions -> rate -> angles -> outcome -> provenance -> write

Every stage passes blocks on as they come, so that nothing is ever in memory as a whole.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from misstep.errors import MisstepError
from misstep.formats import Block, Ending, Episode, Format, Header, read_episodes
from misstep.parameters import ParameterValue
from misstep.recordings.angles import Convention, with_angles
from misstep.recordings.clock import on_one_clock
from misstep.recordings.mapping import ColumnMapping
from misstep.recordings.outcomes import judged
from misstep.recordings.resampling import at_rate

if TYPE_CHECKING:
    from misstep.recordings.checking import Beginnings
    from misstep.systems import System

INVERSE_DYNAMICS, VELOCITIES = "inverse-dynamics", "velocities"


@dataclass(frozen=True)
class Plan:
    """What is to be done to recordings on their way.

    Parameters
    ----------
    mapping : ColumnMapping
        Which columns become which.
    to_rate : float or None, Hz
        Rate of what is written; None: that of the recording.
    infer_actions : str
        ``"inverse-dynamics"`` of the system; ``"velocities"``, of all observation columns, or
        ``"velocities:x,theta"`` of some; or empty: those recorded.
    system : str
        Name of the system that was driven; empty: what the file says.
    parameters : mapping from str to float, int, bool or str
        The system's.
    demonstrator : str
        Who acted; empty: what the file says.
    failure, success : str or None
        Formulas for the outcome, see `misstep.judges`.
    hold : float, s
        How long a success must have held in the end.
    angles : "recorded", "wrapped", "unwrapped" or None
        See `misstep.recordings.angles`. None: wrapped, as the systems have them, where actions are
        inferred by inverse dynamics, and else as recorded.
    only : str or None
        Name of a part of the episodes, see `misstep.formats.format.ReadOptions`.

    Raises
    ------
    MisstepError
        If a part of it fits no other: parameters without a system, an unknown way to infer.
    """

    mapping: ColumnMapping = field(default_factory=ColumnMapping)
    to_rate: float | None = None
    infer_actions: str = ""
    system: str = ""
    parameters: Mapping[str, ParameterValue] = field(default_factory=dict)
    demonstrator: str = ""
    failure: str | None = None
    success: str | None = None
    hold: float = 0.0
    angles: Convention | None = None
    only: str | None = None

    def __post_init__(self) -> None:
        if self.parameters and not self.system:
            raise MisstepError("parameters belong to a system: name it with --system")
        way, colon, _ = self.infer_actions.partition(":")
        if way not in ("", INVERSE_DYNAMICS, VELOCITIES):
            raise MisstepError(
                f"--infer-actions {way!r}: there are {INVERSE_DYNAMICS} and {VELOCITIES}"
            )
        if colon and way != VELOCITIES:
            raise MisstepError(
                f"--infer-actions {self.infer_actions!r}: only {VELOCITIES} are of some columns"
            )
        if way == INVERSE_DYNAMICS and not self.system:
            raise MisstepError(
                "--infer-actions inverse-dynamics goes by the equations of a system: name it with "
                "--system, and its parameters with --set"
            )
        if self.angles not in (None, "recorded", "wrapped", "unwrapped"):
            raise MisstepError(
                f"--angles {self.angles!r}: there are recorded, wrapped and unwrapped"
            )

    def make_system(self) -> "System | None":
        """Build the system; None if none is named.

        Raises
        ------
        MisstepError
            If there is no such system or parameter.
        """
        if not self.system:
            return None
        from misstep.systems import make_system

        return make_system(self.system, **self.parameters)

    def apply(
        self, episode: Episode, system: "System | None", beginnings: "Beginnings | None" = None
    ) -> Episode:
        """Return the episode as it is to be written.

        Parameters
        ----------
        episode : Episode
        system : System or None
            What `make_system` built.
        beginnings : Beginnings, optional
            Sees the episode at the rate that it was recorded with, in the system's units.

        Raises
        ------
        MisstepError
            What the stages raise, also on the way.
        """
        episode = self.mapping.apply(episode)
        needs_clock = self.to_rate or self.infer_actions or self.failure or self.success
        if needs_clock or self.mapping.rate is not None:
            episode = on_one_clock(episode, self.mapping.rate)
        episode = self._with_provenance(episode, system)
        if beginnings is not None:
            episode = beginnings.keeping(episode)
        episode = self._with_actions(episode, system)
        episode = at_rate(episode, self.to_rate)
        usual: Convention = "wrapped" if self.infer_actions == INVERSE_DYNAMICS else "recorded"
        episode = with_angles(episode, self.angles or usual)
        episode = judged(episode, failure=self.failure, success=self.success, hold=self.hold)
        return _counted(episode)

    def _with_provenance(self, episode: Episode, system: "System | None") -> Episode:
        provenance = episode.header.provenance
        if system is not None:
            provenance = replace(provenance, system=self.system, parameters=system.parameters)
        if self.demonstrator:
            provenance = replace(provenance, demonstrator=self.demonstrator)
        return replace(episode, header=replace(episode.header, provenance=provenance))

    def _with_actions(self, episode: Episode, system: "System | None") -> Episode:
        way, _, names = self.infer_actions.partition(":")
        if not way:
            return episode
        from misstep.recordings.inverse_dynamics import inferring_actions, inferring_velocities

        if way == INVERSE_DYNAMICS and system is not None:
            return inferring_actions(episode, system)
        chosen = [name.strip() for name in names.split(",")] if names else None
        return inferring_velocities(episode, chosen)


def planned(
    paths: Sequence[Path],
    plan: Plan,
    *,
    format: str | None = None,
    report: Callable[[int, int], None] | None = None,
    beginnings: "Beginnings | None" = None,
) -> Iterator[Episode]:
    """Read files and yield their episodes as a plan says.

    Parameters
    ----------
    paths : sequence of Path
    plan : Plan
    format : str, optional
        Name of the format that the files have.
    report : callable, optional
        ``report(done, total)`` of all files together, in thousandths.
    beginnings : Beginnings, optional
        As `Plan.apply` takes them.

    Raises
    ------
    MisstepError
        Also on the way, with the name of the file.
    """
    system = plan.make_system()
    for number, path in enumerate(paths):

        def report_one(done: int, total: int, number: int = number) -> None:
            if report is not None:
                report(round(1000 * (number + done / max(1, total))), 1000 * len(paths))

        options = replace(plan.mapping.options(), only=plan.only, report=report_one)
        for episode in read_episodes(path, options, format):
            with _naming(path):
                made = plan.apply(episode, system, beginnings)
            yield _with_file(path, made)


def _with_file(path: Path, episode: Episode) -> Episode:
    """Return the episode; what is found wrong with it on its way is told with its file."""

    def blocks() -> Iterator[Block]:
        with _naming(path):
            yield from episode.blocks

    def ending() -> Ending:
        with _naming(path):
            return episode.ending()

    return replace(episode, blocks=blocks(), ending=ending)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Let an error begin with the file, unless it names it, as those of its reader do."""
    try:
        yield
    except MisstepError as error:
        if str(path) in str(error):
            raise
        raise MisstepError(f"{path}: {error}") from error


def losing(episodes: Iterator[Episode], target: Format, *, allowed: bool) -> Iterator[Episode]:
    """Pass on episodes that a format can hold.

    Parameters
    ----------
    episodes : iterator of Episode
    target : Format
    allowed : bool
        Pass on also what it can only hold a part of.

    Raises
    ------
    MisstepError
        On the way, with a list of what would be lost.
    """
    for index, episode in enumerate(episodes):
        lost = target.losses(episode.header)
        if lost and not allowed:
            raise MisstepError(
                f"{target.description.partition(';')[0]} cannot hold of episode_{index}: "
                f"{'; '.join(lost)}; add --allow-loss to write it without"
            )
        yield episode


def _counted(episode: Episode) -> Episode:
    """Check in the end that an episode is left: T + 1 finite observations of T >= 1 actions."""

    def blocks() -> Iterator[Block]:
        rows = 0
        for block in episode.blocks:
            arrays: list[Any] = [block.observations, block.actions]
            arrays += [block.costs] if block.costs is not None else []
            if not all(np.isfinite(array).all() for array in arrays):
                raise MisstepError(
                    f"{episode.where(rows)} or soon after: a value became too large to be finite"
                )
            rows += len(block.observations)
            yield block
        if rows < 2:
            raise MisstepError(
                "an episode is shorter than one step at its new rate: leave it out, or choose a "
                "higher --to-rate"
            )

    return replace(episode, blocks=blocks())


@dataclass
class Summary:
    """What went into a file, counted as it passed.

    Attributes
    ----------
    episodes, steps : int
    outcomes : list of str
    rates : list of float or None, Hz
        None where the rows kept uneven times.
    notes : dict from str to int
        Each note and in how many episodes it is.
    losses : dict from str to int
        What the format cannot hold, and of how many episodes.
    failed_at_start : int
        Episodes that failed at their first observation.
    first : Header or None
        Of the first episode.
    """

    episodes: int = 0
    steps: int = 0
    outcomes: list[str] = field(default_factory=list)
    rates: list[float | None] = field(default_factory=list)
    notes: dict[str, int] = field(default_factory=dict)
    losses: dict[str, int] = field(default_factory=dict)
    failed_at_start: int = 0
    first: Header | None = None

    def counting(self, episodes: Iterator[Episode], target: Format) -> Iterator[Episode]:
        """Pass on episodes and count what is in them."""
        for episode in episodes:
            yield self._count(episode, target)

    def _count(self, episode: Episode, target: Format) -> Episode:
        header = episode.header
        self.first = self.first or header
        self.episodes += 1
        self.rates.append(None if header.dt is None else 1.0 / header.dt)
        for line in target.losses(header):
            self.losses[line] = self.losses.get(line, 0) + 1

        def blocks() -> Iterator[Block]:
            rows = 0
            for block in episode.blocks:
                rows += len(block.observations)
                yield block
            self.steps += rows - 1

        def ending() -> Ending:
            ended = episode.ending()
            self.outcomes.append(ended.outcome.value)
            self.failed_at_start += ended.failure_step == 0
            for note in (*header.provenance.notes, *ended.notes):
                self.notes[note] = self.notes.get(note, 0) + 1
            return ended

        return replace(episode, blocks=blocks(), ending=_once(ending))


def _once(ending: Callable[[], Ending]) -> Callable[[], Ending]:
    """Return a function that asks for the ending the first time only."""
    known: list[Ending] = []

    def ask() -> Ending:
        if not known:
            known.append(ending())
        return known[0]

    return ask
