"""`fall`: learn the picture of the fall, and act against it.

Near an unstable state everything grows like e^{ωt}, so where an attempt will end can be read off
the state long before it ends, and the discounted failure is linear in the state. Three steps, each
a small regression on x = (s − s₀)/σ (s₀ the mean first state, σ over all states) and on the action
a in units of its limit:

1. *Signed danger.* For a failed attempt that ends in e after the remaining time R, the target is
   z = e^{−R/τ} e with weight e^{−R/(κτ)}, so that only what lies past the point of no return
   counts. Ridge regression z ≈ W [1, x] for each τ; the τ with the highest weighted R² is kept, and
   the danger is u(x) = (W [1, x]) · v, v the direction in which the ends differ most.
2. *What the action does to it.* A horizon ahead, u = c · [1, x, ā] by ridge regression on the mean
   action ā, with the covariance C of the coefficients.
3. *Cautious control.* The action that minimises E[u²], uncertainty included:
   a = −(c_a c_aᵀ + C_aa)⁻¹ (c_a c_xᵀ + C_ax) [1, x].

From the second trial on, the attempts' weights are drawn from a Bayesian bootstrap: where they
disagree, the next trial differs. Attempts that did not fail tell what the action does, but not
where they would have ended, and are left out of step 1.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.learners.learner import LEARNERS, Evidence, Task, joint_samples
from misstep.learners.linear import LinearPolicy
from misstep.parameters import check_parameters, parameter
from misstep.trajectory import Trajectory

Array = NDArray[np.float64]

# Candidate time scales of the fall, s; the data choose.
TIME_SCALES = (0.1, 0.15, 0.2, 0.3, 0.4)
# Share of the time scale over which blame reaches back: κ.
BLAME = 0.5
SLOPE_PENALTY = 0.01
INTERCEPT_PENALTY = 1.0
EFFECT_PENALTY = 0.01


class Scaled(NamedTuple):
    """An attempt in scaled units."""

    x: Array
    """States, shape (T + 1, n)."""
    a: Array
    """Actions in units of their limits, shape (T, m)."""
    failed: bool
    weight: float


class Danger(NamedTuple):
    """u(x) = coefficients · [1, x], as step 1 found it."""

    coefficients: Array
    time_scale: float
    r_squared: float


@LEARNERS.register("fall")
@dataclass(frozen=True)
class Fall:
    """Rung 2: learns what a fall looks like from when attempts failed, and pushes against it."""

    horizon: float = parameter(
        0.06, "s", "how far ahead the action's effect is looked for", above=0
    )

    rung: ClassVar[int] = 2

    def __post_init__(self) -> None:
        check_parameters(self, "learner fall")

    def policy(self, task: Task, evidence: Evidence, rng: np.random.Generator) -> LinearPolicy:
        """Return the cautious linear policy against the danger."""
        failed = [t.failure_step is not None for t in evidence.attempts]
        if not any(failed):
            raise MisstepError(
                "fall needs the time of at least one failure: set a failure predicate (rung 2)"
            )
        cut = [_until_failure(t) for t in evidence.attempts]
        origin = np.mean([t.select(task.state)[0] for t in cut], axis=0)
        spread = joint_samples(task, cut)[:, : len(task.state)].std(axis=0)
        weights = rng.exponential(size=len(cut)) if evidence.trials else np.ones(len(cut))
        centre, half = _limits(task)
        attempts = [
            Scaled((t.select(task.state) - origin) / spread, (t.actions - centre) / half, f, w)
            for t, f, w in zip(cut, failed, weights, strict=True)
        ]
        danger = learn_danger(attempts, task.dt)
        bias, gain = cautious_control(attempts, danger, max(1, round(self.horizon / task.dt)))
        gain = gain / spread
        return LinearPolicy(task, centre + half * (bias - gain @ origin), half[:, None] * gain)

    @staticmethod
    def restore(task: Task, arrays: Mapping[str, Array]) -> LinearPolicy:
        """Return the policy that `LinearPolicy.arrays` described."""
        return LinearPolicy.restore(task, arrays)


def learn_danger(attempts: Sequence[Scaled], dt: float) -> Danger:
    """Regress the discounted failure on the state (step 1)."""
    failures = [a for a in attempts if a.failed]
    design = np.concatenate([_with_one(a.x) for a in failures])
    penalty = np.full(design.shape[1], SLOPE_PENALTY)
    penalty[0] = INTERCEPT_PENALTY
    ends = np.array([a.weight * a.x[-1] for a in failures])
    direction = np.linalg.svd(ends, full_matrices=False)[2][0]
    best: Danger | None = None
    for tau in TIME_SCALES:
        remaining = [np.arange(len(a.x))[::-1] * dt for a in failures]
        targets = np.concatenate(
            [np.exp(-r / tau)[:, None] * a.x[-1] for a, r in zip(failures, remaining, strict=True)]
        )
        weight = np.concatenate(
            [
                a.weight * np.exp(-r / (BLAME * tau))
                for a, r in zip(failures, remaining, strict=True)
            ]
        )
        weight /= weight.sum()
        W = _ridge(design, targets, weight, penalty)
        residual = weight @ (targets - design @ W) ** 2
        r_squared = 1.0 - residual.sum() / (weight @ targets**2).sum()
        if best is None or r_squared > best.r_squared:
            best = Danger(W @ direction, tau, float(r_squared))
    if best is None:
        raise MisstepError("fall has no time scale to try")
    return best


def cautious_control(
    attempts: Sequence[Scaled], danger: Danger, horizon: int
) -> tuple[Array, Array]:
    """Return bias (m,) and gain (m, n) of the cautious minimiser of E[u²] (steps 2 and 3)."""
    rows, targets, weights = [], [], []
    for attempt in attempts:
        h = min(horizon, len(attempt.a))
        total = np.concatenate([np.zeros((1, attempt.a.shape[1])), attempt.a.cumsum(axis=0)])
        mean_action = (total[h:] - total[:-h]) / h
        rows.append(np.hstack([_with_one(attempt.x[: len(mean_action)]), mean_action]))
        targets.append(_with_one(attempt.x[h:]) @ danger.coefficients)
        weights.append(np.full(len(mean_action), attempt.weight))
    X, y, w = np.concatenate(rows), np.concatenate(targets), np.concatenate(weights)
    w /= w.mean()
    y /= np.sqrt(np.mean(y**2))
    precision = (X * w[:, None]).T @ X + EFFECT_PENALTY * np.eye(X.shape[1])
    c = np.linalg.solve(precision, X.T @ (w * y))
    freedom = max(len(y) - X.shape[1], 1)
    noise = float(w @ (y - X @ c) ** 2) / freedom + 1e-9
    # Windows overlap by the horizon, so there are that many fewer independent ones.
    C = np.linalg.inv(precision) * noise * horizon
    n = danger.coefficients.size
    c_x, c_a = c[:n], c[n:]
    k = -np.linalg.solve(np.outer(c_a, c_a) + C[n:, n:], np.outer(c_a, c_x) + C[n:, :n])
    return k[:, 0], k[:, 1:]


def _until_failure(trajectory: Trajectory) -> Trajectory:
    """Return the trajectory up to its failure: what follows is no attempt any more."""
    step = trajectory.failure_step
    if step is None or step in (0, trajectory.n_steps):
        return trajectory
    return trajectory.cut(step)


def _limits(task: Task) -> tuple[Array, Array]:
    """Return the middle of the action's range and half of its width, each shape (m,)."""
    return 0.5 * (task.action_low + task.action_high), 0.5 * (task.action_high - task.action_low)


def _with_one(x: Array) -> Array:
    return np.hstack([np.ones((len(x), 1)), x])


def _ridge(X: Array, Y: Array, weight: Array, penalty: Array) -> Array:
    """Weighted ridge regression: (XᵀwX + diag(penalty))⁻¹ XᵀwY."""
    weighted = (X * weight[:, None]).T
    return np.linalg.solve(weighted @ X + np.diag(penalty), weighted @ Y).astype(np.float64)
