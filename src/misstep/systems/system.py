"""What misstep asks of a system: a Gymnasium environment that knows its columns and its past.

A system is an ordinary `gymnasium.Env` with `Box` spaces. What it says beyond that lets a recorded
trajectory explain itself: what each column is, in which unit, how long a step takes, and with which
parameters the same system can be built again.
"""

import math
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from misstep.costs import StateCost
from misstep.errors import MisstepError
from misstep.parameters import ParameterValue
from misstep.systems.mechanics import Mechanics
from misstep.trajectory import Column


class System(gymnasium.Env[NDArray[np.float64], NDArray[np.float64]]):
    """A Gymnasium environment with `Box` spaces that describes itself.

    `step` returns minus the cost of the step as its reward, and in its `info`

    - ``failed`` (bool): the failure predicate has held at some time in this episode;
    - ``success`` (bool): the task is done;
    - ``timed_out`` (bool, where it can happen): ``failed`` for no other reason than that the
      episode is over without success.

    `reset` returns ``failed`` in its `info` too: an episode can start in a failure.

    Attributes
    ----------
    system_id : str
        Name in the registry of systems.
    parameters_type : type
        Dataclass of the constructor's parameters, see `misstep.parameters`.
    typed_only : frozenset of str or None
        Parameters that only the user may give, and never a file: those by which it reaches files,
        networks or machines. None, unless the class itself states something else: a file must not
        even name the system. See `recorded_system`.
    dt : float, s
        Control period.
    observation_columns : tuple of Column, length n
    action_columns : tuple of Column, length m
    parameters : dict
        Every parameter of the constructor: enough to build the same system again.
    cost : StateCost or None
        Cost of an observation as a function, for learners that plan.
    """

    system_id: ClassVar[str]
    parameters_type: ClassVar[type]
    typed_only: ClassVar[frozenset[str] | None] = None
    dt: float
    observation_columns: tuple[Column, ...]
    action_columns: tuple[Column, ...]
    parameters: dict[str, ParameterValue]
    cost: StateCost | None = None

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        # Not inherited: what is derived from a simulation may well drive a machine.
        cls.typed_only = cls.__dict__.get("typed_only")

    @property
    def unwrapped(self) -> "System":
        """The system itself; the one inside where this is a system around a system."""
        return self

    def mechanics(self, **parameters: ParameterValue) -> Mechanics:
        """Return the joints and their forces, to tell from a motion which actions made it.

        Parameters
        ----------
        **parameters
            Of the system, where they are to differ from its own.

        Raises
        ------
        MisstepError
            If this system cannot be run backwards, or has no such parameter or value.
        """
        raise MisstepError(
            f"{self.system_id} has no inverse dynamics: actions cannot be inferred from its "
            "motion, nor its equations checked; the cart-poles have"
        )

    def _take_after(self, system: "System") -> None:
        """Be described as `system` is, whose episodes come from elsewhere or are judged anew."""
        self.system_id = system.system_id  # type: ignore[misc]
        self.parameters_type = system.parameters_type  # type: ignore[misc]
        self.parameters = system.parameters
        self.dt = system.dt
        self.observation_columns = system.observation_columns
        self.action_columns = system.action_columns
        self.observation_space, self.action_space = system.observation_space, system.action_space

    def no_episode(self) -> MisstepError:
        """Return what `step` raises before the first `reset` and after the end of an episode."""
        return MisstepError(f"{self.system_id}: no episode is running; call reset() before step()")

    def checked_number(self, action: NDArray[np.float64], quantity: str, unit: str) -> float:
        """Return the one number of an action, such as a force in N.

        Raises
        ------
        MisstepError
            If the action has another shape than (1,), or is not finite.
        """
        action = np.asarray(action)
        if action.shape != (1,):
            raise MisstepError(
                f"{self.system_id}: the action has shape {action.shape} but one {quantity} in "
                f"{unit}, shape (1,), is wanted"
            )
        number = float(action[0])
        if not math.isfinite(number):
            raise MisstepError(
                f"{self.system_id}: the action is {number} {unit}, which is not a finite {quantity}"
            )
        return number
