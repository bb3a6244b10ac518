"""A catapult that throws a ball into a basket: Grollman & Billard's second task."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.parameters import ParameterValue, build_parameters, parameter
from misstep.systems.striking import StrikingParameters, StrikingSystem, striking_spec
from misstep.trajectory import Column

_GAP = 0.001  # m, between the effector and the lever at the start; left at the end of the stroke
_ARM_RADIUS = 0.006  # m, as in the MJCF
_CUP_HALF_THICKNESS = 0.003  # m, as in the MJCF
_CUP_HALF_WIDTH = 0.024  # m, between the lips, as in the MJCF
_ARM_END = 0.85  # the effector strikes the arm at this share of its length
_SETTLING = 0.1  # s, before an episode: lever and ball come to rest
_TOUCH = 0.004  # m, nearer than this to the floor the ball is on it


@dataclass(frozen=True)
class BasketParameters(StrikingParameters):
    """What can be set on a `Basket`; units and meanings are in its fields and its docstring.

    Raises
    ------
    MisstepError
        If a value is of the wrong type, not finite, or out of its range, or the ball does not fit
        the basket.
    """

    effector_radius: float = parameter(0.012, "m", "radius of the effector, a sphere", above=0)
    effector_offset: float = parameter(0.12, "m", "from the pivot to the effector's line", above=0)
    pivot_height: float = parameter(0.25, "m", "height of the lever's pivot", above=0)
    ball_arm: float = parameter(0.3, "m", "from the pivot to the cup", above=0)
    bend_deg: float = parameter(
        20.0, "deg", "how far the arm of the cup is bent up", at_least=0, at_most=60
    )
    swing_deg: float = parameter(
        25.0, "deg", "the lever swings this far to either side", above=0, at_most=60
    )
    hinge_damping: float = parameter(
        0.002, "N·m·s/rad", "viscous friction in the pivot", at_least=0
    )
    struck_arm_mass: float = parameter(0.05, "kg", "mass of the arm that is struck", above=0)
    ball_arm_mass: float = parameter(0.08, "kg", "mass of the arm of the cup", above=0)
    ball_radius: float = parameter(0.02, "m", "radius of the ball", above=0)
    ball_mass: float = parameter(0.05, "kg", "mass of the ball", above=0)
    ball_friction: float = parameter(0.6, "1", "friction coefficient of the ball", at_least=0)
    basket_distance: float = parameter(0.8, "m", "from the pivot to the basket's centre", above=0)
    basket_half_width: float = parameter(0.1, "m", "from the basket's centre to a wall", above=0)
    basket_height: float = parameter(0.08, "m", "height of the basket's walls", above=0)
    inside_time: float = parameter(0.3, "s", "success is to stay inside this long", above=0)
    start_spread: float = parameter(
        0.0, "m", "spread of the ball's place in the cup at the start", at_least=0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        room = min(_CUP_HALF_WIDTH, self.basket_half_width)
        if self.ball_radius >= room:
            raise MisstepError(
                f"basket: ball_radius is {self.ball_radius:g} m, but must be below {room:g} m, or "
                "the ball does not fit the cup and the basket"
            )
        if self.inside_time >= self.longest_wait:
            raise MisstepError(
                f"basket: inside_time is {self.inside_time:g} s, but must be below longest_wait, "
                f"{self.longest_wait:g} s"
            )
        lowest = self.ball_arm * math.sin(math.radians(self.swing_deg - self.bend_deg))
        if self.pivot_height <= lowest + self.effector_radius:
            raise MisstepError(
                f"basket: pivot_height is {self.pivot_height:g} m, but must be above "
                f"{lowest + self.effector_radius:.3g} m, or the cup strikes the floor"
            )

    @classmethod
    def owner(cls) -> str:
        """Return the system's name, for messages."""
        return Basket.system_id


