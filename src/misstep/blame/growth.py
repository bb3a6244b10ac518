"""Danger without a boundary: from how failures grew.

Where a failure is no matter of leaving a range, as with one that a person marked by hand a moment
late, no plan can be tried against it. What is left is what `misstep.learners.fall` learns: near an
unstable state everything grows exponentially, and the regression of the discounted end on the state
says how far a failure has come. It has come to the point of no return when what fall blames on it,
the share e^{−κ} of its end, is reached. Less exact than trying plans; see ``studies/blame.py``.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from misstep.learners.fall import BLAME, Scaled, learn_danger, ways_to_fail
from misstep.trajectory import Trajectory

Array = NDArray[np.float64]

# A regression that explains less of the ends than this tells nothing.
LEAST_R_SQUARED = 0.5


def growth_dangers(trajectories: Sequence[Trajectory]) -> list[Array | None]:
    """Return how far the failure of each trajectory had come.

    Parameters
    ----------
    trajectories : sequence of Trajectory

    Returns
    -------
    dangers : list of ndarray, shape (failure step + 1,), or None
        From 0 to 1 at each observation up to the failure; 1 past the point of no return. None for
        trajectories that did not fail, failed at their start, or fail in a way that their state
        does not announce.
    """
    failed = [i for i, t in enumerate(trajectories) if t.failure_step]
    dangers: list[Array | None] = [None] * len(trajectories)
    if not failed:
        return dangers
    until = [trajectories[i].observations[: trajectories[i].failure_step + 1] for i in failed]  # type: ignore[operator]
    origin = np.mean([states[0] for states in until], axis=0)
    spread = np.concatenate(until).std(axis=0)
    varying = spread > 0
    if not varying.any():
        return dangers
    attempts = [
        Scaled((s - origin)[:, varying] / spread[varying], np.zeros((len(s) - 1, 0)), True, 1.0)
        for s in until
    ]
    where = {id(attempt): i for attempt, i in zip(attempts, failed, strict=True)}
    for way in ways_to_fail(attempts, len(attempts)):
        if not any(attempt.x[-1].any() for attempt in way):
            continue  # they ended where attempts begin: nothing has grown
        danger = learn_danger(way, trajectories[0].dt)
        if danger.r_squared < LEAST_R_SQUARED:
            continue
        for attempt in way:
            come = np.abs(danger.coefficients[0] + attempt.x @ danger.coefficients[1:])
            lost = np.exp(-BLAME) * max(float(come[-1]), 1e-12)
            dangers[where[id(attempt)]] = np.minimum(come / lost, 1.0)
    return dangers
