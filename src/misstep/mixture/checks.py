"""What the mixture's borders check about matrices and points."""

import math
import operator
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from misstep.errors import MisstepError
from misstep.mixture import compiled

Array = NDArray[np.float64]

# The smallest variance whose inverse is a number, with room to spare.
_SMALLEST = 1e-300


def whiteners_of(matrices: Array) -> Array | None:
    """Return L⁻¹ of each L Lᵀ (K, d, d), or None if one is not definite.

    Definite is what is finite, symmetric but for rounding, and not so nearly singular that rounding
    decides, nor so small that its inverse leaves the range of numbers.
    """
    variances = np.diagonal(matrices, axis1=1, axis2=2)
    if not np.all(np.isfinite(matrices)) or not np.all(variances > _SMALLEST):
        return None
    deviations = np.sqrt(variances)
    rounding = 1e-9 * deviations[:, :, None] * deviations[:, None, :]
    if np.any(np.abs(matrices - matrices.transpose(0, 2, 1)) > rounding):
        return None
    whiteners = np.empty_like(matrices)
    log_dets = map(compiled.cholesky_whitener, matrices, whiteners)
    return whiteners if all(map(math.isfinite, log_dets)) else None


def checked_points(a: ArrayLike, d: int) -> Array:
    """Return points as an array (N, d); raise MisstepError unless they are that, and finite."""
    points = np.array(a, np.float64, order="C")
    if points.ndim != 2 or points.shape[1] != d or not np.all(np.isfinite(points)):
        raise MisstepError(f"points are finite and have shape (N, {d}), got {points.shape}")
    return points


def checked_columns(indices: Sequence[int], d: int) -> list[int]:
    """Return `indices` as a list; raise MisstepError unless they are distinct columns of d."""
    try:
        columns = [operator.index(i) for i in indices]
    except TypeError:
        columns = []
    if not columns or len(set(columns)) < len(columns) or not all(0 <= i < d for i in columns):
        raise MisstepError(
            f"columns are given as a list of distinct whole numbers from 0 to {d - 1}, got "
            f"{indices!r}"
        )
    return columns
