"""Planning in a forward model: at every step the best plan over a horizon, of which one action.

Receding-horizon iLQR. What it starts from decides what it finds:

- random piecewise-constant plans, some of which happen to do something useful from afar;
- near the goal, the rollout of the LQR of the model linearised there, which also continues the plan
  of the step before by its one missing step.

Every few steps some of the random plans are tried again from where the system now is.
"""

import numpy as np
from numpy.typing import NDArray

from misstep.costs import StateCost
from misstep.dynamics import compiled

Array = NDArray[np.float64]

HORIZON = 100
"""Default length of a plan, in control periods."""

N_RANDOM = 200
N_POLISHED = 6
FIRST_ITERATIONS = 60
FIRST_TOLERANCE = 1e-4
ITERATIONS = 2
TOLERANCE = 1e-5
# A plan from elsewhere has to be this much better to be worth the change.
RESEED_SHARE = 0.95
RESEED_PERIOD = 5
RESEED_RANDOM = 10
RESEED_ITERATIONS = 5
_RICCATI_STEPS = 1000
_RICCATI_TOLERANCE = 1e-9


class Planner:
    """A policy that plans; deterministic, `reset` starts it anew.

    Parameters
    ----------
    model : compiled.Model
    cost : StateCost
    horizon : int
        Steps of a plan.
    seed : int
        Of the random plans.
    """

    def __init__(
        self, model: compiled.Model, cost: StateCost, *, horizon: int = HORIZON, seed: int = 0
    ) -> None:
        self.model = model
        self.cost = compiled.Cost.of(cost, model.angles)
        self._work = compiled.Workspace.of(model, horizon)
        m = model.n_actions
        self._bank = random_plans(np.random.default_rng(seed), N_RANDOM, horizon, m)
        self._gain = lqr_gain(model, self.cost, self._work)
        self._warm_up()
        self.reset()

    def reset(self) -> None:
        """Forget the plan."""
        self._plan: Array | None = None
        self._t = 0

    def __call__(self, state: Array) -> Array:
        """Return the action (m,) in [−1, 1] for a state (n,)."""
        if self._plan is None:
            self._plan = self._first_plan(state)
        else:
            self._improve(state, self._plan)
        self._t += 1
        action: Array = self._plan[0].copy()
        return action

    def _warm_up(self) -> None:
        """Compile now, or read the cache, and not in the first control step."""
        (plan,) = self._best_random(self.cost.goal, self._bank[:1], 1)
        self._extend(self.cost.goal, plan, 0)
        self._optimise(self.cost.goal, plan, 1, TOLERANCE)

    def _first_plan(self, state: Array) -> Array:
        candidates = [*self._best_random(state, self._bank, N_POLISHED), self._lqr_plan(state)[0]]
        costs = [self._optimise(state, p, FIRST_ITERATIONS, FIRST_TOLERANCE) for p in candidates]
        return candidates[int(np.argmin(costs))]

    def _improve(self, state: Array, plan: Array) -> None:
        """Shift the plan by one step and improve it, or take a better one; in place."""
        plan[:-1] = plan[1:]
        cost = self._extend(state, plan, len(plan) - 1)
        other, other_cost = self._lqr_plan(state)
        if other_cost < cost:
            plan[:] = other
        cost = self._optimise(state, plan, ITERATIONS, TOLERANCE)
        if self._t % RESEED_PERIOD == 0:
            self._reseed(state, plan, cost)

    def _reseed(self, state: Array, plan: Array, cost: float) -> None:
        start = self._t // RESEED_PERIOD * RESEED_RANDOM % N_RANDOM
        (other,) = self._best_random(state, self._bank[start : start + RESEED_RANDOM], 1)
        other_cost = self._optimise(state, other, RESEED_ITERATIONS, FIRST_TOLERANCE)
        if other_cost < RESEED_SHARE * cost:
            self._optimise(state, other, RESEED_ITERATIONS, FIRST_TOLERANCE)
            plan[:] = other

    def _best_random(self, state: Array, plans: Array, count: int) -> list[Array]:
        costs = np.empty(len(plans))
        compiled.rank(self.model, self.cost, state, plans, costs, self._work)
        return [plans[i].copy() for i in np.argsort(costs, kind="stable")[:count]]

    def _lqr_plan(self, state: Array) -> tuple[Array, float]:
        plan = np.zeros(self._bank.shape[1:])
        return plan, self._extend(state, plan, 0)

    def _extend(self, state: Array, plan: Array, start: int) -> float:
        cost: float = compiled.extend(
            self.model, self.cost, state, self._gain, plan, start, self._work
        )
        return cost

    def _optimise(self, state: Array, plan: Array, iterations: int, tolerance: float) -> float:
        cost: float = compiled.optimise(
            self.model, self.cost, state, plan, iterations, tolerance, self._work
        )
        return cost


def random_plans(rng: np.random.Generator, count: int, horizon: int, m: int) -> Array:
    """Return piecewise-constant plans (count, horizon, m) in [−1, 1].

    Each has a pace and a strength of its own; half of them switch between full, none and full the
    other way, the others take any value.
    """
    plans = np.empty((count, horizon, m))
    for p in range(count):
        hold = int(np.exp(rng.uniform(np.log(4.0), np.log(60.0))))
        strength = rng.uniform(0.1, 1.0)
        for c in range(m):
            pieces = horizon // hold + 2
            switches = rng.random() < 0.5
            levels = rng.integers(-1, 2, pieces) if switches else rng.uniform(-1.0, 1.0, pieces)
            start = rng.integers(hold)
            plans[p, :, c] = strength * np.repeat(levels, hold)[start : start + horizon]
    return plans


def lqr_gain(model: compiled.Model, cost: compiled.Cost, work: compiled.Workspace) -> Array:
    """Return the gain (m, n) of u = −K (s − goal), optimal for the model linearised at the goal.

    Zero where the linearisation cannot be controlled: then there is nothing to start from.
    """
    n, m = len(model.angles), model.n_actions
    a, b = np.zeros((n, n)), np.zeros((n, m))
    compiled.linearise(model, cost.goal, np.zeros(m), a, b, work)
    # A touch of weight on every column, so that none drifts away unseen.
    q = np.diag(cost.weights + 1e-3)
    r = compiled.EFFORT_SLOPE * np.eye(m)
    value = q
    for _ in range(_RICCATI_STEPS):
        gain = np.asarray(np.linalg.solve(r + b.T @ value @ b, b.T @ value @ a), np.float64)
        previous, value = value, q + a.T @ value @ (a - b @ gain)
        value = 0.5 * (value + value.T)
        largest = np.abs(value).max()
        if not largest < 1e8:
            return np.zeros((m, n))
        if np.abs(value - previous).max() < _RICCATI_TOLERANCE * largest:
            break
    return gain
