"""The compiled loops: expectation–maximisation, and "which action now?".

Everything here takes plain float64 arrays that the callers have validated. `reference.py` says the
same in readable NumPy, and the tests hold the two against each other.

Two rules of speed shape the code. Expectation–maximisation walks the data in blocks that stay in
cache, with the sample index innermost, so that every loop vectorises; the exponential is a
polynomial, because calling ``exp`` once a sample would not. A query answers one state without
allocating more than a few small arrays.

Fast-math is limited to re-ordering (`REORDER`), so infinities and NaN keep their meaning. What uses
it is inlined by force into callers that do not: left to itself, the process that compiles runs the
stand-alone copy and later ones the copy in the caller's cache, whose last bits differ.
"""

import math

import numpy as np
from numba import njit

REORDER = {"reassoc", "contract", "nsz", "arcp"}
CONTRACT = {"contract"}
BLOCK = 256
LOG_2PI = math.log(2.0 * math.pi)

# Adding 1.5·2⁵² to a small whole double leaves that whole number in the low bits of the sum.
_TO_LOW_BITS = 6755399441055744.0
_LOG2_E = 1.4426950408889634
_LN2_HIGH = 0.693147180369123816490
_LN2_LOW = 1.90821492927058770002e-10


@njit(fastmath=CONTRACT, forceinline=True)
def exp_block(z, out, bits, count):
    """Write exp(z) into `out` for the first `count` entries; z ≤ 0; below −708 it gives exp(−708).

    `bits` is the int64 view of `out`. Cody–Waite reduction and a Taylor polynomial of degree 12:
    relative error below 1e-15. `REORDER` would undo the reduction, and a function that states no
    fast-math of its own would inherit it from whichever caller is compiled first.
    """
    for i in range(count):
        v = max(z[i], -708.0)
        n = math.floor(v * _LOG2_E + 0.5)
        r = (v - n * _LN2_HIGH) - n * _LN2_LOW
        p = 1.0 / 479001600.0
        p = p * r + 1.0 / 39916800.0
        p = p * r + 1.0 / 3628800.0
        p = p * r + 1.0 / 362880.0
        p = p * r + 1.0 / 40320.0
        p = p * r + 1.0 / 5040.0
        p = p * r + 1.0 / 720.0
        p = p * r + 1.0 / 120.0
        p = p * r + 1.0 / 24.0
        p = p * r + 1.0 / 6.0
        p = p * r + 0.5
        p = p * r + 1.0
        p = p * r + 1.0
        z[i] = p
        out[i] = n + _TO_LOW_BITS
    for i in range(count):
        bits[i] = (bits[i] + 1023) << 52
    for i in range(count):
        out[i] *= z[i]


@njit(cache=True)
def cholesky_whitener(covariance, whitener):
    """Fill `whitener` with W = L⁻¹ of L Lᵀ = `covariance`; return log det W or NaN."""
    d = covariance.shape[0]
    lower = np.zeros((d, d))
    log_det = 0.0
    for i in range(d):
        for j in range(i + 1):
            s = covariance[i, j]
            for m in range(j):
                s -= lower[i, m] * lower[j, m]
            if i > j:
                lower[i, j] = s / lower[j, j]
            elif s > 0.0:
                lower[i, i] = math.sqrt(s)
                log_det -= math.log(lower[i, i])
            else:
                return np.nan
    for j in range(d):
        for i in range(d):
            whitener[i, j] = 0.0
        whitener[j, j] = 1.0 / lower[j, j]
        for i in range(j + 1, d):
            s = 0.0
            for m in range(j, i):
                s -= lower[i, m] * whitener[m, j]
            whitener[i, j] = s / lower[i, i]
    return log_det


@njit(fastmath=REORDER, forceinline=True)
def _squared_distances(x, start, count, mean, whitener, q, row):
    """q[b] = Mahalanobis² of samples start..start+count of x (d, N) from `mean`."""
    d = x.shape[0]
    for b in range(count):
        q[b] = 0.0
    for i in range(d):
        offset = 0.0
        for j in range(i + 1):
            offset -= whitener[i, j] * mean[j]
        for b in range(count):
            row[b] = offset
        for j in range(i + 1):
            c = whitener[i, j]
            xj = x[j, start : start + count]
            for b in range(count):
                row[b] += c * xj[b]
        for b in range(count):
            q[b] += row[b] * row[b]


