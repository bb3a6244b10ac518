"""One or two plain sentences on a trial: what became of it, and what it had tried."""

import math

import numpy as np

from misstep.learners import LEARNERS, DonutPolicy
from misstep.systems import CartPole, System
from misstep.trajectory import Outcome, Trajectory

_BEFORE = 1.5  # s before the end, in which what was decisive happened


def tell_trial(number: int, trial: Trajectory, system: System, learner: str, policy: object) -> str:
    """Return what happened in a trial, and why it acted as it did."""
    return f"Trial {number} {tell_end(trial, system)} {_tell_why(trial, learner, policy)}"


def tell_end(attempt: Trajectory, system: System) -> str:
    """Return how an attempt ended, without a subject: "fell to the left after 1.20 s."."""
    if attempt.outcome is Outcome.SUCCESS:
        return f"succeeded: it went well for the whole {attempt.duration:.3g} s."
    if attempt.outcome is Outcome.UNKNOWN:
        return f"was stopped after {attempt.duration:.2f} s; nobody said what became of it."
    step = attempt.failure_step
    when = attempt.duration if step is None else step * attempt.dt
    inside = system.unwrapped
    if not isinstance(inside, CartPole) or step is None:
        return f"failed after {when:.2f} s."
    x, theta = float(attempt.column("x")[step]), float(attempt.column("theta")[step])
    if abs(theta) > math.radians(float(inside.parameters["fall_angle_deg"])):
        return f"fell to the {_side(theta)} after {when:.2f} s."
    limit = float(inside.parameters["track_limit"])
    if limit and abs(x) > limit:
        return f"left the track on the {_side(x)} after {when:.2f} s."
    if step == attempt.n_steps and attempt.duration >= float(inside.parameters["duration"]):
        return f"was not upright at the end of its {when:.3g} s."
    return f"failed after {when:.2f} s."


def _tell_why(trial: Trajectory, learner: str, policy: object) -> str:
    if isinstance(policy, DonutPolicy):
        return _tell_donut(trial, policy)
    if learner == "fall":
        return (
            "It had learned from the failures before what a fall looks like while it begins, and "
            "pushed against that."
        )
    if LEARNERS[learner].rung == 4:
        return (
            "It had learned from every attempt before how the system responds, and looked ahead "
            "in that."
        )
    sentence = (LEARNERS[learner].__doc__ or "").strip().partition("\n")[0].partition(": ")[2]
    return f"Its way: {sentence}" if sentence else ""


def _tell_donut(trial: Trajectory, policy: DonutPolicy) -> str:
    """Tell of the state, late in the trial, in which the attempts before disagreed most."""
    first = max(0, trial.n_steps - round(_BEFORE / trial.dt))
    if trial.outcome is Outcome.SUCCESS:
        first = 0
    steps = range(first, trial.n_steps, max(1, (trial.n_steps - first) // 50))
    donuts = [policy.donut_at(policy.state_of(trial.observations[step])) for step in steps]
    best = int(np.argmax([donut.exploration for donut in donuts]))
    epsilon = donuts[best].exploration
    when = steps[best] * trial.dt
    column = trial.action_columns[0]
    did, usual = float(trial.actions[steps[best]][0]), float(donuts[best].conditional.mean[0])
    if epsilon < 0.5:
        return (
            f"The attempts before agreed all along (ε at most {epsilon:.2f}), so it repeated what "
            "they had done."
        )
    return (
        f"At {when:.2f} s the attempts before disagreed (ε\u00a0=\u00a0{epsilon:.2f}): there it "
        f"tried {_signed(did)} {column.unit} where their average is {_signed(usual)} {column.unit}."
    )


def _signed(value: float) -> str:
    text = f"{value:+z.1f}" if abs(value) >= 1.0 else f"{value:+z.2f}"
    return text.replace("-", "−")


def _side(value: float) -> str:
    return "right" if value > 0 else "left"
