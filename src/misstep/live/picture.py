"""What the page is shown of systems, attempts and mixtures: plain values that become JSON.

Numbers are rounded to five digits: more cannot be seen, and a trial of 1,500 steps stays below
100 kB.
"""

import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from misstep.learners import LEARNERS, DonutPolicy, MixturePolicy, Task
from misstep.learners.donut import default_scale
from misstep.live.attempt import can_start_at, is_one_way
from misstep.mixture import Conditioner, GaussianMixture
from misstep.mixture.donut import DEFAULT_K, DEFAULT_REACH
from misstep.systems import SYSTEMS, CartPole, System
from misstep.systems.flipup import FlipUp
from misstep.trajectory import Column, Trajectory

Array = NDArray[np.float64]
Shown = dict[str, Any]

_DIGITS = 5
_TRACE_POINTS = 48
_FAR = 50.0  # m, an end of the rail that no attempt reaches
_MOST_SAMPLES = 6000
# Of each column's spread. Keys give three forces; without a width their ellipses would be lines.
_WIDTH = 0.08
_DRAWINGS = {
    "basket": "basket",
    "gym:Pendulum-v1": "pendulum",
    "gym:InvertedPendulum-v5": "cart-with-poles",
    "gym:InvertedDoublePendulum-v5": "cart-with-poles",
    "gym:MountainCarContinuous-v0": "hill",
}
_RUNG_MEANINGS = (
    "nothing beyond the recordings",
    "whether each attempt succeeded",
    "when each attempt went wrong",
    "what each step cost",
    "the cost, and it may learn how the system responds",
)


def rounded(values: Any) -> Any:
    """Return numbers, lists or arrays of them to five digits; None for what is not finite."""
    if isinstance(values, np.ndarray):
        values = values.tolist()
    if isinstance(values, list | tuple):
        return [rounded(value) for value in values]
    if isinstance(values, float):
        return float(f"{values:.{_DIGITS}g}") if math.isfinite(values) else None
    return values


def to_json(value: object) -> str:
    """Return JSON without spaces; NaN and infinities are no part of it."""
    return json.dumps(value, allow_nan=False, separators=(",", ":"))


def show_columns(columns: Sequence[Column]) -> list[Shown]:
    """Return names and units."""
    return [{"name": column.name, "unit": column.unit} for column in columns]


def show_system(name: str, system: System) -> Shown:
    """Return what the page has to know of a system to draw and to drive it."""
    space: Any = system.action_space
    inside = system.unwrapped
    return {
        "name": name,
        "title": title_of(name),
        "task": _first_line(type(inside).__doc__),
        "columns": show_columns(system.observation_columns),
        "actions": show_columns(system.action_columns),
        "low": rounded(np.asarray(space.low, np.float64)),
        "high": rounded(np.asarray(space.high, np.float64)),
        "dt": system.dt,
        "drawing": _drawing(inside),
        "parameters": {
            key: rounded(value) if isinstance(value, float) else value
            for key, value in system.parameters.items()
        },
        "can_start_at": can_start_at(system),
        "one_way": is_one_way(system),
        "pushable": isinstance(inside, CartPole),
        "suggested": suggested_state(system),
        "main": main_column(system.observation_columns),
        "cost": "mean |angle| [deg]" if isinstance(inside, CartPole) else "mean cost of a step",
    }


def suggested_state(system: System) -> list[str]:
    """Return the columns that suffice where nothing is to be known of the dynamics.

    On a rail without an end in reach, where the cart is and how fast it goes makes no difference to
    the pole. Four attempts by hand are some hundred samples: two columns more, and `fall` needed up
    to eight trials for what it did in the first one without them.
    """
    names = [column.name for column in system.observation_columns]
    inside = system.unwrapped
    if isinstance(inside, CartPole):
        p = inside.parameters
        end = min(float(p["rail"]), float(p["track_limit"]) or math.inf)
        if end > _FAR and float(p["fall_angle_deg"]) < 90.0:
            return ["theta", "theta_dot"]
    return names


def title_of(name: str) -> str:
    """Return a system's name for people."""
    titles = {
        "cartpole": "Cart-pole",
        "cartpole-rail": "Cart-pole on a short track",
        "cartpole-swingup": "Swing-up",
        "flipup": "Flip-up",
        "basket": "Basket",
    }
    return titles.get(name, name)


def show_systems() -> list[Shown]:
    """Return the systems of the registry."""
    return [
        {"name": name, "title": title_of(name), "task": _first_line(kind.__doc__)}
        for name, kind in SYSTEMS.loaded()[0].items()
    ]