@njit(fastmath=REORDER, forceinline=True)
def _accumulate(x, start, count, mean, r, deviations, mass, first, second):
    """Add the block's moments about `mean` to `first` (d,) and `second` (d, d); return the mass."""
    d = x.shape[0]
    for b in range(count):
        mass += r[b]
    for j in range(d):
        xj = x[j, start : start + count]
        mj = mean[j]
        dev = deviations[j]
        for b in range(count):
            dev[b] = xj[b] - mj
    for j in range(d):
        dev = deviations[j]
        weighted = deviations[d]
        s = 0.0
        for b in range(count):
            weighted[b] = r[b] * dev[b]
            s += weighted[b]
        first[j] += s
        for m in range(j + 1):
            other = deviations[m]
            s = 0.0
            for b in range(count):
                s += weighted[b] * other[b]
            second[j, m] += s
    return mass


@njit(fastmath=REORDER, forceinline=True)
def expectation(x, sample_weight, constants, means, whiteners, mass, first, second):
    """One pass over the data: weighted log-likelihood, and each component's moments about its mean.

    Parameters
    ----------
    x : ndarray, shape (d, N)
    sample_weight : ndarray, shape (N,)
    constants : ndarray, shape (K,)
        log π_k + log det W_k − d/2 log 2π.
    means, whiteners : ndarray, shapes (K, d) and (K, d, d)
    mass, first, second : ndarray, shapes (K,), (K, d), (K, d, d)
        Overwritten.
    """
    d, n = x.shape
    n_components = constants.shape[0]
    log_p = np.empty((n_components, BLOCK))
    scratch = np.empty(BLOCK)
    top = np.empty(BLOCK)
    total = np.empty(BLOCK)
    p = np.empty((n_components, BLOCK))
    bits = p.view(np.int64)
    deviations = np.empty((d + 1, BLOCK))
    mass[:] = 0.0
    first[:] = 0.0
    second[:] = 0.0
    log_likelihood = 0.0
    for start in range(0, n, BLOCK):
        count = min(BLOCK, n - start)
        for k in range(n_components):
            lp = log_p[k]
            _squared_distances(x, start, count, means[k], whiteners[k], lp, scratch)
            c = constants[k]
            if k == 0:
                for b in range(count):
                    lp[b] = c - 0.5 * lp[b]
                    top[b] = lp[b]
            else:
                for b in range(count):
                    lp[b] = c - 0.5 * lp[b]
                    top[b] = max(top[b], lp[b])
        for b in range(count):
            total[b] = 0.0
        for k in range(n_components):
            lp = log_p[k]
            for b in range(count):
                lp[b] -= top[b]
            exp_block(lp, p[k], bits[k], count)
            pk = p[k]
            for b in range(count):
                total[b] += pk[b]
        w = sample_weight[start : start + count]
        for b in range(count):
            log_likelihood += w[b] * (top[b] + math.log(total[b]))
            total[b] = w[b] / total[b]
        for k in range(n_components):
            pk = p[k]
            for b in range(count):
                pk[b] *= total[b]
            mass[k] = _accumulate(
                x, start, count, means[k], pk, deviations, mass[k], first[k], second[k]
            )
    return log_likelihood


@njit(cache=True)
def maximisation(mass, first, second, means, floor, weights, covariances):
    """Turn moments about the old means into the new weights, means and covariances, in place."""
    n_components, d = means.shape
    total = 0.0
    for k in range(n_components):
        total += mass[k]
    for k in range(n_components):
        weights[k] = mass[k] / total
        # A component that no sample claims keeps its place: dividing by its mass would be 0/0.
        if mass[k] <= 1e-12 * total:
            continue
        for j in range(d):
            first[k, j] /= mass[k]
        for j in range(d):
            for m in range(j + 1):
                s = second[k, j, m] / mass[k] - first[k, j] * first[k, m]
                covariances[k, j, m] = s
                covariances[k, m, j] = s
            covariances[k, j, j] += floor
            means[k, j] += first[k, j]


@njit(cache=True)
def precompute(weights, covariances, whiteners, constants):
    """Fill `whiteners` (K, d, d) and `constants` (K,); False if a covariance is not definite."""
    d = covariances.shape[1]
    for k in range(weights.shape[0]):
        log_det = cholesky_whitener(covariances[k], whiteners[k])
        if not math.isfinite(log_det):
            return False
        constants[k] = math.log(max(weights[k], 1e-300)) + log_det - 0.5 * d * LOG_2PI
    return True


