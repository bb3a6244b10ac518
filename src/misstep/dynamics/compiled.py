"""The compiled loops of planning: the model's step with its Jacobians, rollouts, iLQR, networks.

Everything here takes plain arrays that the callers have validated, in groups that change together:
`Model`, `Cost`, `Networks` and `Workspace`. The workspace holds every intermediate result, so that
a control step allocates nothing.

A step costs one exponential a centre and a few inner products over the centres, which value and
Jacobian share. The exponent is expanded, −½|z − c|² = z·c − ½|c|² − ½|z|², everything constant in
it is multiplied out beforehand, and the centres are padded to whole vector registers.

Fast-math is limited to re-ordering. What uses it is inlined by force, up to the functions that only
Python calls: left to itself, the process that compiles and later ones that load from the cache run
copies whose last bits differ (as in `misstep.mixture.em`).
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from misstep.compiling import njit
from misstep.costs import EFFORT, FREE_SHARE, WALL, StateCost
from misstep.errors import MisstepError
from misstep.mixture.elementary import REORDER, exp_nonpositive

Array = NDArray[np.float64]

# Without reference counting, which would take two thirds of the time; numba then refuses to compile
# anything that allocates.
_COMPILED: dict[str, Any] = {"cache": True, "_nrt": False}
_INLINED: dict[str, Any] = {"fastmath": REORDER, "forceinline": True, "_nrt": False}

# The last step of the horizon stands for all that follow.
FINAL_WEIGHT = 10.0
EFFORT_SLOPE = 2.0 * EFFORT
# Where 1 − cos e turns concave, a quadratic model needs some curvature all the same.
LEAST_CURVATURE = 0.1
LINE_SEARCHES = 6
SHORTENING = 0.4
LEAST_DAMPING = 1e-6
FIRST_DAMPING = 1e-3
MOST_DAMPING = 1e4


class Model(NamedTuple):
    """A forward model: n state columns, nz encoded, m actions, ny learned columns, D centres."""

    angles: NDArray[np.bool_]
    """Which columns are encoded as sine and cosine, shape (n,)."""
    mean: Array
    """Of each column, shape (n,)."""
    inverse_scale: Array
    """Of each column, shape (n,)."""
    inverse_lengths: Array
    """1/ℓ, shape (nz,)."""
    centres: Array
    """Divided by ℓ, shape (nz, D)."""
    offsets: Array
    """−½|c|² of the divided centres, shape (D,)."""
    local: Array
    """Weights of the exponentials, without and with each action, shape (1 + m, ny, D)."""
    linear: Array
    """Weights of z/ℓ, likewise, shape (1 + m, ny, nz)."""
    constant: Array
    """Likewise, shape (1 + m, ny)."""
    learned: NDArray[np.int64]
    """Index of each learned column, shape (ny,)."""
    source: NDArray[np.int64]
    """Column j whose integral a column is, or −1, shape (n,)."""
    alpha: Array
    """Δs_i = α s_j + β Δs_j, shape (n,)."""
    beta: Array
    """Shape (n,)."""
    low: Array
    """Smallest value a rollout may take, shape (n,)."""
    high: Array
    """Largest value a rollout may take, shape (n,)."""

    @property
    def n_actions(self) -> int:
        """Number of actions, m."""
        return len(self.constant) - 1

    def check(self) -> None:
        """Raise MisstepError if the arrays do not fit each other; the loops would not notice."""
        n, m, ny = len(self.angles), self.n_actions, len(self.learned)
        nz, n_centres = n + int(np.count_nonzero(self.angles)), len(self.offsets)
        shapes = {
            "mean": (n,),
            "inverse_scale": (n,),
            "inverse_lengths": (nz,),
            "centres": (nz, n_centres),
            "local": (1 + m, ny, n_centres),
            "linear": (1 + m, ny, nz),
            "constant": (1 + m, ny),
            "source": (n,),
            "alpha": (n,),
            "beta": (n,),
            "low": (n,),
            "high": (n,),
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise MisstepError(
                    f"the forward model's {name} has shape {getattr(self, name).shape}, but the "
                    f"others want {shape}"
                )
        integrals = np.flatnonzero(self.source >= 0)
        whole = np.array_equal(self.learned, np.flatnonzero(self.source < 0))
        if not whole or not np.isin(self.source[integrals], self.learned).all():
            raise MisstepError(
                f"the forward model learns the columns {self.learned} and integrates "
                f"{self.source}: each integral needs a learned source, each other column learning"
            )


class Cost(NamedTuple):
    """`misstep.costs.StateCost` as arrays, each of shape (n,)."""

    angles: NDArray[np.bool_]
    goal: Array
    weights: Array
    inverse_limits: Array

    @classmethod
    def of(cls, cost: StateCost, angles: NDArray[np.bool_]) -> "Cost":
        """Return the arrays of a cost of states whose columns `angles` (n,) wrap."""
        limits = np.array(cost.limits, dtype=np.float64)
        return cls(angles, np.array(cost.goal), np.array(cost.weights), 1.0 / limits)


class Networks(NamedTuple):
    """P networks of one hidden layer: u = tanh(outer [tanh(inner [z, 1]), 1])."""

    inner: Array
    """Shape (P, units, nz + 1)."""
    outer: Array
    """Shape (P, m, units + 1)."""
    hidden: Array
    """Room for the hidden units, shape (units,)."""


class Workspace(NamedTuple):
    """Room for the intermediate results of planning over H steps."""

    encoded: Array
    exponent: Array
    basis: Array
    weighted: Array
    states: Array
    new_states: Array
    new_plan: Array
    jacobian: Array
    action_jacobian: Array
    feedforward: Array
    feedback: Array
    value: Array
    value_jacobian: Array
    value_action: Array
    gradient: Array
    state_gradient: Array
    action_gradient: Array
    cross: Array
    curvature: Array
    lower: Array

    @classmethod
    def of(cls, model: Model, horizon: int) -> "Workspace":
        """Make room for plans of `horizon` steps."""
        n, m = len(model.angles), model.n_actions
        nz, n_centres = model.centres.shape
        return cls(
            encoded=np.empty(nz),
            exponent=np.empty(n_centres),
            basis=np.empty(n_centres),
            weighted=np.empty(n_centres),
            states=np.empty((horizon + 1, n)),
            new_states=np.empty((horizon + 1, n)),
            new_plan=np.empty((horizon, m)),
            jacobian=np.empty((horizon, n, n)),
            action_jacobian=np.empty((horizon, n, m)),
            feedforward=np.empty((horizon, m)),
            feedback=np.empty((horizon, m, n)),
            value=np.empty((n, n)),
            value_jacobian=np.empty((n, n)),
            value_action=np.empty((n, m)),
            gradient=np.empty(n),
            state_gradient=np.empty(n),
            action_gradient=np.empty(m),
            cross=np.empty((m, n)),
            curvature=np.empty((m, m)),
            lower=np.empty((m, m)),
        )


@njit(**_INLINED)
def _encode(model, state, z):
    """Fill `z` (nz,) with the encoded state."""
    k = 0
    for i in range(state.shape[0]):
        if model.angles[i]:
            z[k] = math.sin(state[i])
            z[k + 1] = math.cos(state[i])
            k += 2
        else:
            z[k] = (state[i] - model.mean[i]) * model.inverse_scale[i]
            k += 1


@njit(**_INLINED)
def _evaluate_basis(model, state, work):
    """Fill `work.encoded` with z/ℓ and `work.basis` with the exponentials at `state`."""
    z = work.encoded
    exponent = work.exponent
    _encode(model, state, z)
    n_centres = exponent.shape[0]
    half = 0.0
    for k in range(z.shape[0]):
        v = z[k] * model.inverse_lengths[k]
        z[k] = v
        half += 0.5 * v * v
    offsets = model.offsets
    for d in range(n_centres):
        exponent[d] = offsets[d] - half
    for k in range(z.shape[0]):
        v = z[k]
        row = model.centres[k]
        for d in range(n_centres):
            exponent[d] += v * row[d]
    basis = work.basis
    for d in range(n_centres):
        basis[d] = exp_nonpositive(exponent[d])


@njit(**_INLINED)
def _copy(source, target):
    for i in range(source.shape[0]):
        target[i] = source[i]


@njit(**_INLINED)
def _copy_rows(source, target):
    for t in range(source.shape[0]):
        _copy(source[t], target[t])


@njit(**_INLINED)
def _dot(a, b):
    total = 0.0
    for d in range(a.shape[0]):
        total += a[d] * b[d]
    return total


@njit(**_INLINED)
def _learned_part(model, c, j, work):
    """Return what multiplies u_c in the change of learned column j; u_0 = 1."""
    total = model.constant[c, j] + _dot(model.local[c, j], work.basis)
    for k in range(work.encoded.shape[0]):
        total += model.linear[c, j, k] * work.encoded[k]
    return total


@njit(**_INLINED)
def _step(model, state, action, new_state, work):
    """Fill `new_state` (n,) with the prediction; leaves the basis of `state` in `work`."""
    _evaluate_basis(model, state, work)
    n = state.shape[0]
    m = action.shape[0]
    for j in range(model.learned.shape[0]):
        y = _learned_part(model, 0, j, work)
        for c in range(m):
            y += action[c] * _learned_part(model, 1 + c, j, work)
        new_state[model.learned[j]] = y
    for i in range(n):
        j = model.source[i]
        if j >= 0:
            new_state[i] = model.alpha[i] * state[j] + model.beta[i] * new_state[j]
    for i in range(n):
        new_state[i] = min(max(state[i] + new_state[i], model.low[i]), model.high[i])


@njit(**_INLINED)
def _linearise(model, state, action, jacobian, action_jacobian, work):
    """Fill ∂s′/∂s (n, n) and ∂s′/∂u (n, m), the rollout's limits ignored."""
    _evaluate_basis(model, state, work)
    n = state.shape[0]
    m = action.shape[0]
    weighted = work.weighted
    basis = work.basis
    for j in range(model.learned.shape[0]):
        row = model.learned[j]
        plain = model.local[0, j]
        for d in range(basis.shape[0]):
            weighted[d] = plain[d]
        for c in range(m):
            modulated = model.local[1 + c, j]
            u = action[c]
            for d in range(basis.shape[0]):
                weighted[d] += u * modulated[d]
            action_jacobian[row, c] = _learned_part(model, 1 + c, j, work)
        total = 0.0
        for d in range(basis.shape[0]):
            weighted[d] *= basis[d]
            total += weighted[d]
        k = 0
        for i in range(n):
            slope = _encoded_slope(model, action, j, k, total, work)
            if model.angles[i]:
                other = _encoded_slope(model, action, j, k + 1, total, work)
                slope = slope * math.cos(state[i]) - other * math.sin(state[i])
                k += 2
            else:
                slope *= model.inverse_scale[i]
                k += 1
            jacobian[row, i] = slope
    for i in range(n):
        j = model.source[i]
        if j >= 0:
            for k in range(n):
                jacobian[i, k] = model.beta[i] * jacobian[j, k]
            for c in range(m):
                action_jacobian[i, c] = model.beta[i] * action_jacobian[j, c]
            jacobian[i, j] += model.alpha[i]
    for i in range(n):
        jacobian[i, i] += 1.0


