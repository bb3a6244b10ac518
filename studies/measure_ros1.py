"""How long the exploration service of ROS 1 takes to answer, beside empty services.

Starts a roscore of its own, the exploration node, and a node with two services that do nothing:
std_srvs/Empty, and one with the exploration service's messages and a constant action. All are
called over persistent connections, in short blocks that take turns, so that a busy machine disturbs
all alike. The services that do nothing are rospy's own on both sides, with genpy's messages.

    python studies/measure_ros1.py [--calls 20000] [--learner donut] [--core 0]
"""

import argparse
import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import misstep
from misstep.robot.ros.explorer import NodeExplorer
from misstep.robot.ros1.bus import Ros1Bus
from misstep.robot.ros1.environment import import_ros
from misstep.robot.ros1.services import generated_type
from misstep.storage import write_json

BLOCK = 20
EMPTY = """
from misstep.robot.ros1.environment import import_ros, init_node
rospy = init_node("empty")
kind = import_ros("std_srvs.srv")
service = rospy.Service("empty", kind.Empty, lambda request: kind.EmptyResponse())
from misstep.robot.ros1.services import generated_type
explore = generated_type("Explore")
answer = explore._response_class(1, 1, 1, (0.5,), (0.5,))
other = rospy.Service("constant", explore, lambda request: answer)
rospy.spin()
"""
MISSTEP = "import sys; from misstep.cli import main; sys.exit(main())"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--calls", type=int, default=20_000)
    parser.add_argument("--learner", default="donut")
    parser.add_argument("--core", type=int, help="let all processes run on this core")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    if arguments.core is not None:
        os.sched_setaffinity(0, {arguments.core})
    with tempfile.TemporaryDirectory() as name, socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
        probe.close()
        os.environ |= {
            "ROS_MASTER_URI": f"http://127.0.0.1:{port}",
            "ROS_HOSTNAME": "127.0.0.1",
            "ROS_HOME": name,
        }
        seconds = arguments.calls / 50.0
        shown = misstep.demonstrate(misstep.make_system("cartpole"), "weak", n=4, seed=0)
        misstep.save_dataset(shown, Path(name) / "shown.h5")
        parameters = ["--set", f"duration={seconds}", "--set", "stop_at_fall=false"]
        explore = ["explore", f"{name}/run", "--from", f"{name}/shown.h5", *parameters]
        explore += ["--learner", arguments.learner, "--lock-step"]
        with open(f"{name}/said", "wb") as said:
            commands = (
                ["roscore", "-p", str(port)],
                [sys.executable, "-c", EMPTY],
                [sys.executable, "-c", MISSTEP, "ros1", *explore],
            )
            processes = []
            for command in commands:
                processes.append(subprocess.Popen(command, stdout=said, stderr=said))  # noqa: S603
                time.sleep(3.0)  # the first is waited for by nobody else
            try:
                result = measure(arguments.calls)
            finally:
                for process in reversed(processes):
                    process.terminate()
                    process.wait(20)
    for key, value in result.items():
        print(f"{key:22} {value:10.2f}")
    if arguments.json:
        write_json(arguments.json, result)


def measure(calls: int) -> dict[str, float]:
    """Return medians and 99 % quantiles [µs] of the services, and ratios of the medians."""
    bus, rospy = Ros1Bus("measuring"), import_ros("rospy")
    empty_type = import_ros("std_srvs.srv").Empty
    rospy.wait_for_service("empty", 60)
    empty = rospy.ServiceProxy("empty", empty_type, persistent=True)
    rospy.wait_for_service("constant", 60)
    constant = rospy.ServiceProxy("constant", generated_type("Explore"), persistent=True)
    explorer = NodeExplorer(bus)
    explorer.start()
    rng = np.random.default_rng(0)
    rows = list(map(tuple, rng.normal(0.0, [0.1, 0.1, 0.1, 0.5], (calls, 4)).tolist()))
    flags = {"cost": None, "failed": False, "succeeded": False, "over": False}

    def explore(i: int) -> None:
        command = explorer.ask(rows[i], stamp=(i + 1) / 50.0, **flags)
        if not command.in_trial:
            raise SystemExit(f"the trial is over after {i} states: {command}")

    services = {
        "empty": lambda i: empty(),
        "constant": lambda i: constant(i, i / 50.0, 0.0, False, False, False, rows[i]),
        "explore": explore,
    }
    times: dict[str, list[float]] = {name: [] for name in services}
    for start in range(0, calls, BLOCK):
        for name, call in services.items():
            for i in range(start, start + BLOCK):
                before = time.perf_counter()
                call(i)
                times[name].append(time.perf_counter() - before)
    result = {}
    for name, seconds in times.items():
        for q in (50, 99, 99.9):
            result[f"{name}_p{q:g}_us"] = float(np.percentile(seconds, q) * 1e6)
    for name in ("empty", "constant"):
        result[f"ratio_to_{name}"] = result["explore_p50_us"] / result[f"{name}_p50_us"]
    return result


if __name__ == "__main__":
    main()
