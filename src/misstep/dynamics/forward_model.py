"""A forward model learned from trajectories: where an action leads from here.

Some columns are integrals of others, a position of its velocity. Those pairs are found by least
squares and not learned; a sparse Gaussian process predicts the change of every other column.
Failed attempts are as good a source as any: they show how the system moves.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from misstep.dynamics import compiled
from misstep.dynamics.encoding import Encoding, wrapped_differences
from misstep.dynamics.gaussian_process import (
    NOISE_FLOOR,
    Hyperparameters,
    SparseGaussianProcess,
)
from misstep.errors import MisstepError

Array = NDArray[np.float64]
Recording = tuple[Array, Array]
"""Observations (T + 1, n) and actions (T, m)."""

FEWEST_TRANSITIONS = 8
# Falls, impacts of a pole on its way and noise stay below 2, strokes that last beyond 13.
LONGER_STEP = 5.0
# A column is another's integral if that leaves less than this share of its change unexplained.
KINEMATIC_TOLERANCE = 0.02
# … in all but a few rows: a rail stop or a bad sample is no reason to learn an integral.
KINEMATIC_SHARE = 0.95
# Robust regression hurts where there is little to be robust with.
ROBUST_TRANSITIONS = 200
# Too smooth to bend around a single row, and so what outliers are first told by.
SMOOTH_LENGTH = np.e
SMOOTH_NOISE = 0.05
SMOOTH_ROUNDS = 5
ROBUST_ROUNDS = 2
# Degrees of freedom of Student's t.
STUDENT = 3.0
# An outlier is this many robust standard deviations out, and this share of the column's spread.
OUTLIER_DEVIATIONS = 10.0
OUTLIER_SPREAD = 0.05
_PADDING = 8
_INTEGRAL_ROUNDS = 4


@dataclass(frozen=True)
class Kinematics:
    """Columns that are integrals of others: Δs_i = α_i s_j + β_i Δs_j.

    Parameters
    ----------
    source : ndarray of int, shape (n,)
        j of each column i, −1 where a column is no integral.
    alpha, beta : ndarray, shape (n,)
        Where j is the velocity of i, α is in seconds.
    """

    source: NDArray[np.int64]
    alpha: Array
    beta: Array

    @classmethod
    def find(cls, states: Array, changes: Array, angles: NDArray[np.bool_]) -> Self:
        """Find the pairs in transitions, `states` and `changes` both (N, n); best first.

        α is positive, but for an angle, which may count against its velocity.
        """
        n = states.shape[1]
        source, alpha, beta = np.full(n, -1, dtype=np.int64), np.zeros(n), np.zeros(n)
        velocities: set[int] = set()
        candidates = [
            (*_integral(states[:, j], changes[:, j], changes[:, i]), i, j)
            for i in range(n)
            for j in range(n)
            if i != j
        ]
        for residual, a, b, i, j in sorted(candidates):
            free = source[i] < 0 and source[j] < 0 and i not in velocities
            if residual < KINEMATIC_TOLERANCE and (a > 0 or angles[i]) and free:
                source[i], alpha[i], beta[i] = j, a, b
                velocities.add(j)
        return cls(source, alpha, beta)

    @property
    def learned(self) -> NDArray[np.int64]:
        """Indices of the columns that have to be learned."""
        return np.flatnonzero(self.source < 0)


@dataclass(frozen=True)
class ForwardModel:
    """Predicts the next observation; `fit` makes one.

    Parameters
    ----------
    encoding : Encoding
    kinematics : Kinematics
    process : SparseGaussianProcess
        Of the changes of `kinematics.learned`.
    low, high : ndarray, shape (n,)
        What a prediction is clipped to: one range beyond the data on either side, for the learned
        columns that do not wrap.
    """

    encoding: Encoding
    kinematics: Kinematics
    process: SparseGaussianProcess
    low: Array
    high: Array

    @classmethod
    def fit(
        cls,
        recordings: Sequence[Recording],
        angles: NDArray[np.bool_],
        action_low: Array,
        action_high: Array,
        rng: np.random.Generator,
        *,
        n_centres: int = 150,
    ) -> Self:
        """Learn from recordings.

        The last step of a recording may last longer than all others, see `transitions`. Where
        there are more than 200 transitions and some lie far off what a smooth model says, as
        contacts, rail stops and bad samples do, these get Student's t for their noise, by
        reweighting.

        Parameters
        ----------
        recordings : sequence of (observations, actions), shapes (T + 1, n) and (T, m)
        angles : ndarray of bool, shape (n,)
            Which columns wrap around, in rad.
        action_low, action_high : ndarray, shape (m,)
        rng : numpy.random.Generator
        n_centres : int
            Most centres of the sparse process.

        Raises
        ------
        MisstepError
            If there are fewer than 8 transitions, or an action has no finite limits.
        """
        states, actions, changes = transitions(recordings, angles)
        if len(states) < FEWEST_TRANSITIONS:
            raise MisstepError(
                f"the recordings hold {len(states)} transitions: a forward model needs at least "
                f"{FEWEST_TRANSITIONS}"
            )
        if not np.isfinite(action_low).all() or not np.isfinite(action_high).all():
            raise MisstepError(
                f"the actions range from {action_low} to {action_high}: a forward model needs "
                "finite limits"
            )
        encoding = Encoding.of(states, angles, action_low, action_high)
        kinematics = Kinematics.find(states, changes, angles)
        z, u = encoding.encode(states), encoding.encode_actions(actions)
        process = _fit_process(z, u, changes[:, kinematics.learned], rng, n_centres)
        free = angles | (kinematics.source >= 0)
        lowest, highest = states.min(axis=0), states.max(axis=0)
        low = np.where(free, -np.inf, 2.0 * lowest - highest)
        high = np.where(free, np.inf, 2.0 * highest - lowest)
        return cls(encoding, kinematics, process, low, high)

    def predict(self, observations: Array, actions: Array) -> Array:
        """Return the next observations (N, n) after actions (N, m); angles are not wrapped."""
        model = self.compiled()
        states = np.array(observations, dtype=np.float64, order="C")
        new = np.empty_like(states)
        encoded = np.ascontiguousarray(self.encoding.encode_actions(actions))
        compiled.predict(model, states, encoded, new, compiled.Workspace.of(model, 1))
        return new

    def variance(self, observations: Array, actions: Array) -> Array:
        """Return the variance of the next observations (N, n), each column in its unit squared."""
        encoded = self.encoding.encode(observations), self.encoding.encode_actions(actions)
        out = np.zeros_like(observations)
        out[:, self.kinematics.learned] = self.process.predict(*encoded)[1]
        for i, j in enumerate(self.kinematics.source):
            if j >= 0:
                out[:, i] = self.kinematics.beta[i] ** 2 * out[:, j]
        return out

    def compiled(self) -> compiled.Model:
        """Return the model as the compiled loops want it: multiplied out and padded."""
        c = self.process.coefficients()
        lengths = self.process.hyperparameters.lengths
        centres = self.process.centres / lengths
        padding = -len(centres) % _PADDING
        centres = np.pad(centres, ((0, padding), (0, 0)))
        return compiled.Model(
            angles=self.encoding.angles,
            mean=self.encoding.mean,
            inverse_scale=1.0 / self.encoding.scale,
            inverse_lengths=1.0 / lengths,
            centres=np.ascontiguousarray(centres.T),
            offsets=-0.5 * (centres**2).sum(axis=1),
            local=np.pad(c.local, ((0, 0), (0, 0), (0, padding))),
            linear=c.linear * lengths,
            constant=c.constant,
            learned=self.kinematics.learned,
            source=self.kinematics.source,
            alpha=self.kinematics.alpha,
            beta=self.kinematics.beta,
            low=self.low,
            high=self.high,
        )


def transitions(
    recordings: Sequence[Recording], angles: NDArray[np.bool_]
) -> tuple[Array, Array, Array]:
    """Return states (N, n), actions (N, m) and changes (N, n) of all steps of one length.

    A system may let the last action act until its verdict, or end with an impact. The last step of
    a recording is left out where it changes a column by more than 5 times the most that any step
    before the last changes it.
    """
    changes = [wrapped_differences(o[:-1], o[1:], angles) for o, _ in recordings]
    most = np.max([np.abs(c[:-1]).max(axis=0, initial=0.0) for c in changes], axis=0)
    kept = [
        len(c) - bool(most.any() and np.any(np.abs(c[-1]) > LONGER_STEP * most)) for c in changes
    ]
    states = [o[:k] for (o, _), k in zip(recordings, kept, strict=True)]
    actions = [a[:k] for (_, a), k in zip(recordings, kept, strict=True)]
    shown = [c[:k] for c, k in zip(changes, kept, strict=True)]
    return np.concatenate(states), np.concatenate(actions), np.concatenate(shown)


def _fit_process(
    z: Array, u: Array, y: Array, rng: np.random.Generator, n_centres: int
) -> SparseGaussianProcess:
    """Fit the process; with Student's t for the noise of outliers, if there are any.

    Told by a fit of their own, outliers would hide: a process is flexible enough to follow them.
    """
    if len(z) <= ROBUST_TRANSITIONS:
        return SparseGaussianProcess.fit(z, u, y, rng, n_centres=n_centres)
    smooth = Hyperparameters(
        np.full(z.shape[1], SMOOTH_LENGTH), np.ones(4), np.full(y.shape[1], SMOOTH_NOISE)
    )
    weights = np.ones_like(y)
    for _ in range(SMOOTH_ROUNDS):
        process = SparseGaussianProcess.fit(
            z, u, y, rng, n_centres=n_centres, weights=weights, hyperparameters=smooth
        )
        residuals = _residuals(process, z, u, y)
        weights = student_weights(residuals, robust_deviation(residuals))
    for _ in range(ROBUST_ROUNDS):
        weights = outlier_weights(_residuals(process, z, u, y))
        process = SparseGaussianProcess.fit(z, u, y, rng, n_centres=n_centres, weights=weights)
        if np.all(weights == 1.0):
            break
    return process


def _residuals(process: SparseGaussianProcess, z: Array, u: Array, y: Array) -> Array:
    """Residuals (N, ny) as shares of each column's spread."""
    residuals: Array = (y - process.predict(z, u)[0]) / process.scale
    return residuals


