"""Where each attempt went wrong, from the recordings alone.

Three things are found for every trajectory:

- its *danger*: how much of the actuators' strength it took to save it from each state, by plans
  tried in a model learned from all attempts (`misstep.blame.recovery`). From the point of no return
  on it is 1;
- where the demonstrators *disagree*, and where an action *departs* from what worked elsewhere
  (`misstep.blame.agreement`).

The blame of a step joins them as independent causes, of which only a failure that is certain weighs
fully:

    blame = 1 − (1 − danger) (1 − 0.3 departure) (1 − 0.1 disagreement)
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from misstep.blame.actions import ActionLimits, action_limits
from misstep.blame.agreement import Agreement, find_agreement
from misstep.blame.boundary import leapt
from misstep.blame.faults import Fault, find_departure, find_fault
from misstep.blame.growth import growth_dangers
from misstep.blame.recovery import Recovery
from misstep.errors import MisstepError
from misstep.trajectory import Dataset, Outcome, Trajectory

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]
"""``report(done, total)``."""

DEPARTURE_SHARE = 0.3
DISAGREEMENT_SHARE = 0.1

PLANS = "plans tried in a model learned from all attempts"
GROWTH = "how failures grew in all attempts"


@dataclass(frozen=True)
class Blame:
    """Where one trajectory went wrong.

    Parameters
    ----------
    point_of_no_return : float or None, s
        Time of the last observation from which the failure could still be avoided, 0 if there is
        none; None where it is not known, or the attempt did not fail.
    danger : ndarray, shape (T + 1,), or None
        Share of the strongest action that it took to avoid the failure from each observation, from
        0 to 1; 1 past the point of no return. None where it is not known.
    disagreement, departure : ndarray, shape (T,)
        Of the demonstrators at each state, and of each action from what worked elsewhere; 0 to 1.
    blame : ndarray, shape (T,)
        0 to 1.
    fault : Fault or None
        What was wrong with the actions before the point of no return.
    method : str
        How the point of no return was found, or why it was not.
    sentence : str
        All of it in words: ``"recoverable until 2.14 s; from 1.90 s the force pushed the wrong
        way"``.
    """

    point_of_no_return: float | None
    danger: Array | None
    disagreement: Array
    departure: Array
    blame: Array
    fault: Fault | None
    method: str
    sentence: str


def find_blame(
    dataset: Dataset,
    *,
    limits: ActionLimits | None = None,
    seed: int = 0,
    progress: Progress = lambda done, total: None,
) -> tuple[Blame, ...]:
    """Find where each trajectory of a data set went wrong.

    Parameters
    ----------
    dataset : Dataset
    limits : ActionLimits, optional
        How strongly the system can be acted on; by `action_limits` if left out.
    seed : int
        Of the fits. Same seed, same result.
    progress : callable
        ``progress(done, total)`` is called with the trajectories done.

    Returns
    -------
    blames : tuple of Blame
        One a trajectory.

    Raises
    ------
    MisstepError
        If an action never varies.
    """
    rng = np.random.default_rng(seed)
    progress(0, len(dataset))
    limits = action_limits(dataset) if limits is None else limits
    recovery, reason = _learned(dataset, limits, rng)
    grown, leaps = growth_dangers(dataset), leapt(dataset)
    found = []
    for i, trajectory in enumerate(dataset):
        late = _timed_out(i, dataset)
        found.append(_danger(trajectory, i, recovery, reason, grown[i], late, leaps[i]))
        progress(i, len(dataset))
    worth = [_worth(t, f.danger) for t, f in zip(dataset, found, strict=True)]
    agreements = find_agreement(dataset, worth, rng)
    progress(len(dataset), len(dataset))
    return tuple(_blame(*parts, recovery) for parts in zip(dataset, found, agreements, strict=True))


@dataclass(frozen=True)
class _Found:
    """The danger of one trajectory and how it was found."""

    danger: Array | None
    method: str


def _learned(
    dataset: Dataset, limits: ActionLimits, rng: np.random.Generator
) -> tuple[Recovery | None, str]:
    """Return what plans can be tried in, or None and why there is nothing."""
    if not any(t.failure_step for t in dataset):
        return None, "nobody said when an attempt failed; `misstep mark` does"
    try:
        return Recovery.learn(dataset, limits, rng), ""
    except MisstepError as error:
        return None, str(error)


def _danger(
    trajectory: Trajectory,
    index: int,
    recovery: Recovery | None,
    reason: str,
    grown: Array | None,
    timed_out: bool,
    leap: bool,
) -> _Found:
    if recovery is None:
        return _Found(None, reason)
    failed = trajectory.failure_step
    if failed is None:
        if trajectory.outcome is Outcome.FAILURE:
            return _Found(None, "nobody said when it failed; `misstep mark` does")
        if not any(recovery.boundary.told):
            return _Found(None, "the failures are not ones of leaving a range")
        return _Found(recovery.danger(trajectory.observations), PLANS)
    if failed == 0:
        return _Found(np.ones(trajectory.n_steps + 1), "it failed at its start")
    if recovery.boundary.told[index]:
        return _Found(
            _until(failed, recovery.danger(trajectory.observations[:failed]), trajectory), PLANS
        )
    if leap:
        return _Found(None, "it came in one leap that nothing before it announces")
    if timed_out:
        return _Found(None, "it ended in time, in a state like others before it")
    if grown is None:
        return _Found(None, "its states do not announce the failure")
    return _Found(_until(failed, grown[:failed], trajectory), GROWTH)


def _until(failed: int, danger: Array, trajectory: Trajectory) -> Array:
    """Return the danger of all observations: past the failure it is 1."""
    return np.concatenate([danger, np.ones(trajectory.n_steps + 1 - failed)])


def _timed_out(index: int, dataset: Dataset) -> bool:
    """Whether a trajectory failed where the longest ones end, which is what time-outs do."""
    trajectory = dataset[index]
    longest = max(t.n_steps for t in dataset)
    return trajectory.failure_step == trajectory.n_steps == longest and (
        len(dataset) == 1 or sum(t.n_steps == longest for t in dataset) > 1
    )


def _worth(trajectory: Trajectory, danger: Array | None) -> Array:
    """Return how good an example each step is: a success is, and a failure while it was safe."""
    if trajectory.outcome is Outcome.SUCCESS or danger is None:
        return np.ones(trajectory.n_steps)
    worth: Array = 1.0 - danger[1:]
    return worth


def _blame(
    trajectory: Trajectory, found: _Found, agreement: Agreement, recovery: Recovery | None
) -> Blame:
    danger = found.danger
    certain = np.zeros(trajectory.n_steps) if danger is None else danger[:-1]
    left = 1.0 - DEPARTURE_SHARE * agreement.departure
    blame = 1.0 - (1.0 - certain) * left * (1.0 - DISAGREEMENT_SHARE * agreement.disagreement)
    lost, fault = None, None
    if danger is not None and trajectory.failure_step is not None:
        recoverable = np.flatnonzero(danger[: trajectory.failure_step] < 1.0)
        lost = int(recoverable[-1]) if len(recoverable) else -1
        if lost >= 0 and found.method == PLANS and recovery is not None:
            fault = find_fault(trajectory, danger, lost, recovery)
    return Blame(
        None if lost is None else max(lost, 0) * trajectory.dt,
        danger,
        agreement.disagreement,
        agreement.departure,
        blame,
        fault,
        found.method,
        _sentence(trajectory, agreement, lost, fault, found.method),
    )


def _sentence(
    trajectory: Trajectory,
    agreement: Agreement,
    lost: int | None,
    fault: Fault | None,
    method: str,
) -> str:
    if trajectory.outcome is Outcome.SUCCESS:
        return "succeeded"
    if lost is None:
        parts = [f"where it went wrong cannot be told: {method}"]
        if trajectory.failure_step is None and trajectory.outcome is Outcome.UNKNOWN:
            parts = ["nobody said what became of it"]
    elif lost < 0:
        parts = ["lost from its start on"]
    else:
        parts = [f"recoverable until {lost * trajectory.dt:.2f} s"]
    if fault is not None:
        parts.append(f"from {fault.time:.2f} s {fault.words}")
    until = trajectory.n_steps if lost is None else lost
    departed = find_departure(trajectory, agreement.departure, until) if until >= 0 else None
    if departed is not None:
        since = f"{departed:.2f} s" if departed > 0 else "its start"
        parts.append(f"from {since} unlike what worked elsewhere")
    return "; ".join(parts)


def sentences(blames: Sequence[Blame], name: str = "demonstration") -> list[str]:
    """Return the sentences with the numbers of the attempts, counted from 1."""
    return [f"{name} {i}: {blame.sentence}" for i, blame in enumerate(blames, start=1)]
