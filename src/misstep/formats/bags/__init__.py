"""Bags of ROS 1 and ROS 2, through rosbags, without ROS.

Reading: columns are places in messages, `misstep.formats.bags.places`; observations and actions can
be named with ``ReadOptions``. Unless they are, positions and velocities of
``sensor_msgs/JointState`` (and the poses of ``nav_msgs/Odometry`` and their kind) are the
observations, and commands (``std_msgs/Float64``, ``geometry_msgs/Twist`` ...) the actions. Message
types come from the bag, so those that nobody else knows will do. Messages are brought to one
clock, `misstep.formats.bags.clock`: the times at which those of the first observation's topic were
received, or a given rate.

A bag is one episode, unless misstep wrote it, or ``ReadOptions.episode`` says where to cut: at
every change of a field of a topic, or after a pause.

Writing: observations go to ``/joint_states``, ``x_dot`` as the velocity of ``x``; each action to a
``std_msgs/Float64`` topic of its own, such as ``/force/command``. Episodes follow one another, a
second apart. What ROS has no place for stands in messages on ``/misstep`` before and after each
episode; costs on ``/misstep/cost``. Times are whole nanoseconds.
"""

from misstep.formats.bags.reading import read
from misstep.formats.bags.topics import recognise
from misstep.formats.bags.writing import write_mcap, write_ros1, write_ros2
from misstep.formats.format import Format

ROS1 = Format("ROS 1 bag", (".bag",), read, write_ros1, extra="ros")
ROS2 = Format(
    "ROS 2 bag, a folder (SQLite; reads MCAP too)",
    (".ros2",),
    read,
    write_ros2,
    is_folder=True,
    recognise=recognise,
    extra="ros",
)
MCAP = Format("ROS 2 bag, one MCAP file", (".mcap",), read, write_mcap, extra="ros")
DB3 = Format("ROS 2 bag, one SQLite file", (".db3",), read, None, extra="ros")
