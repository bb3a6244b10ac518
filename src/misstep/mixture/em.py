"""Expectation–maximisation, compiled: the data in blocks that stay in cache, one pass an iteration.

Samples lie in blocks of `BLOCK`, the sample's number innermost, the last block padded with samples
of no weight: every inner loop has the same fixed length and vectorises. Sums go over four columns
at a time, so that a load serves several products; up to 48 columns that beat OpenBLAS wherever it
was measured.

`PANEL` blocks make a panel, whose moments are summed apart and then added in order. The partition
depends on the data alone, so threads that take some panels each change no bit of the result.

Fast-math is limited to re-ordering (`REORDER`), so infinities and NaN keep their meaning. What uses
it is inlined by force into callers that do not, and `iterate` is the only place where `expectation`
ends up: left to itself, the process that compiles runs the stand-alone copy and later ones the copy
in the caller's cache, whose last bits differ.

Nothing here allocates, and no loop is left to array expressions: reference counting and NumPy's
broadcasting would take most of the time that compiling takes.
"""

# mypy: disallow-untyped-defs=False, check-untyped-defs=False
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from misstep.compiling import njit
from misstep.mixture.compiled import COMPILED, precompute
from misstep.mixture.elementary import REORDER, exp_nonpositive, log_positive

Array = NDArray[np.float64]

BLOCK = 256
PANEL = 4
# Variance as a share of a squared step of the mean, below which rounding takes six digits of it.
JUMP = 1e-10

INLINED: dict[str, Any] = {"fastmath": REORDER, "forceinline": True, "_nrt": False}


class Samples(NamedTuple):
    """N samples of d columns, in blocks."""

    blocks: Array
    """Shape (⌈N / BLOCK⌉, d, BLOCK); the last is padded with copies of a sample."""
    weight: Array
    """Shape (⌈N / BLOCK⌉, BLOCK); 0 in the padding."""


class Mixture(NamedTuple):
    """The parameters that are being fitted; overwritten by each iteration."""

    weights: Array
    """Shape (K,)."""
    means: Array
    """Shape (K, d)."""
    covariances: Array
    """Shape (K, d, d)."""


class Moments(NamedTuple):
    """What an expectation leaves, one row a panel; moments are about the old means."""

    log_likelihood: Array
    """Shape (P,)."""
    mass: Array
    """Shape (P, K)."""
    first: Array
    """Shape (P, K, d)."""
    second: Array
    """Shape (P, K, d, d); of symmetric matrices, only the lower triangle is filled."""

    @classmethod
    def room_for(cls, n_panels: int, K: int, d: int) -> "Moments":
        """Return zero moments of K components."""
        return cls(
            np.zeros(n_panels),
            np.zeros((n_panels, K)),
            np.zeros((n_panels, K, d)),
            np.zeros((n_panels, K, d, d)),
        )


class Work(NamedTuple):
    """Room for the intermediate results of one thread."""

    whiteners: Array
    """Shape (K, d, d)."""
    constants: Array
    """log π_k + log det W_k − d/2 log 2π, shape (K,)."""
    log_p: Array
    """Shape (K, BLOCK); then the responsibilities."""
    deviations: Array
    """Shape (d, BLOCK)."""
    rows: Array
    """Shape (3, BLOCK)."""

    @classmethod
    def room_for(cls, K: int, d: int) -> "Work":
        """Return room for K components."""
        return cls(
            np.empty((K, d, d)),
            np.empty(K),
            np.empty((K, BLOCK)),
            np.empty((d, BLOCK)),
            np.empty((3, BLOCK)),
        )


class Rule(NamedTuple):
    """When to stop, and how narrow a component may become."""

    floor: Array
    """Added to the diagonal of each covariance."""
    tol: float
    """Least rise of the mean log-likelihood that goes on."""
    max_iter: int


