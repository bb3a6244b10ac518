"""Any Gymnasium environment with `Box` spaces as a system, by its id: ``gym:Pendulum-v1``.

An environment does not say what a success is: that is the user's to tell, by formulas over the
columns (`misstep.judges`). For four environments the columns, a judge and a cost are known here.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from misstep.costs import StateCost
from misstep.errors import MisstepError, reason_of
from misstep.parameters import ParameterValue, build_parameters, check_parameters, parameter
from misstep.systems.judged import Judged
from misstep.systems.simulated import LONGEST_TIME, SHORTEST_STEP
from misstep.systems.system import System
from misstep.trajectory import Column

PREFIX = "gym:"
_LONGEST = 10.0  # s, where neither the user nor the environment says how long an episode is


@dataclass(frozen=True)
class GymParameters:
    """What can be set on a `GymSystem` itself; anything else goes to the environment."""

    duration: float = parameter(
        0.0,
        "s",
        "length of an episode that does not end early; 0: the environment's",
        at_least=0,
        at_most=LONGEST_TIME,
    )
    dt: float = parameter(0.0, "s", "control period; 0: as the environment says", at_least=0)

    def __post_init__(self) -> None:
        check_parameters(self, "gym")
        if 0.0 < self.dt < SHORTEST_STEP:
            raise MisstepError(
                f"gym: dt is {self.dt:g} s but must be at least {SHORTEST_STEP:g} s, or 0"
            )


@dataclass(frozen=True)
class _Known:
    """What is known of an environment: columns as "name unit", a judge, and a cost."""

    observations: tuple[str, ...]
    actions: tuple[str, ...]
    judge: Mapping[str, str | float]
    cost: StateCost | None


_FREE = math.inf
# Actions of the two pendulums on carts go through a gear: a control of 1 is 100 N, and 500 N.
KNOWN: dict[str, _Known] = {
    # Upright to the end; the environment ends beyond 0.2 rad, and its rail at 1 m.
    "InvertedPendulum-v5": _Known(
        ("x m", "theta rad", "x_dot m/s", "theta_dot rad/s"),
        ("force 100 N",),
        {"failure": "abs(theta) > 0.2rad"},
        StateCost((0.0,) * 4, (0.5, 10.0, 0.05, 0.1), (1.0, 0.2, _FREE, _FREE)),
    ),
    # The tip, at most 1.2 m high, stays above 1 m to the end; theta_2 is relative to the first.
    "InvertedDoublePendulum-v5": _Known(
        (
            "x m",
            "sin_theta_1",
            "sin_theta_2",
            "cos_theta_1",
            "cos_theta_2",
            "x_dot m/s",
            "theta_1_dot rad/s",
            "theta_2_dot rad/s",
            "constraint_force N",
        ),
        ("force 500 N",),
        {
            "failure": "0.6 * cos_theta_1 + 0.6 * cos_theta_1 * cos_theta_2"
            " - 0.6 * sin_theta_1 * sin_theta_2 <= 1"
        },
        StateCost(
            (0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0),
            (0.5, 10.0, 10.0, 10.0, 10.0, 0.05, 0.1, 0.1, 0.0),
            (1.0, *(_FREE,) * 8),
        ),
    ),
    # Upright during the last three seconds.
    "Pendulum-v1": _Known(
        ("cos_theta", "sin_theta", "theta_dot rad/s"),
        ("torque N·m",),
        {"success": "cos_theta > cos(12deg)", "hold": 3.0},
        StateCost((1.0, 0.0, 0.0), (10.0, 10.0, 0.1), (_FREE,) * 3),
    ),
    # At the flag; the environment ends there.
    "MountainCarContinuous-v0": _Known(
        ("position", "velocity"),
        ("push",),
        {"success": "position >= 0.45"},
        StateCost((0.5, 0.0), (10.0, 0.0), (_FREE, _FREE)),
    ),
}


class GymSystem(System):
    """A Gymnasium environment with `Box` spaces, looked up by its id.

    To be judged by a `Judged` around it: by itself it never fails, and its success is to last.

    **Observation**, **action**: one row of numbers each, as float64. Columns are called ``o0``,
    ``o1``, … and ``a0``, …, without a unit, but for these:

    =============================  ===========================================================
    id                             columns
    =============================  ===========================================================
    ``InvertedPendulum-v5``        ``x`` [m], ``theta`` [rad], ``x_dot`` [m/s], ``theta_dot``
                                   [rad/s]; ``force`` [100 N]
    ``InvertedDoublePendulum-v5``  ``x`` [m], ``sin_theta_1``, ``sin_theta_2``,
                                   ``cos_theta_1``, ``cos_theta_2``, ``x_dot`` [m/s],
                                   ``theta_1_dot``, ``theta_2_dot`` [rad/s],
                                   ``constraint_force`` [N]; ``force`` [500 N]; angle 2 is
                                   relative to pole 1
    ``Pendulum-v1``                ``cos_theta``, ``sin_theta``, ``theta_dot`` [rad/s];
                                   ``torque`` [N·m]
    ``MountainCarContinuous-v0``   ``position``, ``velocity`` (a step); ``push``
    =============================  ===========================================================

    **Judge** where the user names none:

    =============================  ===========================================================
    id                             default
    =============================  ===========================================================
    ``InvertedPendulum-v5``        never ``abs(theta) > 0.2rad``
    ``InvertedDoublePendulum-v5``  the tip of the second pole never at or below 1 m
    ``Pendulum-v1``                ``cos_theta > cos(12deg)`` during the last 3 s
    ``MountainCarContinuous-v0``   ``position >= 0.45`` in the end
    =============================  ===========================================================

    **Reward**: the environment's.

    **End**: *terminated* when the environment says so; *truncated* when ``duration`` is over.

    **Info**: the environment's, with ``failed``, false, and ``success`` (bool): ``duration`` is
    over.

    Parameters
    ----------
    env_id : str
        Such as ``"Pendulum-v1"``, of an installed package.
    render_mode : str, optional
        One of the environment's.
    **parameters
        Fields of `GymParameters`, and whatever the environment itself takes:

        ============  =======  ====  ====================================================
        name          default  unit  meaning
        ============  =======  ====  ====================================================
        ``duration``  0.0      s     length of an episode; 0: the environment's, or 10 s
        ``dt``        0.0      s     control period; 0: as the environment says
        ============  =======  ====  ====================================================

    Attributes
    ----------
    default_judge : mapping
        What `Judged` takes where the user names no judge; empty if nothing is known here.

    Raises
    ------
    MisstepError
        If there is no such environment, it cannot be made, its spaces are not rows of numbers, or
        nobody says what its control period is.
    """

    parameters_type = GymParameters

    def __init__(
        self, env_id: str, render_mode: str | None = None, **parameters: ParameterValue
    ) -> None:
        self.system_id = PREFIX + env_id  # type: ignore[misc]
        names = GymParameters.__dataclass_fields__
        own = {name: parameters.pop(name) for name in list(parameters) if name in names}
        p = build_parameters(GymParameters, self.system_id, own)
        self._env = _make(env_id, render_mode, parameters)
        self.render_mode = render_mode
        self.metadata = self._env.metadata
        self._over = True
        self._t = 0
        try:
            self._describe(env_id, p, parameters)
        except MisstepError:
            self.close()
            raise

    def _describe(
        self, env_id: str, p: GymParameters, parameters: Mapping[str, ParameterValue]
    ) -> None:
        """Tell the clock, the spaces, the columns and what else is known of the environment."""
        self.dt = p.dt or _control_period(self._env, self.system_id)
        self._n_steps = _n_steps(p.duration, self.dt, env_id)
        if self._n_steps < 1:
            raise MisstepError(
                f"{self.system_id}: duration is {p.duration:g} s, shorter than one control period "
                f"of {self.dt:g} s"
            )
        self.parameters = {"duration": self._n_steps * self.dt, "dt": self.dt, **parameters}

        observations = _box(self._env.observation_space, "observations", self.system_id)
        actions = _box(self._env.action_space, "actions", self.system_id)
        self.observation_space, self.action_space = observations, actions
        self._action_type = self._env.action_space.dtype
        n, m = len(observations.low), len(actions.low)
        known = KNOWN.get(env_id)
        # Parameters of an environment can change what it observes.
        if known is None or (len(known.observations), len(known.actions)) != (n, m):
            known = _Known(_numbered("o", n), _numbered("a", m), {}, None)
        self.observation_columns = _columns(known.observations)
        self.action_columns = _columns(known.actions)
        self.default_judge = known.judge
        self.cost = known.cost

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """Start an episode; the arguments are the environment's."""
        super().reset(seed=seed)
        observation, info = self._env.reset(seed=seed, options=options)
        self._over = False
        self._t = 0
        return np.array(observation, np.float64), {**info, "failed": False, "success": False}

    def step(
        self, action: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """Apply one action for one control period; see the class for what is returned.

        Raises
        ------
        MisstepError
            If the episode is over, or the action has the wrong shape or is not finite.
        """
        if self._over:
            raise self.no_episode()
        action = np.asarray(action)
        if action.shape != self.action_space.shape or not np.isfinite(action).all():
            raise MisstepError(
                f"{self.system_id}: the action is {action}, but finite numbers of shape "
                f"{self.action_space.shape} are wanted"
            )
        observation, reward, terminated, truncated, info = self._env.step(
            action.astype(self._action_type)
        )
        self._t += 1
        lasted = self._t >= self._n_steps
        self._over = bool(terminated or truncated or lasted)
        info = {**info, "failed": False, "success": lasted and not terminated}
        return (
            np.array(observation, np.float64),
            float(reward),
            bool(terminated),
            bool(truncated) or lasted,
            info,
        )

    def render(self) -> Any:
        """Return what the environment renders."""
        return self._env.render()

    def close(self) -> None:
        """Close the environment."""
        self._env.close()


def make_gym_system(name: str, judge: Mapping[str, Any], parameters: Mapping[str, Any]) -> Judged:
    """Build the environment ``gym:ID``, judged as said or as is known of it.

    Parameters
    ----------
    name : str
        ``"gym:"`` and the id.
    judge : mapping
        What `Judged` takes; without success and failure the default is taken where there is one.
    parameters : mapping
        What `GymSystem` takes.

    Raises
    ------
    MisstepError
        As `GymSystem` and `Judged`; and if nobody says what a success or a failure is.
    """
    system = GymSystem(name.removeprefix(PREFIX), **parameters)
    try:
        return Judged(system, **_complete(judge, system))
    except MisstepError:
        system.close()
        raise


def _complete(judge: Mapping[str, Any], system: GymSystem) -> dict[str, Any]:
    """Return what to judge by: the default where neither success nor failure is told."""
    if "success" in judge or "failure" in judge:
        return dict(judge)
    if not system.default_judge:
        listed = ", ".join(column.name for column in system.observation_columns)
        raise MisstepError(
            f"{system.system_id} does not say what it is to succeed or to fail: give success or "
            f"failure, a condition on the columns {listed}"
        )
    return {**system.default_judge, **judge}


def _make(env_id: str, render_mode: str | None, parameters: Mapping[str, Any]) -> Any:
    # Gymnasium would import the module before the colon, and an id may come out of a file.
    if ":" in env_id or not env_id:
        raise MisstepError(
            f"{env_id!r} is no id of a Gymnasium environment; one is, for example, Pendulum-v1"
        )
    try:
        # No limit: the adapter counts the steps itself.
        return gymnasium.make(
            env_id,
            render_mode=render_mode,
            max_episode_steps=-1,
            disable_env_checker=True,
            **parameters,
        )
    except Exception as error:  # whatever somebody else's code makes of parameters that are wrong
        raise MisstepError(f"gym:{env_id} cannot be made: {reason_of(error)}") from error


def _control_period(env: Any, name: str) -> float:
    dt = getattr(env.unwrapped, "dt", None)
    fps = env.metadata.get("render_fps")
    if dt is None and fps:
        dt = 1.0 / fps
    if not isinstance(dt, int | float | np.floating) or not 0 < dt < math.inf:
        raise MisstepError(f"{name} does not say what its control period is: give dt, in s")
    return float(dt)


def _n_steps(duration: float, dt: float, env_id: str) -> int:
    if duration:
        return round(duration / dt)
    return gymnasium.spec(env_id).max_episode_steps or round(_LONGEST / dt)


def _box(space: Any, what: str, name: str) -> Any:
    if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1 or not space.shape[0]:
        raise MisstepError(
            f"{name} has {what} in {space}, but a Box of one row of real numbers is wanted"
        )
    return gymnasium.spaces.Box(
        space.low.astype(np.float64), space.high.astype(np.float64), dtype=np.float64
    )


def _numbered(letter: str, count: int) -> tuple[str, ...]:
    return tuple(f"{letter}{i}" for i in range(count))


def _columns(texts: tuple[str, ...]) -> tuple[Column, ...]:
    return tuple(Column(name, unit) for name, _, unit in (text.partition(" ") for text in texts))
