"""How many densities a climb to a donut mixture's mode takes, over 100,000 random conditionals.

``python studies/climbs.py`` writes ``studies/climbs.csv``: for every number of actions, warm or
cold, how many climbs took so many densities. About a minute.

A conditional has 1 to 10 components in 1 to 14 actions, near each other or far apart, weights even
or uneven, and any exploration; one in five has an exploration within 1e-9 of 1, where holes are
deepest. Cold, a climb begins at the best analytic candidate. Warm, it begins at the mode of a
neighbouring state: the same conditional before its means moved by a tenth of a standard deviation
and its weights by a fifth.
"""

import csv
from collections import Counter
from pathlib import Path

import numpy as np

from misstep.mixture import Conditional, DonutMixture, compiled

N, SEED = 100_000, 0


def draw(rng):
    """Return a conditional, one of a neighbouring state, an exploration and a reach."""
    d, K = int(rng.integers(1, 15)), int(rng.integers(1, 11))
    factors = rng.normal(size=(K, d, d))
    covariances = factors @ factors.transpose(0, 2, 1) / d + 0.1 * np.eye(d)
    means = rng.choice([1.0, 3.0]) * rng.normal(size=(K, d))
    weights = rng.dirichlet(np.full(K, rng.choice([0.3, 3.0])))
    moved = means + 0.1 * np.einsum(
        "kij,kj->ki", np.linalg.cholesky(covariances), rng.normal(size=(K, d))
    )
    weighed = weights * np.exp(0.2 * rng.normal(size=K))
    exploration = rng.random() if rng.random() < 0.8 else 1.0 - 10.0 ** -rng.uniform(1.0, 9.0)
    here = Conditional(weights, means, covariances)
    near = Conditional(weighed / weighed.sum(), moved, covariances)
    return here, near, exploration, float(rng.choice([1.0, 2.0, 3.0]))


def climb(mixture, a):
    """Return how many densities a climb from `a` takes."""
    whiteners, precisions, _, log_norms = mixture._components
    room = compiled.scratch_for(*mixture.conditional.means.shape)
    means = mixture.conditional.means
    with np.errstate(divide="ignore"):
        log_h = np.log(mixture.conditional.weights)
    return compiled.ascend(a, log_h, means, whiteners, precisions, log_norms, mixture.shape, room)[
        1
    ]


def best_start(mixture):
    """Return the best analytic candidate."""
    whiteners, _, lowers, log_norms = mixture._components
    K, d = mixture.conditional.means.shape
    a = np.empty(d)
    with np.errstate(divide="ignore"):
        log_h = np.log(mixture.conditional.weights)
    means, room = mixture.conditional.means, compiled.scratch_for(K, d)
    ridge = mixture.ridge_radius
    compiled.best_candidate(
        a, log_h, means, whiteners, lowers, log_norms, mixture.shape, ridge, room
    )
    return a


def main():
    """Make the climbs and write and print their distribution."""
    rng = np.random.default_rng(SEED)
    counts = Counter()
    for number in range(N):
        here, near, exploration, reach = draw(rng)
        mixture = DonutMixture(here, exploration, reach=reach)
        warm = number % 2 == 1
        start = DonutMixture(near, exploration, reach=reach).mode() if warm else best_start(mixture)
        counts[here.means.shape[1], warm, climb(mixture, start)] += 1
    with open(Path(__file__).with_suffix(".csv"), "w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["actions", "start", "densities", "climbs"])
        for (d, warm, n), count in sorted(counts.items()):
            rows.writerow([d, "warm" if warm else "cold", n, count])
    for warm in (False, True):
        taken = np.repeat(
            *zip(*[(k[2], c) for k, c in counts.items() if k[1] == warm], strict=True)
        )
        quantiles = ", ".join(f"{q} %: {np.percentile(taken, q):.0f}" for q in (50, 90, 99, 99.9))
        print("warm" if warm else "cold", quantiles, "largest:", taken.max(), "of", len(taken))


if __name__ == "__main__":
    main()
