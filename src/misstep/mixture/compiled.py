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
    return np.empty(K * (4 + 2 * d) + 8 * d + 5 * d * d)


@njit(inline="always", _nrt=False)
def _component_rooms(scratch, n_components, d):
    """h, value, slope and squared (K,), m and direction (K, d)."""
    a, b = 4 * n_components, n_components * d
    return (
        scratch[:n_components],
        scratch[n_components : 2 * n_components],
        scratch[2 * n_components : 3 * n_components],
        scratch[3 * n_components : a],
        scratch[a : a + b].reshape((n_components, d)),
        scratch[a + b : a + 2 * b].reshape((n_components, d)),
    )


@njit(inline="always", _nrt=False)
def _vector_room(scratch, n_components, d, i):
    """One of eight vectors (d,)."""
    begin = n_components * (4 + 2 * d) + i * d
    return scratch[begin : begin + d]


@njit(inline="always", _nrt=False)
def _matrix_room(scratch, n_components, d, i):
    """One of five matrices (d, d)."""
    begin = n_components * (4 + 2 * d) + 8 * d + i * d * d
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
    """r_α², r_β² − r_α², (γ − 1) kᵈ, the centre's density in units of N, d log r_α, + log γ."""
    gamma, r_alpha, r_beta = shape
    a2 = r_alpha * r_alpha
    gap = r_beta * r_beta - a2
    ratio = (r_beta / r_alpha) ** d
    inner = (gamma - 1.0) * ratio
    centre = gamma - inner
    # At full exploration the centre is zero; what rounding leaves there would be a false floor.
    if abs(centre) < 1e-14 * gamma + 4e-16 * ratio:
        centre = 0.0
    log_width = d * math.log(r_alpha)
    return a2, gap, inner, centre, log_width, log_width + math.log(gamma)


@njit(**_INLINED)
def _log_donut(squared, log_norm, terms):
    """Return log D at Mahalanobis² `squared`, and the factor g in ∇ log D = g Σ⁻¹(a − μ)."""
    a2, gap, inner, centre, log_width, _ = terms
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
def _log_donuts(a, log_h, m, whiteners, log_norms, terms, value, slope, squared, direction, y):
    """Fill each component's log h_k D_k(a) and the makings of its derivatives; return the largest.

    Components passed over get −∞.
    """
    n_components, d = m.shape
    top = -np.inf
    for k in range(n_components):
        q = 0.0
        for i in range(d):
            y[i] = 0.0
            for j in range(i + 1):
                y[i] += whiteners[k, i, j] * (a[j] - m[k, j])
            q += y[i] * y[i]
        squared[k] = q
        if log_h[k] + log_norms[k] + terms[5] - 0.5 * terms[0] * q < top - NEGLIGIBLE:
            value[k], slope[k] = -np.inf, 0.0
            continue
        for j in range(d):
            direction[k, j] = 0.0
            for i in range(j, d):
                direction[k, j] += whiteners[k, i, j] * y[i]
        v, slope[k] = _log_donut(q, log_norms[k], terms)
        value[k] = log_h[k] + v
        top = max(top, value[k])
    return top


@njit(**_INLINED)
def _shares(value, top):
    """Turn the components' log densities into their shares of the sum; return the sum's log."""
    total = 0.0
    for k in range(value.shape[0]):
        if top == -np.inf:
            value[k] = 1.0 if k == 0 else 0.0
        elif value[k] < top - NEGLIGIBLE:
            value[k] = 0.0
        else:
            value[k] = math.exp(value[k] - top)
        total += value[k]
    for k in range(value.shape[0]):
        value[k] /= total
    return top + math.log(total)


@njit(**COMPILED)
def mixture_density(a, log_h, m, whiteners, log_norms, shape, gradient, scratch):
    """Return log DMM(a) and fill its gradient (d,).

    `shape` holds γ, r_α, r_β. Where the density is zero the gradient is zero.
    """
    n_components, d = m.shape
    _, value, slope, squared, _, direction = _component_rooms(scratch, n_components, d)
    y = _vector_room(scratch, n_components, d, 0)
    terms = _donut_terms(shape, d)
    top = _log_donuts(a, log_h, m, whiteners, log_norms, terms, value, slope, squared, direction, y)
    density = _shares(value, top)
    for i in range(d):
        gradient[i] = 0.0
    for k in range(n_components):
        if value[k] > 0.0 and top > -np.inf:
            for i in range(d):
                gradient[i] += value[k] * slope[k] * direction[k, i]
    return density


