"""Could it still be saved? Asked of a model learned from the attempts themselves.

Failed attempts show well how a system moves, whatever they were meant for. A forward model is
learned from all of them, and from every recorded state plans are tried in it: to push fully one
way for a while, and then to counter what grows. If one of them stays clear of failure over the
horizon, the state was recoverable. With less strength fewer states are; the least share of the
strongest action with which a state is recoverable is its *danger*: 0 where nothing has to be done,
1 where nothing helps any more. Past the point of no return it is 1.

What counters the growth is the linear quadratic regulator of the model linearised at the mean first
state, with so little weight on the state that it spends its strength on what is unstable and on
nothing else. For a linear system with one unstable mode and limited actions, saturating it that way
recovers every state that can be recovered at all; pushing fully first does so where the failure is
nearer than that.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, solve_discrete_are

from misstep.blame.actions import ActionLimits
from misstep.blame.boundary import Boundary
from misstep.dynamics import ForwardModel, compiled
from misstep.dynamics.encoding import wrapped_differences
from misstep.trajectory import Trajectory

Array = NDArray[np.float64]

# A model's step, s: that of the recording, but of a faster one several at a time, since what
# changes in a millisecond is mostly noise.
MODEL_STEP = 0.02
# Transitions that the model is learned from, at most.
MOST_TRANSITIONS = 20_000
# How long a plan has to stay clear of failure, in time constants of what grows fastest, and in s.
HORIZON_CONSTANTS, SHORTEST_HORIZON, LONGEST_HORIZON = 6.0, 0.5, 3.0
# For how many steps of the model a plan first pushes fully one way.
PUSHES = (2, 4, 8, 16)
# Up to this many actions every combination of full pushes is tried, beyond it one at a time.
MOST_COMBINED = 3
STATE_WEIGHT = 1e-6
# Saturates early: near the limit of what can be saved every delay counts.
GAIN = 1.5
# Halvings of the interval in which the least strength lies.
HALVINGS = 5
# States that are asked about one by one; between them the danger is interpolated.
MOST_STATES = 300


@dataclass(frozen=True)
class Recovery:
    """A forward model and plans to try in it; `learn` makes one.

    Parameters
    ----------
    model : compiled.Model
    limits : ActionLimits
    boundary : Boundary
    origin : ndarray, shape (n,)
        The state that plans lead back to.
    gain : ndarray, shape (m, n)
        Of the regulator, in units of the actions' limits.
    horizon : int
        Steps of the model that a plan has to stay clear of failure.
    """

    model: compiled.Model
    limits: ActionLimits
    boundary: Boundary
    origin: Array
    gain: Array
    horizon: int

    @classmethod
    def learn(
        cls, trajectories: Sequence[Trajectory], limits: ActionLimits, rng: np.random.Generator
    ) -> Self:
        """Learn the model and the boundary of failure.

        Parameters
        ----------
        trajectories : sequence of Trajectory
        limits : ActionLimits
        rng : numpy.random.Generator

        Raises
        ------
        MisstepError
            If there are too few transitions to learn a model from.
        """
        first = trajectories[0]
        angles = np.array([column.unit == "rad" for column in first.observation_columns])
        stride = max(1, round(MODEL_STEP / first.dt))
        recordings = [_every(t, stride) for t in _evenly(trajectories, stride)]
        learned = ForwardModel.fit(recordings, angles, limits.low, limits.high, rng)
        model = learned.compiled()
        origin = np.mean([t.observations[0] for t in trajectories], axis=0)
        a, b = _linearised(model, origin)
        spread = np.concatenate([t.observations for t in trajectories]).std(axis=0)
        period = stride * first.dt
        return cls(
            model,
            limits,
            Boundary.find(trajectories, learned.kinematics.source >= 0),
            origin,
            regulator(a, b, STATE_WEIGHT / np.maximum(spread, 1e-12) ** 2),
            max(1, round(_horizon(a, period) / period)),
        )

    def danger(self, states: Array) -> Array:
        """Return the share of the strongest action that it takes to recover from states.

        Parameters
        ----------
        states : ndarray, shape (N, n)
            In the order of time; of more than 300 only some are asked about, the others
            interpolated.

        Returns
        -------
        danger : ndarray, shape (N,)
            From 0 to 1; 1 where no plan recovers.
        """
        if len(states) > MOST_STATES:
            asked = np.unique(np.linspace(0, len(states) - 1, MOST_STATES).round().astype(int))
            danger = np.interp(np.arange(len(states)), asked, self.danger(states[asked]))
            return self._refined(states, asked, danger)
        danger = np.ones(len(states))
        open_ = np.flatnonzero(self.recoverable(states, np.ones(len(states))))
        low, high = np.zeros(len(open_)), np.ones(len(open_))
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            enough = self.recoverable(states[open_], middle)
            high, low = np.where(enough, middle, high), np.where(enough, low, middle)
        danger[open_] = 0.5 * (low + high)
        return danger

    def recoverable(self, states: Array, strength: Array) -> NDArray[np.bool_]:
        """Return whether a plan of at most a share of the strongest action keeps clear of failure.

        Parameters
        ----------
        states : ndarray, shape (N, n)
        strength : ndarray, shape (N,)
            From 0 to 1.

        Returns
        -------
        recoverable : ndarray of bool, shape (N,)
        """
        pushes, lengths = _plans(len(self.limits.low))
        # Mostly it is enough to counter what grows; the other plans are for where it is not.
        found = np.asarray(self._tried(states, strength, pushes[:1], lengths[:1])[1].any(axis=1))
        rest = np.flatnonzero(~found)
        others = self._tried(states[rest], strength[rest], pushes[1:], lengths[1:])[1]
        found[rest] = others.any(axis=1)
        return found

    def rescue(self, states: Array, danger: Array) -> Array:
        """Return what had to be done at states to recover from them with the least strength.

        Parameters
        ----------
        states : ndarray, shape (N, n)
        danger : ndarray, shape (N,)
            As `danger` found it.

        Returns
        -------
        action : ndarray, shape (N, m)
            First action of the plans that recover, on average; ±1 is the limit. Zero where none
            does.
        """
        least = np.minimum(danger + 0.5**HALVINGS, 1.0)
        first, survived = self._tried(states, least, *_plans(len(self.limits.low)))
        share = survived / np.maximum(survived.sum(axis=1, keepdims=True), 1)
        action: Array = least[:, None] * np.einsum("np,npm->nm", share, first)
        return action

    def _tried(
        self, states: Array, strength: Array, pushes: Array, lengths: NDArray[np.int64]
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Return the first action of each of P plans from N states, (N, P, m), and what survived.

        Parameters
        ----------
        states, strength : ndarray, shapes (N, n) and (N,)
        pushes, lengths : ndarray, shapes (P, m) and (P,)
            As `_plans` returns them.
        """
        count = len(lengths)
        s = np.repeat(np.asarray(states, dtype=np.float64), count, axis=0)
        share = np.repeat(strength, count)[:, None]
        push, length = np.tile(pushes, (len(states), 1)), np.tile(lengths, len(states))
        first = np.where((length > 0)[:, None], push, self._countering(s))
        alive = np.flatnonzero(self.boundary.inside(s))
        work = compiled.Workspace.of(self.model, 1)
        for step in range(self.horizon):
            now = np.ascontiguousarray(s[alive])
            pushing = (step < length[alive])[:, None]
            action = np.where(pushing, push[alive], self._countering(now))
            after = np.empty_like(now)
            encoded = self._encoded(share[alive] * action)
            compiled.predict(self.model, now, encoded, after, work)
            s[alive] = after
            alive = alive[self.boundary.inside(after)]
        survived = np.zeros(len(s), dtype=bool)
        survived[alive] = True
        shape = (len(states), count)
        return first.reshape(*shape, push.shape[1]), survived.reshape(shape)

    def _countering(self, states: Array) -> Array:
        """Return what counters the growth at states (N, n), shape (N, m): ±1 is all there is."""
        error = wrapped_differences(self.origin, states, self.model.angles)
        action: Array = np.clip(-GAIN * error @ self.gain.T, -1.0, 1.0)
        return action

    def _refined(self, states: Array, asked: NDArray[np.intp], danger: Array) -> Array:
        """Ask about every state between the last recoverable one asked about and the next."""
        open_ = np.flatnonzero(danger[asked] < 1.0)
        if len(open_) and open_[-1] + 1 < len(asked):
            between = np.arange(asked[open_[-1]], asked[open_[-1] + 1])
            danger[between] = self.danger(states[between])
        return danger

    def _encoded(self, action: Array) -> Array:
        """Return the model's actions of those around the neutral one; both in [−1, 1]."""
        low, high = self.limits.low, self.limits.high
        neutral = self.limits.neutral
        reach = np.where(action > 0, high - neutral, neutral - low)
        return np.ascontiguousarray(2.0 * (neutral + reach * action - low) / (high - low) - 1.0)


