"""What reading and writing bags have in common: the library, and misstep's own topics."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from misstep.errors import MisstepError

ANNOTATIONS, COST = "/misstep", "/misstep/cost"


def installed() -> None:
    """Make sure that rosbags is installed.

    Raises
    ------
    MisstepError
        If it is not; it says how to get it.
    """
    try:
        import rosbags.highlevel  # noqa: F401
    except ImportError as error:
        raise MisstepError("bags need rosbags: pip install 'misstep[ros]'") from error


@contextmanager
def library_errors(what: str) -> Iterator[None]:
    """Tell in one line whatever rosbags raises over a damaged bag."""
    try:
        yield
    except (MisstepError, GeneratorExit):
        raise
    except Exception as error:  # assertions, struct.error, KeyError ...: it expects no damage
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MisstepError(f"{what} cannot be read ({reason[:300]})") from error


def recognise(path: Path) -> bool:
    """Say whether a folder is a bag of ROS 2."""
    metadata = path / "metadata.yaml"
    try:
        with open(metadata, "rb") as file:
            return b"rosbag2_bagfile_information" in file.read(4096)
    except OSError:
        return False
