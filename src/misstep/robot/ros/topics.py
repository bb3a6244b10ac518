"""A robot behind topics: joint states come in, effort commands go out, a recorder keeps both."""

import queue
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from misstep.errors import MisstepError
from misstep.robot.limits import Row
from misstep.robot.ros.bus import Bus, JointArrays, Recorder
from misstep.robot.ros.joint_system import JointStates
from misstep.robot.ros.joints import Joints

_READY_FOR = 1.0  # s that the robot has to be ready before a trial begins


@dataclass(frozen=True)
class Topics:
    """Names in the graph."""

    joint_states: str = "joint_states"
    commands: tuple[str, ...] = ("effort_controller/command",)
    """One for each action."""
    reset: str = "simulation/reset"
    """The service that brings a simulation to its start."""


class TopicRobot:
    """A `misstep.robot.ros.joint_system.Robot` behind topics.

    Parameters
    ----------
    bus : Bus
    topics : Topics
    joints : Joints
    lock_step : bool
        Whether the simulation waits for each command.
    ready : callable, optional
        Whether an observation is one to start from. If given, an episode begins when the robot has
        been there for 1 s, wherever it was put by whom; else the simulation is reset.
    recorder : Recorder, optional
    """

    def __init__(
        self,
        bus: Bus,
        topics: Topics,
        joints: Joints,
        *,
        lock_step: bool = False,
        ready: Callable[[Row], bool] | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        self.lock_step = lock_step
        self._bus, self._topics, self._joints, self._ready = bus, topics, joints, ready
        self._recorder = recorder
        self._states: queue.SimpleQueue[JointStates] = queue.SimpleQueue()
        self._stamp = -1.0
        self._commands = [bus.publish_effort(name) for name in topics.commands]
        self._reset = None if ready else bus.call(topics.reset, "Reset")
        bus.subscribe_joints(topics.joint_states, self._receive)

    def wait(self, timeout: float) -> None:
        """Wait until somebody publishes joint states and somebody takes every command.

        Raises
        ------
        MisstepError
            If nobody does for `timeout` s.
        """
        deadline = time.monotonic() + timeout
        for name in (self._topics.joint_states, *self._topics.commands):
            while self._bus.count(name) == 0:
                if time.monotonic() > deadline:
                    raise MisstepError(f"nobody is at the other end of the topic {name}")
                time.sleep(0.01)

    def reset(self, seed: int | None) -> float | None:
        """Reset the simulation, or wait until the robot has been put to a start."""
        if self._recorder is not None:
            self._recorder.begin()
        if self._reset is not None:
            response = self._reset(seeded=seed is not None, seed=seed or 0)
            return float(response.stamp)
        since = None
        while True:
            state = self.receive(1.0)
            if state is None or self._ready is None or not self._ready(state.observation):
                since = None
            elif since is None:
                since = state.stamp
            elif state.stamp - since >= _READY_FOR:
                return state.stamp

    def receive(self, timeout: float) -> JointStates | None:
        """Return the next state, the newest where it need not answer every one; or None."""
        try:
            state = self._states.get(timeout=timeout)
            while not self.lock_step and not self._states.empty():
                state = self._states.get_nowait()
        except queue.Empty:
            return None
        return state

    def send(self, efforts: Sequence[float]) -> None:
        """Publish the efforts, (m,)."""
        for name, publish, effort in zip(
            self._topics.commands, self._commands, efforts, strict=True
        ):
            if self._recorder is not None:
                self._recorder.effort(name, effort, self._stamp)
            publish(effort)

    def close(self) -> None:
        """End the recording."""
        if self._recorder is not None:
            self._recorder.end()

    def _receive(self, joints: JointArrays) -> None:
        if joints.stamp <= self._stamp:  # a simulation that nobody has answered says it again
            return
        self._stamp = joints.stamp
        if self._recorder is not None:
            self._recorder.joints(self._topics.joint_states, joints)
        observation = self._joints.observation(joints.names, joints.positions, joints.velocities)
        self._states.put(JointStates(joints.stamp, observation))
