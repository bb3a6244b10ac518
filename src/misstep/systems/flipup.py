"""A block over a table's edge, to be struck upright: Grollman & Billard's first task."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.parameters import ParameterValue, build_parameters, parameter
from misstep.systems.striking import StrikingParameters, StrikingSystem, striking_spec
from misstep.trajectory import Column

_GAP = 0.001  # m, between the effector and the block at the start
_EASING = 0.05  # s, time constant with which the retracting effector comes to rest

# The block rests when its centre and its corners have been slower than this for that long.
_REST_SPEED = 0.005  # m/s
_REST_TIME = 0.2  # s


@dataclass(frozen=True)
class FlipUpParameters(StrikingParameters):
    """What can be set on a `FlipUp`; units and meanings are in its fields and its docstring.

    Raises
    ------
    MisstepError
        If a value is of the wrong type, not finite, or out of its range, or the block would fall
        off or be missed.
    """

    v_max: float = parameter(1.5, "m/s", "largest velocity that can be commanded", above=0)
    stroke: float = parameter(0.05, "m", "how far the effector goes up", above=0)
    retract_speed: float = parameter(
        0.3, "m/s", "how fast the effector goes back after the stroke", above=0
    )
    effector_offset: float = parameter(0.03, "m", "from the table's edge to the effector", above=0)
    block_length: float = parameter(0.12, "m", "length of the block as it lies", above=0)
    block_height: float = parameter(0.06, "m", "height of the block as it lies", above=0)
    block_depth: float = parameter(0.06, "m", "depth of the block", above=0)
    block_mass: float = parameter(0.2, "kg", "mass of the block, uniform", above=0)
    overhang: float = parameter(0.042, "m", "how far the block reaches over the edge", above=0)
    table_friction: float = parameter(
        0.9, "1", "friction coefficient of block and table", at_least=0
    )
    upright_angle_deg: float = parameter(
        3.0, "deg", "the block stands within this angle of upright", above=0, at_most=45
    )
    upright_time: float = parameter(1.0, "s", "success is to stand this long", above=0)
    start_spread: float = parameter(
        0.0, "m", "standard deviation of the block's place at the start", at_least=0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.overhang >= 0.5 * self.block_length:
            raise MisstepError(
                f"flipup: overhang is {self.overhang:g} m, but must be below half of block_length, "
                f"{0.5 * self.block_length:g} m, or the block falls off the table"
            )
        if not self.effector_radius < self.effector_offset < self.overhang:
            raise MisstepError(
                f"flipup: effector_offset is {self.effector_offset:g} m, but must lie between "
                f"effector_radius, {self.effector_radius:g} m, and overhang, {self.overhang:g} m, "
                "or the effector strikes the table or misses the block"
            )
        if self.upright_time >= self.longest_wait:
            raise MisstepError(
                f"flipup: upright_time is {self.upright_time:g} s, but must be below longest_wait, "
                f"{self.longest_wait:g} s"
            )

    @classmethod
    def owner(cls) -> str:
        """Return the system's name, for messages."""
        return FlipUp.system_id


