"""Do two engines give the paper's tables alike? Compare two reproductions, variant by variant.

    misstep reproduce --seeds 30 --out A
    misstep reproduce --seeds 30 --out B --physics gazebo
    python studies/compare_physics.py A B

Both start from the same seeds, so the noise of the demonstrators is the same in both and the
repetitions are pairs: Wilcoxon's signed-rank test on the cost of a repetition, by variant and
horizon, Holm's correction over all of them. What makes them differ is the subject of rail_stop.py.
"""

import sys
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.stats import wilcoxon

from misstep.paper.costs import HORIZONS
from misstep.paper.experiments import VARIANTS
from misstep.paper.measures import CellMeasures
from misstep.storage import read_json


def read_costs(out, variant):
    """Return a repetition's mean costs, demonstrations' and explorations', each (seeds, 3), deg."""
    cells = [
        CellMeasures.from_json(read_json(path))
        for path in sorted((out / "cells" / variant).glob("*.json"))
    ]
    return tuple(
        np.array([getattr(cell, kind).mean(axis=0) for cell in cells])
        for kind in ("demonstration_costs", "exploration_costs")
    )


def holm(p):
    """Return the p values corrected for their number by Holm's method."""
    order = np.argsort(p)
    corrected = np.maximum.accumulate(np.sort(p) * np.arange(len(p), 0, -1))
    return np.minimum(1.0, corrected)[np.argsort(order)]


def compare(first, second):
    """Return a row for each variant and horizon: name, horizon [s], both means, difference, p."""
    rows = []
    variants = [name for name in VARIANTS if (first / "cells" / name).is_dir()]
    shown = {"A": "demonstrations", "B": "demonstrations, physics B"}
    for name in variants:
        demonstrated, explored = zip(read_costs(first, name), read_costs(second, name), strict=True)
        title = shown.pop(VARIANTS[name].calibration, None)
        groups = ([(title, demonstrated)] if title else []) + [(VARIANTS[name].title, explored)]
        for label, (ours, theirs) in groups:
            for column, horizon in enumerate(HORIZONS):
                a, b = ours[:, column], theirs[:, column]
                error = (b - a).std(ddof=1) / np.sqrt(len(a))
                rows.append(
                    (label, horizon, a.mean(), b.mean(), (b - a).mean(), error, wilcoxon(a, b)[1])
                )
    return rows


def main():
    """Print the comparison of the two folders that the command line names."""
    first, second = (Path(folder) for folder in sys.argv[1:3])
    rows = compare(first, second)
    corrected = holm(np.array([row[-1] for row in rows]))
    names = [read_json(folder / "reproduce.json") for folder in (first, second)]
    engines = [values["physics"] for values in names]
    table = Table(title=f"mean cost [deg], {names[0]['seeds']} seeds")
    for heading in ("", "over [s]", *engines, "difference", "p, Holm"):
        table.add_column(heading, justify="left" if not heading else "right")
    for (label, horizon, a, b, gap, error, _), p in zip(rows, corrected, strict=True):
        table.add_row(
            label, f"{horizon:g}", f"{a:.1f}", f"{b:.1f}", f"{gap:+.1f} ± {error:.1f}", f"{p:.2f}"
        )
    Console().print(table)
    apart = int((corrected < 0.05).sum())
    print(f"{apart} of {len(rows)} differ at 5 % after Holm's correction")
    print(f"largest difference of means: {max(abs(row[4]) for row in rows):.1f} deg")


if __name__ == "__main__":
    main()
