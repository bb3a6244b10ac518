"""`fall`: learn the picture of the fall, and act against it.

Near an unstable state everything grows like e^{ωt}, so where an attempt will end can be read off
the state long before it ends, and the discounted failure is linear in the state. Four steps, each a
small regression on x = (s − s₀)/σ (s₀ the mean first state, σ over all states) and on the action a
in units of the largest that was used:

1. *Ways to fail.* Failures whose ends lie along one line through s₀ are one way to fail (the pole
   falls over); those that do not are another (the cart reaches the end of the rail).
2. *Signed danger* of each way. For a failed attempt that ends in e after the remaining time R, the
   target is z = e^{−R/τ} e with weight e^{−R/(κτ)}, so that only what lies past the point of no
   return counts. Ridge regression z ≈ W [1, x] for each τ; the τ with the highest weighted R² is
   kept, and the danger is u(x) = (W [1, x]) · v, v the direction along which the ends lie farthest
   from s₀.
3. *What an action does to it.* A horizon ahead, u = c · [1, x, ā] by ridge regression on the mean
   action ā, with the covariance C of the coefficients.
4. *Cautious control.* The action that minimises E[(u − r)²], uncertainty included:
   a = (c_a c_aᵀ + C_aa)⁻¹ (c_a r − (c_a c_xᵀ + C_ax) [1, x]), with r = 0 for a single danger.

With two dangers the fast one is what the slow one acts through: over a second, a cart is moved by
leaning the pole. Step 3 then takes the fast danger for the action of the slow one, and step 4 gives
the r that the fast danger is to be kept at. The result is linear all the same.

An attempt that lasted less long than the demonstrations did counts for less in all of it: a cart
that is pushed over shows the push, not the fall. After some trials the weights are drawn from a
Bayesian bootstrap besides, so that where attempts disagree, the next trial differs; and one in two
of these trials, drawn by lot, keeps half of the policy that has lasted longest. Attempts that did
not fail tell what the action does, but not where they would have ended, and are left out of steps 1
and 2.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.learners.learner import LEARNERS, Evidence, Task, joint_samples
from misstep.learners.linear import LinearLearner, LinearPolicy, longest_lasting
from misstep.parameters import check_parameters, parameter
from misstep.trajectory import Trajectory

Array = NDArray[np.float64]

# Candidate time scales of a fall, s; the data choose.
TIME_SCALES = (0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0, 1.5, 2.0)
# Share of the time scale over which blame reaches back: κ.
BLAME = 0.5
SLOPE_PENALTY = 0.01
INTERCEPT_PENALTY = 1.0
EFFECT_PENALTY = 0.01
# Ends belong to one way to fail if its line explains at least this share of their squared length.
SAME_WAY = 0.5
# A third way has not been seen to help.
MOST_WAYS = 2
# The slow danger's horizon: two of its time scales, at most one second.
SLOW_HORIZON_SCALES, LONGEST_SLOW_HORIZON = 2.0, 1.0


class Scaled(NamedTuple):
    """An attempt in scaled units."""

    x: Array
    """States, shape (T + 1, n)."""
    a: Array
    """Actions in units of their limits, shape (T, m)."""
    failed: bool
    weight: float


class Danger(NamedTuple):
    """u(x) = coefficients · [1, x], as step 2 found it."""

    coefficients: Array
    time_scale: float
    r_squared: float


class Response(NamedTuple):
    """What to command: gain · [1, x] + sensitivity · r (step 4)."""

    gain: Array
    """Shape (q, 1 + n) for q commands."""
    sensitivity: Array
    """Shape (q,), to the value r that the danger is to be kept at, in units of `unit`."""
    unit: float
    """Root mean square of the danger."""


@LEARNERS.register("fall")
@dataclass(frozen=True)
class Fall(LinearLearner):
    """Rung 2: learns what a fall looks like from when attempts failed, and pushes against it."""

    horizon: float = parameter(
        0.06,
        "s",
        "how far ahead the action's effect is seen on the fastest danger",
        above=0,
        at_most=3600,
    )
    steady_trials: int = parameter(
        4, "", "trials before the bootstrap makes every further one different", at_least=1
    )

    rung: ClassVar[int] = 2

    def __post_init__(self) -> None:
        check_parameters(self, "learner fall")

    def policy(self, task: Task, evidence: Evidence, rng: np.random.Generator) -> LinearPolicy:
        """Return the cautious linear policy against the dangers."""
        # How an attempt was lost that began as a failure, nobody has seen.
        demonstrations = [t for t in evidence.demonstrations if t.failure_step != 0]
        tried = [*demonstrations, *(t for t in evidence.trials if t.failure_step != 0)]
        failed = [t.failure_step is not None for t in tried]
        if not any(failed) or not demonstrations:
            raise MisstepError(
                "fall needs the time of at least one failure, after the start of its attempt: give "
                "the system a failure predicate, or mark when the recordings failed"
            )
        cut = [_until_failure(t) for t in tried]
        origin = np.mean([t.select(task.state)[0] for t in cut], axis=0)
        spread = joint_samples(task, cut)[:, : len(task.state)].std(axis=0)
        weights = shares_of_the_usual(cut, len(demonstrations))
        steady = len(evidence.trials) < self.steady_trials
        if not steady:
            weights *= rng.exponential(size=len(cut))
        centre, half = task.action_range()
        # A limit that nobody comes near is no measure of an action.
        used = np.concatenate([np.abs(t.actions - centre) for t in cut]).max(axis=0)
        half = np.minimum(half, used)
        attempts = [
            Scaled((t.select(task.state) - origin) / spread, (t.actions - centre) / half, f, w)
            for t, f, w in zip(cut, failed, weights, strict=True)
        ]
        ways = ways_to_fail(attempts, len(demonstrations))[:MOST_WAYS]
        dangers = sorted((learn_danger(way, task.dt) for way in ways), key=lambda d: d.time_scale)
        rows = cascade(attempts, dangers, self.horizon, task.dt)
        gain = rows[:, 1:] / spread
        policy = LinearPolicy(
            task, centre + half * (rows[:, 0] - gain @ origin), half[:, None] * gain
        )
        if steady or rng.random() < 0.5:
            return policy
        return _half_way(longest_lasting(evidence), policy)


def ways_to_fail(attempts: Sequence[Scaled], n_demonstrations: int) -> list[list[Scaled]]:
    """Group the failed attempts by the line along which they ended (step 1).

    The demonstrations that failed give the first line; what it does not explain gives the next.
    """
    rest = [a for a in attempts if a.failed]
    first = [a for a in attempts[:n_demonstrations] if a.failed] or rest
    ways = []
    while rest:
        line = _leading_direction(np.array([a.x[-1] for a in first]))
        explained = [(a.x[-1] @ line) ** 2 >= SAME_WAY * (a.x[-1] @ a.x[-1]) for a in rest]
        if not any(explained):
            explained[0] = True
        ways.append([a for a, same in zip(rest, explained, strict=True) if same])
        first = rest = [a for a, same in zip(rest, explained, strict=True) if not same]
    return ways


def learn_danger(failures: Sequence[Scaled], dt: float) -> Danger:
    """Regress the discounted failure of failed attempts on the state (step 2)."""
    design = np.concatenate([_with_one(a.x) for a in failures])
    penalty = np.full(design.shape[1], SLOPE_PENALTY)
    penalty[0] = INTERCEPT_PENALTY
    direction = _leading_direction(np.array([a.weight * a.x[-1] for a in failures]))
    remaining = [np.arange(len(a.x))[::-1] * dt for a in failures]
    candidates = []
    for tau in TIME_SCALES:
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
        r_squared = 1.0 - float(residual.sum() / (weight @ targets**2).sum())
        candidates.append(Danger(W @ direction, tau, r_squared))
    return max(candidates, key=lambda danger: danger.r_squared)


def cascade(
    attempts: Sequence[Scaled], dangers: Sequence[Danger], horizon: float, dt: float
) -> Array:
    """Return bias and gain of the control, shape (m, 1 + n), through dangers from fast to slow."""
    commands = [a.a for a in attempts]
    responses: list[Response] = []
    for level, danger in enumerate(dangers):
        ahead = horizon
        if level:
            ahead = min(LONGEST_SLOW_HORIZON, SLOW_HORIZON_SCALES * danger.time_scale)
        response = respond(attempts, commands, danger, max(1, round(ahead / dt)))
        if response is None:
            break
        responses.append(response)
        commands = [
            (_with_one(a.x[:-1]) @ danger.coefficients / response.unit)[:, None] for a in attempts
        ]
    if not responses:
        raise MisstepError(
            f"fall sees no attempt longer than its horizon of {horizon:g} s: shorten it"
        )
    kept_at = np.zeros(responses[-1].gain.shape[1])
    for response in reversed(responses):
        rows = response.gain + np.outer(response.sensitivity, kept_at)
        kept_at = rows[0]
    return rows


def respond(
    attempts: Sequence[Scaled], commands: Sequence[Array], danger: Danger, horizon: int
) -> Response | None:
    """Learn what commands (T, q) do to a danger, and how to command it (steps 3 and 4).

    Returns None if no attempt is as long as the horizon.
    """
    rows, targets, weights = [], [], []
    for attempt, command in zip(attempts, commands, strict=True):
        if len(command) < horizon:
            continue
        total = np.concatenate([np.zeros((1, command.shape[1])), command.cumsum(axis=0)])
        mean_command = (total[horizon:] - total[:-horizon]) / horizon
        rows.append(np.hstack([_with_one(attempt.x[: len(mean_command)]), mean_command]))
        targets.append(_with_one(attempt.x[horizon:]) @ danger.coefficients)
        weights.append(np.full(len(mean_command), attempt.weight))
    if not rows:
        return None
    X, y, w = np.concatenate(rows), np.concatenate(targets), np.concatenate(weights)
    w /= w.mean()
    unit = float(np.sqrt(np.mean(y**2)))
    y /= unit
    precision = (X * w[:, None]).T @ X + EFFECT_PENALTY * np.eye(X.shape[1])
    c = np.linalg.solve(precision, X.T @ (w * y))
    freedom = max(len(y) - X.shape[1], 1)
    noise = float(w @ (y - X @ c) ** 2) / freedom + 1e-9
    # Windows overlap by the horizon, so there are that many fewer independent ones.
    C = np.linalg.inv(precision) * noise * horizon
    n = danger.coefficients.size
    c_x, c_a = c[:n], c[n:]
    expected = np.outer(c_a, c_a) + C[n:, n:]
    gain = -np.linalg.solve(expected, np.outer(c_a, c_x) + C[n:, :n])
    return Response(gain, np.linalg.solve(expected, c_a), unit)


def _leading_direction(ends: Array) -> Array:
    """Return the unit vector along which ends (N, n) are longest, shape (n,)."""
    direction: Array = np.linalg.svd(ends, full_matrices=False)[2][0]
    return direction


def shares_of_the_usual(attempts: Sequence[Trajectory], n_demonstrations: int) -> Array:
    """Return how long attempts lasted, of the demonstrations' median; at most 1."""
    lasted = np.array([attempt.duration for attempt in attempts])
    return np.minimum(1.0, lasted / np.median(lasted[:n_demonstrations]))


def _half_way(a: LinearPolicy, b: LinearPolicy) -> LinearPolicy:
    return LinearPolicy(a.task, 0.5 * (a.bias + b.bias), 0.5 * (a.gain + b.gain))


def _until_failure(trajectory: Trajectory) -> Trajectory:
    """Return the trajectory up to its failure: what follows is no attempt any more."""
    step = trajectory.failure_step
    if step is None or step == trajectory.n_steps:
        return trajectory
    return trajectory.cut(step)


def _with_one(x: Array) -> Array:
    return np.hstack([np.ones((len(x), 1)), x])


def _ridge(X: Array, Y: Array, weight: Array, penalty: Array) -> Array:
    """Weighted ridge regression: (XᵀwX + diag(penalty))⁻¹ XᵀwY."""
    weighted = (X * weight[:, None]).T
    return np.linalg.solve(weighted @ X + np.diag(penalty), weighted @ Y).astype(np.float64)
