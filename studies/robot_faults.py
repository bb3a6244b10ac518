"""Two hundred faults on a robot, over a socket and in a ROS 1 graph; nothing kept is lost.

    python studies/robot_faults.py [--sockets 156] [--ros 44] [--seed 0] [--json FILE]

After each fault the actuator has to come to rest at its safe action, and everything that was on the
disk before has to be there unchanged; then the robot has to go on. The first fault that breaks any
of it ends the script with an error. With root's rights the ROS graph lives in a network of its own,
which is then cut, too. The faults are those of tests/robot_faults.py and tests/ros_faults.py.
"""

import argparse
import ctypes
import os
import signal
import sys
import tempfile
import time
from pathlib import Path

import misstep
from misstep.storage import write_json

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import robot_faults
import ros_faults

_NEW_NETWORK = 0x40000000  # CLONE_NEWNET


def main() -> None:
    """Make the faults and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sockets", type=int, default=156, help="faults over a socket")
    parser.add_argument("--ros", type=int, default=44, help="faults in a ROS 1 graph")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    # In the background of a shell interrupts are ignored, and so they would be by every node.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    results = {}
    for name, harm, n in (
        ("socket", over_sockets, options.sockets),
        ("ROS 1", in_a_graph, options.ros),
    ):
        started = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            made, kept = harm(Path(folder), n, options.seed)
        seconds = time.perf_counter() - started
        results[name] = {"faults": dict(made), "trials": kept, "seconds": round(seconds, 1)}
        print(f"{name}: {made.total()} faults, {kept} trials kept, {seconds:.0f} s")
        for way, count in made.items():
            print(f"  {way.replace('_', ' '):42} {count:3}")
    print(f"{sum(sum(r['faults'].values()) for r in results.values())} faults; nothing was lost")
    if options.json:
        write_json(options.json, results)


def over_sockets(folder: Path, n: int, seed: int):
    """Make faults over a socket."""
    system = misstep.make_system("cartpole")
    return robot_faults.harm(folder, misstep.demonstrate(system, by="weak", n=3, seed=0), n, seed)


def in_a_graph(folder: Path, n: int, seed: int):
    """Make faults in a ROS 1 graph."""
    ways = ros_faults.WAYS
    if own_network():
        ways = (*ways[:6], ros_faults.RosRobot.network_is_cut, *ways[6:])
    return ros_faults.harm_robot(
        folder, ways, n, seed, lambda way: print(f"  . {way}", file=sys.stderr, flush=True)
    )


def own_network() -> bool:
    """Move to a network namespace of its own; return whether that was allowed."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(_NEW_NETWORK) != 0:
        print(f"the network is not cut: {os.strerror(ctypes.get_errno())}", file=sys.stderr)
        return False
    ros_faults.set_loopback(True)
    return True


if __name__ == "__main__":
    main()
