"""One attempt made by hand, step by step, and the trajectory that comes of it.

What `misstep.rollout.rollout` does in one go, a person does in real time: the attempt can be
paused, ended, and said to have failed at the moment when it goes wrong.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from misstep.rollout import utc_now
from misstep.systems import System
from misstep.trajectory import Outcome, Provenance, Trajectory

Array = NDArray[np.float64]

PERSON = "person"


def can_start_at(system: System) -> bool:
    """Return whether a person can choose the angle at which an attempt starts."""
    return "start_angle" in system.parameters and hasattr(system.unwrapped, "set_state")


def is_one_way(system: System) -> bool:
    """Return whether actions have one direction only, as a stroke's speed has."""
    space: Any = system.action_space
    return bool(np.all(space.low >= 0.0))


def action_of(system: System, hand: Sequence[float], strength: float) -> Array:
    """Return the action, shape (m,), of how far a person pushes.

    Parameters
    ----------
    system : System
    hand : sequence of float
        One for each action, from −1 to 1; what is missing is 0.
    strength : float
        Share of the actuator's range that a full push is.
    """
    space: Any = system.action_space
    m = space.shape[0]
    pushed = np.zeros(m)
    pushed[: len(hand)] = hand[:m]
    low = np.where(np.isfinite(space.low), space.low, -1.0)
    high = np.where(np.isfinite(space.high), space.high, 1.0)
    if is_one_way(system):
        action = low + strength * np.maximum(pushed, 0.0) * (high - low)
    else:
        action = 0.5 * (low + high) + strength * pushed * 0.5 * (high - low)
    clipped: Array = np.minimum(np.maximum(action, space.low), space.high)
    return clipped


class Attempt:
    """An attempt in progress.

    Parameters
    ----------
    system : System
        Driven by nobody else meanwhile.
    seed : int
        Of the episode.
    start_angle : float or None, rad
        Where it starts, if `can_start_at`; None: where the system says.
    """

    def __init__(self, system: System, seed: int, start_angle: float | None = None) -> None:
        self.system = system
        self.seed = seed
        self.observation, info = system.reset(seed=seed)
        self.notes: list[str] = []
        if start_angle is not None and can_start_at(system):
            inside: Any = system.unwrapped
            inside.set_state(0.0, 0.0, start_angle, 0.0)
            self.observation = inside.state
            self.notes.append(f"start: at {math.degrees(start_angle):g} deg, chosen by hand")
            info = {"failed": False}
        self._observations = [self.observation]
        self._actions: list[Array] = []
        self._costs: list[float] = []
        self._failure_step = 0 if info.get("failed", False) else None
        self._success = False
        self.over = False

    @property
    def n_steps(self) -> int:
        """Actions so far."""
        return len(self._actions)

    @property
    def time(self) -> float:
        """Time since the start, s of the system's own."""
        return self.n_steps * self.system.dt

    @property
    def failed(self) -> bool:
        """Whether there has been a failure."""
        return self._failure_step is not None

    def step(self, action: Array) -> None:
        """Apply one action for one control period."""
        self.observation, reward, terminated, truncated, info = self.system.step(action)
        self._observations.append(self.observation)
        self._actions.append(action)
        self._costs.append(-float(reward))
        if self._failure_step is None and info.get("failed", False):
            self._failure_step = self.n_steps
        self._success = bool(info.get("success", False))
        self.over = terminated or truncated

    def fail_now(self) -> None:
        """Have the attempt end here because a person says that it has failed."""
        if self._failure_step is None:
            self._failure_step = self.n_steps
            self.notes.append(f"failure time: {self.time:g} s, marked by hand")
        self.over = True

    def trajectory(self, notes: Sequence[str] = ()) -> Trajectory | None:
        """Return what was recorded, with `notes` in its provenance; None if nothing was done."""
        if not self._actions:
            return None
        outcome = Outcome.SUCCESS if self._success else Outcome.UNKNOWN
        return Trajectory(
            observations=np.array(self._observations),
            actions=np.array(self._actions),
            dt=self.system.dt,
            observation_columns=self.system.observation_columns,
            action_columns=self.system.action_columns,
            provenance=Provenance(
                system=self.system.system_id,
                parameters=self.system.parameters,
                demonstrator=PERSON,
                seed=self.seed,
                time=utc_now(),
                notes=(*notes, *self.notes),
            ),
            outcome=Outcome.FAILURE if self.failed else outcome,
            costs=np.array(self._costs),
            failure_step=self._failure_step,
        )
