"""Which forces make a system move as it moved: its MuJoCo model run backwards.

A simulation goes from forces to accelerations; `mj_inverse` goes from accelerations to the forces
at the joints. At a joint with a motor that is the action. At a joint without one nothing may be
left: what is left there is how far the model is from what was recorded.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Mechanics:
    """A system's joints, and the forces that move them.

    Every joint slides along or turns about one axis, so positions and velocities are as many. Stops
    at the ends of joints are left out: against a stop a force moves nothing, and cannot be told
    from the motion.

    Parameters
    ----------
    model : mujoco.MjModel
        Changed: its joint limits are disabled.
    positions, velocities : tuple of str, length k
        The observation columns that are the joints' positions [m or rad] and velocities, in the
        order of the model's joints.
    typical : mapping from str to float
        Parameters of the system that the equations of the joints without a motor contain, each
        with a typical size in its unit; not 0 where the parameter is.
    delay : float, s
        From an action to its force.

    Attributes
    ----------
    turns : ndarray of bool, shape (k,)
        Which joints turn.
    stops : ndarray, shape (k, 2), m or rad
        Ends of each joint's range; infinite where it has none.
    free : ndarray of int
        Indices of the joints without a motor.

    Raises
    ------
    MisstepError
        If a joint has more than one axis, or an actuator is no plain motor on one joint.
    """

    model: mujoco.MjModel
    positions: tuple[str, ...]
    velocities: tuple[str, ...]
    typical: Mapping[str, float] = field(default_factory=dict)
    delay: float = 0.0

    def __post_init__(self) -> None:
        model = self.model
        if not len(self.positions) == len(self.velocities) == model.nv == model.nq:
            raise MisstepError(
                f"the model has {model.nq} positions and {model.nv} velocities, but "
                f"{len(self.positions)} and {len(self.velocities)} columns are named for them"
            )
        motors = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (
            model.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED
        )
        if not motors.all() or (model.actuator_biastype != mujoco.mjtBias.mjBIAS_NONE).any():
            raise MisstepError("inverse dynamics needs actuators that are plain motors on a joint")
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT

    @property
    def turns(self) -> NDArray[np.bool_]:
        """Which joints turn, shape (k,)."""
        turns: NDArray[np.bool_] = self.model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
        return turns

    @property
    def stops(self) -> Array:
        """Ends of each joint's range [m or rad], shape (k, 2); infinite where it has none."""
        limited = self.model.jnt_limited.astype(bool)[:, None]
        return np.where(limited, self.model.jnt_range, [-np.inf, np.inf])

    @property
    def transmission(self) -> Array:
        """Force at each joint per unit of each action, shape (k, m)."""
        model = self.model
        matrix = np.zeros((model.nv, model.nu))
        joints = model.actuator_trnid[:, 0]
        matrix[joints, np.arange(model.nu)] = (
            model.actuator_gear[:, 0] * model.actuator_gainprm[:, 0]
        )
        return matrix

    @property
    def free(self) -> NDArray[np.int64]:
        """Indices of the joints without a motor."""
        return np.flatnonzero(~self.transmission.any(axis=1))

    def inverse(self, positions: Array, velocities: Array, accelerations: Array) -> Array:
        """Return the forces at the joints that explain a motion, friction and gravity apart.

        Parameters
        ----------
        positions, velocities, accelerations : ndarray, shape (T, k)
            In m or rad, and per s and s².

        Returns
        -------
        forces : ndarray, shape (T, k), N or N·m
        """
        forces: Array = np.empty_like(accelerations)
        for t, data in enumerate(self._solved(positions, velocities, accelerations)):
            forces[t] = data.qfrc_inverse
        return forces

    def actions(self, forces: Array) -> Array:
        """Return the actions (T, m) that make forces (T, k) at the joints, by least squares."""
        actions = np.linalg.lstsq(self.transmission, forces.T, rcond=None)[0].T
        return np.asarray(actions, dtype=np.float64)

    def free_accelerations(
        self, positions: Array, velocities: Array, accelerations: Array
    ) -> Array:
        """Return how the joints without a motor should accelerate, given how the others do.

        Parameters
        ----------
        positions, velocities, accelerations : ndarray, shape (T, k)

        Returns
        -------
        expected : ndarray, shape (T, f), m/s² or rad/s²
            For each of `free`; equal to the accelerations there if no force acts on them.
        """
        free = self.free
        inertias = np.empty((len(positions), self.model.nv, self.model.nv))
        forces = np.empty((len(positions), len(free)))
        for t, data in enumerate(self._solved(positions, velocities, accelerations)):
            mujoco.mj_fullM(self.model, data, inertias[t])
            forces[t] = data.qfrc_inverse[free]
        coupled = inertias[:, free[:, None], free]
        excess = np.linalg.solve(coupled, forces[..., None])[..., 0]
        expected: Array = accelerations[:, free] - excess
        return expected

    def _solved(
        self, positions: Array, velocities: Array, accelerations: Array
    ) -> Iterator[mujoco.MjData]:
        """Yield MuJoCo's data, the same for every row, after inverse dynamics."""
        model, data = self.model, mujoco.MjData(self.model)
        qpos, qvel, qacc = data.qpos, data.qvel, data.qacc
        for position, velocity, acceleration in zip(
            positions, velocities, accelerations, strict=True
        ):
            qpos[:], qvel[:], qacc[:] = position, velocity, acceleration
            mujoco.mj_inverse(model, data)
            yield data
