"""The compiled loops that answer "which action now?".

Everything here takes plain float64 arrays that the callers have validated. `reference.py` says the
same in readable NumPy, and the tests hold the two against each other.

A query allocates nothing: it works in one array that the caller brings (`scratch_for`). Components
too far away to change the last bit of a density are passed over, which in a mixture of ten leaves
two or three.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from misstep.compiling import njit

Array = NDArray[np.float64]

COMPILED: dict[str, Any] = {"cache": True, "nogil": True, "_nrt": False}
_INLINED: dict[str, Any] = {"forceinline": True, "_nrt": False}
LOG_2PI = math.log(2.0 * math.pi)

# Of a variance of which no larger share is left by the columns before, rounding is most of it.
SINGULAR = 1e-14


@njit(**COMPILED)
def cholesky_whitener(covariance, whitener):
    """Fill `whitener` with W = L⁻¹ of L Lᵀ = `covariance`; return log det W.

    Return NaN where the matrix is not definite, or so nearly singular that one could not tell.
    """
    d = covariance.shape[0]
    log_det = 0.0
    for i in range(d):
        for j in range(i + 1):
            s = covariance[i, j]
            for m in range(j):
                s -= whitener[i, m] * whitener[j, m]
            if i > j:
                whitener[i, j] = s / whitener[j, j]
            elif s > SINGULAR * covariance[i, i]:
                whitener[i, i] = math.sqrt(s)
                log_det -= math.log(whitener[i, i])
            else:
                return np.nan
    # L is inverted in place: a column of it is read for the last time where it is overwritten.
    for j in range(d):
        for i in range(j):
            whitener[i, j] = 0.0
        whitener[j, j] = 1.0 / whitener[j, j]
        for i in range(j + 1, d):
            s = 0.0
            for m in range(j, i):
                s -= whitener[i, m] * whitener[m, j]
            whitener[i, j] = s / whitener[i, i]
    return log_det


@njit(**COMPILED)
def precompute(weights, covariances, whiteners, constants):
    """Fill `whiteners` (K, d, d) and `constants` (K,); False if a covariance is not definite."""
    d = covariances.shape[1]
    for k in range(weights.shape[0]):
        log_det = cholesky_whitener(covariances[k], whiteners[k])
        if not math.isfinite(log_det):
            return False
        constants[k] = math.log(max(weights[k], 1e-300)) + log_det - 0.5 * d * LOG_2PI
    return True


# What adds less than exp(−45) of a sum would not change its last bit, however many do.
NEGLIGIBLE = 45.0
# A log density so low that the double's range ends nearby.
LOWEST = -1e300


def scratch_for(K: int, d: int) -> Array:
    """Return the room that a query of K components and d actions works in."""
    return np.empty(K * (3 + 2 * d) + 6 * d + 3 * d * d)


@njit(inline="always", _nrt=False)
def _component_rooms(scratch, n_components, d):
    """h, value and slope (K,), m and direction (K, d)."""
    a, b = 3 * n_components, n_components * d
    return (
        scratch[:n_components],
        scratch[n_components : 2 * n_components],
        scratch[2 * n_components : a],
        scratch[a : a + b].reshape((n_components, d)),
        scratch[a + b : a + 2 * b].reshape((n_components, d)),
    )


@njit(inline="always", _nrt=False)
def _vector_room(scratch, n_components, d, i):
    """One of six vectors (d,)."""
    begin = n_components * (3 + 2 * d) + i * d
    return scratch[begin : begin + d]


@njit(inline="always", _nrt=False)
def _matrix_room(scratch, n_components, d, i):
    """One of three matrices (d, d)."""
    begin = n_components * (3 + 2 * d) + 6 * d + i * d * d
    return scratch[begin : begin + d * d].reshape((d, d))


@njit(**COMPILED)
def condition(state, constants, state_means, whiteners, gains, action_means, h, m):
    """Gaussian mixture regression at one state: fill h (K,) and the conditional means m (K, d)."""
    n_components, n = state_means.shape
    d = action_means.shape[1]
    top = -np.inf
    for k in range(n_components):
        q = 0.0
        for i in range(n):
            y = 0.0
            for j in range(i + 1):
                y += whiteners[k, i, j] * (state[j] - state_means[k, j])
            q += y * y
        h[k] = constants[k] - 0.5 * q
        # Where the square overflows, all components are alike: far too far away.
        if not h[k] > LOWEST:
            h[k] = LOWEST
        top = max(top, h[k])
        for i in range(d):
            m[k, i] = action_means[k, i]
            for j in range(n):
                m[k, i] += gains[k, i, j] * (state[j] - state_means[k, j])
    total = 0.0
    for k in range(n_components):
        h[k] = math.exp(h[k] - top)
        total += h[k]
    for k in range(n_components):
        h[k] /= total


@njit(**COMPILED)
def conditions(states, constants, state_means, whiteners, gains, action_means, h, m):
    """`condition` at many states (N, n): fill h (N, K) and m (N, K, d)."""
    for i in range(states.shape[0]):
        condition(states[i], constants, state_means, whiteners, gains, action_means, h[i], m[i])


@njit(**COMPILED)
def scaled_variance(h, m, covariances, scale):
    """‖V‖/s² = tr(V/s²)/d, the spread of the conditional mixture in units of `scale` (d,)."""
    n_components, d = m.shape
    total = 0.0
    for i in range(d):
        mean = 0.0
        second = 0.0
        for k in range(n_components):
            mean += h[k] * m[k, i]
        for k in range(n_components):
            if h[k] > 0.0:  # 0 × ∞ is no number
                deviation = m[k, i] - mean
                second += h[k] * (covariances[k, i, i] + deviation * deviation)
        total += second / (scale[i] * scale[i])
    return total / d


@njit(**COMPILED)
def exploration_of(spread, printed):
    """ε of V/s², which may have overflowed, to infinity or to what is no number."""
    if not spread < np.inf:
        return 0.0 if printed else 1.0
    return 1.0 / (1.0 + spread) if printed else spread / (1.0 + spread)


@njit(**_INLINED)
def _donut_terms(shape, d):
    """r_α², r_β² − r_α², (γ − 1) kᵈ, the density at the centre in units of N, and d log r_α."""
    gamma, r_alpha, r_beta = shape
    a2 = r_alpha * r_alpha
    gap = r_beta * r_beta - a2
    ratio = (r_beta / r_alpha) ** d
    inner = (gamma - 1.0) * ratio
    centre = gamma - inner
    # At full exploration the centre is zero; what rounding leaves there would be a false floor.
    if abs(centre) < 1e-14 * gamma + 4e-16 * ratio:
        centre = 0.0
    return a2, gap, inner, centre, d * math.log(r_alpha)


@njit(**_INLINED)
def _log_donut(squared, log_norm, terms):
    """Return log D at Mahalanobis² `squared`, and the factor g in ∇ log D = g Σ⁻¹(a − μ)."""
    a2, gap, inner, centre, log_width = terms
    # expm1 keeps the bracket exact next to the centre, where it may vanish.
    rise = math.expm1(-0.5 * squared * gap)
    bracket = centre - inner * rise
    if bracket <= 0.0:
        return -np.inf, 0.0
    slope = inner * (rise + 1.0) * gap / bracket - a2
    return log_norm + log_width - 0.5 * a2 * squared + math.log(bracket), slope


@njit(**COMPILED)
def donut_log_density(squared, log_norm, gamma, r_alpha, r_beta, d):
    """Return log D at Mahalanobis² `squared`, and the factor g in ∇ log D = g Σ⁻¹(a − μ)."""
    return _log_donut(squared, log_norm, _donut_terms((gamma, r_alpha, r_beta), d))


@njit(**_INLINED)
def _log_donuts(a, log_h, m, whiteners, log_norms, shape, value, slope, direction, y):
    """Fill each component's log h_k D_k(a) and what its gradient is made of; return the largest.

    Components passed over get −∞.
    """
    n_components, d = m.shape
    terms = _donut_terms(shape, d)
    most = terms[4] + math.log(shape[0])
    top = -np.inf
    for k in range(n_components):
        squared = 0.0
        for i in range(d):
            y[i] = 0.0
            for j in range(i + 1):
                y[i] += whiteners[k, i, j] * (a[j] - m[k, j])
            squared += y[i] * y[i]
        for j in range(d):
            direction[k, j] = 0.0
            for i in range(j, d):
                direction[k, j] += whiteners[k, i, j] * y[i]
        if log_h[k] + log_norms[k] + most - 0.5 * terms[0] * squared < top - NEGLIGIBLE:
            value[k], slope[k] = -np.inf, 0.0
            continue
        v, slope[k] = _log_donut(squared, log_norms[k], terms)
        value[k] = log_h[k] + v
        top = max(top, value[k])
    return top


@njit(**COMPILED)
def mixture_density(a, log_h, m, whiteners, log_norms, shape, gradient, metric, scratch):
    """Return log DMM(a); fill its gradient (d,) and the metric (d, d), the mean precision there.

    `shape` holds γ, r_α, r_β. Where the density is zero the gradient is zero and the metric the
    first component's.
    """
    n_components, d = m.shape
    _, value, slope, _, direction = _component_rooms(scratch, n_components, d)
    y = _vector_room(scratch, n_components, d, 0)
    top = _log_donuts(a, log_h, m, whiteners, log_norms, shape, value, slope, direction, y)
    for i in range(d):
        gradient[i] = 0.0
        for j in range(d):
            metric[i, j] = 0.0
    silent = top == -np.inf
    total = 0.0
    for k in range(n_components):
        if silent:
            value[k] = 1.0 if k == 0 else 0.0
        elif value[k] < top - NEGLIGIBLE:
            value[k] = 0.0
        else:
            value[k] = math.exp(value[k] - top)
        total += value[k]
    for k in range(n_components):
        rho = value[k] / total
        if rho == 0.0:
            continue
        for i in range(d):
            gradient[i] += rho * slope[k] * direction[k, i]
            for j in range(d):
                for q in range(max(i, j), d):
                    metric[i, j] += rho * whiteners[k, q, i] * whiteners[k, q, j]
    return top + math.log(total)


@njit(**COMPILED)
def mixture_densities(points, log_h, m, whiteners, log_norms, shape, values, gradients, scratch):
    """`mixture_density` at many points (N, d): fill `values` (N,) and `gradients` (N, d)."""
    n_components, d = m.shape
    metric = _matrix_room(scratch, n_components, d, 0)
    for i in range(points.shape[0]):
        values[i] = mixture_density(
            points[i], log_h, m, whiteners, log_norms, shape, gradients[i], metric, scratch
        )


@njit(**COMPILED)
def solve_definite(matrix, right, out, whitener, y):
    """Solve `matrix` · out = `right` for a positive definite matrix (d, d).

    Where it is nearly singular, only its diagonal counts.
    """
    d = matrix.shape[0]
    if d == 1:
        out[0] = right[0] / matrix[0, 0]
        return
    if not math.isfinite(cholesky_whitener(matrix, whitener)):
        # Of a step that only has to go uphill, the column's own scale is enough.
        for i in range(d):
            out[i] = right[i] / matrix[i, i]
        return
    for i in range(d):
        y[i] = 0.0
        for j in range(i + 1):
            y[i] += whitener[i, j] * right[j]
    for j in range(d):
        out[j] = 0.0
        for i in range(j, d):
            out[j] += whitener[i, j] * y[i]


LONGEST_STEP = 0.5
SHORTEST_STEP = 1e-7
NUDGE = 1e-3
MAX_ASCENT = 500


@njit(**COMPILED)
def ascend(a, log_h, m, whiteners, log_norms, shape, scratch):
    """Climb from `a` (overwritten) to a local maximum of the donut mixture; return its log density.

    Gradient ascent in the metric of the components that matter where it stands, with backtracking.
    No step is longer than half a standard deviation, so the climb stays on the hill it starts on;
    only more than ten out, where there are no hills, it strides. At a centre the gradient vanishes
    although the centre may be a pit: a start without a slope is moved by a thousandth of a standard
    deviation.
    """
    n_components, d = m.shape
    y = _vector_room(scratch, n_components, d, 0)
    gradient = _vector_room(scratch, n_components, d, 1)
    step = _vector_room(scratch, n_components, d, 2)
    trial = _vector_room(scratch, n_components, d, 3)
    trial_gradient = _vector_room(scratch, n_components, d, 4)
    metric = _matrix_room(scratch, n_components, d, 0)
    trial_metric = _matrix_room(scratch, n_components, d, 1)
    whitener = _matrix_room(scratch, n_components, d, 2)
    value = mixture_density(a, log_h, m, whiteners, log_norms, shape, gradient, metric, scratch)
    solve_definite(metric, gradient, step, whitener, y)
    squared = 0.0
    for i in range(d):
        squared += step[i] * gradient[i]
    if squared < SHORTEST_STEP**2:
        for i in range(d):
            a[i] += NUDGE / math.sqrt(metric[i, i])
        value = mixture_density(a, log_h, m, whiteners, log_norms, shape, gradient, metric, scratch)
    length = 1.0
    for _ in range(MAX_ASCENT):
        if value == -np.inf:
            break
        solve_definite(metric, gradient, step, whitener, y)
        squared = 0.0
        for i in range(d):
            squared += step[i] * gradient[i]
        norm = math.sqrt(max(squared, 0.0))
        if norm < SHORTEST_STEP:
            break
        # In units of the slope: a longer last step may have become too short where it is gentler.
        length = max(length, min(1.0, 10.0 * SHORTEST_STEP / norm))
        length = min(length, max(LONGEST_STEP, 0.25 * norm - 2.0) / norm)
        trial_value = -np.inf
        while length * norm >= SHORTEST_STEP:
            for i in range(d):
                trial[i] = a[i] + length * step[i]
            trial_value = mixture_density(
                trial,
                log_h,
                m,
                whiteners,
                log_norms,
                shape,
                trial_gradient,
                trial_metric,
                scratch,
            )
            if trial_value >= value + 0.1 * length * squared:
                break
            length *= 0.5
        else:
            break
        # Barzilai–Borwein: the next length from the curvature just met, or twice as long if none.
        curvature = 0.0
        for i in range(d):
            curvature += length * step[i] * (gradient[i] - trial_gradient[i])
        length = length * length * squared / curvature if curvature > 0.0 else 2.0 * length
        value = trial_value
        for i in range(d):
            a[i] = trial[i]
            gradient[i] = trial_gradient[i]
            for j in range(d):
                metric[i, j] = trial_metric[i, j]
    return value


@njit(**COMPILED)
def best_candidate(a, log_h, m, whiteners, lowers, log_norms, shape, ridge, scratch):
    """Overwrite `a` with the densest of the centres and the points on each component's ridge."""
    n_components, d = m.shape
    _, value, slope, _, direction = _component_rooms(scratch, n_components, d)
    y = _vector_room(scratch, n_components, d, 0)
    candidate = _vector_room(scratch, n_components, d, 3)
    best = -np.inf
    for k in range(n_components):
        for c in range(2 * d + 1):
            axis = (c - 1) // 2
            sign = 0.0 if c == 0 else (1.0 if c % 2 == 1 else -1.0)
            for i in range(d):
                candidate[i] = m[k, i] + sign * ridge * lowers[k, i, max(axis, 0)]
            top = _log_donuts(
                candidate, log_h, m, whiteners, log_norms, shape, value, slope, direction, y
            )
            # The sum is at most K times its largest term.
            if top + math.log(n_components) < best or top == -np.inf:
                density = top
            else:
                total = 0.0
                for i in range(n_components):
                    if value[i] >= top - NEGLIGIBLE:
                        total += math.exp(value[i] - top)
                density = top + math.log(total)
            if density > best or (k == 0 and c == 0):
                best = density
                for i in range(d):
                    a[i] = candidate[i]


