"""A robot in a ROS 1 graph, by the clock, and everything that can go wrong there.

The simulation is a process of its own, which tells which efforts act on its joint through a pipe,
so also when the network is cut, and which lies about its states when it is told to.
"""

import fcntl
import math
import multiprocessing
import os
import resource
import signal
import socket
import struct
import threading
import time
from collections import Counter, deque

import numpy as np
from ros_graphs import Graph, until

import misstep
from misstep.robot.limits import Reason
from misstep.robot.log import Sent, read_log
from misstep.runs import load_run

PLANT = {"physics_step": 0.005, "duration": 1.5, "stop_at_fall": False}
OPTIONS = [word for name, value in PLANT.items() for word in ("--set", f"{name}={value}")]
AT_REST = 20  # states, 0.1 s
MOVING = 10
PATIENCE = 90.0
_SIOCSIFFLAGS, _UP = 0x8914, 1


class _LyingBus:
    """A bus whose joint states pass through a function."""

    def __init__(self, bus, corrupt):
        self._bus, self._corrupt = bus, corrupt

    def __getattr__(self, name):
        return getattr(self._bus, name)

    def publish_joints(self, topic):
        say = self._bus.publish_joints(topic)

        def publish(joints):
            for told in self._corrupt(joints):
                say(told)

        return publish


class _Liar:
    """Remembers which efforts acted, and corrupts what is told of them."""

    def __init__(self):
        self.efforts, self.how, self._held = deque(maxlen=AT_REST), "truth", []
        self._stamp = 0.0

    def __call__(self, joints):
        self.efforts.append(joints.efforts[0])
        told, self._held = self._held, []
        if self.how == "not finite":
            return [joints._replace(positions=[math.nan] * 2)]
        if self.how == "stale":
            return [joints._replace(stamp=self._stamp)]
        if self.how == "ahead":
            return [joints._replace(stamp=joints.stamp + 3600.0)]
        if self.how == "behind":
            return [joints._replace(stamp=joints.stamp - 3600.0)]
        if self.how == "reordered" and not told:
            self._held = [joints]
            return []
        self._stamp = joints.stamp
        return [joints, *told]


def _simulate(pipe, environment):
    os.environ.update(environment)
    from misstep.robot.ros.joints import Joints
    from misstep.robot.ros.plant import Plant
    from misstep.robot.ros.simulation_node import SimulationNode
    from misstep.robot.ros.topics import Topics
    from misstep.robot.ros1.bus import Ros1Bus

    plant, liar = Plant("cartpole", PLANT), _Liar()
    bus = _LyingBus(Ros1Bus("simulation"), liar)
    joints = Joints(plant.system.observation_columns)
    node = SimulationNode(bus, plant, Topics(), joints, lock_step=False, watchdog=1.0)
    threading.Thread(target=node.run, daemon=True).start()
    pipe.send("here")
    while (order := pipe.recv()) != "end":
        if order == "efforts":
            pipe.send(list(liar.efforts))
        else:
            liar.how = order
    node.close()