@njit(**COMPILED)
def mixture_densities(points, log_h, m, whiteners, log_norms, shape, values, gradients, scratch):
    """`mixture_density` at many points (N, d): fill `values` (N,) and `gradients` (N, d)."""
    for i in range(points.shape[0]):
        values[i] = mixture_density(
            points[i], log_h, m, whiteners, log_norms, shape, gradients[i], scratch
        )


@njit(**COMPILED)
def mixture_curvature(
    a, log_h, m, whiteners, precisions, log_norms, shape, gradient, metric, hessian, scratch
):
    """Return log DMM(a); fill its gradient (d,), the metric and its Hessian, lower triangles.

    With ρ_k the components' shares, g_k and c_k the factors of ∇ log D = g Σ⁻¹δ and of
    ∇∇D / D = g Σ⁻¹ + c Σ⁻¹δ δᵀΣ⁻¹ (both of the same closed form, see `_log_donut`):

        ∇ f = Σ ρ_k g_k Σ_k⁻¹δ_k
        ∇∇f = Σ ρ_k (g_k Σ_k⁻¹ + c_k Σ_k⁻¹δ_k δ_kᵀΣ_k⁻¹) − ∇f ∇fᵀ

    The metric is Σ ρ_k Σ_k⁻¹, the mean precision. Where the density is zero, gradient and Hessian
    are zero and the metric the first component's. The components' shares are left in their room.
    """
    n_components, d = m.shape
    _, value, slope, squared, _, direction = _component_rooms(scratch, n_components, d)
    y = _vector_room(scratch, n_components, d, 0)
    terms = _donut_terms(shape, d)
    top = _log_donuts(a, log_h, m, whiteners, log_norms, terms, value, slope, squared, direction, y)
    density = _shares(value, top)
    for i in range(d):
        gradient[i] = 0.0
        for j in range(i + 1):
            metric[i, j] = hessian[i, j] = 0.0
    for k in range(n_components):
        rho = value[k]
        if rho == 0.0:
            continue
        weighted = rho * slope[k]
        bend = rho * (terms[0] * terms[0] - (slope[k] + terms[0]) * (2.0 * terms[0] + terms[1]))
        if top == -np.inf:
            weighted = bend = 0.0
        for i in range(d):
            gradient[i] += weighted * direction[k, i]
            bent = bend * direction[k, i]
            for j in range(i + 1):
                metric[i, j] += rho * precisions[k, i, j]
                hessian[i, j] += weighted * precisions[k, i, j] + bent * direction[k, j]
    for i in range(d):
        for j in range(i + 1):
            hessian[i, j] -= gradient[i] * gradient[j]
    return density


@njit(**_INLINED)
def _factor(matrix, lower):
    """Fill `lower` with L of L Lᵀ = `matrix`, of which the lower triangle is read.

    Return False where it is not definite, or so nearly singular that one could not tell.
    """
    d = matrix.shape[0]
    for i in range(d):
        for j in range(i + 1):
            s = matrix[i, j]
            for q in range(j):
                s -= lower[i, q] * lower[j, q]
            if i > j:
                lower[i, j] = s / lower[j, j]
            elif s > SINGULAR * abs(matrix[i, i]):
                lower[i, i] = math.sqrt(s)
            else:
                return False
    return True


@njit(**_INLINED)
def _forward(lower, right, out):
    """Fill `out` with L⁻¹ `right`; return its squared length."""
    squared = 0.0
    for i in range(right.shape[0]):
        s = right[i]
        for j in range(i):
            s -= lower[i, j] * out[j]
        out[i] = s / lower[i, i]
        squared += out[i] * out[i]
    return squared


@njit(**_INLINED)
def _backward(lower, out):
    """Overwrite `out` with L⁻ᵀ `out`."""
    d = out.shape[0]
    for i in range(d - 1, -1, -1):
        s = out[i]
        for j in range(i + 1, d):
            s -= lower[j, i] * out[j]
        out[i] = s / lower[i, i]


