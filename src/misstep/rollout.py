"""One attempt from start to end: a policy drives a system, and a trajectory comes out."""

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.trajectory import Outcome, Provenance, Trajectory

if TYPE_CHECKING:  # a rollout needs no physics of its own, and MuJoCo is slow to load
    from misstep.systems.system import System


class Policy(Protocol):
    """A rule from what is observed to what is done.

    Deterministic unless it owns a `numpy.random.Generator`.
    """

    def reset(self) -> None:
        """Forget the attempt before; called at the start of each."""

    def __call__(self, observation: NDArray[np.float64], /) -> NDArray[np.float64]:
        """Return the action, shape (m,), for an observation, shape (n,)."""


def utc_now() -> str:
    """Return the present time in UTC, ISO 8601, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def rollout(
    system: "System", policy: Policy, *, seed: int, demonstrator: str, time: str | None = None
) -> Trajectory:
    """Run one attempt to its end and record it.

    Parameters
    ----------
    system : System
        Reset with `seed` at the start.
    policy : Policy
        Its actions are clipped to the system's action space.
    seed : int
        Same seed, same start and same sensor noise.
    demonstrator : str
        Who acts, for the provenance: ``"noisy"``, ``"learner:donut"``.
    time : str, optional
        When, ISO 8601, for the provenance alone; now if left out.

    Returns
    -------
    Trajectory
        The observations, the clipped actions, the costs (minus the rewards), and the outcome: a
        failure if the system says so at the end, a success if it says that, else unknown.

    Raises
    ------
    MisstepError
        If the policy returns an action of the wrong shape or one that is not finite.
    """
    observation, info = system.reset(seed=seed)
    policy.reset()
    observations = [observation]
    actions: list[NDArray[np.float64]] = []
    costs: list[float] = []
    failure_step = 0 if info.get("failed", False) else None
    over = False
    while not over:
        action = _sendable(system, policy(observation), len(actions))
        observation, reward, terminated, truncated, info = system.step(action)
        observations.append(observation)
        actions.append(action)
        costs.append(-float(reward))
        if failure_step is None and info.get("failed", False):
            failure_step = len(actions)
        over = terminated or truncated
    return Trajectory(
        observations=np.array(observations),
        actions=np.array(actions),
        dt=system.dt,
        observation_columns=system.observation_columns,
        action_columns=system.action_columns,
        provenance=Provenance(
            system=system.system_id,
            parameters=system.parameters,
            demonstrator=demonstrator,
            seed=seed,
            time=utc_now() if time is None else time,
        ),
        outcome=_outcome(failure_step is not None, info.get("success", False)),
        costs=np.array(costs),
        failure_step=failure_step,
    )


def _sendable(system: "System", action: NDArray[np.float64], step: int) -> NDArray[np.float64]:
    space = system.action_space
    action = np.asarray(action, dtype=np.float64)
    if action.shape != space.shape:
        raise MisstepError(
            f"the policy's action at step {step} has shape {action.shape} but {system.system_id} "
            f"takes {space.shape}"
        )
    if not np.isfinite(action).all():
        raise MisstepError(f"the policy's action at step {step} is {action}: it must be finite")
    # Two ufuncs, because np.clip takes three times as long on so small an array.
    return np.minimum(np.maximum(action, space.low), space.high)  # type: ignore[attr-defined]


def _outcome(failed: bool, success: bool) -> Outcome:
    if failed:
        return Outcome.FAILURE
    return Outcome.SUCCESS if success else Outcome.UNKNOWN