def in_blocks(X: Array, sample_weight: Array) -> Samples:
    """Lay samples (N, d) and their weights (N,) out in blocks."""
    N, d = X.shape
    n_blocks = -(-N // BLOCK)
    blocks, weight = np.empty((n_blocks, d, BLOCK)), np.zeros((n_blocks, BLOCK))
    weight.reshape(-1)[:N] = sample_weight
    whole = N // BLOCK
    blocks[:whole] = X[: whole * BLOCK].reshape(whole, BLOCK, d).transpose(0, 2, 1)
    if whole < n_blocks:
        rest = N - whole * BLOCK
        blocks[whole, :, :rest] = X[whole * BLOCK :].T
        blocks[whole, :, rest:] = X[-1, :, None]
    return Samples(blocks, weight)


def panels_of(samples: Samples) -> int:
    """Return the number of panels that the blocks make."""
    return -(-len(samples.blocks) // PANEL)


@njit(**INLINED)
def _log_component(x, mean, whitener, constant, out, row):
    """out[b] = constant − ½ Mahalanobis² of the block's samples x (d, BLOCK) from `mean`."""
    d = x.shape[0]
    if d == 2:
        w00, w10, w11 = whitener[0, 0], whitener[1, 0], whitener[1, 1]
        o0 = -w00 * mean[0]
        o1 = -w10 * mean[0] - w11 * mean[1]
        x0, x1 = x[0], x[1]
        for b in range(BLOCK):
            y0 = o0 + w00 * x0[b]
            y1 = o1 + w10 * x0[b] + w11 * x1[b]
            out[b] = constant - 0.5 * (y0 * y0 + y1 * y1)
        return
    for b in range(BLOCK):
        out[b] = constant
    for i in range(d):
        offset = 0.0
        for j in range(i + 1):
            offset -= whitener[i, j] * mean[j]
        for b in range(BLOCK):
            row[b] = offset
        # Above the diagonal the whitener is zero, so whole groups of four may be taken.
        for j in range(0, i + 1, 4):
            j1, j2, j3 = min(j + 1, d - 1), min(j + 2, d - 1), min(j + 3, d - 1)
            c0 = whitener[i, j]
            c1 = whitener[i, j1] if j + 1 < d else 0.0
            c2 = whitener[i, j2] if j + 2 < d else 0.0
            c3 = whitener[i, j3] if j + 3 < d else 0.0
            x0, x1, x2, x3 = x[j], x[j1], x[j2], x[j3]
            if j + 4 <= i:
                for b in range(BLOCK):
                    row[b] += c0 * x0[b] + c1 * x1[b] + c2 * x2[b] + c3 * x3[b]
            else:
                for b in range(BLOCK):
                    y = row[b] + c0 * x0[b] + c1 * x1[b] + c2 * x2[b] + c3 * x3[b]
                    out[b] -= 0.5 * y * y


@njit(**INLINED)
def _add_moments(x, mean, r, deviations, weighted, first, second):
    """Add the block's moments about `mean`, weighted by r, to `first` (d,) and `second` (d, d)."""
    d = x.shape[0]
    if d == 2:
        x0, x1 = x[0], x[1]
        m0, m1 = mean[0], mean[1]
        s0, s1, s00, s10, s11 = 0.0, 0.0, 0.0, 0.0, 0.0
        for b in range(BLOCK):
            u, v = x0[b] - m0, x1[b] - m1
            ru, rv = r[b] * u, r[b] * v
            s0 += ru
            s1 += rv
            s00 += ru * u
            s10 += rv * u
            s11 += rv * v
        first[0] += s0
        first[1] += s1
        second[0, 0] += s00
        second[1, 0] += s10
        second[1, 1] += s11
        return
    for j in range(d):
        xj, mj, deviation = x[j], mean[j], deviations[j]
        for b in range(BLOCK):
            deviation[b] = xj[b] - mj
    for j in range(d):
        deviation = deviations[j]
        s = 0.0
        for b in range(BLOCK):
            weighted[b] = r[b] * deviation[b]
            s += weighted[b]
        first[j] += s
        for m in range(0, j + 1, 4):
            m1, m2, m3 = min(m + 1, j), min(m + 2, j), min(m + 3, j)
            d0, d1, d2, d3 = deviations[m], deviations[m1], deviations[m2], deviations[m3]
            s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
            for b in range(BLOCK):
                w = weighted[b]
                s0 += w * d0[b]
                s1 += w * d1[b]
                s2 += w * d2[b]
                s3 += w * d3[b]
            second[j, m] += s0
            if m + 1 <= j:
                second[j, m1] += s1
            if m + 2 <= j:
                second[j, m2] += s2
            if m + 3 <= j:
                second[j, m3] += s3


@njit(**INLINED)
def _expectation(samples, begin, end, means, work, moments, panel):
    """Overwrite row `panel` of the moments with those of blocks `begin` to `end`."""
    n_components, d = means.shape
    log_p, constants = work.log_p, work.constants
    row, top, total = work.rows[0], work.rows[1], work.rows[2]
    mass, first, second = moments.mass[panel], moments.first[panel], moments.second[panel]
    for k in range(n_components):
        mass[k] = 0.0
        for i in range(d):
            first[k, i] = 0.0
            for j in range(i + 1):
                second[k, i, j] = 0.0
    log_likelihood = 0.0
    for block in range(begin, end):
        x = samples.blocks[block]
        w = samples.weight[block]
        for k in range(n_components):
            p = log_p[k]
            _log_component(x, means[k], work.whiteners[k], constants[k], p, row)
            if k == 0:
                for b in range(BLOCK):
                    top[b] = p[b]
            else:
                for b in range(BLOCK):
                    top[b] = max(top[b], p[b])
        for b in range(BLOCK):
            total[b] = 0.0
        for k in range(n_components):
            p = log_p[k]
            for b in range(BLOCK):
                p[b] = exp_nonpositive(p[b] - top[b])
                total[b] += p[b]
        for b in range(BLOCK):
            log_likelihood += w[b] * (top[b] + log_positive(total[b]))
            total[b] = w[b] / total[b]
        for k in range(n_components):
            p = log_p[k]
            s = 0.0
            for b in range(BLOCK):
                p[b] *= total[b]
                s += p[b]
            mass[k] += s
            _add_moments(x, means[k], p, work.deviations, row, first[k], second[k])
    moments.log_likelihood[panel] = log_likelihood


@njit(**COMPILED)
def add_panels(moments):
    """Add all panels to the first, in order."""
    n_panels, n_components, d = moments.first.shape
    for panel in range(1, n_panels):
        moments.log_likelihood[0] += moments.log_likelihood[panel]
        for k in range(n_components):
            moments.mass[0, k] += moments.mass[panel, k]
            for i in range(d):
                moments.first[0, k, i] += moments.first[panel, k, i]
                for j in range(i + 1):
                    moments.second[0, k, i, j] += moments.second[panel, k, i, j]


@njit(**COMPILED)
def maximise(moments, mixture, floor):
    """Turn the first panel's moments about the old means into the new mixture, in place."""
    weights, means, covariances = mixture
    mass, first, second = moments.mass[0], moments.first[0], moments.second[0]
    n_components, d = means.shape
    total = 0.0
    for k in range(n_components):
        total += mass[k]
    for k in range(n_components):
        weights[k] = mass[k] / total
        # A component that no sample claims keeps its place: dividing by its mass would be 0/0.
        if mass[k] <= 1e-12 * total:
            continue
        told = True
        for j in range(d):
            first[k, j] /= mass[k]
            means[k, j] += first[k, j]
            step = first[k, j] * first[k, j]
            told &= second[k, j, j] / mass[k] - step + floor[j] > JUMP * step
        # About so distant an old mean nothing is told of the spread about the new one: this time
        # only the mean moves, which raises the likelihood too (conditional maximisation).
        if not told:
            continue
        for j in range(d):
            for m in range(j + 1):
                s = second[k, j, m] / mass[k] - first[k, j] * first[k, m]
                covariances[k, j, m] = s
                covariances[k, m, j] = s
            covariances[k, j, j] += floor[j]


@njit(**COMPILED)
def iterate(samples, mixture, moments, work, first_panel, last_panel, total_weight, rule):
    """Run expectation–maximisation from `mixture`, which is overwritten by the result.

    Stops when the mean log-likelihood per unit of weight rises by less than ``rule.tol``, or after
    ``rule.max_iter`` iterations. With ``rule.max_iter`` = −1 it only fills the moments of the
    panels from `first_panel` to before `last_panel`, for callers that share the work out.

    Returns
    -------
    log_likelihood : float
        Weighted log-likelihood of the resulting parameters; NaN if a covariance collapsed.
    n_iter : int
    converged : bool
    """
    n_blocks = samples.blocks.shape[0]
    previous = -np.inf
    iteration = 0
    while True:
        if not precompute(mixture.weights, mixture.covariances, work.whiteners, work.constants):
            return np.nan, iteration, False
        for panel in range(first_panel, last_panel):
            end = min((panel + 1) * PANEL, n_blocks)
            _expectation(samples, panel * PANEL, end, mixture.means, work, moments, panel)
        if rule.max_iter < 0:
            return 0.0, 0, False
        add_panels(moments)
        log_likelihood = moments.log_likelihood[0]
        if abs(log_likelihood - previous) < rule.tol * total_weight:
            return log_likelihood, iteration, True
        if iteration == rule.max_iter:
            return log_likelihood, iteration, False
        previous = log_likelihood
        maximise(moments, mixture, rule.floor)
        iteration += 1


@njit(**COMPILED)
def log_joint(blocks, means, origin, work, out):
    """Fill `out` (blocks · BLOCK, K) with log π_k N(x_i; μ_k, Σ_k).

    Whitening is exact only next to the origin, and the data may lie far from it: here the deviation
    is whitened, where `iterate`, whose samples are standardised, whitens sample and mean. `origin`
    (d,) is zero: nothing is allocated here.
    """
    n_components, d = means.shape
    for block in range(blocks.shape[0]):
        for k in range(n_components):
            p = work.log_p[k]
            for j in range(d):
                for b in range(BLOCK):
                    work.deviations[j, b] = blocks[block, j, b] - means[k, j]
            _log_component(
                work.deviations, origin, work.whiteners[k], work.constants[k], p, work.rows[0]
            )
            for b in range(BLOCK):
                out[block * BLOCK + b, k] = p[b]
