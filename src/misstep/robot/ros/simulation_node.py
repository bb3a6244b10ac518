"""The simulation node: a cart-pole behind the topics that a Gazebo robot has.

In wall-clock mode it moves on at its rate whatever comes, and counts what it was late for; without
a command for `watchdog` seconds its actuator drops the effort. In lock-step every state waits for
its command, so that a run depends on no timing.
"""

import math
import queue
import threading
import time
from dataclasses import dataclass
from typing import Any

from misstep.robot.limits import Row
from misstep.robot.ros.bus import Bus, JointArrays
from misstep.robot.ros.joints import Joints
from misstep.robot.ros.plant import Plant
from misstep.robot.ros.topics import Topics

_SAY_AGAIN = 1.0  # s
_LOOK = 0.1  # s


@dataclass
class _Reset:
    seed: int | None
    done: threading.Event
    stamp: float = 0.0


class SimulationNode:
    """Simulates until `close`.

    Parameters
    ----------
    bus : Bus
    plant : Plant
    topics : Topics
    joints : Joints
    lock_step : bool
    watchdog : float, s
        Longest time without a command, in wall-clock mode.

    Attributes
    ----------
    steps, late : int
        How many steps were made; how many of them began late by more than one period.
    """

    def __init__(
        self,
        bus: Bus,
        plant: Plant,
        topics: Topics,
        joints: Joints,
        *,
        lock_step: bool,
        watchdog: float = 0.1,
    ) -> None:
        self.steps = self.late = 0
        self._bus, self._plant, self._joints = bus, plant, joints
        self._lock_step, self._watchdog = lock_step, watchdog
        self._inbox: queue.SimpleQueue[float | _Reset] = queue.SimpleQueue()
        self._closing = threading.Event()
        self._ticks = 0
        self._topic = topics.joint_states
        (command,) = topics.commands
        # Before the topics: who is connected to them finds it.
        bus.serve("~reset", "Reset", self._on_reset)
        self._say = bus.publish_joints(topics.joint_states)
        bus.subscribe_effort(command, self._on_command)

    def run(self) -> None:
        """Simulate until `close`, from another thread, or an interrupt."""
        if self._lock_step:
            self._run_in_lock_step()
        else:
            self._run_by_the_clock()

    def close(self) -> None:
        """Have `run` end; in lock-step that can take a second."""
        self._closing.set()

    def _run_in_lock_step(self) -> None:
        started = False
        while not self._closing.is_set():
            try:
                item = self._inbox.get(timeout=_SAY_AGAIN)
            except queue.Empty:
                if started:
                    self._publish(self._stamp())
                continue
            if isinstance(item, _Reset):
                started = True
                self._reset(item)
            elif started:
                self._plant.step((item,))
                self._ticks += 1
                self.steps += 1
            else:
                continue
            self._publish(self._stamp())

    def _run_by_the_clock(self) -> None:
        period = 1.0 / self._plant.rate
        safe = self._plant.limits.safe
        efforts, heard = safe, -self._watchdog
        due = time.monotonic()
        while not self._closing.is_set():
            effort = self._newest()
            now = time.monotonic()
            if effort is not None:
                efforts, heard = effort, now
            elif now - heard > self._watchdog:
                efforts = safe
            self._plant.step(efforts)
            self.steps += 1
            self._publish(time.time())
            due += period
            now = time.monotonic()
            if now < due:
                time.sleep(due - now)
            elif now > due + period:
                self.late += 1
                due = now

    def _newest(self) -> Row | None:
        """Do what has been asked for; return the newest command."""
        effort = None
        while not self._inbox.empty():
            item = self._inbox.get()
            if isinstance(item, _Reset):
                self._reset(item)
                effort = None
            else:
                effort = (item,)
        return effort

    def _stamp(self) -> float:
        """Return the simulated time, s."""
        return self._ticks / self._plant.rate

    def _reset(self, reset: _Reset) -> None:
        self._plant.reset(reset.seed)
        self._ticks += 1
        reset.stamp = self._stamp() if self._lock_step else time.time()
        reset.done.set()
        # In lock-step the first state must not be missed.
        while self._lock_step and not self._closing.is_set() and not self._bus.count(self._topic):
            time.sleep(0.001)

    def _publish(self, stamp: float) -> None:
        positions, velocities = self._joints.arrays(self._plant.observation)
        self._say(
            JointArrays(stamp, self._joints.names, positions, velocities, self._plant.efforts)
        )

    def _on_command(self, effort: float) -> None:
        self._inbox.put(effort if math.isfinite(effort) else self._plant.limits.safe[0])

    def _on_reset(self, request: Any, who: str) -> dict[str, float]:
        reset = _Reset(request.seed if request.seeded else None, threading.Event())
        self._inbox.put(reset)
        reset.done.wait()
        return {"stamp": reset.stamp}
