"""What reading and writing bags have in common."""

from pathlib import Path

from misstep.errors import MisstepError
from misstep.storage import check_regular

ANNOTATIONS, COST = "/misstep", "/misstep/cost"
"""misstep's own topics."""


def recognise(path: Path) -> bool:
    """Say whether a folder is a bag of ROS 2."""
    metadata = path / "metadata.yaml"
    try:
        check_regular(metadata)
        with open(metadata, "rb") as file:
            return b"rosbag2_bagfile_information" in file.read(4096)
    except (MisstepError, OSError):
        return False