@njit(cache=True)
def fit_em(x, sample_weight, weights, means, covariances, floor, tol, max_iter):
    """Run expectation–maximisation from the given start, which is overwritten by the result.

    Stops when the mean log-likelihood per unit of weight rises by less than `tol`, or after
    `max_iter` iterations.

    Returns
    -------
    log_likelihood : float
        Weighted log-likelihood of the returned parameters; NaN if a covariance collapsed.
    n_iter : int
    converged : bool
    """
    n_components, d = means.shape
    whiteners = np.empty((n_components, d, d))
    constants = np.empty(n_components)
    mass = np.empty(n_components)
    first = np.empty((n_components, d))
    second = np.empty((n_components, d, d))
    total_weight = sample_weight.sum()
    previous = -np.inf
    for iteration in range(max_iter + 1):
        if not precompute(weights, covariances, whiteners, constants):
            return np.nan, iteration, False
        log_likelihood = expectation(
            x, sample_weight, constants, means, whiteners, mass, first, second
        )
        if abs(log_likelihood - previous) < tol * total_weight:
            return log_likelihood, iteration, True
        if iteration == max_iter:
            break
        previous = log_likelihood
        maximisation(mass, first, second, means, floor, weights, covariances)
    return log_likelihood, max_iter, False


@njit(cache=True)
def log_joint(x, constants, means, whiteners):
    """Return log π_k N(x_i; μ_k, Σ_k), shape (N, K), for samples x of shape (d, N)."""
    n = x.shape[1]
    n_components = constants.shape[0]
    out = np.empty((n, n_components))
    q = np.empty(BLOCK)
    row = np.empty(BLOCK)
    for start in range(0, n, BLOCK):
        count = min(BLOCK, n - start)
        for k in range(n_components):
            _squared_distances(x, start, count, means[k], whiteners[k], q, row)
            for b in range(count):
                out[start + b, k] = constants[k] - 0.5 * q[b]
    return out


@njit(cache=True)
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


@njit(cache=True)
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
            deviation = m[k, i] - mean
            second += h[k] * (covariances[k, i, i] + deviation * deviation)
        total += second / (scale[i] * scale[i])
    return total / d


@njit(cache=True)
def donut_log_density(squared, log_norm, gamma, r_alpha, r_beta, d):
    """Return log D at Mahalanobis² `squared`, and the factor g in ∇ log D = g Σ⁻¹(a − μ)."""
    a2 = r_alpha * r_alpha
    gap = r_beta * r_beta - a2
    ratio = (r_beta / r_alpha) ** d
    inner = (gamma - 1.0) * ratio
    centre = gamma - inner
    # At full exploration the centre is zero; what rounding leaves there would be a false floor.
    if abs(centre) < 1e-14 * gamma + 4e-16 * ratio:
        centre = 0.0
    # expm1 keeps the bracket exact next to the centre, where it may vanish.
    bracket = centre - inner * math.expm1(-0.5 * squared * gap)
    if bracket <= 0.0:
        return -np.inf, 0.0
    slope = inner * math.exp(-0.5 * squared * gap) * gap / bracket - a2
    value = log_norm + d * math.log(r_alpha) - 0.5 * a2 * squared + math.log(bracket)
    return value, slope


@njit(cache=True)
def mixture_density(a, log_h, m, whiteners, log_norms, shape, gradient, metric):
    """Return log DMM(a); fill its gradient (d,) and the metric (d, d), the mean precision there.

    `shape` holds γ, r_α, r_β. Where the density is zero the gradient is zero and the metric the
    first component's.
    """
    n_components, d = m.shape
    gamma, r_alpha, r_beta = shape
    y = np.empty(d)
    direction = np.empty((n_components, d))
    value = np.empty(n_components)
    slope = np.empty(n_components)
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
        v, slope[k] = donut_log_density(squared, log_norms[k], gamma, r_alpha, r_beta, d)
        value[k] = log_h[k] + v
        top = max(top, value[k])
    for i in range(d):
        gradient[i] = 0.0
        for j in range(d):
            metric[i, j] = 0.0
    silent = top == -np.inf
    total = 0.0
    for k in range(n_components):
        value[k] = (1.0 if k == 0 else 0.0) if silent else math.exp(value[k] - top)
        total += value[k]
    for k in range(n_components):
        rho = value[k] / total
        for i in range(d):
            gradient[i] += rho * slope[k] * direction[k, i]
            for j in range(d):
                for q in range(max(i, j), d):
                    metric[i, j] += rho * whiteners[k, q, i] * whiteners[k, q, j]
    return top + math.log(total)


@njit(cache=True)
def mixture_densities(points, log_h, m, whiteners, log_norms, shape, values, gradients):
    """`mixture_density` at many points (N, d): fill `values` (N,) and `gradients` (N, d)."""
    d = points.shape[1]
    metric = np.empty((d, d))
    for i in range(points.shape[0]):
        values[i] = mixture_density(
            points[i], log_h, m, whiteners, log_norms, shape, gradients[i], metric
        )


