"""Each sentence of the paper's section V that states a result, and whether it held for us.

A claim is judged once a seed: it holds there or it does not. The share of seeds in which it held,
with its 95 % Wilson interval, decides: *holds* if the interval lies above one half, *does not hold*
if it lies below, *undecided* in between. Where both calibrations of the physics were run and both
are decided, differently, the verdict is *depends on the physics*.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from misstep.learning import wilson_interval
from misstep.paper.measures import CellMeasures
from misstep.paper.synthetic import SyntheticMeasures

# Columns of the cost tables.
C30, C15, C7 = 0, 1, 2


@dataclass(frozen=True)
class Sample:
    """What one seed measured on one calibration."""

    cells: Mapping[str, CellMeasures]
    synthetic: SyntheticMeasures | None

    def mean_cost(self, variant: str, horizon: int = C30) -> float:
        """Mean cost of a variant's explorations, deg."""
        return float(self.cells[variant].exploration_costs[:, horizon].mean())

    @property
    def made_up(self) -> SyntheticMeasures:
        """The synthetic measures, where there are some."""
        if self.synthetic is None:
            raise LookupError("no synthetic data on this calibration")
        return self.synthetic


@dataclass(frozen=True)
class Claim:
    """A sentence, how it was measured, and what came out."""

    section: str
    sentence: str
    how: str
    measured: str
    seeds: int
    share: float
    verdict: str

    def to_json(self) -> dict[str, Any]:
        """Return the claim as `tables.json` holds it."""
        return asdict(self)


@dataclass(frozen=True)
class _Test:
    section: str
    sentence: str
    how: str
    holds: Callable[[Sample], bool]
    detail: Callable[[Sample], float]
    label: str
    """What `detail` is, with a place for its median: "median ratio {:.2f}"."""
    needs: tuple[str, ...] = ()
    synthetic: bool = False


def judge_all(samples: Mapping[str, Sequence[Sample]]) -> list[Claim]:
    """Judge every claim whose variants were run.

    Parameters
    ----------
    samples : mapping
        By calibration, one sample a seed.
    """
    return [
        _judge(test, usable)
        for test in TESTS
        if (usable := {name: s for name, s in samples.items() if _can(test, s)})
    ]


def _can(test: _Test, samples: Sequence[Sample]) -> bool:
    sample = samples[0]
    made_up = sample.synthetic is not None or not test.synthetic
    return made_up and all(name in sample.cells for name in test.needs)


def _judge(test: _Test, samples: Mapping[str, Sequence[Sample]]) -> Claim:
    parts, verdicts, shares = [], [], []
    for name, group in samples.items():
        held = sum(test.holds(sample) for sample in group)
        low, high = wilson_interval(held, len(group))
        shares.append(held / len(group))
        verdicts.append("holds" if low > 0.5 else "does not hold" if high < 0.5 else "undecided")
        median = float(np.median([test.detail(sample) for sample in group]))
        prefix = f"physics {name}: " if len(samples) > 1 else ""
        parts.append(
            f"{prefix}{held} of {len(group)} seeds ({low:.0%} to {high:.0%}), "
            + test.label.format(median)
        )
    decided = {v for v in verdicts if v != "undecided"}
    return Claim(
        section=test.section,
        sentence=test.sentence,
        how=test.how,
        measured="; ".join(parts),
        seeds=len(next(iter(samples.values()))),
        share=shares[0],
        verdict="depends on the physics" if len(decided) > 1 else verdicts[0],
    )


def _over(value: float, base: float) -> float:
    """Return the ratio, infinite where only the base is zero."""
    return value / base if base else np.inf if value else 1.0


def _erraticness(sample: Sample) -> float:
    """Return the spread of the explorations' costs over that of the demonstrations', 7.5 s."""
    cell = sample.cells["without-reward"]
    explored = cell.exploration_costs[:, C7].std(ddof=1)
    return float(explored / cell.demonstration_costs[:, C7].std(ddof=1))


def _worse(sample: Sample) -> float:
    shown = sample.cells["without-reward"].demonstration_costs[:, C30].mean()
    return float(sample.mean_cost("without-reward") / shown)


def _best_ratio(horizon: int) -> Callable[[Sample], float]:
    def ratio(sample: Sample) -> float:
        cell = sample.cells["without-reward"]
        best = cell.demonstration_costs[:, horizon].min()
        return float(best / cell.exploration_costs[:, horizon].min())

    return ratio


