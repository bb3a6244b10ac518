"""Which number of a JointState is which observation column.

A column ``x`` with its companion ``x_dot`` is the position and the velocity of one joint; any other
column is the position of a joint of its own name. What a joint is called on the robot can differ.
"""

from collections.abc import Mapping, Sequence

from misstep.errors import MisstepError
from misstep.robot.limits import Row
from misstep.trajectory import Column

_VELOCITY = "_dot"


class Joints:
    """Translates between observations and the arrays of a ``sensor_msgs/JointState``.

    Parameters
    ----------
    columns : sequence of n Column
        Of the observation.
    names : mapping from str to str
        What the joint of a column is called on the robot, where it is not called the same.

    Attributes
    ----------
    names : tuple of k str
        The joints, as the robot calls them.

    Raises
    ------
    MisstepError
        If there is no such column, or two joints get one name.
    """

    def __init__(self, columns: Sequence[Column], names: Mapping[str, str] | None = None) -> None:
        known = [column.name for column in columns]
        parts = [_part(name, known) for name in known]
        joints = list(dict.fromkeys(joint for joint, _ in parts))
        renamed = dict(names or {})
        for name in renamed:
            if name not in joints:
                raise MisstepError(f"no joint {name!r} to rename; there are: {', '.join(joints)}")
        self.names = tuple(renamed.get(joint, joint) for joint in joints)
        if len(set(self.names)) < len(joints):
            raise MisstepError(f"two joints have one name: {', '.join(self.names)}")
        self._places = tuple((joints.index(joint), velocity) for joint, velocity in parts)

    def arrays(self, observation: Sequence[float]) -> tuple[list[float], list[float]]:
        """Return positions (k,) and velocities (k,) for an observation (n,)."""
        positions, velocities = [0.0] * len(self.names), [0.0] * len(self.names)
        for (joint, is_velocity), value in zip(self._places, observation, strict=True):
            (velocities if is_velocity else positions)[joint] = value
        return positions, velocities

    def observation(
        self, names: Sequence[str], positions: Sequence[float], velocities: Sequence[float]
    ) -> Row:
        """Return the observation (n,) in the arrays of a message; it may name more joints.

        Raises
        ------
        MisstepError
            If a joint, its position or its velocity is missing.
        """
        values = []
        for joint, is_velocity in self._places:
            name = self.names[joint]
            array = velocities if is_velocity else positions
            if name not in names or names.index(name) >= len(array):
                what = "velocity" if is_velocity else "position"
                raise MisstepError(
                    f"a JointState has no {what} of {name}; its joints: {', '.join(names)}"
                )
            values.append(float(array[names.index(name)]))
        return tuple(values)


def _part(name: str, known: Sequence[str]) -> tuple[str, bool]:
    joint = name.removesuffix(_VELOCITY)
    return (joint, True) if joint != name and joint in known else (name, False)