@njit(**_INLINED)
def _encoded_slope(model, action, j, k, total, work):
    """∂y_j/∂z_k; `total` is the sum of the weighted exponentials."""
    slope = _dot(work.weighted, model.centres[k]) - work.encoded[k] * total + model.linear[0, j, k]
    for c in range(action.shape[0]):
        slope += action[c] * model.linear[1 + c, j, k]
    return model.inverse_lengths[k] * slope


@njit(**_INLINED)
def _state_cost(cost, state):
    total = 0.0
    for i in range(state.shape[0]):
        error = state[i] - cost.goal[i]
        if cost.angles[i]:
            total += cost.weights[i] * (1.0 - math.cos(error))
        else:
            total += 0.5 * cost.weights[i] * error * error
        excess = abs(state[i]) * cost.inverse_limits[i] - FREE_SHARE
        if excess > 0.0:
            total += 0.5 * WALL * excess * excess
    return total


@njit(**_INLINED)
def _add_cost_derivatives(cost, state, factor, gradient, hessian):
    for i in range(state.shape[0]):
        error = state[i] - cost.goal[i]
        weight = factor * cost.weights[i]
        if cost.angles[i]:
            gradient[i] += weight * math.sin(error)
            hessian[i, i] += weight * max(math.cos(error), LEAST_CURVATURE)
        else:
            gradient[i] += weight * error
            hessian[i, i] += weight
        excess = abs(state[i]) * cost.inverse_limits[i] - FREE_SHARE
        if excess > 0.0:
            steep = factor * WALL * cost.inverse_limits[i]
            gradient[i] += math.copysign(steep * excess, state[i])
            hessian[i, i] += steep * cost.inverse_limits[i]