@njit(**_INLINED)
def _times(matrix, x, out):
    """Fill `out` with a symmetric matrix, of which the lower triangle is read, times x."""
    d = x.shape[0]
    for i in range(d):
        out[i] = 0.0
        for j in range(i + 1):
            out[i] += matrix[i, j] * x[j]
        for j in range(i + 1, d):
            out[i] += matrix[j, i] * x[j]


# A step this close to the radius, as shares of it, is as good as one that is on it.
NEAR_RADIUS = (0.7, 1.05)
# Of the curvature in units of the metric, in which that of a Gaussian is 1.
FIRST_SHIFT = 0.05
# Shifts tried for one step: more only sharpen a step that is judged by what it gains anyway.
MOST_SHIFTS = 12


@njit(**COMPILED)
def _trust_step(gradient, metric, hessian, norm, radius, step, shifted, lower, image):
    """Fill `step` with the best of a quadratic model within `radius`; return its gain and length.

    Maximises gᵀp + ½ pᵀH p over |p|_M ≤ radius (Moré & Sorensen, "Computing a trust region step",
    1983): (λM − H) p = g with the smallest λ ≥ 0 that makes λM − H definite and p short enough,
    found by Newton's iteration on 1/|p|. On a ridge, where H is singular, λ keeps the step short.
    `norm` is the gradient's, in the inverse metric.
    """
    d = gradient.shape[0]
    if d == 1:  # the same in closed form
        deviation, bend = 1.0 / math.sqrt(metric[0, 0]), hessian[0, 0]
        length = radius
        if bend < 0.0:
            length = min(radius, -norm / (bend * deviation * deviation))
        step[0] = math.copysign(length * deviation, gradient[0])
        return step[0] * (gradient[0] + 0.5 * step[0] * bend), length
    shift, least, most, length = 0.0, 0.0, np.inf, -1.0
    for _ in range(MOST_SHIFTS):
        for i in range(d):
            for j in range(i + 1):
                shifted[i, j] = shift * metric[i, j] - hessian[i, j]
        if not _factor(shifted, lower):
            least = shift
            shift = max(4.0 * shift, FIRST_SHIFT) if most == np.inf else 0.5 * (least + most)
            continue
        _forward(lower, gradient, step)
        _backward(lower, step)
        _times(metric, step, image)
        squared = 0.0
        for i in range(d):
            squared += step[i] * image[i]
        length = math.sqrt(squared)
        if length <= NEAR_RADIUS[1] * radius and (
            shift == 0.0 or length >= NEAR_RADIUS[0] * radius or most - least < 1e-3 * most
        ):
            break
        if length > radius:
            least = shift
        else:
            most = shift
        shift += (length / radius - 1.0) * squared / _forward(lower, image, image)
        if not least < shift < most:
            shift = 2.0 * least + FIRST_SHIFT if most == np.inf else 0.5 * (least + most)
    if length < 0.0:  # nothing was definite: straight uphill
        _factor(metric, lower)
        _forward(lower, gradient, step)
        _backward(lower, step)
        length = norm
    _times(hessian, step, image)
    slope, bend = 0.0, 0.0
    for i in range(d):
        slope += step[i] * gradient[i]
        bend += step[i] * image[i]
    share = radius / length
    if bend < 0.0:
        # Not beyond the top of the model: it is at 1, but for a step that is straight uphill.
        share = min(share, -slope / bend)
    for i in range(d):
        step[i] *= share
    return share * slope + 0.5 * share * share * bend, share * length


LONGEST_STEP = 0.5
SHORTEST_STEP = 1e-7
NUDGE = 1e-3
MAX_ASCENT = 30
# Deviations from the heaviest component: from further out a climb begins this far out of it.
FAR = 10.0
# Where the next step would gain no more than this log density, it is the last.
LEVEL = 1e-9
# Nearer to a donut's centre than this many deviations, its ridge is no circle to walk on.
ROUND = 0.1


@njit(**_INLINED)
def _heaviest(shares):
    """Return the component with the largest share."""
    heaviest = 0
    for k in range(1, shares.shape[0]):
        if shares[k] > shares[heaviest]:
            heaviest = k
    return heaviest


