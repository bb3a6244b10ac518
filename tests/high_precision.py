"""The mixture's mathematics with sixty digits, from the very doubles that the package is given.

Arrays are NumPy's, of mpmath numbers: slow, but right however badly scaled or nearly singular.
"""

import numpy as np
from mpmath import MPContext

MP = MPContext()
MP.dps = 60
UNIT = 2.0**-53


def exact(a):
    """Return an array of doubles as numbers of sixty digits."""
    return np.vectorize(MP.mpf, otypes=[object])(np.asarray(a, dtype=np.float64))


def rounded(a):
    """Return the nearest doubles."""
    return np.vectorize(float, otypes=[np.float64])(a)


def cholesky(matrix):
    """Return L of L Lᵀ = matrix (d, d); raise ArithmeticError where it is not definite."""
    d = len(matrix)
    lower = exact(np.zeros((d, d)))
    for i in range(d):
        for j in range(i + 1):
            s = matrix[i, j] - MP.fdot(zip(lower[i, :j], lower[j, :j], strict=True))
            if i > j:
                lower[i, j] = s / lower[j, j]
            elif s > 0:
                lower[i, i] = MP.sqrt(s)
            else:
                raise ArithmeticError("the matrix is not positive definite")
    return lower


def solve_lower(lower, right):
    """Return L⁻¹ right, for one vector (d,)."""
    y = []
    for i in range(len(right)):
        y.append((right[i] - MP.fdot(zip(lower[i, :i], y, strict=True))) / lower[i, i])
    return np.array(y)


def solve_upper(lower, right):
    """Return L⁻ᵀ right, for one vector (d,)."""
    return solve_lower(lower.T[::-1, ::-1], right[::-1])[::-1]


def solve(lower, right):
    """Return (L Lᵀ)⁻¹ right, for one vector (d,)."""
    return solve_upper(lower, solve_lower(lower, right))


def inverse(matrix):
    """Return the inverse of a definite matrix (d, d)."""
    lower = cholesky(matrix)
    return np.array([solve(lower, column) for column in exact(np.eye(len(matrix)))])


def log_gaussian(squared, lower):
    """Return log N at a squared Mahalanobis distance."""
    log_det = MP.fsum(MP.log(value) for value in np.diagonal(lower))
    return -log_det - MP.mpf(len(lower)) / 2 * MP.log(2 * MP.pi) - squared / 2


def log_sum(values):
    """Return log Σ exp(value)."""
    top = max(values)
    if top == MP.mpf("-inf"):
        return top
    return top + MP.log(MP.fsum(MP.exp(value - top) for value in values))


class Mixture:
    """A mixture: `weights` (K,), `means` (K, d), `covariances` (K, d, d) and their factors."""

    def __init__(self, weights, means, covariances):
        self.weights, self.means = weights / MP.fsum(weights), means
        self.covariances = covariances
        self.lowers = [cholesky(covariance) for covariance in covariances]

    def squared(self, x):
        """Squared Mahalanobis distance of a point (d,) from each mean, shape (K,)."""
        pairs = zip(self.lowers, self.means, strict=True)
        whitened = [solve_lower(lower, x - mean) for lower, mean in pairs]
        return np.array([MP.fdot(y, y) for y in whitened])

    def log_joint(self, squared):
        """Log π_k N(x; μ_k, Σ_k) at squared distances (K,), shape (K,)."""
        parts = zip(self.weights, squared, self.lowers, strict=True)
        return np.array([MP.log(w) + log_gaussian(q, lower) for w, q, lower in parts])


class Conditioner:
    """A mixture of which the first n columns will be known."""

    def __init__(self, mixture, n):
        self.means, self.n = mixture.means, n
        blocks = [covariance[:n, :n] for covariance in mixture.covariances]
        self.states = Mixture(mixture.weights, mixture.means[:, :n], blocks)
        self.gains, self.covariances = [], []
        for lower, covariance in zip(self.states.lowers, mixture.covariances, strict=True):
            cross = covariance[:n, n:]
            self.gains.append(np.array([solve(lower, column) for column in cross.T]))
            self.covariances.append(covariance[n:, n:] - self.gains[-1] @ cross)

    def at(self, x):
        """Squared distances and log h_k (K,), and the means m (K, d), at x (n,)."""
        squared = self.states.squared(x)
        joint = self.states.log_joint(squared)
        pairs = zip(self.means, self.gains, strict=True)
        m = np.array([mean[self.n :] + gain @ (x - mean[: self.n]) for mean, gain in pairs])
        return squared, joint - log_sum(joint), m


