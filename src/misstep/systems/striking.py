"""What flip-up and basket have in common: an effector strikes once, and physics does the rest.

The effector has one degree of freedom, along which its velocity is commanded. Once its stroke is
over nothing that is commanded matters any more, so the last `step` of an episode simulates what
follows up to the verdict. Every recorded pair of an observation and an action therefore belongs
to the stroke, where the action acted; a learner that conditions the velocity on the position
never sees a command that was ignored.
"""

import inspect
from abc import abstractmethod
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.parameters import check_parameters, parameter, parameter_table
from misstep.systems.simulated import LONGEST_TIME, SHORTEST_STEP, Look, Simulated, substeps
from misstep.trajectory import Column


@dataclass(frozen=True)
class StrikingParameters:
    """The effector, its servo and the clock; a task adds what it strikes.

    Raises
    ------
    MisstepError
        If a value is of the wrong type, not finite, or out of its range.
    """

    v_max: float = parameter(2.0, "m/s", "largest velocity that can be commanded", above=0)
    stop_speed: float = parameter(
        0.01, "m/s", "the stroke is over when less is commanded", at_least=0
    )
    longest_stroke: float = parameter(
        1.5, "s", "the stroke is over after this time", above=0, at_most=LONGEST_TIME
    )
    longest_wait: float = parameter(
        3.0,
        "s",
        "no verdict this long after the stroke is a failure",
        above=0,
        at_most=LONGEST_TIME,
    )
    control_rate: float = parameter(
        200.0, "Hz", "actions per second", at_least=1e-3, at_most=1 / SHORTEST_STEP
    )
    physics_step: float = parameter(
        0.001,
        "s",
        "longest step of the simulation; a control period is cut into equal ones",
        at_least=SHORTEST_STEP,
        at_most=0.002,
    )
    gravity: float = parameter(9.81, "m/s²", "downward acceleration", above=0)
    effector_mass: float = parameter(
        2.0, "kg", "mass of the effector, which gravity spares", above=0
    )
    effector_radius: float = parameter(0.01, "m", "radius of the effector, a sphere", above=0)
    effector_friction: float = parameter(
        0.2, "1", "friction coefficient of the effector", at_least=0
    )
    servo_gain: float = parameter(
        400.0, "N·s/m", "force of the effector's servo per error of its velocity", above=0
    )
    force_limit: float = parameter(400.0, "N", "largest force of the servo", above=0)

    def __post_init__(self) -> None:
        check_parameters(self, self.owner())
        if self.stop_speed >= self.v_max:
            raise MisstepError(
                f"{self.owner()}: stop_speed is {self.stop_speed:g} m/s but must be below v_max, "
                f"{self.v_max:g} m/s, or no stroke ever begins"
            )

    @classmethod
    def owner(cls) -> str:
        """Return the system's name, for messages."""
        raise NotImplementedError