class Basket(StrikingSystem):
    """Strike a catapult so that the ball in its cup flies into a basket.

    Struck too slowly the ball falls short, too fast it flies past. The effector moves on a vertical
    line above the lever's short arm, and its downward velocity is commanded.

    **Observation**, ``Box(5,)``, float64

    =====  ===============  ======  ========================================================
    index  column           unit    meaning
    =====  ===============  ======  ========================================================
    0      ``position``     m       of the effector along its stroke, 0 at the start, down
    1      ``velocity``     m/s     of the effector, down
    2      ``lever_angle``  rad     0 when the struck arm is level, positive when it is down
    3      ``ball_x``       m       of the ball's centre, 0 at the pivot, towards the basket
    4      ``ball_z``       m       of the ball's centre, 0 on the floor
    =====  ===============  ======  ========================================================

    **Action**, ``Box(1,)``, float64

    <action>

    **Reward**: minus the horizontal distance between the ball and the basket's centre, in m, after
    the step. That of the last step is the error of the landing.

    **Start**: everything at rest, the cup down and the ball at its outer lip; the effector is 1 mm
    above the lever. With ``start_spread`` the ball starts farther in, by the absolute value of a
    normal draw with that standard deviation, at most as far as the inner lip.

    **End**: the stroke is over when the effector has pressed the lever to 1 mm before its stop,
    less than ``stop_speed`` is commanded, or ``longest_stroke`` has passed. From then on the
    effector stands still, whatever is commanded. The last `step` simulates on up to the verdict
    and returns the observation there, *terminated*: every action of an episode belongs to its
    stroke. Nothing is ever *truncated*.
    The last observation is therefore up to ``longest_wait`` later than one control period.

    **Info**

    - ``success`` (bool): the ball has been inside the basket, below its rim, for ``inside_time``;
    - ``failed`` (bool): the verdict is that it has not: it has touched the floor elsewhere, or
      ``longest_wait`` is over.

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
    Where two bodies touch, MuJoCo takes the larger of their friction coefficients. The arm that is
    struck is longer than ``effector_offset`` by a factor of 1 / 0.85.

    With a velocity that rises from A/4 to A by a smoothstep over the first 35 % of the stroke, the
    ball ends in the basket for A from 1.21 to 1.35 m/s, and for single speeds from 1.15 m/s on, at
    which it bounces in from the rim. Other starts and rises of the velocity and places of the ball
    in the cup give bands within 1.15 to 1.39 m/s. Slower throws fall short, faster ones fly past.

    The task, not its dimensions, is that of D. H. Grollman and A. Billard, "Donut as I do:
    learning from failed demonstrations", ICRA 2011.

    **Version history**

    - v1 (``misstep/Basket-v1``): first version.
    """

    system_id: ClassVar[str] = "basket"
    typed_only: ClassVar[frozenset[str] | None] = frozenset()
    parameters_type: ClassVar[type] = BasketParameters
    observation_columns = (
        Column("position", "m"),
        Column("velocity", "m/s"),
        Column("lever_angle", "rad"),
        Column("ball_x", "m"),
        Column("ball_z", "m"),
    )

    def __init__(self, render_mode: str | None = None, **parameters: ParameterValue) -> None:
        p = build_parameters(BasketParameters, self.system_id, parameters)
        super().__init__(p, basket_spec(p), render_mode)
        self.stroke = stroke_length(p)
        self._swing = math.radians(p.swing_deg)
        self._ball_radius = p.ball_radius
        self._basket = (p.basket_distance, p.basket_half_width, p.basket_height)
        self._inside_periods = max(1, round(p.inside_time * p.control_rate))
        self._settling_periods = max(1, round(_SETTLING * p.control_rate))
        self._start_spread = p.start_spread

    def _start(self) -> None:
        self.data.qpos[self._joints["lever"]] = -self._swing
        mujoco.mj_kinematics(self.model, self.data)
        cup = self.data.body("cup")
        slack = _CUP_HALF_WIDTH - self._ball_radius
        above = _CUP_HALF_THICKNESS + self._ball_radius
        self._move_ball(cup.xpos + cup.xmat.reshape(3, 3) @ (-slack, 0.0, above))
        for _ in range(self._settling_periods):
            self._advance(0.0)
        inward = min(abs(self.np_random.standard_normal()) * self._start_spread, 2.0 * slack)
        ball = self.data.body("ball").xpos
        self._move_ball(ball + cup.xmat.reshape(3, 3) @ (inward, 0.0, 0.0))

    def _move_ball(self, place: NDArray[np.float64]) -> None:
        self.data.qpos[self._joints["ball_x"]] = place[0]
        self.data.qpos[self._joints["ball_z"]] = place[2]

    def _observe(self) -> NDArray[np.float64]:
        return np.array(
            [
                self._position(),
                self._rate("stroke"),
                self._coordinate("lever"),
                self._coordinate("ball_x"),
                self._coordinate("ball_z"),
            ]
        )

    def _error(self) -> float:
        return abs(self._coordinate("ball_x") - self._basket[0])

    def _watch(self) -> bool:
        _, half_width, height = self._basket
        inside = 0
        for _ in range(self._wait_periods):
            self._advance(0.0)
            z = self._coordinate("ball_z")
            between_walls = self._error() < half_width
            inside = inside + 1 if between_walls and z < height else 0
            if inside >= self._inside_periods:
                return True
            if not between_walls and z < self._ball_radius + _TOUCH:
                return False
        return False


