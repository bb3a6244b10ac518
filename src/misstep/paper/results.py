"""All that one reproduction measured, for the tables, the claims, the figures and the report."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from misstep.paper.calibration import CALIBRATIONS
from misstep.paper.costs import horizon_costs
from misstep.paper.experiments import demonstrations_of
from misstep.paper.measures import CellMeasures
from misstep.paper.synthetic import SyntheticMeasures, SyntheticRun
from misstep.runs import Run

# Demonstrations beyond those of the experiments, to see where the paper's twelve numbers fall.
CALIBRATION_DEMONSTRATIONS = 60

SHOWN_RUNS = ("without-reward", "with-reward", "velocity")
"""Variants whose first run is drawn."""


@dataclass(frozen=True)
class Results:
    """The runs of the first seed, the measures of all, and where table I falls."""

    seed: int
    seeds: int
    physics: str
    cells: dict[str, list[CellMeasures]]
    runs: dict[str, Run]
    synthetic: SyntheticRun
    synthetic_measures: list[SyntheticMeasures]
    calibrations: dict[str, NDArray[np.float64]]
    """Costs of many demonstrations of each calibration, shape (N, 3), deg."""
    sequel: Run
    """Four failures and what solves them, see `misstep.paper.sequel`."""

    def costs(self, variant: str) -> NDArray[np.float64]:
        """Return the exploration costs of all seeds, shape (seeds, E, 3), deg."""
        return np.array([cell.exploration_costs for cell in self.cells[variant]])

    def demonstration_costs(self, variant: str) -> NDArray[np.float64]:
        """Return the demonstration costs of all seeds, shape (seeds, 4, 3), deg."""
        return np.array([cell.demonstration_costs for cell in self.cells[variant]])


def collect_calibration(
    seed: int, *, quick: bool, physics: str = "mujoco"
) -> dict[str, NDArray[np.float64]]:
    """Return the costs of many demonstrations by calibration; only the first with `quick`."""
    names = list(CALIBRATIONS)[: 1 if quick else None]
    n = CALIBRATION_DEMONSTRATIONS
    # A repetition that no experiment uses.
    return {name: horizon_costs(demonstrations_of(name, seed, 10**6, n, physics)) for name in names}
