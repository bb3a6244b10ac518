"""Which action now? A donut mixture's mode at one state after another, and at many at once."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from misstep.mixture import compiled
from misstep.mixture.checks import checked_points
from misstep.mixture.conditional import Conditioner
from misstep.mixture.donut import DEFAULT_K, DEFAULT_REACH, check_family, check_hole
from misstep.mixture.donut_mixture import check_formula, check_scale, component_arrays

Array = NDArray[np.float64]


class DonutQuery:
    """A joint mixture made ready to be asked for the donut mixture's mode, in one compiled call.

    It works in room of its own and allocates nothing, so one thread at a time may ask it: give each
    thread a query of its own.

    Parameters
    ----------
    conditioner : Conditioner
        Of n state columns and d actions.
    scale : array-like, shape (d,)
        s of the exploration, in the action's unit; see `exploration_from_variance`.
    k, reach : float
        The donut family, see `DonutShape.of`.
    formula : {"prose", "printed"}
        See `exploration_from_variance`.
    low, high : array-like, shape (d,), optional
        Bounds of the actions; infinite if left out.
    columns : sequence of n int, optional
        Where the state's columns are in what is handed to `explore`; the first n if left out.

    Raises
    ------
    MisstepError
        If a value is out of its range.
    """

    def __init__(
        self,
        conditioner: Conditioner,
        scale: ArrayLike,
        k: float = DEFAULT_K,
        reach: float = DEFAULT_REACH,
        formula: str = "prose",
        low: ArrayLike | None = None,
        high: ArrayLike | None = None,
        columns: ArrayLike | None = None,
    ) -> None:
        c = conditioner
        d = c.action_means.shape[1]
        self._n, self._d = c.state_means.shape[1], d
        check_family(k, reach)
        check_hole(k, d)
        s = np.array(scale, dtype=np.float64)
        check_scale(s, d)
        check_formula(formula)
        bounds = np.empty((2, d))
        bounds[0] = -np.inf if low is None else low
        bounds[1] = np.inf if high is None else high
        state_arrays = (
            c.state_constants,
            c.state_means,
            c.state_whiteners,
            c.gains,
            c.action_means,
            c.covariances,
        )
        family = (float(formula == "printed"), float(k), float(reach))
        components = component_arrays(c.covariances)
        at = np.arange(self._n) if columns is None else columns
        self._packed = compiled.packed_query(at, state_arrays, components, s, bounds, family)

    def explore(self, state: Array, action: Array, warm: bool, flat_stays: bool = False) -> float:
        """Overwrite `action` with a mode at `state`, inside the bounds, and return ε.

        Nothing is checked or allocated.

        Parameters
        ----------
        state : ndarray of float64, shape (n,), or an observation with those columns in it
        action : ndarray of float64, shape (d,)
        warm : bool
            Climb from the `action` that comes in; otherwise from the best analytic candidate.
        flat_stays : bool
            Whether an action stays where its density is zero in double precision.
        """
        exploration: float = compiled.answer(state, action, warm, flat_stays, self._packed)
        return exploration

    def modes(self, states: ArrayLike) -> tuple[Array, Array]:
        """Return the modes (N, d), inside the bounds, and ε (N,) at states (N, n), begun cold.

        Raises
        ------
        MisstepError
            If `states` has another shape or is not finite.
        """
        x = checked_points(states, self._n)
        actions = np.zeros((len(x), self._d))
        epsilons = [self.explore(*pair, warm=False) for pair in zip(x, actions, strict=True)]
        return actions, np.array(epsilons)