def show_learners() -> list[Shown]:
    """Return the learners, each with its rung and one sentence."""
    shown = []
    for name, kind in LEARNERS.loaded()[0].items():
        sentence = _first_line(kind.__doc__).partition(": ")[2]
        shown.append(
            {
                "name": name,
                "rung": kind.rung,
                "told": _RUNG_MEANINGS[kind.rung],
                "sentence": sentence[:1].upper() + sentence[1:],
            }
        )
    return sorted(shown, key=lambda learner: (learner["rung"], learner["name"]))


def show_summary(trajectory: Trajectory) -> Shown:
    """Return one line of a list of attempts, with a small trace."""
    column = trajectory.column(main_column(trajectory.observation_columns))
    at = np.linspace(0, trajectory.n_steps, min(_TRACE_POINTS, trajectory.n_steps + 1))
    return {
        "outcome": str(trajectory.outcome),
        "duration": round(trajectory.duration, 6),
        "failure_time": rounded(trajectory.failure_time),
        "cost": rounded(trajectory.mean_cost),
        "by": trajectory.provenance.demonstrator,
        "time": trajectory.provenance.time,
        "notes": list(trajectory.provenance.notes),
        "trace": rounded(column[at.round().astype(int)]),
    }


def show_recording(trajectory: Trajectory) -> Shown:
    """Return a whole recording."""
    return {
        **show_summary(trajectory),
        "dt": trajectory.dt,
        "observations": rounded(trajectory.observations),
        "actions": rounded(trajectory.actions),
        "failure_step": trajectory.failure_step,
    }


def main_column(columns: Sequence[Column]) -> str:
    """Return the column that says most: the first angle, or its sine, or the first of all."""
    angles = [c.name for c in columns if c.unit == "rad"]
    return next(
        iter([*angles, *(c.name for c in columns if c.name.startswith("sin_"))]), columns[0].name
    )


def still_columns(attempts: Sequence[Trajectory]) -> list[str]:
    """Return the observation columns that have the same value in all attempts, if there are any.

    Nothing can be learned from them: no mixture has a spread along them.
    """
    if not attempts:
        return []
    low = np.min([t.observations.min(axis=0) for t in attempts], axis=0)
    high = np.max([t.observations.max(axis=0) for t in attempts], axis=0)
    columns = attempts[0].observation_columns
    return [column.name for column, same in zip(columns, low == high, strict=True) if same]


def show_mixture(
    task: Task, attempts: Sequence[Trajectory], policy: object, rng: np.random.Generator
) -> Shown | None:
    """Return the mixture of (state, action) pairs, and what conditions it on a state.

    It is the policy's own where it has one; else one that is fitted to the attempts, to show what
    was done in which state. None where a column does not vary and there is nothing to fit.

    Parameters
    ----------
    task : Task
    attempts : sequence of Trajectory
        What the policy was learned from; demonstrations first.
    policy : LearnedPolicy or None
    rng : numpy.random.Generator
        For the fit.
    """
    own = isinstance(policy, MixturePolicy)
    mixture = policy.mixture if isinstance(policy, MixturePolicy) else _fitted(task, attempts, rng)
    if mixture is None:
        return None
    k, reach = DEFAULT_K, DEFAULT_REACH
    scale = default_scale(attempts)
    if isinstance(policy, DonutPolicy):
        scale, k, reach = policy.scale, policy.settings.k, policy.settings.reach
    c = Conditioner(mixture, range(len(task.state)))
    return {
        "own": own,
        "donut": isinstance(policy, DonutPolicy),
        "state": list(task.state),
        "weights": rounded(mixture.weights_),
        "means": rounded(mixture.means_),
        "covariances": rounded(mixture.covariances_),
        "state_constants": c.state_constants.tolist(),
        "state_means": c.state_means.tolist(),
        "state_whiteners": c.state_whiteners.tolist(),
        "gains": c.gains.tolist(),
        "action_means": c.action_means.tolist(),
        "action_covariances": c.covariances.tolist(),
        "scale": scale.tolist(),
        "k": k,
        "reach": reach,
    }


def _fitted(
    task: Task, attempts: Sequence[Trajectory], rng: np.random.Generator
) -> GaussianMixture | None:
    samples = np.concatenate([task.joint(t) for t in attempts])
    if len(samples) > _MOST_SAMPLES:
        samples = samples[rng.choice(len(samples), _MOST_SAMPLES, replace=False)]
    too_few = len(samples) < 2 * samples.shape[1]
    if too_few or np.any(samples.max(axis=0) == samples.min(axis=0)):
        return None
    return GaussianMixture(
        max_components=5, covariance_floor=_WIDTH**2, tol=1e-4, random_state=rng
    ).fit(samples)


def _drawing(system: System) -> str:
    if isinstance(system, CartPole):
        return "cartpole"
    if isinstance(system, FlipUp):
        return "flipup"
    return _DRAWINGS.get(system.system_id, "columns")


def _first_line(doc: str | None) -> str:
    # Under `python -OO` there are no docstrings.
    return (doc or "").strip().partition("\n")[0]