def regulator(a: Array, b: Array, weights: Array) -> Array:
    """Return the gain K (m, n) of u = −K s that is optimal for Σ sᵀ diag(weights) s + uᵀ u.

    Parameters
    ----------
    a, b : ndarray, shapes (n, n) and (n, m)
        Of s′ = A s + B u.
    weights : ndarray, shape (n,)

    Returns
    -------
    gain : ndarray, shape (m, n)
        Zero where what grows cannot be controlled: then there is nothing to counter it with.
    """
    try:
        value = solve_discrete_are(a, b, np.diag(weights), np.eye(b.shape[1]))
    except (LinAlgError, ValueError):
        return np.zeros((b.shape[1], b.shape[0]))
    gain: Array = np.linalg.solve(np.eye(b.shape[1]) + b.T @ value @ b, b.T @ value @ a)
    return gain


def _plans(m: int) -> tuple[Array, NDArray[np.int64]]:
    """Return pushes (P, m) in [−1, 1] and for how many steps (P,); the first pushes not at all."""
    if m <= MOST_COMBINED:
        corners = np.array(list(product((-1.0, 1.0), repeat=m)))
    else:
        corners = np.concatenate([np.eye(m), -np.eye(m)])
    pushes = np.concatenate([np.zeros((1, m)), np.repeat(corners, len(PUSHES), axis=0)])
    return pushes, np.array([0, *PUSHES * len(corners)], dtype=np.int64)


