"""ROS 2: the same nodes, topics and services as in ROS 1, with rclpy or without any ROS.

Where an installation of ROS 2 with the package misstep_ros is sourced, rclpy is used. Elsewhere, in
a plain virtual environment, a node speaks what ROS 2's Zenoh middleware (rmw_zenoh_cpp) speaks: its
key expressions, type hashes, CDR bytes and graph tokens, from rmw_zenoh's published design.

**What has been verified**: the bridge between our own processes; its bytes against rosbags' CDR;
its type hashes against published ones. Neither the bridge nor the rclpy nodes have yet been run
against a live ROS 2 graph.
"""

import importlib.util

from misstep.robot.ros.bus import Bus


def open_bus(node: str) -> Bus:
    """Join the graph of ROS 2 as a node.

    Raises
    ------
    MisstepError
        If there is neither a ROS 2 installation nor the Python package eclipse-zenoh.
    """
    if importlib.util.find_spec("rclpy") is not None:
        from misstep.robot.ros2.rclpy_bus import RclpyBus

        return RclpyBus(node)
    from misstep.robot.ros2.zenoh_bus import ZenohBus

    return ZenohBus(node)