@njit(**COMPILED)
def _bend_round(gradient, direction, offset, radius, precision, hessian):
    """Turn a Hessian (lower triangle) into that of steps along circles about a donut's centre.

    With δ the offset from the centre, r its Mahalanobis distance, n = Σ⁻¹δ/r and g_r = gᵀδ/r, a
    step p that goes round by p − (nᵀp) δ/r and out by nᵀp ends at a + p + a term of second order.
    That term's gradient is what the Hessian gains:

        H − (g_r/r)(Σ⁻¹ − n nᵀ) + ((g − g_r n) nᵀ + n (g − g_r n)ᵀ)/r
    """
    d = gradient.shape[0]
    outward = 0.0
    for i in range(d):
        outward += gradient[i] * offset[i]
    outward /= radius
    for i in range(d):
        n_i = direction[i] / radius
        for j in range(i + 1):
            n_j = direction[j] / radius
            across = gradient[i] * n_j + n_i * gradient[j] - outward * n_i * n_j
            hessian[i, j] += (across - outward * precision[i, j]) / radius


@njit(**COMPILED)
def _go_round(centre, offset, direction, radius, precision, step, out, image):
    """Fill `out` with the end of a step along a circle about a donut's centre."""
    d = step.shape[0]
    outward, squared = 0.0, 0.0
    _times(precision, step, image)
    for i in range(d):
        outward += direction[i] * step[i]
        squared += image[i] * step[i]
    outward /= radius
    around = math.sqrt(max(squared - outward * outward, 0.0))
    angle = around / radius
    # sin(angle)/angle stays a number where nothing is gone round.
    share = math.sin(angle) / angle if angle > 1e-8 else 1.0
    along = (1.0 + outward / radius) * math.cos(angle)
    for i in range(d):
        tangent = step[i] - outward * offset[i] / radius
        out[i] = centre[i] + along * offset[i] + (1.0 + outward / radius) * share * tangent


@njit(**COMPILED)
def ascend(a, log_h, m, whiteners, precisions, log_norms, shape, scratch):
    """Climb from `a` (overwritten) to a local maximum of the donut mixture.

    Returns the log density there and the number of densities that it took. Newton's ascent in a
    trust region, in the metric of the components that matter where it stands, and along circles
    about the centre of the heaviest, as its ridge runs. No step is longer than half a standard
    deviation, so the climb stays on the hill it starts on; only more than ten out, where there are
    no hills, it strides. It ends where the slope, or what is left to gain, is lost in rounding, and
    so never walks along a level ridge. At a centre the gradient vanishes although the centre may be
    a pit: a start without a slope is moved by a thousandth of a standard deviation.
    """
    n_components, d = m.shape
    _, shares, _, squared, _, direction = _component_rooms(scratch, n_components, d)
    offset = _vector_room(scratch, n_components, d, 7)
    gradient = _vector_room(scratch, n_components, d, 1)
    step = _vector_room(scratch, n_components, d, 2)
    trial = _vector_room(scratch, n_components, d, 3)
    trial_gradient = _vector_room(scratch, n_components, d, 4)
    image = _vector_room(scratch, n_components, d, 5)
    normal = _vector_room(scratch, n_components, d, 6)
    metric = _matrix_room(scratch, n_components, d, 0)
    hessian = _matrix_room(scratch, n_components, d, 1)
    trial_metric = _matrix_room(scratch, n_components, d, 2)
    trial_hessian = _matrix_room(scratch, n_components, d, 3)
    lower = _matrix_room(scratch, n_components, d, 4)
    value = mixture_curvature(
        a, log_h, m, whiteners, precisions, log_norms, shape, gradient, metric, hessian, scratch
    )
    _factor(metric, lower)
    k = _heaviest(shares)
    distance = math.sqrt(squared[k])
    is_level = _forward(lower, gradient, image) < SHORTEST_STEP**2
    if is_level or distance > FAR:
        for i in range(d):
            if is_level:
                a[i] += NUDGE / math.sqrt(metric[i, i])
            else:
                a[i] = m[k, i] + FAR / distance * (a[i] - m[k, i])
        value = mixture_curvature(
            a, log_h, m, whiteners, precisions, log_norms, shape, gradient, metric, hessian, scratch
        )
    longest, moved = np.inf, True
    for count in range(1, MAX_ASCENT):
        if moved:
            _factor(metric, lower)
            norm = math.sqrt(_forward(lower, gradient, image))
            if value == -np.inf or norm < SHORTEST_STEP:
                return value, count
            k = _heaviest(shares)
            distance = math.sqrt(squared[k])
            for i in range(d):
                offset[i], normal[i] = a[i] - m[k, i], direction[k, i]
            if d > 1 and distance > ROUND:
                _bend_round(gradient, normal, offset, distance, precisions[k], hessian)
        radius = min(longest, max(LONGEST_STEP, 0.8 * distance - 2.5))
        gain, length = _trust_step(
            gradient, metric, hessian, norm, radius, step, trial_hessian, lower, image
        )
        last = gain < LEVEL
        if d > 1 and distance > ROUND:
            _go_round(m[k], offset, normal, distance, precisions[k], step, trial, image)
        else:
            for i in range(d):
                trial[i] = a[i] + step[i]
        trial_value = mixture_curvature(
            trial,
            log_h,
            m,
            whiteners,
            precisions,
            log_norms,
            shape,
            trial_gradient,
            trial_metric,
            trial_hessian,
            scratch,
        )
        risen = trial_value - value
        if last:
            if risen > 0.0:
                value = trial_value
                for i in range(d):
                    a[i] = trial[i]
            return value, count + 1
        moved = risen >= 0.1 * gain
        if risen < 0.25 * gain:
            longest = 0.3 * length
        elif risen > 0.5 * gain:
            longest = 2.0 * max(length, min(longest, radius))
        if moved:
            value = trial_value
            for i in range(d):
                a[i] = trial[i]
                gradient[i] = trial_gradient[i]
                for j in range(i + 1):
                    metric[i, j] = trial_metric[i, j]
                    hessian[i, j] = trial_hessian[i, j]
    return value, MAX_ASCENT