class RosRobot:
    """A graph with a robot in it that explores, until `close`."""

    def __init__(self, folder, max_trials=10_000):
        self.folder = folder
        own = misstep.make_system("cartpole", **PLANT)
        misstep.save_dataset(misstep.demonstrate(own, "weak", n=2, seed=1), folder / "shown.h5")
        self.graph = Graph(folder)
        self.kept = {}
        self._new = ("--from", folder / "shown.h5", *OPTIONS, "--learner", "mean", "--keep-going")
        self._new += ("--max-trials", max_trials)
        self.simulation = self.exploration = self.controller = None
        self.start()

    @property
    def run(self):
        return self.folder / "run"

    def start(self):
        """Start what is not there, and wait until the robot moves."""
        context = multiprocessing.get_context("spawn")
        if self.simulation is None:
            self.pipe, other = context.Pipe()
            arguments = (other, self.graph.environment)
            self.simulation = context.Process(target=_simulate, args=arguments, daemon=True)
            self.simulation.start()
            assert self.pipe.recv() == "here"
        if self.exploration is None:
            new = () if self.run.exists() else self._new
            self.exploration = self.graph.node("explore", self.run, *new, "--watchdog-ms", 500)
        self.wait(self.goes_on)

    def goes_on(self):
        """Whether the robot moves; a controller that has given up is started anew, as is due."""
        if self.controller is None or self.controller.poll() is not None:
            self.controller = self.graph.node("control", "cartpole", *OPTIONS)
        return self.moves()

    def wait(self, condition):
        try:
            until(condition, condition.__name__, PATIENCE)
        except AssertionError as error:
            said = "".join(process.said()[-300:] for process in self.graph.processes[-3:])
            raise AssertionError(f"{error}; the nodes say {said}") from error

    def efforts(self):
        """The last efforts that acted on the joint."""
        self.pipe.send("efforts")
        return self.pipe.recv()

    def rests(self):
        efforts = self.efforts()
        return len(efforts) == AT_REST and not any(efforts)

    def moves(self):
        efforts = self.efforts()
        return len(efforts) == AT_REST and all(efforts[-MOVING:])

    def makes_a_trial(self):
        return len(list(self.run.glob("trials/*.h5"))) > len(self.kept)

    def remember(self):
        """Check that all that was kept is still there, and remember it."""
        found = {path: path.read_bytes() for path in sorted(self.run.glob("trials/*.h5"))}
        assert all(found.get(path) == data for path, data in self.kept.items())
        self.kept = found

    def tell(self, how):
        self.pipe.send(how)

    def kill(self, name):
        self.graph.kill(getattr(self, name))
        setattr(self, name, None)

    def call(self, service):
        assert "success: True" in self.graph.call("rosservice", "call", f"/exploration/{service}")

    def end_simulation(self):
        self.pipe.send("end")
        self.simulation.join()
        self.simulation = None

    def close(self):
        """End everything; return how many trials were kept, having looked at all of them."""
        if self.controller is not None:
            self.kill("controller")
        self.wait(self.rests)
        self.graph.stop(self.exploration)
        self.remember()
        self.end_simulation()
        self.graph.close()
        run = load_run(self.run)
        assert len(run.trials) == len(self.kept)
        logs = sorted(self.run.glob("actions/*.log"))
        records = [record for log in logs for record in read_log(log)[1]]
        sent = [record for record in records if isinstance(record, Sent)]
        actions = np.array([record.action for record in sent])
        assert np.isfinite(actions).all()
        assert (np.abs(actions) <= 20.0).all()
        assert all(record.action == (0.0,) for record in sent if record.reason & Reason.STOP)
        return len(run.trials)

    # Each ends with a robot at rest, and nobody has lost anything

    def controller_is_killed(self, rng):
        self.kill("controller")
        self.wait(self.rests)

    def controller_hangs(self, rng):
        os.kill(self.controller.pid, signal.SIGSTOP)
        self.wait(self.rests)
        os.kill(self.controller.pid, signal.SIGCONT)

    def exploration_is_killed(self, rng):
        self.kill("exploration")
        self.wait(self.rests)

    def exploration_hangs(self, rng):
        os.kill(self.exploration.pid, signal.SIGSTOP)
        self.wait(self.rests)
        os.kill(self.exploration.pid, signal.SIGCONT)

    def roscore_is_restarted(self, rng):
        """The nodes go on without; who comes after it needs nodes that have told the new one."""
        self.graph.kill(self.graph.core)
        self.wait(self.makes_a_trial)
        self.wait(self.moves)
        self.kill("controller")
        self.wait(self.rests)
        self.graph.stop(self.exploration)
        self.exploration = None
        self.end_simulation()
        self.graph.start_core()

    def network_is_cut(self, rng):
        set_loopback(False)
        self.wait(self.rests)
        set_loopback(True)

    def states_are_not_finite(self, rng):
        self.lies("not finite")

    def states_are_stale(self, rng):
        self.lies("stale")

    def clock_jumps(self, rng):
        self.lies(["ahead", "behind"][rng.integers(2)])

    def states_are_reordered(self, rng):
        """Older ones are passed over, so that the robot goes on until somebody stops it."""
        self.tell("reordered")
        self.wait(self.makes_a_trial)
        self.somebody_stops(rng)
        self.tell("truth")

    def somebody_stops(self, rng):
        self.call("stop")
        self.wait(self.rests)
        self.call("clear")

    def disk_is_full(self, rng):
        limits = resource.prlimit(self.exploration.pid, resource.RLIMIT_FSIZE, (0, -1))
        self.wait(self.rests)  # at the end of the trial, which cannot be kept yet
        number = len(list(self.run.glob("trials/*.h5")))
        time.sleep(0.5)
        assert self.rests()
        assert len(list(self.run.glob("trials/*.h5"))) == number
        resource.prlimit(self.exploration.pid, resource.RLIMIT_FSIZE, limits)

    def lies(self, how):
        self.tell(how)
        self.wait(self.rests)
        self.tell("truth")


WAYS = (
    RosRobot.controller_is_killed,
    RosRobot.controller_hangs,
    RosRobot.exploration_is_killed,
    RosRobot.exploration_hangs,
    RosRobot.states_are_not_finite,
    RosRobot.states_are_stale,
    RosRobot.clock_jumps,
    RosRobot.states_are_reordered,
    RosRobot.somebody_stops,
    RosRobot.disk_is_full,
    RosRobot.roscore_is_restarted,
)


def harm_robot(folder, ways, n_faults, seed=0, done=None):
    """Make so many faults in turn; return a Counter of them, and how many trials were kept."""
    robot, rng, made = RosRobot(folder), np.random.default_rng(seed), Counter()
    try:
        robot.wait(robot.makes_a_trial)
        for n in range(n_faults):
            way = ways[n % len(ways)]
            robot.remember()
            way(robot, rng)
            robot.remember()
            made[way.__name__] += 1
            robot.start()
            if done is not None:
                done(way.__name__)
        return made, robot.close()
    finally:
        robot.graph.close()


def set_loopback(up):
    """Switch this network's loopback on or off; in a network namespace of its own, as root."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as handle:
        request = struct.pack("16sH22x", b"lo", _UP if up else 0)
        fcntl.ioctl(handle, _SIOCSIFFLAGS, request)
