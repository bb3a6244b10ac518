"""Counting the modes of a donut mixture over a scalar action."""

import numpy as np
from numpy.typing import NDArray

from misstep.mixture import Conditional, DonutMixture

Array = NDArray[np.float64]


def action_grid(conditional: Conditional, points: int = 801) -> Array:
    """Return actions (N,) from end to end of all that is heard, eight deviations beyond each."""
    means = conditional.means[:, 0]
    reach = 8.0 * np.sqrt(conditional.covariances[:, 0, 0])
    # A component that is not heard at this state has no say in how far the grid goes.
    heard = conditional.weights > 1e-3
    return np.linspace((means - reach)[heard].min(), (means + reach)[heard].max(), points)


def count_modes(donut: DonutMixture) -> int:
    """Count the local maxima of the density on a fine grid."""
    rising = np.diff(donut.log_pdf(action_grid(donut.conditional)[:, None])) > 0
    return int(np.sum(rising[:-1] & ~rising[1:]))
