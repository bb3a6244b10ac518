"""A trial that happens elsewhere: it is told state by state, judged and recorded here.

The judging is that of `misstep.systems.Judged`, applied to a system whose steps are reported by a
robot instead of computed, so that a trial is judged alike wherever it is made.
"""

from array import array
from typing import Any

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.learning import Proposal
from misstep.robot.guard import State
from misstep.robot.limits import Row
from misstep.rollout import utc_now
from misstep.systems import Judged, System
from misstep.trajectory import Outcome, Provenance, Trajectory

_JUDGES = ("success", "failure", "hold", "cost")


class Reported(System):
    """A system whose states come from elsewhere; `state` is the one that `step` will return.

    **Info**: ``failed`` and ``success`` as the robot says them. Where `lasting` is set, an episode
    that reaches its full length is a success too.

    Parameters
    ----------
    system : System
        What the robot is described by; only described, never driven.
    n_steps : int
        Control periods of an episode at the most.
    lasting : bool
        Whether to last is to succeed.
    """

    def __init__(self, system: System, n_steps: int, lasting: bool) -> None:
        self._take_after(system)
        self.state: State | None = None
        self._n_steps, self._lasting, self._t = n_steps, lasting, 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """Start an episode at `state`."""
        self._t = 0
        state = self._reported()
        return np.array(state.observation), {"failed": state.failed}

    def step(
        self, action: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """Return `state` and what the robot says of it."""
        self._t += 1
        state = self._reported()
        lasted = self._t >= self._n_steps
        reward = 0.0 if state.cost is None else -state.cost
        success = state.succeeded or (lasted and self._lasting and not state.failed)
        info = {"failed": state.failed, "success": success}
        return np.array(state.observation), reward, state.over, lasted, info

    def _reported(self) -> State:
        if self.state is None:
            raise MisstepError(f"{self.system_id}: no state has been reported yet")
        return self.state


class ReportedTrial:
    """One trial on a robot: judges each state and records each exchange.

    Parameters
    ----------
    system : System
        What the robot is described by. If it is `Judged`, by its judges; else by what the robot
        says alone.
    proposal : Proposal
        What is tried.
    n_steps : int
        Control periods at the most.

    Attributes
    ----------
    proposal : Proposal
    over : bool
        Whether the last state ended the trial.
    """

    def __init__(self, system: System, proposal: Proposal, n_steps: int) -> None:
        self.proposal = proposal
        self.over = False
        self._parameters = system.parameters
        judges: dict[str, Any] = {}
        if isinstance(system, Judged):
            judges = {key: system.parameters[key] for key in _JUDGES if key in system.parameters}
        lasting = "failure" in judges and "success" not in judges
        self._reported = Reported(system, n_steps, lasting)
        self._system: System = Judged(self._reported, **judges) if judges else self._reported
        self._take = self._judge if judges else self._believe
        self._has_cost = "cost" in judges
        self._observations = np.zeros((n_steps + 1, len(system.observation_columns)))
        self._actions, self._costs = array("d"), np.zeros(n_steps)  # row by row
        self._m = len(system.action_columns)
        self._n_observations = 0
        self._n_steps = n_steps
        self._costs_known = True
        self._failure_step: int | None = None
        self._success = False

    @property
    def is_under_way(self) -> bool:
        """Whether there has been a state."""
        return self._n_observations > 0

    @property
    def n_steps(self) -> int:
        """Actions so far that were followed by a state."""
        return max(self._n_observations - 1, 0)

    def observe(self, state: State, observation: NDArray[np.float64]) -> None:
        """Judge and record a state, and its observation as an array, (n,).

        Raises
        ------
        MisstepError
            If the cost of it is not finite.
        """
        t = self._n_observations
        self._observations[t] = observation
        if self._take(state, t) and self._failure_step is None:
            self._failure_step = t
        self._n_observations = t + 1

    def act(self, action: Row) -> None:
        """Record what was sent in answer to the state observed last."""
        self._actions.extend(action)

    def mark(self, outcome: Outcome) -> None:
        """Let a person say what became of the trial, which ends it at the state observed last."""
        self.over = True
        self._success = outcome is Outcome.SUCCESS
        if outcome is Outcome.FAILURE:
            if self._failure_step is None:
                self._failure_step = self.n_steps
        else:
            self._failure_step = None

    def _believe(self, state: State, t: int) -> bool:
        """Take what the robot says of a state for the truth; return whether it has failed."""
        if t > 0:
            if state.cost is None:
                self._costs_known = False
            else:
                self._costs[t - 1] = state.cost
            self._success = state.succeeded
            self.over = state.over or t >= self._n_steps
        return state.failed

    def _judge(self, state: State, t: int) -> bool:
        """Judge a state by formulas and by what the robot says; return whether it has failed."""
        self._reported.state = state
        if t == 0:
            _, info = self._system.reset()
        else:
            action = np.array(self._actions[(t - 1) * self._m : t * self._m])
            _, reward, terminated, truncated, info = self._system.step(action)
            self._costs[t - 1] = -float(reward)
            self._costs_known &= self._has_cost or state.cost is not None
            self.over = terminated or truncated
            self._success = bool(info["success"])
        return bool(info["failed"])

    def trajectory(self) -> Trajectory:
        """Return the trial, at least one step long."""
        n = self.n_steps
        if self._failure_step is not None:
            outcome = Outcome.FAILURE
        else:
            outcome = Outcome.SUCCESS if self._success else Outcome.UNKNOWN
        return Trajectory(
            observations=self._observations[: n + 1],
            actions=np.array(self._actions[: n * self._m]).reshape(n, self._m),
            dt=self._reported.dt,
            observation_columns=self._reported.observation_columns,
            action_columns=self._reported.action_columns,
            provenance=Provenance(
                system=self._reported.system_id,
                parameters=self._parameters,
                demonstrator=self.proposal.demonstrator,
                seed=self.proposal.seed,
                time=utc_now(),
            ),
            outcome=outcome,
            costs=self._costs[:n] if self._costs_known else None,
            failure_step=self._failure_step,
        )
