"""The mixture's mathematics in readable NumPy: what `compiled.py` must agree with.

Written for reading and for testing, one formula a function, whole arrays at a time. Nothing in the
package calls it; the tests compare every compiled loop with it.
"""

import numpy as np
from scipy.optimize import brentq
from scipy.special import logsumexp
from scipy.stats import multivariate_normal


def log_joint(X, weights, means, covariances):
    """Return log π_k N(x_i; μ_k, Σ_k), shape (N, K)."""
    return np.stack(
        [
            np.log(w) + multivariate_normal(m, c).logpdf(X).reshape(len(X))
            for w, m, c in zip(weights, means, covariances, strict=True)
        ],
        axis=1,
    )


def em_step(X, sample_weight, weights, means, covariances, floor):
    """One iteration; return the log-likelihood before it and the new mixture."""
    joint = log_joint(X, weights, means, covariances)
    log_density = logsumexp(joint, axis=1)
    r = np.exp(joint - log_density[:, None]) * sample_weight[:, None]
    mass = r.sum(axis=0)
    new_means = r.T @ X / mass[:, None]
    deviations = X[:, None, :] - new_means
    new_covariances = np.einsum("nk,nki,nkj->kij", r, deviations, deviations) / mass[:, None, None]
    new_covariances += floor * np.eye(X.shape[1])
    return sample_weight @ log_density, mass / mass.sum(), new_means, new_covariances


def condition(state, weights, means, covariances):
    """h_k, m_k, S_k of the actions given the leading columns `state`; see `conditional`."""
    n = len(state)
    x, a = slice(0, n), slice(n, None)
    log_h = log_joint(state[None, :], weights, means[:, x], covariances[:, x, x])[0]
    gains = covariances[:, a, x] @ np.linalg.inv(covariances[:, x, x])
    m = means[:, a] + np.einsum("kij,kj->ki", gains, state - means[:, x])
    S = covariances[:, a, a] - gains @ covariances[:, x, a]
    return np.exp(log_h - logsumexp(log_h)), m, S


def moments(h, m, S):
    """Mean E (d,) and variance V (d, d) of a mixture."""
    mean = h @ m
    return mean, np.einsum("k,kij->ij", h, S + m[:, :, None] * m[:, None, :]) - np.outer(mean, mean)


def donut_density(a, mean, covariance, gamma, r_alpha, r_beta):
    """D(a) = γ N(a; μ, Σ/r_α²) − (γ − 1) N(a; μ, Σ/r_β²)."""
    wide = multivariate_normal(mean, covariance / r_alpha**2).pdf(a)
    narrow = multivariate_normal(mean, covariance / r_beta**2).pdf(a)
    return gamma * wide - (gamma - 1.0) * narrow


def donut_mixture_density(a, h, m, S, gamma, r_alpha, r_beta):
    """DMM(a) = Σ_k h_k D(a; m_k, S_k)."""
    return sum(
        w * donut_density(a, mean, covariance, gamma, r_alpha, r_beta)
        for w, mean, covariance in zip(h, m, S, strict=True)
    )


def log_donut_mixture(a, h, m, S, gamma, r_alpha, r_beta):
    """Log DMM(a), its gradient (d,), its Hessian (d, d), and the mean precision (d, d) at a (d,).

    Each donut is a sum of two Gaussians c N(a; m, S/r²), of which ∇N = −r² P δ N and
    ∇∇N = (r⁴ P δ δᵀ P − r² P) N, with P = S⁻¹ and δ = a − m.
    """
    d = len(a)
    density, slope, bend, precision = 0.0, np.zeros(d), np.zeros((d, d)), np.zeros((d, d))
    for weight, mean, covariance in zip(h, m, S, strict=True):
        P = np.linalg.inv(covariance)
        pull = P @ (a - mean)
        for c, r in ((weight * gamma, r_alpha), (weight * (1.0 - gamma), r_beta)):
            part = c * multivariate_normal(mean, covariance / r**2).pdf(a)
            density += part
            slope -= part * r**2 * pull
            bend += part * (r**4 * np.outer(pull, pull) - r**2 * P)
            precision += part * P
    slope, bend, precision = slope / density, bend / density, precision / density
    return np.log(density), slope, bend - np.outer(slope, slope), precision


def trust_step(gradient, hessian, metric, radius):
    """Maximise gᵀp + ½ pᵀH p over |p|_M ≤ radius: (λM − H) p = g with the smallest λ that fits."""
    whitener = np.linalg.inv(np.linalg.cholesky(metric))
    curvatures, axes = np.linalg.eigh(whitener @ hessian @ whitener.T)
    slopes = axes.T @ whitener @ gradient

    def step(shift):
        return slopes / (shift - curvatures)

    low = max(0.0, curvatures.max() * (1.0 + 1e-9) + 1e-12)
    shift = low
    if np.linalg.norm(step(low)) > radius:
        high = low + np.linalg.norm(slopes) / radius
        shift = brentq(lambda s: np.linalg.norm(step(s)) - radius, low, high, xtol=1e-12)
    return whitener.T @ axes @ step(shift)


def climb(a, h, m, S, gamma, r_alpha, r_beta, longest=0.5):
    """Newton's ascent of log DMM in a trust region; straight steps, where `compiled` goes round."""
    radius = longest
    for _ in range(500):
        value, gradient, hessian, metric = log_donut_mixture(a, h, m, S, gamma, r_alpha, r_beta)
        if gradient @ np.linalg.solve(metric, gradient) < 1e-14:
            break
        step = trust_step(gradient, hessian, metric, radius)
        gain = gradient @ step + 0.5 * step @ hessian @ step
        if log_donut_mixture(a + step, h, m, S, gamma, r_alpha, r_beta)[0] - value > 0.1 * gain:
            a, radius = a + step, min(longest, 2.0 * radius)
        else:
            radius *= 0.3
    return a