@njit(**COMPILED)
def best_candidate(a, log_h, m, whiteners, lowers, log_norms, shape, ridge, scratch):
    """Overwrite `a` with the densest of the centres and the points on each component's ridge."""
    n_components, d = m.shape
    _, value, slope, squared, _, direction = _component_rooms(scratch, n_components, d)
    y = _vector_room(scratch, n_components, d, 0)
    candidate = _vector_room(scratch, n_components, d, 3)
    terms = _donut_terms(shape, d)
    best = -np.inf
    for k in range(n_components):
        if log_h[k] == -np.inf and k > 0:
            continue
        for c in range(2 * d + 1):
            axis = (c - 1) // 2
            sign = 0.0 if c == 0 else (1.0 if c % 2 == 1 else -1.0)
            for i in range(d):
                candidate[i] = m[k, i] + sign * ridge * lowers[k, i, max(axis, 0)]
            top = _log_donuts(
                candidate,
                log_h,
                m,
                whiteners,
                log_norms,
                terms,
                value,
                slope,
                squared,
                direction,
                y,
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


# A hill whose components weigh less than one demonstrated step in a million is gone.
GONE = 1e-6


@njit(**COMPILED)
def climb(
    a, log_h, m, whiteners, precisions, lowers, log_norms, shape, ridge, warm, jumps, scratch
):
    """Overwrite `a` with a mode; with `warm`, that of the hill on which `a` lies.

    With `jumps`, a climb that ends on a hill whose components have next to no weight in this state,
    wherever else it is dense, begins again at the best candidate. Such a hill is what an action is
    left on when the state has moved away from the component that it followed.
    """
    if not warm:
        best_candidate(a, log_h, m, whiteners, lowers, log_norms, shape, ridge, scratch)
    ascend(a, log_h, m, whiteners, precisions, log_norms, shape, scratch)
    if not (warm and jumps):
        return
    n_components, d = m.shape
    shares = _component_rooms(scratch, n_components, d)[1]
    weight = 0.0
    for k in range(n_components):
        weight += shares[k] * math.exp(log_h[k])
    if weight < GONE:
        best_candidate(a, log_h, m, whiteners, lowers, log_norms, shape, ridge, scratch)
        ascend(a, log_h, m, whiteners, precisions, log_norms, shape, scratch)


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


# What comes first in the array of a query: n, d, K, whether the formula is as printed, k and reach.
HEAD = 6


def packed_query(columns, state_arrays, component_arrays, scale, bounds, family):
    """Return one array of all that `answer` needs: to hand over twenty takes longer than to answer.

    Parameters
    ----------
    columns : ndarray of int, shape (n,)
        Of an observation, that are the state.
    state_arrays : tuple
        Of a `Conditioner`: state_constants (K,), state_means (K, n), state_whiteners (K, n, n),
        gains (K, d, n), action_means (K, d), covariances (K, d, d).
    component_arrays : tuple
        Whiteners, precisions, lower factors (K, d, d) and log norms (K,) of those covariances.
    scale : ndarray, shape (d,)
    bounds : ndarray, shape (2, d)
    family : tuple
        Whether the formula is as printed, k and reach.
    """
    K, n = state_arrays[1].shape
    d = len(scale)
    head = np.array([n, d, K, *family], dtype=np.float64)
    rest = scale, bounds, columns, np.empty(n), scratch_for(K, d)
    arrays = head, *state_arrays, *component_arrays, *rest
    return np.concatenate([np.ravel(array) for array in arrays])


@njit(**COMPILED)
def answer(observation, action, warm, flat_stays, packed):
    """Condition on an observed state, choose ε, climb; overwrite `action` and return ε.

    The action is a mode, moved inside the bounds. With `warm` the climb starts from the `action`
    that comes in, otherwise from the best analytic candidate. With `flat_stays` the action climbs
    the density itself, as in the paper's listing: it stays where that is zero in double precision,
    and never jumps to another hill. ``packed`` is of `packed_query`; its formula as printed takes
    ε = 1/(1 + V/s²).
    """
    n, d, n_components = int(packed[0]), int(packed[1]), int(packed[2])
    at = HEAD
    state_constants = packed[at : at + n_components]
    at += n_components
    state_means = packed[at : at + n_components * n].reshape((n_components, n))
    at += n_components * n
    state_whiteners = packed[at : at + n_components * n * n].reshape((n_components, n, n))
    at += n_components * n * n
    gains = packed[at : at + n_components * d * n].reshape((n_components, d, n))
    at += n_components * d * n
    action_means = packed[at : at + n_components * d].reshape((n_components, d))
    at += n_components * d
    size = n_components * d * d
    covariances = packed[at : at + size].reshape((n_components, d, d))
    whiteners = packed[at + size : at + 2 * size].reshape((n_components, d, d))
    precisions = packed[at + 2 * size : at + 3 * size].reshape((n_components, d, d))
    lowers = packed[at + 3 * size : at + 4 * size].reshape((n_components, d, d))
    at += 4 * size
    log_norms = packed[at : at + n_components]
    at += n_components
    scale = packed[at : at + d]
    low, high = packed[at + d : at + 2 * d], packed[at + 2 * d : at + 3 * d]
    at += 3 * d
    state = packed[at + n : at + 2 * n]
    for i in range(n):
        state[i] = observation[int(packed[at + i])]
    scratch = packed[at + 2 * n :]

    h, _, _, _, m, _ = _component_rooms(scratch, n_components, d)
    condition(state, state_constants, state_means, state_whiteners, gains, action_means, h, m)
    spread = scaled_variance(h, m, covariances, scale)
    exploration = exploration_of(spread, packed[3] == 1.0)
    shape, ridge = donut_shape(exploration, d, packed[4], packed[5])
    for k in range(n_components):
        h[k] = math.log(h[k]) if h[k] > 0.0 else -np.inf
    stays = False
    if warm and flat_stays:
        gradient = _vector_room(scratch, n_components, d, 1)
        value = mixture_density(action, h, m, whiteners, log_norms, shape, gradient, scratch)
        stays = math.exp(value) == 0.0
    if not stays:
        climb(
            action,
            h,
            m,
            whiteners,
            precisions,
            lowers,
            log_norms,
            shape,
            ridge,
            warm,
            not flat_stays,
            scratch,
        )
    for i in range(d):
        action[i] = min(max(action[i], low[i]), high[i])
    return exploration
