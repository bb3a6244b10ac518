"""The controller's loop: states go to the exploration node, its actions to the robot."""

from typing import Protocol

import numpy as np

from misstep.robot.guard import Command
from misstep.robot.limits import Row
from misstep.robot.ros.joint_system import JointSystem
from misstep.robot.service import Start


class Explorer(Protocol):
    """A connection to an exploration service; see `misstep.robot.client.RobotClient`."""

    def start(self) -> Start | None:
        """Begin the next trial, once its policy is there; None if the run is finished."""

    def ask(
        self,
        observation: Row,
        *,
        stamp: float,
        cost: float | None,
        failed: bool,
        succeeded: bool,
        over: bool,
    ) -> Command:
        """Return the command that answers a state, or the safe one if there is no answer."""


def explore(explorer: Explorer, system: JointSystem) -> int:
    """Make the trials of a run until it is finished.

    Parameters
    ----------
    explorer : Explorer
    system : JointSystem
        Reset with the seed of each trial.

    Returns
    -------
    int
        How many trials went on to their end.

    Raises
    ------
    MisstepError
        If the robot or the exploration node is gone; the robot has been sent the safe effort.
    """
    ended = 0
    try:
        while (start := explorer.start()) is not None:
            ended += _trial(explorer, system, start)
    finally:
        system.rest()
    return ended


def _trial(explorer: Explorer, system: JointSystem, start: Start) -> bool:
    observation, info = system.reset(seed=start.seed)
    cost, over = None, False
    while True:
        command = explorer.ask(
            tuple(observation.tolist()),
            stamp=system.stamp,
            cost=cost,
            failed=bool(info["failed"]),
            succeeded=bool(info["success"]),
            over=over,
        )
        if over or not command.in_trial:
            system.rest(command.action)
            return over
        observation, _, terminated, truncated, info = system.step(np.array(command.action))
        cost = info["cost"]
        over = terminated or truncated
