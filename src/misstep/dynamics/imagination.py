"""Searching a compact policy in a forward model: CMA-ES on imagined rollouts.

The policy is a network of one hidden layer, u = tanh(V tanh(W z)), with z the encoded state and a
one. All policies of a generation are imagined from the same starts and with the same noise, so that
they differ by what they do alone.

The cost of a rollout counts from its first step to its last, with no weight on the end: to be good
a policy has to arrive early and to stay.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from misstep.costs import StateCost
from misstep.dynamics import compiled

Array = NDArray[np.float64]

# First standard deviation of a weight; small enough for the units to begin in their linear part.
STEP = 0.5


@dataclass(frozen=True)
class Imagination:
    """What policies are tried in.

    Parameters
    ----------
    model : compiled.Model
    cost : StateCost
    starts : ndarray, shape (R, n)
        Where each rollout begins.
    noise : ndarray, shape (R, H, n)
        Added after each step of each rollout.
    """

    model: compiled.Model
    cost: StateCost
    starts: Array
    noise: Array

    def costs(self, inner: Array, outer: Array) -> Array:
        """Return the mean cost of a step of networks, (P, units, nz + 1) and (P, m, units + 1)."""
        cost = compiled.Cost.of(self.cost, self.model.angles)
        networks = compiled.Networks(inner, outer, np.empty(inner.shape[1]))
        work = compiled.Workspace.of(self.model, 1)
        costs = np.empty(len(inner))
        compiled.imagine(self.model, cost, networks, self.starts, self.noise, costs, work)
        return costs / self.noise[:, :, 0].size


def search_network(
    imagination: Imagination,
    n_units: int,
    generations: int,
    population: int,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Return the inner (units, nz + 1) and outer (m, units + 1) weights of the best network found.

    The search begins with the network that does nothing.

    Parameters
    ----------
    imagination : Imagination
    n_units : int
    generations, population : int
    rng : numpy.random.Generator
    """
    import cma  # slow to import

    def normal(*shape: int) -> Array:
        return rng.standard_normal(shape)

    nz, m = len(imagination.model.inverse_lengths), imagination.model.n_actions
    options = {
        # Not a number: leave NumPy's global generator alone.
        "seed": np.nan,
        "randn": normal,
        "popsize": population,
        "maxiter": generations,
        "verbose": -9,
    }
    start = np.zeros(n_units * (nz + 1) + m * (n_units + 1))
    with threadpool_limits(limits=1, user_api="blas"):
        evolution = cma.CMAEvolutionStrategy(start, STEP, options)
        while not evolution.stop():
            candidates = evolution.ask()
            costs = imagination.costs(*_unpacked(np.array(candidates), n_units, nz, m))
            evolution.tell(candidates, costs.tolist())
    inner, outer = _unpacked(np.array([evolution.best.x]), n_units, nz, m)
    return inner[0], outer[0]


def _unpacked(parameters: Array, n_units: int, nz: int, m: int) -> tuple[Array, Array]:
    """Return the inner (P, units, nz + 1) and outer (P, m, units + 1) weights of rows (P, …)."""
    split = n_units * (nz + 1)
    inner = np.ascontiguousarray(parameters[:, :split]).reshape(-1, n_units, nz + 1)
    outer = np.ascontiguousarray(parameters[:, split:]).reshape(-1, m, n_units + 1)
    return inner, outer
