"""The paper's cost: C = (1/T) Σ |θ| in degrees, over 30 s, 15 s and 7.5 s (section IV-C)."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from misstep.trajectory import Trajectory

HORIZONS = (30.0, 15.0, 7.5)
"""The horizons in the order of the paper's tables, s."""


def horizon_costs(trajectories: Iterable[Trajectory]) -> NDArray[np.float64]:
    """Return the cost of each trajectory over each horizon, shape (N, 3), deg.

    The angle is that of the states that the actions led to, as the system judged them.
    """
    rows = []
    for trajectory in trajectories:
        if trajectory.costs is None:
            raise ValueError("the paper's cost needs trajectories with costs")
        steps = [round(horizon / trajectory.dt) for horizon in HORIZONS]
        rows.append([float(trajectory.costs[:n].mean()) for n in steps])
    return np.array(rows)
