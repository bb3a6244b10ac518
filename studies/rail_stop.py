"""Why Gazebo's physics gives other tables than MuJoCo's: the stop at the end of the rail.

    python studies/rail_stop.py 30

The donut on θ (section V-B) on physics A, from the same seeds, on MuJoCo, on MuJoCo with the step
of Gazebo's physics, and on Gazebo's physics; with the rail of the calibration, and with one that is
never left. MuJoCo's stop is a spring and damper as stiff as its step allows: pushed into it, the
cart goes 6 cm too far at 10 ms, 2 mm at 1 ms. DART's stop is rigid.
"""

import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.stats import wilcoxon

from misstep.demonstrators import demonstrate
from misstep.learning import learn
from misstep.paper.calibration import CALIBRATIONS
from misstep.paper.costs import HORIZONS, horizon_costs
from misstep.paper.experiments import EXPLORATIONS, VARIANTS
from misstep.systems import make_system

ENGINES = {
    "MuJoCo, 10 ms": ("cartpole", {}),
    "MuJoCo, 1 ms": ("cartpole", {"physics_step": 0.001}),
    "Gazebo, 1 ms": ("cartpole-gazebo", {"physics_step": 0.001}),
}
RAILS = {"rail of ±3 m": {}, "rail of ±1 km": {"rail": 1000.0}}


def explored(engine, rail, seed):
    """Return the mean costs of the explorations of one repetition, shape (3,), deg."""
    name, parameters = ENGINES[engine]
    calibration, variant = CALIBRATIONS["A"], VARIANTS["without-reward"]
    system = make_system(name, **{**calibration.system, **parameters, **RAILS[rail]})
    shown = demonstrate(system, "noisy", n=4, seed=seed, **calibration.demonstrator)
    run = learn(
        system,
        shown,
        variant.learner,
        state=variant.state,
        max_trials=EXPLORATIONS,
        seed=seed,
        stop_on_success=False,
        **variant.parameters,
    )
    return horizon_costs(run.trials).mean(axis=0)


def main():
    """Run all of it and print a row for each engine and rail."""
    seeds = range(int(sys.argv[1]))
    table = Table(title=f"mean cost of the explorations [deg], {len(seeds)} seeds")
    for heading in ("", "engine", *(f"{h:g} s" for h in HORIZONS), "p against MuJoCo, 10 ms"):
        table.add_column(heading)
    with ProcessPoolExecutor(2) as pool:
        for rail in RAILS:
            costs = {}
            for engine in ENGINES:
                runs = pool.map(partial(explored, engine, rail), seeds)
                told = f"{rail}, {engine}"
                costs[engine] = np.array(list(track(runs, told, len(seeds))))
                first = next(iter(costs.values()))
                pairs = zip(first.T, costs[engine].T, strict=True)
                p = (
                    ""
                    if costs[engine] is first
                    else " ".join(f"{wilcoxon(a, b)[1]:.3f}" for a, b in pairs)
                )
                means = costs[engine].mean(axis=0)
                errors = costs[engine].std(axis=0, ddof=1) / np.sqrt(len(seeds))
                cells = (f"{m:.1f} ± {e:.1f}" for m, e in zip(means, errors, strict=True))
                table.add_row(rail, engine, *cells, p)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
