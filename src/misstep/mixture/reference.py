"""The mixture's mathematics in readable NumPy: what `compiled.py` must agree with.

Written for reading and for testing, one formula a function, whole arrays at a time. Nothing in the
package calls it; the tests compare every compiled loop with it.
"""

import numpy as np
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