def _all_successes(sample: Sample) -> int:
    return sum(cell.successes for name, cell in sample.cells.items() if not name.startswith("mean"))


def _side_change(sample: Sample) -> float:
    """Return the mean change, from one exploration to the next, in the share above the mean."""
    above = sample.cells["without-reward"].above
    return float(np.abs(np.diff(above[1:])).mean())


def _model_change(sample: Sample) -> float:
    """Return the mean relative change of the model's spread from one fit to the next."""
    spread = sample.cells["without-reward"].action_spread[1:]
    return float(np.abs(np.diff(np.log(spread))).mean())


def _disagreement_growth(variant: str) -> Callable[[Sample], float]:
    def growth(sample: Sample) -> float:
        disagreement = sample.cells[variant].disagreement
        return float(disagreement[-1] / disagreement[0])

    return growth


def _after_first(sample: Sample) -> float:
    costs = sample.cells["with-reward"].exploration_costs[:, C30]
    return float(costs[1:].mean() - costs[0])


def _late_minus_early(sample: Sample) -> float:
    costs = sample.cells["with-reward"].exploration_costs[:, C30]
    return float(costs[-3:].mean() - costs[:3].mean())


def _trend_agreement(sample: Sample) -> float:
    costs = sample.cells["with-reward"].exploration_costs
    return float(np.mean([spearmanr(costs[:, C30], costs[:, c])[0] for c in (C15, C7)]))


def _first_model_difference(sample: Sample) -> float:
    first = [sample.cells[v].action_spread[0] for v in ("without-reward", "with-reward")]
    return float(abs(np.log(first[1] / first[0])))


def _relative(variant: str, other: str) -> Callable[[Sample], float]:
    """Return a function: mean 30 s cost of `variant` over that of `other`."""
    return lambda sample: sample.mean_cost(variant) / sample.mean_cost(other)


def _below_one(value: Callable[[Sample], float]) -> Callable[[Sample], bool]:
    return lambda sample: value(sample) < 1.0


def _jumps(variant: str) -> Callable[[Sample], float]:
    return lambda sample: float(sample.cells[variant].jumps.mean())