class StrikingSystem(Simulated):
    """A system in which an effector strikes once along its stroke.

    A task says where an episode starts, what is observed, how far from success it is, and when
    the verdict is clear. In its docstring the line ``<action>`` stands for the table of the action,
    ``<render_mode>`` and ``<parameters>`` for the documentation of the constructor's arguments.

    Parameters
    ----------
    p : StrikingParameters
        Of the task.
    spec : mujoco.MjSpec
        The task's model, which names its joint and servo of the effector ``stroke``, ``servo``.
    render_mode : {None, "rgb_array"}

    Attributes
    ----------
    stroke : float, m
        How far the effector can go; the last action is the one that takes it there.
    """

    action_columns = (Column("velocity", "m/s"),)
    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 200}  # noqa: RUF012
    stroke: float

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        # Under `python -OO` there are no docstrings.
        if cls.__doc__ and hasattr(cls, "parameters_type"):
            cls.__doc__ = _documented(inspect.cleandoc(cls.__doc__), cls.parameters_type)

    def __init__(self, p: StrikingParameters, spec: Any, render_mode: str | None) -> None:
        super().__init__(p, spec, render_mode)
        n = len(self.observation_columns)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, shape=(n,), dtype=np.float64)
        self.action_space = gymnasium.spaces.Box(0.0, p.v_max, shape=(1,), dtype=np.float64)

        self._joints = {
            self.model.joint(i).name: int(self.model.jnt_qposadr[i]) for i in range(self.model.njnt)
        }
        self._v_max, self._stop_speed = p.v_max, p.stop_speed
        self._stroke_periods = max(1, round(p.longest_stroke * p.control_rate))
        self._wait_periods = max(1, round(p.longest_wait * p.control_rate))
        self._success = False
        self._velocity = 0.0

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
        mujoco.mj_resetData(self.model, self.data)
        self._start()
        self._t = 0
        self._velocity = 0.0
        self._over = self._success = False
        return self._observe(), {"failed": False, "success": False}

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
        velocity = self.checked_number(action, "velocity", "m/s")
        velocity = min(max(velocity, 0.0), self._v_max)
        self._t += 1
        if velocity >= self._stop_speed:
            self._velocity = velocity
            self._advance(velocity)
            self._over = self._position() >= self.stroke or self._t >= self._stroke_periods
        else:
            self._over = True
        if self._over:
            self._success = self._watch()
        info = {"failed": self._over and not self._success, "success": self._success}
        return self._observe(), -self._error(), self._over, False, info

    def _advance(self, velocity: float) -> None:
        """Simulate one control period in which the servo is told `velocity` [m/s]."""
        self.data.ctrl[0] = velocity
        mujoco.mj_step(self.model, self.data, self._substeps)
        if not np.isfinite(self.data.qpos).all():
            raise MisstepError(
                f"{self.system_id}: the simulation diverged after {self.data.time:.3f} s: set a "
                "smaller physics_step, servo_gain or force_limit"
            )

    def _coordinate(self, joint: str) -> float:
        """Return the position of a joint, m or rad."""
        return float(self.data.qpos[self._joints[joint]])

    def _rate(self, joint: str) -> float:
        """Return the velocity of a joint, m/s or rad/s."""
        # Every joint has one degree of freedom, so positions and velocities share their indices.
        return float(self.data.qvel[self._joints[joint]])

    def _position(self) -> float:
        return self._coordinate("stroke")

    @abstractmethod
    def _start(self) -> None:
        """Bring freshly reset data to the start of an episode, drawing from `np_random`."""

    @abstractmethod
    def _observe(self) -> NDArray[np.float64]:
        """Return the observation, shape (n,)."""

    @abstractmethod
    def _error(self) -> float:
        """Return the distance from success, in the unit that the class states."""

    @abstractmethod
    def _watch(self) -> bool:
        """Simulate what follows the stroke up to the verdict, and return whether it succeeded."""

    def _look(self) -> Look:
        names = [column.name for column in self.observation_columns]
        observation = dict(zip(names, self._observe().tolist(), strict=True))
        verdict = ("failure", "success")[self._success] if self._over and self._t else ""
        return Look(observation, {"velocity": self._velocity}, verdict)


_ACTION = """\
=====  ===============  ======  ========================================================
index  column           unit    meaning
=====  ===============  ======  ========================================================
0      ``velocity``     m/s     that the effector's servo is told, clipped to
                                0 .. ``v_max``
=====  ===============  ======  ========================================================"""

_RENDER_MODE = """\
render_mode : {None, "rgb_array"}
    With ``"rgb_array"``, `render` returns a picture, shape (360, 640, 3), uint8."""


def _documented(doc: str, kind: type) -> str:
    """Return a task's docstring with what is said of every task, and its table of parameters."""
    parameters = f"**parameters\n    Fields of `{kind.__name__}`:\n\n" + _parameter_rows(kind)
    for line, text in (
        ("<action>", _ACTION),
        ("<render_mode>", _RENDER_MODE),
        ("<parameters>", parameters),
    ):
        doc = doc.replace(line, text)
    return doc


def _parameter_rows(kind: type) -> str:
    """Return the table of parameters, indented as the description of an argument."""
    rows = [("name", "default", "unit", "meaning")]
    rows += [(f"``{r.name}``", str(r.default), r.unit, r.meaning) for r in parameter_table(kind)]
    widths = [max(len(row[i]) for row in rows) for i in range(4)]
    rule = "  ".join("=" * width for width in widths)
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
    return "\n".join(f"    {line}" for line in (rule, lines[0], rule, *lines[1:], rule))


def striking_spec(file: str, p: StrikingParameters) -> Any:
    """Return the `mujoco.MjSpec` of an MJCF file with the shared parameters set."""
    spec = mujoco.MjSpec.from_string(
        files("misstep.systems").joinpath(file).read_text(encoding="utf-8")
    )
    spec.option.timestep = 1.0 / (p.control_rate * substeps(p))
    spec.option.gravity = (0.0, 0.0, -p.gravity)
    effector = spec.geom("effector")
    effector.mass = p.effector_mass
    effector.size[0] = p.effector_radius
    effector.friction[0] = p.effector_friction
    servo = spec.actuator("servo")
    servo.gainprm[0], servo.biasprm[2] = p.servo_gain, -p.servo_gain
    servo.forcerange = (-p.force_limit, p.force_limit)
    return spec