@njit(**_INLINED)
def _effort(action):
    total = 0.0
    for c in range(action.shape[0]):
        total += EFFORT * action[c] * action[c]
    return total


@njit(**_COMPILED)
def predict(model, states, actions, new_states, work):
    """Fill `new_states` (N, n) with one step from each of `states` (N, n); actions in [−1, 1]."""
    for t in range(states.shape[0]):
        _step(model, states[t], actions[t], new_states[t], work)


@njit(**_COMPILED)
def linearise(model, state, action, jacobian, action_jacobian, work):
    """Fill ∂s′/∂s (n, n) and ∂s′/∂u (n, m) at one state and action."""
    _linearise(model, state, action, jacobian, action_jacobian, work)


@njit(**_COMPILED)
def rank(model, cost, state, plans, costs, work):
    """Fill `costs` (N,) with the cost of each of `plans` (N, H, m) from `state`."""
    horizon = plans.shape[1]
    states = work.new_states
    _copy(state, states[0])
    for p in range(plans.shape[0]):
        total = 0.0
        for t in range(horizon):
            _step(model, states[t], plans[p, t], states[t + 1], work)
            factor = FINAL_WEIGHT if t == horizon - 1 else 1.0
            total += factor * _state_cost(cost, states[t + 1]) + _effort(plans[p, t])
        costs[p] = total


