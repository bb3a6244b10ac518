"""A pole on a cart on a rail, simulated with MuJoCo: the system of the paper."""

import math
from collections import deque
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, ClassVar

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from misstep.costs import StateCost
from misstep.errors import MisstepError
from misstep.parameters import ParameterValue, build_parameters, check_parameters, parameter
from misstep.systems.mechanics import Mechanics
from misstep.systems.simulated import LONGEST_TIME, SHORTEST_STEP, Look, Simulated, substeps
from misstep.trajectory import Column

# The pole's inertia about its own axis, as a share of the one across it. The hinge never turns
# about that axis; MuJoCo merely wants a positive number.
_AXIAL_INERTIA = 1e-3

# A critically damped stop still throws the cart back with e⁻² = 14 % of its speed, because it can
# push but not pull; three times that damping leaves 2 %.
_STOP_DAMPING_RATIO = 3.0


@dataclass(frozen=True)
class CartPoleParameters:
    """What can be set on a `CartPole`; units and meanings are in its fields and its docstring.

    Raises
    ------
    MisstepError
        If a value is of the wrong type, not finite, or out of its range.
    """

    cart_mass: float = parameter(1.0, "kg", "mass of the cart", above=0)
    pole_mass: float = parameter(0.1, "kg", "mass of the pole", above=0)
    half_length: float = parameter(0.5, "m", "from the hinge to the pole's centre of mass", above=0)
    pole_inertia: float = parameter(
        0.0,
        "kg·m²",
        "inertia of the pole about its centre of mass; 0: that of a uniform thin rod",
        at_least=0,
    )
    hinge_damping: float = parameter(
        0.002, "N·m·s/rad", "viscous friction in the hinge", at_least=0
    )
    cart_damping: float = parameter(0.1, "N·s/m", "viscous friction on the rail", at_least=0)
    gravity: float = parameter(9.81, "m/s²", "downward acceleration", at_least=0)
    rail: float = parameter(1000.0, "m", "from the middle of the rail to each stop", above=0)
    force_limit: float = parameter(
        20.0, "N", "largest force on the cart, to either side", above=0, at_most=1e6
    )
    control_rate: float = parameter(
        50.0, "Hz", "actions per second", at_least=1e-3, at_most=1 / SHORTEST_STEP
    )
    physics_step: float = parameter(
        0.01, "s", "longest step of the simulation", at_least=SHORTEST_STEP
    )
    duration: float = parameter(
        30.0, "s", "length of an episode that does not end early", above=0, at_most=LONGEST_TIME
    )
    start_angle: float = parameter(0.0, "rad", "mean angle at the start")
    start_spread: float = parameter(
        0.05, "rad", "standard deviation of the angle at the start", at_least=0
    )
    fall_angle_deg: float = parameter(
        30.0, "deg", "the pole has fallen beyond this angle", above=0, at_most=180
    )
    track_limit: float = parameter(
        0.0,
        "m",
        "the cart has left the track beyond this distance from its middle; 0: never",
        at_least=0,
    )
    stop_at_fall: bool = parameter(True, "", "end the episode at a failure")
    upright_time: float = parameter(
        0.0, "s", "success is to be upright this long at the end; 0: to last", at_least=0
    )
    upright_angle_deg: float = parameter(
        12.0, "deg", "the pole is upright within this angle", above=0, at_most=180
    )
    delay: float = parameter(
        0.0, "s", "from an action to its force on the cart", at_least=0, at_most=60
    )
    position_noise: float = parameter(
        0.0, "m", "standard deviation of the noise on x as observed", at_least=0
    )
    velocity_noise: float = parameter(
        0.0, "m/s", "standard deviation of the noise on x_dot as observed", at_least=0
    )
    angle_noise: float = parameter(
        0.0, "rad", "standard deviation of the noise on theta as observed", at_least=0
    )
    angular_velocity_noise: float = parameter(
        0.0, "rad/s", "standard deviation of the noise on theta_dot as observed", at_least=0
    )

    owner: ClassVar[str] = "cartpole"

    def __post_init__(self) -> None:
        check_parameters(self, self.owner)
        if self.duration * self.control_rate < 1:
            raise MisstepError(
                f"{self.owner}: duration is {self.duration:g} s, shorter than one control period "
                f"of {1 / self.control_rate:g} s"
            )
        if self.upright_time > self.duration:
            raise MisstepError(
                f"{self.owner}: upright_time is {self.upright_time:g} s but must be at most the "
                f"duration, {self.duration:g} s"
            )
        timestep, longest = 1.0 / (self.control_rate * substeps(self)), 1.0 / _fastest_rate(self)
        if timestep > longest:
            raise MisstepError(
                f"{self.owner}: physics_step is {self.physics_step:g} s, too long to simulate how "
                f"fast these masses, lengths and frictions move: it must be at most {longest:.2g} s"
            )


