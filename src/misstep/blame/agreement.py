"""Where demonstrators disagree, and where an action left what worked elsewhere.

Both are read off mixtures of (state, action). *Disagreement* is the exploration ε of the paper at
the state: 1 − 1/(1 + V/s²), V the variance of the actions that all attempts show there and s 0.3 of
their standard deviation. *Departure* asks a mixture of what worked in other attempts, each of their
steps weighted by how little in danger it was: how many standard deviations does the action lie
from what was done there? One is usual (0), three are not (1).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from misstep.learners.donut import default_scale
from misstep.learners.mixtures import MixtureParameters
from misstep.mixture import Conditioner, exploration_from_variance
from misstep.trajectory import Trajectory

Array = NDArray[np.float64]

USUAL, UNUSUAL = 1.0, 3.0
# A state further than this from every component of what worked is one where nobody else was.
FAMILIAR = 3.0
# "Elsewhere" is everybody else, or all but every tenth attempt if there are more.
MOST_FOLDS = 10
MOST_SAMPLES = 20_000
# A step of what worked that weighs less than this tells nothing and only takes time.
LEAST_WEIGHT = 0.05
FEWEST_SAMPLES = 20


class Agreement(NamedTuple):
    """Of the T actions of one trajectory."""

    disagreement: Array
    """ε of all attempts at the state, shape (T,), from 0 to 1."""
    departure: Array
    """Shape (T,), from 0 to 1; 0 too where nobody else was."""


def find_agreement(
    trajectories: Sequence[Trajectory], worth: Sequence[Array], rng: np.random.Generator
) -> list[Agreement]:
    """Compare the actions of every trajectory with those of the others.

    Parameters
    ----------
    trajectories : sequence of Trajectory
        Whose actions vary.
    worth : sequence of ndarray, shape (T,)
        Of each trajectory: how good an example each step is, from 0 to 1.
    rng : numpy.random.Generator
    """
    states = np.concatenate([t.observations[:-1] for t in trajectories])
    # A column that is the same everywhere, or says the same as another, tells nothing.
    columns = _independent(states)
    joint = [np.hstack([t.observations[:-1, columns], t.actions]) for t in trajectories]
    scale = default_scale(trajectories)
    n = len(columns)
    everybody = _Mixture.fit(joint, None, n, rng)
    folds = min(len(trajectories), MOST_FOLDS)
    elsewhere = [
        _Mixture.fit(_without(joint, k, folds), _without(worth, k, folds), n, rng)
        for k in range(folds)
    ]
    return [
        Agreement(
            np.zeros(len(rows))
            if everybody is None
            else np.array([everybody.disagreement(row, scale) for row in rows]),
            _departures(elsewhere[i % folds], rows),
        )
        for i, rows in enumerate(joint)
    ]


class _Mixture:
    """A mixture of (state, action), conditioned on the state."""

    def __init__(self, conditioner: Conditioner, n: int) -> None:
        self._conditioner = conditioner
        self._n = n

    @classmethod
    def fit(
        cls,
        joint: Sequence[Array],
        worth: Sequence[Array] | None,
        n: int,
        rng: np.random.Generator,
    ) -> "_Mixture | None":
        """Return the mixture; None where there are too few samples for one."""
        if not joint or n == 0:
            return None
        samples = np.concatenate(joint)
        weights = np.ones(len(samples)) if worth is None else np.concatenate(worth)
        kept = np.flatnonzero(weights >= LEAST_WEIGHT)
        kept = kept[:: max(1, -(-len(kept) // MOST_SAMPLES))]
        samples, weights = samples[kept], weights[kept]
        if len(samples) < FEWEST_SAMPLES or np.any(samples.std(axis=0) == 0):
            return None
        mixture = MixtureParameters().fit(samples, rng, weights)
        return cls(Conditioner(mixture, range(n)), n)

    def disagreement(self, row: Array, scale: Array) -> float:
        conditional = self._conditioner.at(row[: self._n])
        return exploration_from_variance(conditional.variance, scale)

    def departure(self, row: Array) -> float:
        state, action = row[: self._n], row[self._n :]
        c = self._conditioner
        away = np.einsum("kij,kj->ki", c.state_whiteners, state - c.state_means)
        if np.sqrt((away**2).sum(axis=1).min() / self._n) > FAMILIAR:
            return 0.0
        conditional = c.at(state)
        error = action - conditional.mean
        squared = error @ np.linalg.solve(conditional.variance, error) / len(action)
        return float(np.clip((np.sqrt(squared) - USUAL) / (UNUSUAL - USUAL), 0.0, 1.0))


def _departures(elsewhere: _Mixture | None, rows: Array) -> Array:
    if elsewhere is None:
        return np.zeros(len(rows))
    return np.array([elsewhere.departure(row) for row in rows])


def _without(items: Sequence[Array], fold: int, folds: int) -> list[Array]:
    return [item for i, item in enumerate(items) if i % folds != fold]


def _independent(states: Array) -> list[int]:
    """Return columns that vary, each not merely a multiple of one before it."""
    spread = states.std(axis=0)
    chosen: list[int] = []
    for column in np.flatnonzero(spread > 1e-12 * np.maximum(1.0, np.abs(states).max(axis=0))):
        if not chosen:
            chosen.append(int(column))
            continue
        correlation = np.array(np.corrcoef(states[:, [*chosen, int(column)]].T))[-1, :-1]
        if np.abs(correlation).max() < 1.0 - 1e-9:
            chosen.append(int(column))
    return chosen
