"""The mode of a donut mixture by numerical ascent, for libraries that stop at densities.

What the paper's listing does with PyPR: build the density of the donut mixture out of densities of
Gaussian mixtures, and climb it from the previous action. Done as well as it can be: all differences
of a step in one call, Newton's steps with the curvature's sign set right, which take a handful of
calls where a plain gradient ascent takes dozens, and the same end as misstep's.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

LEVEL = 1e-9
"""A step that gains no more log density is the last, as in `misstep.mixture.compiled`."""
STOP = 1e-7
LONGEST = 0.5
WIDTH = 1e-3
MOST_STEPS = 100


def exploration(weights: Any, means: Any, covariances: Any, scale: Any) -> float:
    """ε = 1 − 1/(1 + V/s²) of a conditional mixture (K,), (K, m), (K, m, m)."""
    deviations = means - weights @ means
    variances = np.diagonal(covariances, axis1=1, axis2=2) + deviations**2
    spread = float(np.mean(weights @ variances / scale**2))
    return spread / (1.0 + spread)


def donut_shape(epsilon: float, m: int, k: float, reach: float) -> tuple[float, float, float]:
    """γ, r_α, r_β of misstep's family of donuts in m dimensions."""
    r_alpha = 1.0 / (1.0 + (reach - 1.0) * epsilon)
    return 1.0 + epsilon / (k**m - 1.0), r_alpha, k * r_alpha


def climb(density: Callable[[Any], Any], action: Any, deviation: Any) -> Any:
    """Return a local maximum near `action` (m,).

    Parameters
    ----------
    density : callable
        Of points (N, m); returns (N,).
    action : ndarray, shape (m,)
    deviation : ndarray, shape (m,)
        The conditional mixture's standard deviations: the unit of the steps.
    """
    m = len(action)
    units = np.eye(m)
    pairs = [(i, j) for i in range(m) for j in range(i)]
    offsets = np.array([0 * units[0], *units, *-units, *(units[i] + units[j] for i, j in pairs)])
    # Steps and slopes are in units of the standard deviations.
    step, value = np.zeros(m), -math.inf
    for _ in range(MOST_STEPS):
        points = action + (step + WIDTH * offsets) * deviation
        height = np.log(np.maximum(density(points), 1e-300))
        if height[0] < value:
            step = 0.2 * step
        else:
            action, value = points[0], height[0]
            forward, backward, corner = np.split(height[1:], [m, 2 * m])
            slope = (forward - backward) / (2.0 * WIDTH)
            bend = np.diag(forward + backward - 2.0 * value)
            for (i, j), top in zip(pairs, corner, strict=True):
                bend[i, j] = bend[j, i] = top - forward[i] - forward[j] + value
            curvature, axes = np.linalg.eigh(bend / WIDTH**2)
            step = axes @ (axes.T @ slope / np.maximum(np.abs(curvature), 1e-3))
            if 0.5 * slope @ step < LEVEL:
                return action + step * deviation
            step *= min(1.0, LONGEST / max(math.sqrt(step @ step), 1e-300))
        if math.sqrt(step @ step) < STOP:
            break
    return action
