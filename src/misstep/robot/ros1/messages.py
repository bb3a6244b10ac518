"""ROS 1's messages, from and to plain numbers."""

from typing import Any

from misstep.robot.ros.bus import JointArrays
from misstep.robot.ros1.environment import import_ros


def joint_state(joints: JointArrays) -> Any:
    """Return a ``sensor_msgs/JointState``."""
    message = import_ros("sensor_msgs.msg").JointState()
    message.header.stamp = import_ros("genpy").Time.from_sec(joints.stamp)
    message.name, message.position = joints.names, joints.positions
    message.velocity, message.effort = joints.velocities, joints.efforts
    return message


def joint_arrays(message: Any) -> JointArrays:
    """Return what a ``sensor_msgs/JointState`` says."""
    stamp = message.header.stamp.to_sec()
    return JointArrays(stamp, message.name, message.position, message.velocity, message.effort)