TESTS = (
    _Test(
        "V-A",
        "There is less variance for smaller theta and more variance for larger theta.",
        "standard deviation of the force in the first model, at 90° over at 0°: above 1",
        lambda s: s.made_up.spread[1] > s.made_up.spread[0],
        lambda s: s.made_up.spread[1] / s.made_up.spread[0],
        "median ratio {:.1f}",
        synthetic=True,
    ),
    _Test(
        "V-A",
        "In the low variance area the donut resembles a Gaussian.",
        "modes of the donut mixture at 0°: exactly one",
        lambda s: s.made_up.modes[0] == 1,
        lambda s: s.made_up.exploration[0],
        "median ε {:.2f}",
        synthetic=True,
    ),
    _Test(
        "V-A",
        "Where the variance is high the pdf is higher away from the center; it is multimodal.",
        "modes of the donut mixture at 90°: at least two",
        lambda s: s.made_up.modes[1] >= 2,
        lambda s: s.made_up.modes[1],
        "median number of modes {:.0f}",
        synthetic=True,
    ),
    _Test(
        "V-A",
        "Gradient ascent may find any of the modes, depending on the initialization.",
        "different ends of 25 climbs at 90°: at least two",
        lambda s: s.made_up.reached[1] >= 2,
        lambda s: s.made_up.reached[1],
        "median number of ends {:.0f}",
        synthetic=True,
    ),
    _Test(
        "V-A",
        "Exploration 2 aligns with the demonstrations near zero and moves towards the edges of "
        "the Gaussian for larger angles.",
        "|F − mean|/standard deviation beyond 60° over that within 10°: above 1",
        lambda s: s.made_up.departure[1] > s.made_up.departure[0],
        lambda s: _over(*s.made_up.departure[::-1]),
        "median ratio {:.1f}",
        synthetic=True,
    ),
    _Test(
        "V-A",
        "After the update the region near zero also becomes a high variance region.",
        "ε at 0°, third model over first: above 1",
        lambda s: s.made_up.last_exploration[0] > s.made_up.exploration[0],
        lambda s: s.made_up.last_exploration[0] / s.made_up.exploration[0],
        "median ratio {:.1f}",
        synthetic=True,
    ),
    _Test(
        "V-A",
        "… and erratic exploration is witnessed there in the third exploration.",
        "mean |ΔF| a step within 30°, third exploration over second: above 1",
        lambda s: s.made_up.roughness[1] > s.made_up.roughness[0],
        lambda s: _over(*s.made_up.roughness[::-1]),
        "median ratio {:.1f}",
        synthetic=True,
    ),
    _Test(
        "V-B",
        "The data is primarily described by two broad Gaussians and a third narrow one near zero.",
        "three components in most fits, the narrowest less than half as wide in θ as the broadest",
        lambda s: bool(
            np.median(s.cells["without-reward"].components) == 3
            and np.median(s.cells["without-reward"].narrowest) < 0.5
        ),
        lambda s: float(np.median(s.cells["without-reward"].narrowest)),
        "median width ratio {:.2f}",
        ("without-reward",),
    ),
    _Test(
        "V-B",
        "The exploration performed by the Donut method is very erratic.",
        "spread of the eleven 7.5 s costs over that of the four demonstrations: above 1",
        lambda s: _erraticness(s) > 1.0,
        _erraticness,
        "median ratio {:.1f} (paper: 4.2)",
        ("without-reward",),
    ),
    _Test(
        "V-B",
        "Even though the model looks very similar, the trajectories taken are different.",
        "share of the steps above the model's mean changes by more than 0.1 from one exploration "
        "to the next, while the model's spread changes by less than 10 %",
        lambda s: _side_change(s) > 0.1 and _model_change(s) < 0.1,
        _side_change,
        "median change of side {:.2f}",
        ("without-reward",),
    ),
    _Test(
        "V-B",
        "Over the whole trajectory the explorations perform very poorly, compared with the "
        "demonstrations.",
        "mean 30 s cost of the explorations over that of the demonstrations: above 1",
        lambda s: _worse(s) > 1.0,
        _worse,
        "median ratio {:.2f} (paper: 1.58)",
        ("without-reward",),
    ),
    _Test(
        "V-B",
        "One exploration did as well as the best actual demonstration for the first 15 seconds.",
        "best exploration within 5 % of the best demonstration over 15 s, or better",
        lambda s: _best_ratio(C15)(s) > 1 / 1.05,
        _best_ratio(C15),
        "median of best demonstration / best exploration {:.2f} (paper: 0.99)",
        ("without-reward",),
    ),
    _Test(
        "V-B",
        "Over 7.5 s some exploration beats the best demonstration.",
        "best exploration better than the best demonstration over 7.5 s",
        lambda s: _best_ratio(C7)(s) > 1.0,
        _best_ratio(C7),
        "median of best demonstration / best exploration {:.2f} (paper: 2.34)",
        ("without-reward",),
    ),
    _Test(
        "V-B",
        "… by a factor of 3.",
        "the same, by a factor of 3; the paper's own tables say 29.5/12.6 = 2.34",
        lambda s: _best_ratio(C7)(s) >= 3.0,
        _best_ratio(C7),
        "median factor {:.2f}",
        ("without-reward",),
    ),
    _Test(
        "V-B",
        "The space spanned by the successful trajectories is very small: exploration alone does "
        "not reach it.",
        "no exploration of any donut variant keeps |θ| below 30° for 30 s",
        lambda s: _all_successes(s) == 0,
        _all_successes,
        "median successes {:.0f}",
        ("without-reward",),
    ),
    _Test(
        "V-C",
        "The initial model is very similar with and without reward.",
        "spread of the force in the first models differs by less than 10 %",
        lambda s: _first_model_difference(s) < 0.1,
        _first_model_difference,
        "median difference {:.1%}",
        ("without-reward", "with-reward"),
    ),
    _Test(
        "V-C",
        "With reward the model turns into one of very large variance: the variance keeps growing.",
        "conditional standard deviation of the force at the demonstrated states, last model over "
        "first: above 1",
        lambda s: _disagreement_growth("with-reward")(s) > 1.0,
        _disagreement_growth("with-reward"),
        "median ratio {:.2f}",
        ("with-reward",),
    ),
    _Test(
        "V-C",
        "The Donut explorer sees that variance for all states is high and maximizes exploration.",
        "mean ε along the last exploration above 0.5, and above that along the first",
        lambda s: bool(
            s.cells["with-reward"].exploration[-1] > max(0.5, s.cells["with-reward"].exploration[0])
        ),
        lambda s: float(s.cells["with-reward"].exploration[-1]),
        "median last ε {:.2f}",
        ("with-reward",),
    ),
    _Test(
        "V-C",
        "After the first trajectory the performance goes down and continues like that.",
        "mean 30 s cost of explorations 2 to 11 above that of the first",
        lambda s: _after_first(s) > 0.0,
        _after_first,
        "median difference {:+.0f}°",
        ("with-reward",),
    ),
    _Test(
        "V-C",
        "Even with exploration there is no improvement, even after 10 trials.",
        "mean 30 s cost of the last three explorations not below that of the first three",
        lambda s: _late_minus_early(s) >= 0.0,
        _late_minus_early,
        "median difference {:+.0f}°",
        ("with-reward",),
    ),
    _Test(
        "V-C",
        "The cost follows the same trend for 30 s, 15 s and 7.5 s.",
        "Spearman's correlation of the 30 s costs with the 15 s and 7.5 s ones, mean above 0.5",
        lambda s: _trend_agreement(s) > 0.5,
        _trend_agreement,
        "median correlation {:.2f}",
        ("with-reward",),
    ),
    _Test(
        "V-D",
        "Using the velocity of the cart as well did not bring a qualitative improvement.",
        "no success on (ẋ, θ), and its mean 30 s cost not 10 % below that on θ",
        lambda s: (
            s.cells["velocity"].successes == 0 and _relative("velocity", "without-reward")(s) > 0.9
        ),
        _relative("velocity", "without-reward"),
        "median cost ratio {:.2f}",
        ("velocity", "without-reward"),
    ),
    _Test(
        "ours",
        "Plain averaging (`mean`) does better than the donut over 30 s.",
        "mean 30 s cost, averaging over donut: below 1",
        _below_one(_relative("mean", "without-reward")),
        _relative("mean", "without-reward"),
        "median cost ratio {:.2f}",
        ("mean", "without-reward"),
    ),
    _Test(
        "ours",
        "Giving the donut (θ, θ̇), enough to balance with, lets it succeed.",
        "a success among the eleven explorations on (θ, θ̇)",
        lambda s: s.cells["rate"].successes > 0,
        _relative("rate", "without-reward"),
        "median cost ratio to θ alone {:.2f}",
        ("rate", "without-reward"),
    ),
    _Test(
        "ours",
        "The explorations stray because the ascent stalls: up the log density, which is never "
        "flat, they cost no more than the demonstrations.",
        "mean 30 s cost, climbing the log density over climbing the density: below 0.9",
        lambda s: _relative("log-density", "without-reward")(s) < 0.9,
        _relative("log-density", "without-reward"),
        "median cost ratio {:.2f}",
        ("log-density", "without-reward"),
    ),
    _Test(
        "ours",
        "The best mode at every step, instead of a warm start, jumps more.",
        "jumps of the force by more than half a standard deviation, best mode minus warm start: "
        "above 0",
        lambda s: _jumps("global")(s) > _jumps("without-reward")(s),
        lambda s: _jumps("global")(s) - _jumps("without-reward")(s),
        "median difference {:+.0f} jumps a trial",
        ("global", "without-reward"),
    ),
    _Test(
        "ours",
        "A single Gaussian removes the multimodality that the paper blames for the randomness.",
        "share of states with several modes, one component over three: below 1",
        lambda s: bool(
            s.cells["one-component"].several_modes.mean()
            < s.cells["without-reward"].several_modes.mean()
        ),
        lambda s: float(s.cells["one-component"].several_modes.mean()),
        "median share of states with several modes {:.0%}",
        ("one-component", "without-reward"),
    ),
    _Test(
        "ours",
        "A weighted fit in place of samples makes the reward work.",
        "a success, or a mean 30 s cost 10 % below that of the paper's sampling",
        lambda s: (
            s.cells["with-reward-weights"].successes > 0
            or _relative("with-reward-weights", "with-reward")(s) < 0.9
        ),
        _relative("with-reward-weights", "with-reward"),
        "median cost ratio {:.2f}",
        ("with-reward-weights", "with-reward"),
    ),
    _Test(
        "ours",
        "The exploration formula as printed, ε = 1/(1 + Var), explores most where demonstrators "
        "agree.",
        "mean ε along the first exploration, printed above prose",
        lambda s: bool(
            s.cells["printed-formula"].exploration[0] > s.cells["without-reward"].exploration[0]
        ),
        lambda s: float(s.cells["printed-formula"].exploration[0]),
        "median first ε {:.2f}",
        ("printed-formula", "without-reward"),
    ),
)
