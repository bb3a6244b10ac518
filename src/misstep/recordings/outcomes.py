"""What became of an attempt, where the recording does not say: two conditions on its columns."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from misstep.errors import MisstepError
from misstep.formats.format import Block, Ending, Episode
from misstep.judges import Formula, parse_predicate
from misstep.trajectory import Outcome


def judged(
    episode: Episode, *, failure: str | None, success: str | None, hold: float = 0.0
) -> Episode:
    """Return the episode with the outcome that two formulas say.

    An attempt has failed where the failure holds at any observation, and the first such is its
    failure step. Otherwise it is a success if the success held at every observation of the last
    `hold` seconds, and a failure, at its last observation, if it did not; without a formula for
    success, what was recorded stands.

    Parameters
    ----------
    episode : Episode
        On one clock.
    failure, success : str or None
        Formulas of `misstep.judges` over the observation columns.
    hold : float, s

    Raises
    ------
    MisstepError
        If a formula cannot be read, or `hold` is negative or comes without a success.
    """
    if failure is None and success is None:
        if hold:
            raise MisstepError("--hold needs a --success to hold")
        return episode
    if not 0 <= hold < math.inf:
        raise MisstepError(f"--hold is {hold:g}: it has to be at least 0, in s")
    columns, dt = episode.header.observation_columns, episode.header.dt or 0.0
    judge = _Judge(
        episode,
        None if failure is None else parse_predicate(failure, columns, "--failure"),
        None if success is None else parse_predicate(success, columns, "--success"),
        1 + round(hold / dt) if dt else 1,
    )
    return replace(episode, blocks=judge.blocks(), ending=judge.ending)


class _Judge:
    """Looks at the observations of one episode as they pass."""

    def __init__(
        self, episode: Episode, failure: Formula | None, success: Formula | None, needed: int
    ) -> None:
        self._episode, self._failure, self._success = episode, failure, success
        self._needed = needed  # observations at which success has to have held
        self._rows = self._held = 0
        self._failed_at: int | None = None

    def blocks(self) -> Iterator[Block]:
        """Yield the blocks as they are."""
        for block in self._episode.blocks:
            self._look(block.observations)
            yield block

    def _look(self, observations: np.ndarray) -> None:
        if self._failure is not None and self._failed_at is None:
            for row, observation in enumerate(observations):
                if self._failure(observation):
                    self._failed_at = self._rows + row
                    break
        if self._success is not None:
            tail = observations[-self._needed :]
            holds = [bool(self._success(observation)) for observation in tail]
            since = holds[::-1].index(False) if False in holds else len(holds)
            whole = since == len(observations)
            self._held = self._held + since if whole else since
        self._rows += len(observations)

    def ending(self) -> Ending:
        """Return what the formulas say."""
        recorded = self._episode.ending()
        step: int | None
        if self._failed_at is not None and self._failure is not None:
            outcome, step, formula = Outcome.FAILURE, self._failed_at, self._failure.text
        elif self._success is None:
            return recorded
        else:
            succeeded = self._held >= self._needed
            outcome = Outcome.SUCCESS if succeeded else Outcome.FAILURE
            step = None if succeeded else self._rows - 1
            formula = self._success.text if succeeded else f"not ({self._success.text})"
        note = f"outcome: {outcome.value}, inferred from {formula}"
        return Ending(outcome, step, (*recorded.notes, note))