class CartPole(Simulated):
    """Keep a pole upright by pushing the cart that it is hinged to.

    The hinge swings all the way round; the rail ends in stops that the cart does not bounce off.

    **Observation**, ``Box(4,)``, float64

    =====  =============  ======  ==========================================================
    index  column         unit    meaning
    =====  =============  ======  ==========================================================
    0      ``x``          m       position of the cart, 0 in the middle of the rail
    1      ``x_dot``      m/s     velocity of the cart
    2      ``theta``      rad     angle of the pole, 0 upright, positive leans to +x,
                                  wrapped to (-π, π]
    3      ``theta_dot``  rad/s   angular velocity of the pole
    =====  =============  ======  ==========================================================

    **Action**, ``Box(1,)``, float64

    =====  =============  ======  ==========================================================
    index  column         unit    meaning
    =====  =============  ======  ==========================================================
    0      ``force``      N       horizontal force on the cart, clipped to ±``force_limit``
    =====  =============  ======  ==========================================================

    **Reward**: ``-|theta|`` in degrees, of the true state after the step. The mean of the cost
    over an episode is the paper's C = (1/T) Σ |θ|.

    **Start**: at rest in the middle of the rail, theta drawn from a normal distribution with mean
    ``start_angle`` and standard deviation ``start_spread``.

    **Failure**: the true ``|theta|`` exceeds ``fall_angle_deg`` (180: never), or the true ``|x|``
    exceeds ``track_limit`` (0: never).

    **Success**: ``duration`` is over without a failure, and ``|theta|`` was below
    ``upright_angle_deg`` during the whole last ``upright_time`` (0: whatever it was).

    **End**: *terminated* at a failure if ``stop_at_fall`` is set; *truncated* when ``duration`` is
    over. Without ``stop_at_fall`` the pole goes on swinging after its fall, as in the paper.

    **Info**

    - ``failed`` (bool): there has been a failure in this episode, or ``duration`` is over without
      success;
    - ``success`` (bool): as above;
    - ``timed_out`` (bool, from `step` only): failed for no other reason than that ``duration`` is
      over without success;
    - ``force`` (float, N, from `step` only): force on the cart at the end of the step, after
      clipping and delay;
    - ``state`` (ndarray, shape (4,), only if an observation is noisy): the true state.

    Parameters
    ----------
    render_mode : {None, "rgb_array"}
        With ``"rgb_array"``, `render` returns a picture, shape (360, 640, 3), uint8.
    **parameters
        Fields of `CartPoleParameters`:

        ==========================  =======  =========  =====================================
        name                        default  unit       meaning
        ==========================  =======  =========  =====================================
        ``cart_mass``               1.0      kg         mass of the cart
        ``pole_mass``               0.1      kg         mass of the pole
        ``half_length``             0.5      m          from hinge to the pole's centre of mass
        ``pole_inertia``            0.0      kg·m²      of the pole about its centre of mass; 0:
                                                        that of a uniform thin rod
        ``hinge_damping``           0.002    N·m·s/rad  viscous friction in the hinge
        ``cart_damping``            0.1      N·s/m      viscous friction on the rail
        ``gravity``                 9.81     m/s²       downward acceleration
        ``rail``                    1000.0   m          from the middle to each stop; so long by
                                                        default that it never matters
        ``force_limit``             20.0     N          largest force, to either side
        ``control_rate``            50.0     Hz         actions per second
        ``physics_step``            0.01     s          longest step of the simulation; the
                                                        control period is cut into equal ones
        ``duration``                30.0     s          length of an episode
        ``start_angle``             0.0      rad        mean angle at the start
        ``start_spread``            0.05     rad        its standard deviation
        ``fall_angle_deg``          30.0     deg        the pole has fallen beyond this angle
        ``track_limit``             0.0      m          the cart has left the track beyond this
                                                        distance from its middle; 0: never
        ``stop_at_fall``            True                end the episode at a failure
        ``upright_time``            0.0      s          success is to be upright this long at
                                                        the end; 0: to last
        ``upright_angle_deg``       12.0     deg        the pole is upright within this angle
        ``delay``                   0.0      s          from an action to its force, rounded
                                                        to steps of the simulation
        ``position_noise``          0.0      m          sensor noise, standard deviation
        ``velocity_noise``          0.0      m/s        sensor noise, standard deviation
        ``angle_noise``             0.0      rad        sensor noise, standard deviation
        ``angular_velocity_noise``  0.0      rad/s      sensor noise, standard deviation
        ==========================  =======  =========  =====================================

    Raises
    ------
    MisstepError
        If there is no such parameter, or its value is of the wrong type or out of range.

    Notes
    -----
    Equations of motion, with m the mass of the pole, M that of the cart, l ``half_length``, and
    I ``pole_inertia``, which is m l²/3 for a uniform thin rod:

    - (M + m) ẍ + m l (θ̈ cos θ − θ̇² sin θ) = F − ``cart_damping`` ẋ
    - (I + m l²) θ̈ + m l ẍ cos θ − m g l sin θ = −``hinge_damping`` θ̇

    **Version history**

    - v1 (``misstep/CartPole-v1``): first version. ``track_limit``, ``upright_time``,
      ``upright_angle_deg`` and ``pole_inertia`` came later; their defaults change nothing.
    """

    system_id: ClassVar[str] = "cartpole"
    typed_only: ClassVar[frozenset[str] | None] = frozenset()
    parameters_type: ClassVar[type[CartPoleParameters]] = CartPoleParameters
    observation_columns = (
        Column("x", "m"),
        Column("x_dot", "m/s"),
        Column("theta", "rad"),
        Column("theta_dot", "rad/s"),
    )
    action_columns = (Column("force", "N"),)
    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None, **parameters: ParameterValue) -> None:
        p = build_parameters(self.parameters_type, self.system_id, parameters)
        super().__init__(p, cartpole_spec(p), render_mode)
        bound = np.array([np.inf, np.inf, np.pi, np.inf])
        self.observation_space = gymnasium.spaces.Box(-bound, bound, dtype=np.float64)
        limit = p.force_limit
        self.action_space = gymnasium.spaces.Box(-limit, limit, shape=(1,), dtype=np.float64)

        # Upright and near the middle; weights in 1/m², s²/m², 1, s².
        limits = (min(p.rail, p.track_limit or math.inf), math.inf, math.inf, math.inf)
        self.cost = StateCost((0.0, 0.0, 0.0, 0.0), (0.5, 0.05, 10.0, 0.1), limits)
        self._force_limit = limit
        self._fall_angle = math.radians(p.fall_angle_deg)
        self._track_limit = p.track_limit or math.inf
        self._stop_at_fall = p.stop_at_fall
        self._upright_angle = math.radians(p.upright_angle_deg)
        self._upright_steps = round(p.upright_time * p.control_rate)
        self._start = (p.start_angle, p.start_spread)
        self._n_steps = round(p.duration * p.control_rate)
        noise = (p.position_noise, p.velocity_noise, p.angle_noise, p.angular_velocity_noise)
        self._noise = np.array(noise) if any(noise) else None

        # Views into MuJoCo's memory, kept because asking for them takes longer than a step.
        self._qpos, self._qvel, self._ctrl = self.data.qpos, self.data.qvel, self.data.ctrl

        self._timestep = float(self.model.opt.timestep)
        delay_substeps = round(p.delay / self._timestep)
        # A delay of w whole control periods and r further substeps: the force changes after the
        # first r substeps of a control period, to that of the action w periods ago.
        self._delay_periods, self._late_substeps = divmod(delay_substeps, self._substeps)
        self._pending: deque[float] = deque()
        self._force = 0.0
        self._failed = False
        self._held = 0

    @property
    def state(self) -> NDArray[np.float64]:
        """True state, shape (4,): x [m], x_dot [m/s], theta [rad], theta_dot [rad/s]."""
        return np.array(self._true_state())

    def set_state(self, x: float, x_dot: float, theta: float, theta_dot: float) -> None:
        """Start an episode at a given state, in m, m/s, rad, rad/s.

        Raises
        ------
        MisstepError
            If a value is not finite.
        """
        values = (x, x_dot, theta, theta_dot)
        if not all(map(math.isfinite, values)):
            raise MisstepError(
                f"{self.system_id}: the state {values} holds a number that is not finite"
            )
        mujoco.mj_resetData(self.model, self.data)
        self._qpos[:] = x, theta
        self._qvel[:] = x_dot, theta_dot
        self._pending = deque([0.0] * self._delay_periods)
        self._force = 0.0
        self._t = 0
        self._failed = self._is_failure(x, wrap_angle(theta))
        self._held = -1
        self._hold(wrap_angle(theta))
        self._over = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """Start an episode; see the class for where.

        Parameters
        ----------
        seed : int, optional
            Makes this and the following episodes repeatable.
        options : dict, optional
            Not used.
        """
        super().reset(seed=seed)
        mean, spread = self._start
        self.set_state(0.0, 0.0, mean + spread * self.np_random.standard_normal(), 0.0)
        observation, true_state, _, _ = self._observe()
        return observation, {"failed": self._failed, "success": False, **true_state}

    def step(
        self, action: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """Apply one action for one control period; see the class for what is returned.

        Raises
        ------
        MisstepError
            If the episode is over, the action has the wrong shape or is not finite, or the
            simulation diverges.
        """
        if self._over:
            raise self.no_episode()
        force = self.checked_number(action, "force", "N")
        self._advance(min(max(force, -self._force_limit), self._force_limit))
        self._t += 1

        observation, true_state, x, theta = self._observe()
        self._failed = self._failed or self._is_failure(x, theta)
        self._hold(theta)
        terminated = self._failed and self._stop_at_fall
        truncated = self._t >= self._n_steps
        self._over = terminated or truncated
        lasted = truncated and not self._failed
        success = lasted and self._held >= self._upright_steps
        info = {
            "failed": self._failed or (lasted and not success),
            "success": success,
            "timed_out": lasted and not success,
            "force": self._force,
            **true_state,
        }
        return observation, -math.degrees(abs(theta)), terminated, truncated, info

    def _is_failure(self, x: float, theta: float) -> bool:
        return abs(theta) > self._fall_angle or abs(x) > self._track_limit

    def _hold(self, theta: float) -> None:
        """Count the control periods for which the pole has been upright, from 0 to now."""
        upright = self._upright_steps == 0 or abs(theta) < self._upright_angle
        self._held = self._held + 1 if upright else -1

    def _advance(self, force: float) -> None:
        """Simulate one control period in which the action `force` [N] is sent."""
        self._pending.append(force)
        late = self._late_substeps
        if late:
            mujoco.mj_step(self.model, self.data, late)
        self._force = self._ctrl[0] = self._pending.popleft()
        mujoco.mj_step(self.model, self.data, self._substeps - late)

    def _true_state(self) -> tuple[float, float, float, float]:
        (x, theta), (x_dot, theta_dot) = self._qpos.tolist(), self._qvel.tolist()
        # Beyond half a turn a step the simulation means nothing, and soon it is no number any more.
        if not (math.isfinite(x + x_dot) and abs(theta_dot) * self._timestep < math.pi):
            raise MisstepError(
                f"{self.system_id}: after {self._t * self.dt:.2f} s the pole turns at "
                f"{theta_dot:.3g} rad/s, too fast for a physics_step of {self._timestep:g} s: set "
                "a smaller physics_step or force_limit"
            )
        return x, x_dot, wrap_angle(theta), theta_dot

    def _observe(self) -> tuple[NDArray[np.float64], dict[str, Any], float, float]:
        """Return what the sensors show, the true state as an info if they are noisy, x, theta."""
        values = self._true_state()
        x, _, theta, _ = values
        state = np.array(values)
        if self._noise is None:
            return state, {}, x, theta
        observation = state + self._noise * self.np_random.standard_normal(4)
        observation[2] = wrap_angle(float(observation[2]))
        return observation, {"state": state}, x, theta

    def mechanics(self, **parameters: ParameterValue) -> Mechanics:
        """Return the two joints, the rail's and the hinge, and their forces.

        Parameters
        ----------
        **parameters
            Where they are to differ from the system's own.

        Raises
        ------
        MisstepError
            If there is no such parameter, or its value is of the wrong type or out of range.
        """
        changed = {**self.parameters, **parameters}
        p = build_parameters(self.parameters_type, self.system_id, changed)
        inertia = p.pole_mass * p.half_length**2
        typical = {
            "half_length": p.half_length,
            "pole_mass": p.pole_mass,
            "pole_inertia": inertia / 3.0,
            "gravity": 9.81,
            # What brakes a swing within about ten periods.
            "hinge_damping": 0.1 * inertia * math.sqrt(9.81 / p.half_length),
        }
        return Mechanics(
            cartpole_spec(p).compile(), ("x", "theta"), ("x_dot", "theta_dot"), typical, p.delay
        )

    def _look(self) -> Look:
        x, _, theta, _ = self._true_state()
        return Look({"x": x, "theta": theta}, {"force": self._force})


def cartpole_spec(p: CartPoleParameters) -> Any:
    """Return the cart-pole's model with the parameters set, an uncompiled `mujoco.MjSpec`."""
    spec = mujoco.MjSpec.from_string(
        files("misstep.systems").joinpath("cartpole.xml").read_text(encoding="utf-8")
    )
    # Measured without damping over 10 s at the default step, the energy (0.5 J) drifts by 4e-8 J
    # with RK4 (the XML's choice); implicitfast at 2 ms drifts by 4e-3 J and takes longer.
    timestep = 1.0 / (p.control_rate * substeps(p))
    spec.option.timestep = timestep
    spec.option.gravity = (0.0, 0.0, -p.gravity)

    spec.body("cart").mass = p.cart_mass
    pole = spec.body("pole")
    across = _inertia_across(p)
    pole.mass = p.pole_mass
    pole.ipos = (0.0, 0.0, p.half_length)
    pole.inertia = (across, across, _AXIAL_INERTIA * across)

    slide = spec.joint("slide")
    slide.range = (-p.rail, p.rail)
    slide.solref_limit = (2.0 * timestep, _STOP_DAMPING_RATIO)  # as stiff as the step allows
    slide.damping[0] = p.cart_damping
    spec.joint("hinge").damping[0] = p.hinge_damping
    return spec


def wrap_angle(angle: float) -> float:
    """Return the angle [rad] in (-π, π] that points the same way."""
    wrapped = math.remainder(angle, 2.0 * math.pi)
    return wrapped if wrapped > -math.pi else math.pi


def _inertia_across(p: CartPoleParameters) -> float:
    """Return the pole's inertia [kg·m²] about its centre of mass, across its length."""
    return p.pole_inertia or p.pole_mass * (p.half_length * p.half_length) / 3.0


def _fastest_rate(p: CartPoleParameters) -> float:
    """Return the fastest rate [1/s] at which the pole swings or friction brakes, near upright."""
    total, coupling = p.cart_mass + p.pole_mass, p.pole_mass * p.half_length
    about_hinge = _inertia_across(p) + coupling * p.half_length
    inertia = np.array([[total, coupling], [coupling, about_hinge]])
    if not 0.0 < total * about_hinge - coupling * coupling < math.inf:
        raise MisstepError(
            f"{p.owner}: masses of {p.cart_mass:g} and {p.pole_mass:g} kg and a half length of "
            f"{p.half_length:g} m are too far apart to reckon with"
        )
    braking = np.linalg.solve(inertia, np.diag([p.cart_damping, p.hinge_damping]))
    swinging = np.linalg.solve(inertia, np.diag([0.0, p.gravity * coupling]))
    if not (np.isfinite(braking).all() and np.isfinite(swinging).all()):
        raise MisstepError(
            f"{p.owner}: damping of {p.cart_damping:g} N s/m and {p.hinge_damping:g} N m s/rad or "
            f"a gravity of {p.gravity:g} m/s² is too strong for such small masses"
        )
    fastest_swing = np.sqrt(np.abs(np.linalg.eigvals(swinging)).max())
    return float(max(np.abs(np.linalg.eigvals(braking)).max(), fastest_swing, 1e-9))