def robust_deviation(residuals: Array) -> Array:
    """Return the standard deviation (ny,) of residuals (N, ny), whatever a few of them are."""
    deviation: Array = np.maximum(1.4826 * np.median(np.abs(residuals), axis=0), NOISE_FLOOR)
    return deviation


def student_weights(residuals: Array, deviation: Array | float) -> Array:
    """Return the expected precision of residuals (N, …) under Student's t, 1 at a typical one."""
    weights: Array = (STUDENT + 1.0) / (STUDENT + (residuals / deviation) ** 2)
    return weights


def outlier_weights(residuals: Array) -> Array:
    """Return the weights of residuals (N, ny): Student's for outliers, 1 for all others.

    The scale of an outlier's weight is the noise floor: the process may take the noise of the
    others to be as small as that.
    """
    limit = np.maximum(OUTLIER_DEVIATIONS * robust_deviation(residuals), OUTLIER_SPREAD)
    far = student_weights(residuals, NOISE_FLOOR)
    return np.where(np.abs(residuals) > limit, far, 1.0)


def _integral(value: Array, change: Array, wanted: Array) -> tuple[float, float, float]:
    """How well α · value + β · change explains `wanted`, all (N,).

    Returns
    -------
    residual : float
        Weighted root mean square of what is left, as a share of the spread of `wanted`; infinite
        if too many rows disagree.
    alpha, beta : float
    """
    low, high = np.percentile(wanted, [1.0, 99.0])
    spread = float(np.clip(wanted, low, high).std())
    if spread < 1e-12:
        return np.inf, 0.0, 0.0
    x = np.stack([value, change], axis=1)
    tolerance = KINEMATIC_TOLERANCE * spread
    weights = np.ones(len(x))
    for _ in range(_INTEGRAL_ROUNDS):
        root = np.sqrt(weights)
        solution = np.linalg.lstsq(x * root[:, None], wanted * root, rcond=None)[0]
        errors = wanted - x @ solution
        weights = student_weights(errors, tolerance)
    if (np.abs(errors) < 3.0 * tolerance).mean() < KINEMATIC_SHARE:
        return np.inf, 0.0, 0.0
    residual = np.sqrt((weights * errors**2).sum() / weights.sum()) / spread
    return float(residual), float(solution[0]), float(solution[1])