def _linearised(model: compiled.Model, origin: Array) -> tuple[Array, Array]:
    """Return A (n, n) and B (n, m) of the model at a state and the action in the middle."""
    n, m = len(model.angles), model.n_actions
    a, b = np.zeros((n, n)), np.zeros((n, m))
    compiled.linearise(model, origin, np.zeros(m), a, b, compiled.Workspace.of(model, 1))
    return a, b


def _horizon(a: Array, period: float) -> float:
    """Return how long a plan has to keep clear of failure, s."""
    growth = np.log(np.abs(np.linalg.eigvals(a)).max()) / period
    constants = HORIZON_CONSTANTS / growth if growth > 0 else np.inf
    return float(np.clip(constants, SHORTEST_HORIZON, LONGEST_HORIZON))


def _every(trajectory: Trajectory, stride: int) -> tuple[Array, Array]:
    """Return observations `stride` steps apart and the mean actions between them."""
    steps = trajectory.n_steps // stride
    actions = trajectory.actions[: steps * stride].reshape(steps, stride, -1).mean(axis=1)
    return trajectory.observations[: steps * stride + 1 : stride], actions


def _evenly(trajectories: Sequence[Trajectory], stride: int) -> Sequence[Trajectory]:
    """Return some of the trajectories, spread evenly, with not too many transitions together."""
    total = sum(t.n_steps // stride for t in trajectories)
    return trajectories[:: -(-total // MOST_TRANSITIONS)] if total else trajectories
