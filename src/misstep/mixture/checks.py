"""What the mixture's borders check about matrices and points."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from misstep.errors import MisstepError
from misstep.mixture import compiled

Array = NDArray[np.float64]


def are_definite(matrices: Array) -> bool:
    """Whether each of (K, d, d) is finite, symmetric (but for rounding) and positive definite."""
    if not np.all(np.isfinite(matrices)):
        return False
    rounding = 1e-9 * np.abs(matrices).max()
    if np.any(np.abs(matrices - matrices.transpose(0, 2, 1)) > rounding):
        return False
    whitener = np.empty(matrices.shape[1:])
    return all(math.isfinite(compiled.cholesky_whitener(m, whitener)) for m in matrices)


def checked_points(a: ArrayLike, d: int) -> Array:
    """Return points as an array (N, d); raise MisstepError unless they are that, and finite."""
    points = np.array(a, np.float64, order="C")
    if points.ndim != 2 or points.shape[1] != d or not np.all(np.isfinite(points)):
        raise MisstepError(f"points are finite and have shape (N, {d}), got {points.shape}")
    return points
