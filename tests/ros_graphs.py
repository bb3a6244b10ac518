"""A ROS 1 graph for tests: a roscore of its own on a free port, and nodes as processes."""

import os
import signal
import socket
import subprocess
import sys
import time
import xmlrpc.client
from dataclasses import replace
from pathlib import Path

from misstep.errors import MisstepError
from misstep.robot.ros1.environment import PACKAGES, import_ros

ROOT = Path(__file__).parents[1]
PATIENCE = 60.0


def missing() -> str:
    """Why there can be no graph; empty if there can."""
    try:
        for name in ("rospy", "rosbag", "sensor_msgs.msg", "std_srvs.srv"):
            import_ros(name)
    except MisstepError as error:
        return str(error)
    found = any((Path(folder) / "roscore").exists() for folder in os.environ["PATH"].split(":"))
    return "" if found else f"there is no roscore: apt-get install {PACKAGES}"


def untimed(trajectories):
    """Trajectories without the time of day at which they were made."""
    return [replace(t, provenance=replace(t.provenance, time="")) for t in trajectories]


def until(condition, what, patience=PATIENCE):
    """Wait for a condition and return what it returned."""
    deadline = time.monotonic() + patience
    while not (value := condition()):
        assert time.monotonic() < deadline, f"waited {patience:g} s for {what}"
        time.sleep(0.02)
    return value


class Graph:
    """A roscore and nodes; `close` ends all of them, and whatever they started."""

    def __init__(self, folder):
        self.folder = folder
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.environment = {
            **os.environ,
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "ROS_MASTER_URI": f"http://127.0.0.1:{self.port}",
            "ROS_HOSTNAME": "127.0.0.1",
            "ROS_HOME": str(folder / "ros_home"),
            "ROS_PACKAGE_PATH": f"{ROOT / 'ros'}:/usr/share",
            "PYTHONUNBUFFERED": "1",
        }
        self.processes = []
        self.start_core()

    def start_core(self):
        self.core = self.start("roscore", "-p", str(self.port))
        until(self.master_pid, "roscore")

    def master_pid(self):
        """The process that is the master; 0 where none answers."""
        try:
            with xmlrpc.client.ServerProxy(self.environment["ROS_MASTER_URI"]) as master:
                return master.getPid("/test")[2]
        except OSError:
            return 0

    def start(self, *words, name=None):
        """Start a process; what it says goes to a file."""
        path = self.folder / f"{name or Path(words[0]).name}-{len(self.processes)}.log"
        with path.open("wb") as said:
            process = subprocess.Popen(
                words,
                env=self.environment,
                stdout=said,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )
        process.said = path.read_text
        self.processes.append(process)
        return process

    def node(self, command, *words):
        """Start ``misstep ros1``."""
        words = [str(word) for word in words]
        program = "import sys; from misstep.cli import main; sys.exit(main())"
        start = [sys.executable, "-c", program, "ros1", command, *words]
        return self.start(*start, name=command)

    def call(self, *words):
        """Run one of ROS's own commands and return what it says."""
        done = subprocess.run(
            words, env=self.environment, capture_output=True, text=True, timeout=PATIENCE
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    def stop(self, process):
        """Interrupt a process, as Ctrl-C does, and wait for its end."""
        process.send_signal(signal.SIGINT)
        process.wait(PATIENCE)

    def kill(self, process):
        """Kill a process, and whatever it started, without a word."""
        for pid in (process.pid, *descendants(process.pid)):
            os.kill(pid, signal.SIGKILL)
        process.wait(PATIENCE)

    def close(self):
        for process in self.processes:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        for process in self.processes:
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                self.kill(process)


def descendants(pid):
    """All that a process has started, and they; roscore gives each a session of its own."""
    told = [path.read_text() for path in Path(f"/proc/{pid}/task").glob("*/children")]
    children = map(int, " ".join(told).split())
    return [found for child in children for found in (child, *descendants(child))]


def ended(process):
    """Wait for a node to end by itself, without an error."""
    code = process.wait(PATIENCE)
    assert code == 0, process.said()