class FlipUp(StrikingSystem):
    """Strike a block that lies over a table's edge, from below, so that it stands up and stays.

    Struck too slowly it falls back, too fast it tips over. The effector moves on a vertical line
    beyond the edge, and its velocity is commanded.

    **Observation**, ``Box(6,)``, float64

    =====  ===============  ======  ========================================================
    index  column           unit    meaning
    =====  ===============  ======  ========================================================
    0      ``position``     m       of the effector along its stroke, 0 at the start, up
    1      ``velocity``     m/s     of the effector, up
    2      ``block_angle``  rad     0 as it lies, π/2 upright, π when it has tipped over
    3      ``block_rate``   rad/s   angular velocity of the block
    4      ``block_x``      m       of the block's centre, 0 at the table's edge, positive
                                    beyond it
    5      ``block_z``      m       of the block's centre, 0 at the table's top
    =====  ===============  ======  ========================================================

    **Action**, ``Box(1,)``, float64

    <action>

    **Reward**: minus the angle between the block and upright, in degrees, after the step. That of
    the last step is the verdict's: 0 to ``upright_angle_deg`` for a success, near 90 for a failure.

    **Start**: the block lies at rest, ``overhang`` beyond the edge; its place is drawn from a
    normal distribution with standard deviation ``start_spread``, cut off at two of them. The
    effector is at rest 1 mm below it.

    **End**: the stroke is over when the effector has gone ``stroke``, less than ``stop_speed`` is
    commanded, or ``longest_stroke`` has passed. From then on the effector retracts, whatever is
    commanded. The last `step` simulates on up to the verdict and returns the observation there,
    *terminated*: every action of an episode belongs to its stroke. Nothing is ever *truncated*.
    The last observation is therefore up to ``longest_wait`` later than one control period.

    **Info**

    - ``success`` (bool): the block has stood within ``upright_angle_deg`` of upright for
      ``upright_time``;
    - ``failed`` (bool): the verdict is that it has not: it rests otherwise, or ``longest_wait``
      is over.

    Parameters
    ----------
    <render_mode>
    <parameters>

    Raises
    ------
    MisstepError
        If there is no such parameter, or its value is of the wrong type or out of range.

    Notes
    -----
    Where two bodies touch, MuJoCo takes the larger of their friction coefficients.

    With a velocity that rises from A/4 to A by a smoothstep over the first 35 % of the stroke, the
    block stands for 21 % of the speeds A in 0 .. ``v_max``: without a gap from 0.92 to 1.09 m/s,
    with gaps from 0.85 to 1.12 m/s, because where the block is only just lifted over its edge, or
    only just caught by it, it rocks and a trifle decides. Below the band it falls back. Above it
    tips over, except for some speeds of 1.21 to 1.33 m/s, at which it lands on its far edge and
    rocks back. Other starts and rises of the velocity move all this by 0.07 m/s at most.

    The task, not its dimensions, is that of D. H. Grollman and A. Billard, "Donut as I do:
    learning from failed demonstrations", ICRA 2011.

    **Version history**

    - v1 (``misstep/FlipUp-v1``): first version.
    """

    system_id: ClassVar[str] = "flipup"
    typed_only: ClassVar[frozenset[str] | None] = frozenset()
    parameters_type: ClassVar[type] = FlipUpParameters
    observation_columns = (
        Column("position", "m"),
        Column("velocity", "m/s"),
        Column("block_angle", "rad"),
        Column("block_rate", "rad/s"),
        Column("block_x", "m"),
        Column("block_z", "m"),
    )

    def __init__(self, render_mode: str | None = None, **parameters: ParameterValue) -> None:
        p = build_parameters(FlipUpParameters, self.system_id, parameters)
        super().__init__(p, flipup_spec(p), render_mode)
        self.stroke = p.stroke
        self._retract_speed = p.retract_speed
        self._upright_angle = math.radians(p.upright_angle_deg)
        self._upright_periods = max(1, round(p.upright_time * p.control_rate))
        self._rest_periods = max(1, round(_REST_TIME * p.control_rate))
        self._reach = 0.5 * math.hypot(p.block_length, p.block_height)
        self._lying = (p.overhang - 0.5 * p.block_length, 0.5 * p.block_height)
        self._start_spread = p.start_spread

    def _start(self) -> None:
        x, z = self._lying
        shift = min(max(self.np_random.standard_normal(), -2.0), 2.0)
        self.data.qpos[self._joints["block_x"]] = x + self._start_spread * shift
        self.data.qpos[self._joints["block_z"]] = z

    def _observe(self) -> NDArray[np.float64]:
        return np.array(
            [
                self._position(),
                self._rate("stroke"),
                self._coordinate("block_angle"),
                self._rate("block_angle"),
                self._coordinate("block_x"),
                self._coordinate("block_z"),
            ]
        )

    def _tilt(self) -> float:
        """Return the angle between the block and upright, rad."""
        return abs(self._coordinate("block_angle") - 0.5 * math.pi)

    def _error(self) -> float:
        return math.degrees(self._tilt())

    def _watch(self) -> bool:
        upright = resting = 0
        for _ in range(self._wait_periods):
            self._advance(-min(self._retract_speed, max(self._position(), 0.0) / _EASING))
            upright = upright + 1 if self._tilt() < self._upright_angle else 0
            resting = resting + 1 if self._speed() < _REST_SPEED else 0
            if upright >= self._upright_periods:
                return True
            if resting >= self._rest_periods and not upright:
                return False
        return False

    def _speed(self) -> float:
        """Return a bound on the speed of every point of the block, m/s."""
        turning = self._reach * abs(self._rate("block_angle"))
        return turning + math.hypot(self._rate("block_x"), self._rate("block_z"))


def start_height(p: FlipUpParameters) -> float:
    """Return the height of the effector's centre above the table's top at the start, m."""
    return -p.effector_radius - _GAP


def flipup_spec(p: FlipUpParameters) -> Any:
    """Return the model with the parameters set, an uncompiled `mujoco.MjSpec`."""
    spec = striking_spec("flipup.xml", p)
    block = spec.geom("block")
    block.size = (0.5 * p.block_length, 0.5 * p.block_depth, 0.5 * p.block_height)
    block.mass = p.block_mass
    for name in ("block", "table"):
        spec.geom(name).friction[0] = p.table_friction
    spec.body("effector").pos = (p.effector_offset, 0.0, start_height(p))
    return spec