@njit(**_INLINED)
def _act(model, network, p, state, action, work):
    """Fill `action` (m,) with what network p of `network` does at `state`; uses `work.encoded`."""
    z = work.encoded
    _encode(model, state, z)
    nz = z.shape[0]
    n_units = network.hidden.shape[0]
    for h in range(n_units):
        total = network.inner[p, h, nz]
        for k in range(nz):
            total += network.inner[p, h, k] * z[k]
        network.hidden[h] = math.tanh(total)
    for c in range(action.shape[0]):
        total = network.outer[p, c, n_units]
        for h in range(n_units):
            total += network.outer[p, c, h] * network.hidden[h]
        action[c] = math.tanh(total)


@njit(**_COMPILED)
def imagine(model, cost, networks, starts, noise, costs, work):
    """Fill `costs` (P,) with the cost of each of P networks over all imagined rollouts.

    Rollout r begins at `starts` (R, n); what `noise` (R, H, n) holds is added after each step.
    """
    n_rollouts, horizon, n = noise.shape
    states = work.new_states
    action = work.new_plan[0]
    for p in range(costs.shape[0]):
        total = 0.0
        for r in range(n_rollouts):
            _copy(starts[r], states[0])
            for t in range(horizon):
                before, after = states[t % 2], states[1 - t % 2]
                _act(model, networks, p, before, action, work)
                _step(model, before, action, after, work)
                for i in range(n):
                    after[i] += noise[r, t, i]
                total += _state_cost(cost, after) + _effort(action)
        costs[p] = total