class DonutMixture:
    """Σ_k h_k D(a; m_k, S_k) of a shape (γ, r_α, r_β)."""

    def __init__(self, log_h, means, covariances, shape):
        self.log_h, self.means = log_h, means
        self.lowers = [cholesky(covariance) for covariance in covariances]
        self.gamma, self.r_alpha, self.r_beta = shape

    def squared(self, a):
        """Squared Mahalanobis distance of a point (d,) from each centre, shape (K,)."""
        return np.array([MP.fdot(y, y) for y in self._whitened(a)])

    def _whitened(self, a):
        pairs = zip(self.lowers, self.means, strict=True)
        return [solve_lower(lower, a - mean) for lower, mean in pairs]

    def parts(self, a):
        """Each component's log h γ N_wide, log h (γ − 1) N_narrow, and Σ⁻¹(a − m)."""
        d = len(a)
        for log_h, y, lower in zip(self.log_h, self._whitened(a), self.lowers, strict=True):
            q, centre = MP.fdot(y, y), log_gaussian(MP.mpf(0), lower)
            wide, narrow = (
                log_h + centre + d * MP.log(r) - r * r * q / 2 for r in (self.r_alpha, self.r_beta)
            )
            yield (
                wide + MP.log(self.gamma),
                narrow + (MP.log(self.gamma - 1) if self.gamma > 1 else MP.mpf("-inf")),
                solve_upper(lower, y),
            )

    def wide(self, a):
        """Log of the wide Gaussians alone: what the density is a difference from."""
        return log_sum([wide for wide, _, _ in self.parts(a)])

    def density(self, a, unit):
        """Density and gradient (d,) at a, divided by exp(unit)."""
        value, gradient = MP.mpf(0), 0 * a
        for wide, narrow, direction in self.parts(a):
            w, n = MP.exp(wide - unit), MP.exp(narrow - unit)
            value += w - n
            gradient = gradient - (w * self.r_alpha**2 - n * self.r_beta**2) * direction
        return value, gradient


def standardised(X, weight):
    """Return samples (N, d) of mean 0 and variance 1, and the mean and deviation they had."""
    total = MP.fsum(weight)
    offset = weight @ X / total
    scale = np.array([MP.sqrt(v) for v in weight @ (X - offset) ** 2 / total])
    return (X - offset) / scale, offset, scale


def expectation(X, mixture):
    """Log density (N,) and responsibilities (N, K) of samples."""
    log_density, responsibilities = [], []
    for x in X:
        joint = mixture.log_joint(mixture.squared(x))
        log_density.append(log_sum(joint))
        responsibilities.append([MP.exp(value - log_density[-1]) for value in joint])
    return np.array(log_density), np.array(responsibilities)


def em_step(X, weight, mixture, floor):
    """Mass (K,) and new mixture of one iteration.

    A component that no sample claims keeps its place, and one that jumps keeps its covariance.
    """
    r = expectation(X, mixture)[1] * weight[:, None]
    mass = r.sum(axis=0)
    means, covariances = mixture.means.copy(), mixture.covariances.copy()
    for k in range(len(mass)):
        if mass[k] > MP.mpf("1e-12") * mass.sum():
            means[k] = r[:, k] @ X / mass[k]
            deviation = X - means[k]
            covariance = (r[:, k] * deviation.T) @ deviation / mass[k]
            covariance = covariance + floor * exact(np.eye(X.shape[1]))
            jump = (means[k] - mixture.means[k]) ** 2
            if np.all(np.diag(covariance) > MP.mpf("1e-10") * jump):
                covariances[k] = covariance
    return mass, Mixture(mass, means, covariances)
