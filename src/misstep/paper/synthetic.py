"""Section V-A: two made-up demonstrators who disagree more the further the pole leans.

One pushes with the lean, one against it, F = ±slope · θ plus noise in proportion to |θ|. A model
of both should leave a single bump at θ = 0, where they agree, and a donut at θ = 90°, where they do
not. Explorations sweep the angle once from end to end and join the data, as a trial would.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from misstep.learners import DonutLearner, DonutPolicy, Evidence, Task
from misstep.mixture import DonutMixture
from misstep.paper.modes import action_grid, count_modes
from misstep.trajectory import Column, Outcome, Provenance, Trajectory

Array = NDArray[np.float64]

SLOPE = 0.07
"""Force per angle of the two demonstrators, N/deg; the paper gives none."""
NOISE_SHARE = 0.1
"""Standard deviation of the noise per angle, N/deg."""
SCALE = 10.0
"""s in ε = 1 − 1/(1 + V/s²), N: the same as in the cart-pole experiment."""
ANGLES = np.linspace(-180.0, 180.0, 361)
"""Angles of a demonstration and of an exploration, deg."""
EXPLORATIONS = 3

TASK = Task(
    observation_columns=(Column("theta", "deg"),),
    action_columns=(Column("force", "N"),),
    action_low=np.array([-1e3]),
    action_high=np.array([1e3]),
    state=("theta",),
    dt=1.0,
)
LEARNER = DonutLearner(scale=SCALE, max_components=6)


class SyntheticRun(NamedTuple):
    """The experiment for one seed."""

    demonstrations: tuple[Trajectory, ...]
    explorations: tuple[Trajectory, ...]
    policies: tuple[DonutPolicy, ...]
    """The policy of each exploration; its mixture is that of all attempts before."""


def run_synthetic(seed: int) -> SyntheticRun:
    """Make the data, fit, explore and refit `EXPLORATIONS` times."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(5,)))
    demonstrations = tuple(_demonstration(sign, rng) for sign in (-1.0, 1.0))
    explorations: tuple[Trajectory, ...] = ()
    policies: tuple[DonutPolicy, ...] = ()
    for _ in range(EXPLORATIONS):
        policy = LEARNER.policy(TASK, Evidence(demonstrations, explorations), rng)
        explorations += (_sweep(policy),)
        policies += (policy,)
    return SyntheticRun(demonstrations, explorations, policies)


def _demonstration(sign: float, rng: np.random.Generator) -> Trajectory:
    force = sign * SLOPE * ANGLES + NOISE_SHARE * np.abs(ANGLES) * rng.standard_normal(len(ANGLES))
    return _trajectory(force, "synthetic")


def _sweep(policy: DonutPolicy) -> Trajectory:
    policy.reset()
    return _trajectory(np.array([policy(np.array([a]))[0] for a in ANGLES]), "learner:donut")


def _trajectory(force: Array, who: str) -> Trajectory:
    angles = np.append(ANGLES, ANGLES[-1])
    return Trajectory(
        observations=angles[:, None],
        actions=force[:, None],
        dt=1.0,
        observation_columns=TASK.observation_columns,
        action_columns=TASK.action_columns,
        provenance=Provenance("synthetic", {}, who, None, ""),
        outcome=Outcome.FAILURE,
    )


class SyntheticMeasures(NamedTuple):
    """The numbers of one synthetic run; pairs are at 0° and at 90°."""

    spread: tuple[float, float]
    """Standard deviation of the force in the first model, N."""
    exploration: tuple[float, float]
    """ε of the first model."""
    modes: tuple[int, int]
    """Modes of the first donut mixture."""
    reached: tuple[int, int]
    """Different modes that climbs from all over the range reach."""
    last_exploration: tuple[float, float]
    """ε of the last model."""
    departure: tuple[float, float]
    """Mean |F − E|/σ of the second exploration, for |θ| < 10° and for |θ| > 60°."""
    roughness: tuple[float, float]
    """Mean |ΔF| a step near zero (|θ| < 30°) of the second and the last exploration, N."""


def measure_synthetic(run: SyntheticRun) -> SyntheticMeasures:
    """Measure a synthetic run."""
    first, last = run.policies[0], run.policies[-1]
    donuts = [first.donut_at([angle]) for angle in (0.0, 90.0)]
    spreads = [float(np.sqrt(d.conditional.variance[0, 0])) for d in donuts]
    second = run.explorations[1].actions[:, 0]
    return SyntheticMeasures(
        spread=(spreads[0], spreads[1]),
        exploration=(donuts[0].exploration, donuts[1].exploration),
        modes=(count_modes(donuts[0]), count_modes(donuts[1])),
        reached=(_modes_reached(donuts[0]), _modes_reached(donuts[1])),
        last_exploration=(last.donut_at([0.0]).exploration, last.donut_at([90.0]).exploration),
        departure=(
            _departure(run.policies[1], second, np.abs(ANGLES) < 10.0),
            _departure(run.policies[1], second, np.abs(ANGLES) > 60.0),
        ),
        roughness=(_roughness(second), _roughness(run.explorations[-1].actions[:, 0])),
    )


def synthetic_measures(seed: int, seeds: int) -> list[SyntheticMeasures]:
    """Measure the synthetic runs of the seeds from `seed` on."""
    return [measure_synthetic(run_synthetic(seed + index)) for index in range(seeds)]


def _modes_reached(donut: DonutMixture) -> int:
    """Count the different modes that climbs from a coarse grid of starts end on."""
    starts = action_grid(donut.conditional, points=25)
    ends = np.sort([donut.mode([start])[0] for start in starts])
    tolerance = 1e-3 * np.sqrt(donut.conditional.variance[0, 0])
    return 1 + int(np.sum(np.diff(ends) > tolerance))


def _departure(policy: DonutPolicy, force: Array, where: NDArray[np.bool_]) -> float:
    conditionals = [policy.conditioner.at([angle]) for angle in ANGLES[where]]
    mean = np.array([c.mean[0] for c in conditionals])
    spread = np.sqrt([c.variance[0, 0] for c in conditionals])
    return float(np.mean(np.abs(force[where] - mean) / spread))


def _roughness(force: Array) -> float:
    near = np.abs(ANGLES) < 30.0
    return float(np.mean(np.abs(np.diff(force[near]))))