@njit(**_COMPILED)
def extend(model, cost, state, gain, plan, start, work):
    """Overwrite the steps of `plan` (H, m) from `start` on by the feedback `gain` (m, n).

    Returns
    -------
    cost : float
        Of the whole plan.
    """
    horizon, m = plan.shape
    n = state.shape[0]
    states = work.new_states
    _copy(state, states[0])
    total = 0.0
    for t in range(horizon):
        if t >= start:
            for c in range(m):
                u = 0.0
                for i in range(n):
                    error = states[t, i] - cost.goal[i]
                    if cost.angles[i]:
                        error -= 2.0 * math.pi * math.floor(error / (2.0 * math.pi) + 0.5)
                    u -= gain[c, i] * error
                plan[t, c] = min(max(u, -1.0), 1.0)
        _step(model, states[t], plan[t], states[t + 1], work)
        factor = FINAL_WEIGHT if t == horizon - 1 else 1.0
        total += factor * _state_cost(cost, states[t + 1]) + _effort(plan[t])
    return total


@njit(**_INLINED)
def _follow(model, cost, plan, length, bound, work):
    """Roll out `plan` moved by `length` of the feedforward, with the feedback.

    Fills `work.new_states` and `work.new_plan`; gives up as soon as the cost exceeds `bound`.
    """
    horizon, m = plan.shape
    n = work.states.shape[1]
    total = 0.0
    for t in range(horizon):
        for c in range(m):
            u = plan[t, c] + length * work.feedforward[t, c]
            for i in range(n):
                u += work.feedback[t, c, i] * (work.new_states[t, i] - work.states[t, i])
            work.new_plan[t, c] = min(max(u, -1.0), 1.0)
        _step(model, work.new_states[t], work.new_plan[t], work.new_states[t + 1], work)
        factor = FINAL_WEIGHT if t == horizon - 1 else 1.0
        total += factor * _state_cost(cost, work.new_states[t + 1]) + _effort(work.new_plan[t])
        if total > bound:
            break
    return total


@njit(**_INLINED)
def _multiply_out(work, t):
    """V A, V B and Aᵀ v, Bᵀ v, Bᵀ V A, Bᵀ V B at step t, into the workspace."""
    n = work.value.shape[0]
    m = work.curvature.shape[0]
    jacobian = work.jacobian[t]
    action_jacobian = work.action_jacobian[t]
    for i in range(n):
        for k in range(n):
            total = 0.0
            for j in range(n):
                total += work.value[i, j] * jacobian[j, k]
            work.value_jacobian[i, k] = total
        for c in range(m):
            total = 0.0
            for j in range(n):
                total += work.value[i, j] * action_jacobian[j, c]
            work.value_action[i, c] = total
    for k in range(n):
        total = 0.0
        for j in range(n):
            total += jacobian[j, k] * work.gradient[j]
        work.state_gradient[k] = total
    for c in range(m):
        total = 0.0
        for j in range(n):
            total += action_jacobian[j, c] * work.gradient[j]
        work.action_gradient[c] = total
        for k in range(n):
            total = 0.0
            for j in range(n):
                total += action_jacobian[j, c] * work.value_jacobian[j, k]
            work.cross[c, k] = total
        for b in range(m):
            total = 0.0
            for j in range(n):
                total += action_jacobian[j, c] * work.value_action[j, b]
            work.curvature[c, b] = total


@njit(**_INLINED)
def _solve_step(work, t):
    """Fill feedforward −Q⁻¹q and feedback −Q⁻¹P of step t by the Cholesky factor of Q."""
    m, n = work.cross.shape
    lower = work.lower
    for c in range(m):
        for b in range(c + 1):
            total = work.curvature[c, b]
            for a in range(b):
                total -= lower[c, a] * lower[b, a]
            lower[c, b] = math.sqrt(total) if b == c else total / lower[b, b]
    for column in range(n + 1):
        for c in range(m):
            total = -work.action_gradient[c] if column == n else -work.cross[c, column]
            for b in range(c):
                total -= lower[c, b] * _gain_entry(work, t, b, column)
            _set_gain_entry(work, t, c, column, total / lower[c, c])
        for c in range(m - 1, -1, -1):
            total = _gain_entry(work, t, c, column)
            for b in range(c + 1, m):
                total -= lower[b, c] * _gain_entry(work, t, b, column)
            _set_gain_entry(work, t, c, column, total / lower[c, c])


@njit(**_INLINED)
def _gain_entry(work, t, c, column):
    """Entry of the feedback, or of the feedforward as the column after its last."""
    if column == work.feedback.shape[2]:
        return work.feedforward[t, c]
    return work.feedback[t, c, column]


