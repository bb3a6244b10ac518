"""Sections V-B to V-D as runs: which learner, on which state, on which physics, and what came out.

A *variant* is one way to run the paper's cart-pole experiment: four failed demonstrations, eleven
explorations. The same seed shows every variant of a calibration the same demonstrations. A *cell*
is one variant with one seed; it is an ordinary run folder, so it can be interrupted, resumed,
loaded and evaluated like any other.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from misstep.demonstrators import demonstrate
from misstep.learning import OnTrial, learn, resume
from misstep.paper.calibration import CALIBRATIONS
from misstep.parameters import ParameterValue
from misstep.runs import CONFIG, Run, load_run
from misstep.systems import System, make_system
from misstep.trajectory import Dataset

DEMONSTRATIONS = 4
EXPLORATIONS = 11

# s of the exploration formula, N, and the most components that the paper's figures show.
PAPER_DONUT: Mapping[str, ParameterValue] = {
    "scale": 10.0,
    "max_components": 3,
    "climb": "density",
}
PAPER_MEAN: Mapping[str, ParameterValue] = {"max_components": 3}


@dataclass(frozen=True)
class Physics:
    """An engine that the cart-pole moves in."""

    title: str
    system: str
    parameters: Mapping[str, ParameterValue]
    """What the system is told beyond the calibration."""


PHYSICS = {
    "mujoco": Physics("MuJoCo", "cartpole", {}),
    # It integrates with Euler steps, MuJoCo with Runge-Kutta: ten times as many are as accurate.
    "gazebo": Physics("Gazebo's physics", "cartpole-gazebo", {"physics_step": 0.001}),
}


@dataclass(frozen=True)
class Variant:
    """One way to run the experiment."""

    name: str
    title: str
    learner: str
    state: tuple[str, ...]
    parameters: Mapping[str, ParameterValue] = field(default_factory=dict)
    calibration: str = "A"
    core: bool = False
    """Whether the paper itself shows it, so that a quick reproduction needs it too."""


ANGLE = ("theta",)
VELOCITY = ("x_dot", "theta")
RATE = ("theta", "theta_dot")

VARIANTS = {
    variant.name: variant
    for variant in (
        Variant("without-reward", "donut on θ (V-B)", "donut", ANGLE, PAPER_DONUT, core=True),
        Variant(
            "with-reward", "donut with cost on θ (V-C)", "donut-cost", ANGLE, PAPER_DONUT, core=True
        ),
        Variant("velocity", "donut on (ẋ, θ) (V-D)", "donut", VELOCITY, PAPER_DONUT, core=True),
        Variant("rate", "donut on (θ, θ̇)", "donut", RATE, PAPER_DONUT, core=True),
        Variant("mean", "plain averaging on θ", "mean", ANGLE, PAPER_MEAN, core=True),
        Variant("mean-velocity", "plain averaging on (ẋ, θ)", "mean", VELOCITY, PAPER_MEAN),
        Variant("mean-rate", "plain averaging on (θ, θ̇)", "mean", RATE, PAPER_MEAN),
        Variant(
            "with-reward-velocity", "donut with cost on (ẋ, θ)", "donut-cost", VELOCITY, PAPER_DONUT
        ),
        Variant("with-reward-rate", "donut with cost on (θ, θ̇)", "donut-cost", RATE, PAPER_DONUT),
        Variant(
            "with-reward-weights",
            "donut with cost, weighted fit",
            "donut-cost",
            ANGLE,
            {**PAPER_DONUT, "method": "weights"},
        ),
        Variant(
            "global",
            "donut, best mode each step",
            "donut",
            ANGLE,
            {**PAPER_DONUT, "climb": "global"},
        ),
        Variant(
            "log-density",
            "donut, climbing the log density",
            "donut",
            ANGLE,
            {**PAPER_DONUT, "climb": "warm"},
        ),
        Variant(
            "one-component",
            "donut, one Gaussian",
            "donut",
            ANGLE,
            {**PAPER_DONUT, "n_components": 1},
        ),
        Variant(
            "six-components",
            "donut, up to six Gaussians",
            "donut",
            ANGLE,
            {**PAPER_DONUT, "max_components": 6},
        ),
        Variant(
            "printed-formula",
            "donut, ε as the equation is printed",
            "donut",
            ANGLE,
            {**PAPER_DONUT, "formula": "printed"},
        ),
        Variant("B-without-reward", "donut on θ, physics B", "donut", ANGLE, PAPER_DONUT, "B"),
        Variant(
            "B-with-reward",
            "donut with cost on θ, physics B",
            "donut-cost",
            ANGLE,
            PAPER_DONUT,
            "B",
        ),
        Variant(
            "B-log-density",
            "donut, climbing the log density, physics B",
            "donut",
            ANGLE,
            {**PAPER_DONUT, "climb": "warm"},
            "B",
        ),
        Variant("B-velocity", "donut on (ẋ, θ), physics B", "donut", VELOCITY, PAPER_DONUT, "B"),
        Variant("B-rate", "donut on (θ, θ̇), physics B", "donut", RATE, PAPER_DONUT, "B"),
        Variant("B-mean", "plain averaging on θ, physics B", "mean", ANGLE, PAPER_MEAN, "B"),
    )
}


def build_system(calibration: str, physics: str = "mujoco") -> System:
    """Build the cart-pole of a calibration on one of `PHYSICS`."""
    engine = PHYSICS[physics]
    return make_system(engine.system, **CALIBRATIONS[calibration].system, **engine.parameters)


def demonstrations_of(
    calibration: str, seed: int, index: int, n: int = DEMONSTRATIONS, physics: str = "mujoco"
) -> Dataset:
    """Record the failed demonstrations of the `index`-th repetition of a reproduction's `seed`."""
    stream = np.random.SeedSequence(seed, spawn_key=(index,)).generate_state(1)[0]
    parameters: dict[str, Any] = dict(CALIBRATIONS[calibration].demonstrator)
    system = build_system(calibration, physics)
    return demonstrate(system, "noisy", n=n, seed=int(stream), **parameters)


def run_cell(
    folder: Path,
    variant: Variant,
    seed: int,
    index: int,
    *,
    physics: str = "mujoco",
    on_trial: OnTrial | None = None,
) -> Run:
    """Run one variant with one seed in its folder, from wherever it was left.

    Parameters
    ----------
    folder : Path
        A run folder, or one that is not there yet.
    variant : Variant
    seed : int
        The reproduction's seed.
    index : int
        Which repetition.
    physics : str
        One of `PHYSICS`.
    on_trial : callable, optional
        Called after every exploration, see `misstep.learn`.
    """
    if (folder / CONFIG).exists():
        return resume(load_run(folder), on_trial=on_trial)
    return learn(
        build_system(variant.calibration, physics),
        demonstrations_of(variant.calibration, seed, index, physics=physics),
        variant.learner,
        state=variant.state,
        max_trials=EXPLORATIONS,
        seed=int(np.random.SeedSequence(seed, spawn_key=(index, 1)).generate_state(1)[0]),
        stop_on_success=False,
        out=folder,
        on_trial=on_trial,
        **variant.parameters,
    )
