"""Tables I and II beside the paper's, with the distribution of every number over the seeds."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from misstep.paper.costs import HORIZONS
from misstep.paper.experiments import VARIANTS
from misstep.paper.printed import TABLE_1, TABLE_2
from misstep.paper.results import Results

Array = NDArray[np.float64]


def all_tables(results: Results) -> dict[str, Any]:
    """Return every table as JSON can hold it."""
    return {
        "horizons_s": list(HORIZONS),
        "I": _table_1(results),
        "II": _table_2(results, "without-reward"),
        "with_reward": _table_2(results, "with-reward"),
        "variants": _variants(results),
    }


def _table_1(results: Results) -> dict[str, Any]:
    """Table I: the demonstrations of the first seed, and where the paper's numbers fall in all."""
    shown = results.demonstration_costs("without-reward").reshape(-1, len(HORIZONS))
    return {
        "paper": TABLE_1.tolist(),
        "first_seed": _rounded(results.demonstration_costs("without-reward")[0]),
        "demonstrations": len(shown),
        "mean": _rounded(shown.mean(axis=0)),
        "range_95": _rounded(np.percentile(shown, [2.5, 97.5], axis=0).T),
        "percentile_of_paper": _percentiles(TABLE_1, shown[:, None, :]),
    }


def _table_2(results: Results, variant: str) -> dict[str, Any]:
    """Table II: exploration by exploration; the paper prints only the one without reward."""
    costs = results.costs(variant)
    table = {
        "first_seed": _rounded(costs[0]),
        "seeds": results.seeds,
        "mean": _rounded(costs.mean(axis=0)),
        "range_95": _rounded(np.moveaxis(np.percentile(costs, [2.5, 97.5], axis=0), 0, -1)),
        "mean_of_all": _rounded(costs.mean(axis=(0, 1))),
    }
    if variant == "without-reward":
        table["paper"] = TABLE_2.tolist()
        table["percentile_of_paper"] = _percentiles(TABLE_2, costs)
        table["inside_95"] = _inside(costs)
    return table


def _inside(costs: Array) -> list[int]:
    """Count, for each horizon, the paper's explorations inside our 95 % range of that number."""
    low, high = np.percentile(costs, [2.5, 97.5], axis=0)
    counts: list[int] = ((low <= TABLE_2) & (high >= TABLE_2)).sum(axis=0).tolist()
    return counts


def _variants(results: Results) -> list[dict[str, Any]]:
    """One row a variant: mean costs with their standard error over seeds, successes, models."""
    rows = []
    for name, cells in results.cells.items():
        per_seed = results.costs(name).mean(axis=1)
        error = per_seed.std(axis=0, ddof=1) / np.sqrt(len(per_seed)) if len(per_seed) > 1 else None
        explorations = sum(len(cell.components) for cell in cells)
        rows.append(
            {
                "name": name,
                "title": VARIANTS[name].title,
                "learner": VARIANTS[name].learner,
                "state": list(VARIANTS[name].state),
                "calibration": VARIANTS[name].calibration,
                "mean_costs": _rounded(per_seed.mean(axis=0)),
                "standard_error": None if error is None else _rounded(error),
                "successes": sum(cell.successes for cell in cells),
                "explorations": explorations,
                "components": round(float(np.mean([c.components.mean() for c in cells])), 2),
                "exploration": round(float(np.mean([c.exploration.mean() for c in cells])), 3),
                "jumps": round(float(np.mean([c.jumps.mean() for c in cells])), 1),
            }
        )
    return rows


def calibrations(results: Results) -> dict[str, Any]:
    """Where each of table I's twelve numbers falls among many demonstrations of a calibration."""
    return {
        name: {
            "demonstrations": len(costs),
            "mean": _rounded(costs.mean(axis=0)),
            "range_95": _rounded(np.percentile(costs, [2.5, 97.5], axis=0).T),
            "percentile_of_paper": _percentiles(TABLE_1, costs[:, None, :]),
        }
        for name, costs in results.calibrations.items()
    }


def _percentiles(paper: Array, ours: Array) -> list[list[int]]:
    """Percentile of each number of `paper` (R, 3) among `ours` (N, R or 1, 3), ties split."""
    below = (ours < paper).mean(axis=0)
    equal = (ours == paper).mean(axis=0)
    ranks: list[list[int]] = np.round(100 * (below + 0.5 * equal)).astype(int).tolist()
    return ranks


def _rounded(values: Array) -> Any:
    return np.round(values, 4).tolist()
