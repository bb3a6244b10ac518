"""A robot behind topics as a System: `demonstrate`, `rollout` and `learn` drive it like any other.

    joint states ─▶ every one is answered with the effort in force, and once in a control period
                    the state is handed out and the next effort is asked for

Where the robot is a simulation that waits for each effort before it moves on (lock-step), every run
is therefore the one that the system itself would have made, to the last bit.
"""

import math
import time
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.robot.limits import Limits, Row
from misstep.robot.ros.referee import Referee
from misstep.systems import System

_EARLY = 1e-6  # s: stamps are rounded to nanoseconds


class JointStates(NamedTuple):
    """One state as it came."""

    stamp: float
    """By the robot's clock, s."""
    observation: Row


class Robot(Protocol):
    """What a middleware does for a `JointSystem`."""

    lock_step: bool
    """Whether the robot waits for each effort before it moves on."""

    def reset(self, seed: int | None) -> float | None:
        """Bring the robot to a start; return the stamp of its first state there, if it says."""

    def receive(self, timeout: float) -> JointStates | None:
        """Return the next state; None if there is none for `timeout` s."""

    def send(self, efforts: Sequence[float]) -> None:
        """Send the efforts, (m,)."""


class JointSystem(System):
    """A robot behind a `Robot`, described by a system.

    **Observation**, **action**, **parameters**: those of `described`.

    **Reward**, **failure**, **success**: those of a cart-pole, judged by what is observed; 0 and
    nothing for any other system.

    **Info**: also ``cost``, None where it is not known.

    Parameters
    ----------
    described : System
        Only read, never driven.
    robot : Robot
    patience : float, s
        Longest wait for a state; then the safe effort is sent, and the robot is taken to be gone.

    Attributes
    ----------
    safe : tuple of m float
    stamp : float, s
        Of the state handed out last, by the robot's clock.
    """

    def __init__(
        self, described: System, robot: Robot, *, safe: Row | None = None, patience: float = 1.0
    ) -> None:
        self._take_after(described)
        self.render_mode = None
        self.safe = Limits.of(described).safe if safe is None else safe
        self.stamp = 0.0
        self._robot, self._patience = robot, patience
        self._referee = Referee(described)
        self._n_steps = float(self.parameters.get("duration", math.inf)) / self.dt - 0.5
        self._t, self._due, self._moving = 0, 0.0, False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """Bring the robot to a start.

        Raises
        ------
        MisstepError
            If it says nothing.
        """
        super().reset(seed=seed)
        self.rest()
        started = self._robot.reset(seed)
        self._referee.reset()
        self._t = 0
        state = self._next(-math.inf if started is None else started - _EARLY)
        self.stamp, self._due = state.stamp, state.stamp + self.dt
        self._moving = True
        verdict = self._referee.judge(state.observation)
        return np.array(state.observation), {"failed": verdict.failed, "success": False}

    def step(
        self, action: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """Hold an effort for one control period.

        Raises
        ------
        MisstepError
            If the robot says nothing for too long.
        """
        efforts = tuple(np.asarray(action, np.float64).tolist())
        self._robot.send(efforts)
        while (state := self._next(-math.inf)).stamp < self._due - _EARLY:
            self._robot.send(efforts)
        self.stamp = state.stamp
        self._due += self.dt
        self._t += 1
        verdict = self._referee.judge(state.observation)
        truncated = self._t >= self._n_steps
        info = {"failed": verdict.failed, "success": verdict.succeeded, "cost": verdict.cost}
        reward = 0.0 if verdict.cost is None else -verdict.cost
        return np.array(state.observation), reward, verdict.ended, truncated, info

    def rest(self, efforts: Row | None = None) -> None:
        """Send the last efforts of an episode, the safe ones if left out.

        A robot in lock-step has heard them when this returns.
        """
        if not self._moving:
            return
        self._moving = False
        self._robot.send(self.safe if efforts is None else efforts)
        if self._robot.lock_step:
            self._next(-math.inf)

    def close(self) -> None:
        """Leave the robot with the safe effort."""
        self.rest()

    def _next(self, earliest: float) -> JointStates:
        """Return the next state that is not older than `earliest`."""
        deadline = time.monotonic() + self._patience
        while True:
            state = self._robot.receive(max(deadline - time.monotonic(), 0.0))
            if state is None:
                self._moving = False
                self._robot.send(self.safe)
                raise MisstepError(
                    f"{self.system_id}: no joint state for {self._patience:g} s: the safe effort "
                    "was sent"
                )
            if state.stamp >= earliest:
                return state