def struck_arm_length(p: BasketParameters) -> float:
    """Return the length of the arm that the effector strikes, m."""
    return p.effector_offset / _ARM_END


def start_height(p: BasketParameters) -> float:
    """Return the height of the effector's centre above the pivot at the start, m."""
    slope = math.radians(p.swing_deg)
    touching = p.effector_offset * math.tan(slope)
    return touching + (p.effector_radius + _ARM_RADIUS) / math.cos(slope) + _GAP


def stroke_length(p: BasketParameters) -> float:
    """Return how far down the effector goes, m: to 1 mm before the lever's stop."""
    slope = math.radians(p.swing_deg)
    end = (p.effector_radius + _ARM_RADIUS) / math.cos(slope) - p.effector_offset * math.tan(slope)
    return start_height(p) - end - _GAP


def basket_spec(p: BasketParameters) -> Any:
    """Return the model with the parameters set, an uncompiled `mujoco.MjSpec`."""
    spec = striking_spec("basket.xml", p)
    swing, bend = math.radians(p.swing_deg), math.radians(p.bend_deg)
    spec.body("lever").pos = (0.0, 0.0, p.pivot_height)
    hinge = spec.joint("lever")
    hinge.range = (-swing, swing)
    hinge.damping[0] = p.hinge_damping

    struck, holding = spec.geom("struck_arm"), spec.geom("ball_arm")
    struck.mass, holding.mass = p.struck_arm_mass, p.ball_arm_mass
    struck.fromto = (0.0, 0.0, 0.0, struck_arm_length(p), 0.0, 0.0)
    end = (-p.ball_arm * math.cos(bend), 0.0, p.ball_arm * math.sin(bend))
    holding.fromto = (0.0, 0.0, 0.0, *end)
    cup = spec.body("cup")
    cup.pos = end
    cup.quat = (math.cos(0.5 * bend), 0.0, math.sin(0.5 * bend), 0.0)  # about +y

    ball = spec.geom("ball")
    ball.size[0], ball.mass = p.ball_radius, p.ball_mass
    ball.friction[0] = p.ball_friction
    spec.body("effector").pos = (p.effector_offset, 0.0, p.pivot_height + start_height(p))
    _set_walls(spec, p)
    return spec


def _set_walls(spec: Any, p: BasketParameters) -> None:
    spec.body("basket").pos = (p.basket_distance, 0.0, 0.0)
    half_height = 0.5 * p.basket_height
    width, thickness = p.basket_half_width, spec.geom("near_wall").size[0]
    for name, side in (("near_wall", -1), ("far_wall", 1)):
        wall = spec.geom(name)
        wall.pos = (side * width, 0.0, half_height)
        wall.size = (thickness, width, half_height)
    for name, side in (("left_wall", 1), ("right_wall", -1)):
        wall = spec.geom(name)
        wall.pos = (0.0, side * width, half_height)
        wall.size = (width, thickness, half_height)
