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
    ) -> None:
        c = conditioner
        K, d = c.action_means.shape
        self._n, self._d = c.state_means.shape[1], d
        check_family(k, reach)
        check_hole(k, d)
        s = np.array(scale, dtype=np.float64)
        check_scale(s, d)
        check_formula(formula)
        self._family = (formula == "printed", float(k), float(reach), s)
        self._arrays = (
            c.state_constants,
            c.state_means,
            c.state_whiteners,
            c.gains,
            c.action_means,
            c.covariances,
            *component_arrays(c.covariances),
            compiled.scratch_for(K, d),
        )

    def explore(self, state: Array, action: Array, warm: bool, flat_stays: bool = False) -> float:
        """Overwrite `action` with a mode at `state` and return ε; nothing is checked or allocated.

        Parameters
        ----------
        state : ndarray of float64, shape (n,)
        action : ndarray of float64, shape (d,)
        warm : bool
            Climb from the `action` that comes in; otherwise from the best analytic candidate.
        flat_stays : bool
            Whether an action stays where its density is zero in double precision.
        """
        exploration: float = compiled.answer(
            state, action, warm, flat_stays, *self._family, *self._arrays
        )
        return exploration

    def modes(self, states: ArrayLike) -> tuple[Array, Array]:
        """Return the modes (N, d) and ε (N,) at states (N, n), each from its best candidate.

        Raises
        ------
        MisstepError
            If `states` has another shape or is not finite.
        """
        x = checked_points(states, self._n)
        actions = np.zeros((len(x), self._d))
        epsilons = [self.explore(*pair, warm=False) for pair in zip(x, actions, strict=True)]
        return actions, np.array(epsilons)
