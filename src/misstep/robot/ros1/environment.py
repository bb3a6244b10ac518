"""Finding ROS 1's Python packages: those of a sourced installation, or else Debian's.

Debian keeps them where a virtual environment does not look. Here only they are looked up there, by
name, so that no other package of the system can get between those of the environment.
"""

import importlib
import sys
import warnings
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Any

from misstep.errors import MisstepError

DEBIAN = "/usr/lib/python3/dist-packages"
PACKAGES = "ros-core python3-rospy python3-rosbag python3-sensor-msgs python3-std-srvs"
"""Debian packages that the nodes need."""

_ROS = {"rosbag", "roscpp", "rosgraph", "rosgraph_msgs", "roslib", "roslz4", "rospkg", "rospy"}
_MESSAGES = {"genmsg", "genpy", "geometry_msgs", "sensor_msgs", "std_msgs", "std_srvs"}
_IMPORTED = {"Cryptodome", "catkin", "catkin_pkg", "defusedxml", "distro", "gnupg", "netifaces"}
_NAMES = _ROS | _MESSAGES | _IMPORTED | {"yaml"}


class _DebianFinder:
    """Finds ROS 1 and what it imports in Debian's folder, after every other finder."""

    @classmethod
    def find_spec(
        cls, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if path is None and name in _NAMES:
            return PathFinder.find_spec(name, [DEBIAN], target)
        return None


def import_ros(name: str) -> Any:
    """Import a module of ROS 1, such as ``"rospy"`` or ``"sensor_msgs.msg"``.

    Raises
    ------
    MisstepError
        If it is not installed.
    """
    if _DebianFinder not in sys.meta_path:
        sys.meta_path.append(_DebianFinder)
    try:
        with warnings.catch_warnings():
            # Debian's own Python is older, and its ROS has escapes that 3.12 and later warn of.
            warnings.simplefilter("ignore", SyntaxWarning)
            return importlib.import_module(name)
    except ImportError as error:
        raise MisstepError(
            f"ROS 1 is not here ({error}): source its setup.bash, or on Debian 12 "
            f"`apt-get install --no-install-recommends {PACKAGES}`"
        ) from error


def init_node(name: str) -> Any:
    """Start the node of this process and return rospy; Ctrl-C stays a KeyboardInterrupt.

    Raises
    ------
    MisstepError
        If ROS 1 is not installed, or no roscore answers.
    """
    rospy = import_ros("rospy")
    rosgraph = import_ros("rosgraph")
    if not rosgraph.is_master_online():
        raise MisstepError(
            f"no roscore answers at {rosgraph.get_master_uri()}: start one, or set ROS_MASTER_URI"
        )
    rospy.init_node(name, disable_signals=True)
    return rospy