@njit(**_INLINED)
def _set_gain_entry(work, t, c, column, value):
    if column == work.feedback.shape[2]:
        work.feedforward[t, c] = value
    else:
        work.feedback[t, c, column] = value


@njit(**_INLINED)
def _update_value(work, t):
    """Replace value and gradient after step t by those before it, under the gains of step t."""
    n = work.value.shape[0]
    m = work.curvature.shape[0]
    jacobian = work.jacobian[t]
    k = work.feedforward[t]
    K = work.feedback[t]
    for i in range(n):
        total = work.state_gradient[i]
        for c in range(m):
            inner = work.action_gradient[c]
            for b in range(m):
                inner += work.curvature[c, b] * k[b]
            total += K[c, i] * inner + work.cross[c, i] * k[c]
        work.gradient[i] = total
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for a in range(n):
                total += jacobian[a, i] * work.value_jacobian[a, j]
            for c in range(m):
                inner = work.cross[c, j]
                for b in range(m):
                    inner += work.curvature[c, b] * K[b, j]
                total += K[c, i] * inner + work.cross[c, i] * K[c, j]
            work.value[i, j] = total
            work.value[j, i] = total


@njit(**_INLINED)
def _backward(cost, plan, damping, work):
    """Fill feedforward and feedback by dynamic programming along `work.states`.

    Gauss–Newton: the model's second derivatives are left out. A step that would leave [−1, 1] is
    cut off there and does not feed back.
    """
    horizon, m = plan.shape
    n = work.value.shape[0]
    for i in range(n):
        work.gradient[i] = 0.0
        for j in range(n):
            work.value[i, j] = 0.0
    for t in range(horizon - 1, -1, -1):
        factor = FINAL_WEIGHT if t == horizon - 1 else 1.0
        _add_cost_derivatives(cost, work.states[t + 1], factor, work.gradient, work.value)
        _multiply_out(work, t)
        for c in range(m):
            work.action_gradient[c] += EFFORT_SLOPE * plan[t, c]
            work.curvature[c, c] += EFFORT_SLOPE + damping
        _solve_step(work, t)
        for c in range(m):
            target = plan[t, c] + work.feedforward[t, c]
            if abs(target) > 1.0:
                work.feedforward[t, c] = math.copysign(1.0, target) - plan[t, c]
                for i in range(n):
                    work.feedback[t, c, i] = 0.0
        _update_value(work, t)


@njit(**_COMPILED)
def optimise(model, cost, state, plan, iterations, tolerance, work):
    """Improve `plan` (H, m), in [−1, 1], in place by iLQR with control limits and line search.

    Ends after `iterations`, or when the cost falls by less than its share `tolerance`.

    Returns
    -------
    cost : float
        Of the plan from `state`.
    """
    horizon = plan.shape[0]
    _copy(state, work.new_states[0])
    work.states[:] = 0.0
    work.feedforward[:] = 0.0
    work.feedback[:] = 0.0
    best = _follow(model, cost, plan, 0.0, np.inf, work)
    _copy_rows(work.new_states, work.states)
    damping = LEAST_DAMPING
    fresh = True
    for _ in range(iterations):
        if fresh:
            for t in range(horizon):
                jacobian, action_jacobian = work.jacobian[t], work.action_jacobian[t]
                _linearise(model, work.states[t], plan[t], jacobian, action_jacobian, work)
        _backward(cost, plan, damping, work)
        length = 1.0
        total = np.inf
        for _ in range(LINE_SEARCHES):
            total = _follow(model, cost, plan, length, best, work)
            if total < best:
                break
            length *= SHORTENING
        fresh = total < best
        if fresh:
            gained = best - total
            _copy_rows(work.new_states, work.states)
            _copy_rows(work.new_plan, plan)
            best = total
            damping = max(0.3 * damping, LEAST_DAMPING)
            if gained < tolerance * abs(best):
                break
        else:
            damping = max(10.0 * damping, FIRST_DAMPING)
            if damping > MOST_DAMPING:
                break
    return best
