"""A bag for each attempt, as the controller saw it: every joint state and every command."""

import os
import threading
from pathlib import Path
from typing import Any

from misstep.robot.numbering import next_number
from misstep.robot.ros.bus import JointArrays
from misstep.robot.ros1.environment import import_ros
from misstep.robot.ros1.messages import joint_state
from misstep.storage import make_folder


class BagRecorder:
    """Writes bags into a folder; a bag under its final name is whole.

    Parameters
    ----------
    folder : path
        Made if it is not there.

    Raises
    ------
    MisstepError
        If it cannot be made.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self._folder = Path(folder)
        make_folder(self._folder)
        self._bag_type = import_ros("rosbag").Bag
        self._time = import_ros("genpy").Time.from_sec
        self._float64 = import_ros("std_msgs.msg").Float64
        self._bag: Any = None
        self._lock = threading.Lock()

    def begin(self) -> None:
        """Begin the bag of the next attempt; that of an attempt in progress ends."""
        self.end()
        number = next_number(self._folder, "attempt_*.bag*")
        self._path = self._folder / f"attempt_{number:03d}.bag"
        with self._lock:
            self._bag = self._bag_type(f"{self._path}.active", "w")

    def joints(self, topic: str, joints: JointArrays) -> None:
        """Add joint states to the attempt in progress, if there is one."""
        self._write(topic, joint_state(joints), joints.stamp)

    def effort(self, topic: str, effort: float, stamp: float) -> None:
        """Add an effort to the attempt in progress, if there is one."""
        self._write(topic, self._float64(effort), stamp)

    def end(self) -> None:
        """Close the bag and give it its name."""
        with self._lock:
            if self._bag is None:
                return
            self._bag.close()
            self._bag = None
        Path(f"{self._path}.active").rename(self._path)

    def _write(self, topic: str, message: Any, stamp: float) -> None:
        with self._lock:
            if self._bag is not None:
                self._bag.write(topic, message, self._time(max(stamp, 0.0)))