@njit(cache=True)
def solve_definite(matrix, right, out):
    """Solve `matrix` · out = `right` for a positive definite matrix (d, d)."""
    d = matrix.shape[0]
    if d == 1:
        out[0] = right[0] / matrix[0, 0]
        return
    whitener = np.empty((d, d))
    cholesky_whitener(matrix, whitener)
    y = np.empty(d)
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


@njit(cache=True)
def ascend(a, log_h, m, whiteners, log_norms, shape):
    """Climb from `a` (overwritten) to a local maximum of the donut mixture; return its log density.

    Gradient ascent in the metric of the components that matter where it stands, with backtracking.
    No step is longer than half a standard deviation, so the climb stays on the hill it starts on;
    only more than ten out, where there are no hills, it strides. At a centre the gradient vanishes
    although the centre may be a pit: a start without a slope is moved by a thousandth of a standard
    deviation.
    """
    d = m.shape[1]
    gradient = np.empty(d)
    metric = np.empty((d, d))
    step = np.empty(d)
    trial = np.empty(d)
    trial_gradient = np.empty(d)
    trial_metric = np.empty((d, d))
    value = mixture_density(a, log_h, m, whiteners, log_norms, shape, gradient, metric)
    solve_definite(metric, gradient, step)
    squared = 0.0
    for i in range(d):
        squared += step[i] * gradient[i]
    if squared < SHORTEST_STEP**2:
        for i in range(d):
            a[i] += NUDGE / math.sqrt(metric[i, i])
        value = mixture_density(a, log_h, m, whiteners, log_norms, shape, gradient, metric)
    length = 1.0
    for _ in range(MAX_ASCENT):
        if value == -np.inf:
            break
        solve_definite(metric, gradient, step)
        squared = 0.0
        for i in range(d):
            squared += step[i] * gradient[i]
        norm = math.sqrt(max(squared, 0.0))
        if norm < SHORTEST_STEP:
            break
        # In units of the slope: a longer last step may have become too short where it is gentler.
        length = max(length, min(1.0, 10.0 * SHORTEST_STEP / norm))
        length = min(length, max(LONGEST_STEP, 0.25 * norm - 2.0) / norm)
        while length * norm >= SHORTEST_STEP:
            for i in range(d):
                trial[i] = a[i] + length * step[i]
            trial_value = mixture_density(
                trial, log_h, m, whiteners, log_norms, shape, trial_gradient, trial_metric
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
        a[:] = trial
        value = trial_value
        gradient[:] = trial_gradient
        metric[:] = trial_metric
    return value


@njit(cache=True)
def best_candidate(a, log_h, m, whiteners, lowers, log_norms, shape, ridge):
    """Overwrite `a` with the densest of the centres and the points on each component's ridge."""
    n_components, d = m.shape
    gradient = np.empty(d)
    metric = np.empty((d, d))
    candidate = np.empty(d)
    best = -np.inf
    for k in range(n_components):
        for c in range(2 * d + 1):
            axis = (c - 1) // 2
            sign = 0.0 if c == 0 else (1.0 if c % 2 == 1 else -1.0)
            for i in range(d):
                candidate[i] = m[k, i] + sign * ridge * lowers[k, i, max(axis, 0)]
            value = mixture_density(
                candidate, log_h, m, whiteners, log_norms, shape, gradient, metric
            )
            if value > best or (k == 0 and c == 0):
                best = value
                a[:] = candidate


@njit(cache=True)
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


@njit(cache=True)
def explore(
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
):
    """Condition on `state`, choose ε, climb the donut mixture; overwrite `action`, return ε.

    With `warm` the climb starts from the `action` that comes in, otherwise from the best analytic
    candidate. With `flat_stays` the action stays where it is if the density there is zero in double
    precision. `printed` takes ε = 1/(1 + V/s²), the paper's formula as printed.
    """
    n_components, d = action_means.shape
    h = np.empty(n_components)
    m = np.empty((n_components, d))
    condition(state, state_constants, state_means, state_whiteners, gains, action_means, h, m)
    spread = scaled_variance(h, m, covariances, scale)
    exploration = 1.0 / (1.0 + spread) if printed else spread / (1.0 + spread)
    shape, ridge = donut_shape(exploration, d, k, reach)
    for i in range(n_components):
        h[i] = math.log(max(h[i], 1e-300))
    if not warm:
        best_candidate(action, h, m, whiteners, lowers, log_norms, shape, ridge)
    elif flat_stays:
        gradient, metric = np.empty(d), np.empty((d, d))
        value = mixture_density(action, h, m, whiteners, log_norms, shape, gradient, metric)
        if math.exp(value) == 0.0:
            return exploration
    ascend(action, h, m, whiteners, log_norms, shape)
    return exploration