@njit(**COMPILED)
def donut_shape(exploration, d, k, reach):
    """γ, r_α, r_β of the exploration family, and the Mahalanobis radius of its ridge (0: none)."""
    r_alpha = 1.0 / (1.0 + (reach - 1.0) * exploration)
    r_beta = k * r_alpha
    gamma = 1.0 + exploration / (k**d - 1.0)
    steepness = (gamma - 1.0) / gamma * k ** (d + 2)
    ridge = 0.0
    if steepness > 1.0:
        ridge = math.sqrt(2.0 * math.log(steepness) / (r_beta * r_beta - r_alpha * r_alpha))
    return (gamma, r_alpha, r_beta), ridge


@njit(**COMPILED)
def answer(
    state,
    action,
    warm,
    flat_stays,
    printed,
    k,
    reach,
    scale,
    state_constants,
    state_means,
    state_whiteners,
    gains,
    action_means,
    covariances,
    whiteners,
    lowers,
    log_norms,
    scratch,
):
    """Condition on `state`, choose ε, climb the donut mixture; overwrite `action`, return ε.

    With `warm` the climb starts from the `action` that comes in, otherwise from the best analytic
    candidate. With `flat_stays` the action stays where it is if the density there is zero in double
    precision. `printed` takes ε = 1/(1 + V/s²), the paper's formula as printed.
    """
    n_components, d = action_means.shape
    h, _, _, m, _ = _component_rooms(scratch, n_components, d)
    condition(state, state_constants, state_means, state_whiteners, gains, action_means, h, m)
    spread = scaled_variance(h, m, covariances, scale)
    exploration = exploration_of(spread, printed)
    shape, ridge = donut_shape(exploration, d, k, reach)
    for i in range(n_components):
        h[i] = math.log(max(h[i], 1e-300))
    if not warm:
        best_candidate(action, h, m, whiteners, lowers, log_norms, shape, ridge, scratch)
    elif flat_stays:
        gradient = _vector_room(scratch, n_components, d, 1)
        metric = _matrix_room(scratch, n_components, d, 0)
        value = mixture_density(
            action, h, m, whiteners, log_norms, shape, gradient, metric, scratch
        )
        if math.exp(value) == 0.0:
            return exploration
    ascend(action, h, m, whiteners, log_norms, shape, scratch)
    return exploration
