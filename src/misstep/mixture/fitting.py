"""Fitting many mixtures to one set of samples: which starts go on, and how threads share the work.

A scan over K tries all starts of all K for a few iterations, and the best of each K goes on to
convergence. Each of these is one compiled call that lets go of the interpreter's lock, so threads
take one after another, the most expensive first.

Where there are fewer mixtures than threads, or more data than memory, the fits go by passes
instead: in each pass the data come by once, in pieces, and threads share the panels of a piece. A
panel's moments are the same whoever adds them up, and are added in order, so the result does not
depend on the number of threads.
"""

import math
import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from misstep.mixture import em
from misstep.mixture.em import Mixture, Moments, Rule, Samples, Work
from misstep.threads import available_cores, thread_pool

Array = NDArray[np.float64]
Start = Callable[[], Mixture]
Spread = Callable[[Callable[[Any], Any], Sequence[Any]], list[Any]]

# Iterations after which the starts of one K are compared and only the best goes on.
TRYOUT = 15

# Samples × components × columns, about a nanosecond each, from which on threads pay: for a whole
# scan, and for each pass, where they have to be started and waited for.
WORTH_THREADS = 20_000
WORTH_PASSES = 400_000


class Fit(NamedTuple):
    """One fitted mixture of standardised samples."""

    log_likelihood: float
    """Weighted, of all samples; NaN if a covariance collapsed."""
    n_iter: int
    converged: bool
    mixture: Mixture


def available_threads() -> int:
    """Return one for each core of this process, or 1 in a worker process, whose siblings work too.

    The environment variable OMP_NUM_THREADS, where it is a number, is obeyed.
    """
    limit = os.environ.get("OMP_NUM_THREADS", "")
    if limit.isdigit() and int(limit) > 0:
        return int(limit)
    if multiprocessing.parent_process() is not None:
        return 1
    return available_cores()


@contextmanager
def spread_over(threads: int) -> Iterator[Spread]:
    """Yield a function that applies another to each of many arguments, in threads."""
    if threads == 1:
        yield lambda function, arguments: [function(a) for a in arguments]
        return
    with thread_pool(threads) as pool:
        yield lambda function, arguments: list(pool.map(function, arguments))


def fit_one(samples: Samples, rule: Rule, mixture: Mixture) -> Fit:
    """Run expectation–maximisation from `mixture`, which is overwritten, in this thread."""
    K, d = mixture.means.shape
    n_panels = em.panels_of(samples)
    room = Moments.room_for(n_panels, K, d), Work.room_for(K, d)
    total = float(samples.weight.sum())
    value, n_iter, converged = em.iterate(samples, mixture, *room, 0, n_panels, total, rule)
    return Fit(value, n_iter, converged, mixture)


def fit_each(
    samples: Samples, candidates: Mapping[int, Sequence[Start]], rule: Rule, threads: int
) -> dict[int, Fit]:
    """Fit one mixture for each K.

    Parameters
    ----------
    samples : Samples
    candidates : mapping of int to sequence of callable
        For each K the starts to choose from; a single one goes straight on to convergence.
    rule : Rule
    threads : int
    """
    largest_first = sorted(candidates, reverse=True)
    cells = samples.weight.size * samples.blocks.shape[1]
    threads = threads if cells * sum(candidates) >= WORTH_THREADS else 1

    def try_out(start: Start) -> Fit:
        return fit_one(samples, rule._replace(max_iter=TRYOUT), start())

    several = [(K, s) for K in largest_first if len(candidates[K]) > 1 for s in candidates[K]]
    with spread_over(min(threads, max(len(several), len(candidates)))) as spread:
        tried = spread(try_out, [start for _, start in several])
        chosen = {K: candidates[K][0]() for K in candidates if len(candidates[K]) == 1}
        best = dict.fromkeys(candidates, math.inf)
        for (K, _), fit in zip(several, tried, strict=True):
            loss = -fit.log_likelihood if math.isfinite(fit.log_likelihood) else math.inf
            if loss < best[K] or K not in chosen:
                best[K], chosen[K] = loss, fit.mixture
        mixtures = [chosen[K] for K in largest_first]
        if len(mixtures) < threads and cells * sum(candidates) >= WORTH_PASSES:
            total = float(samples.weight.sum())
            fits = fit_by_passes([samples], mixtures, total, rule, threads)
        else:
            fits = spread(partial(fit_one, samples, rule), mixtures)
    return dict(zip(largest_first, fits, strict=True))


class _Pending:
    """A mixture that is fitted by passes: the sums so far, and where it stands."""

    def __init__(self, mixture: Mixture, total_weight: float, rule: Rule) -> None:
        self.mixture = mixture
        self.n_iter = 0
        self.converged = False
        self.done = False
        self.log_likelihood = -math.inf
        self._total_weight = total_weight
        self._rule = rule
        self._sums = Moments.room_for(1, *mixture.means.shape)

    def clear(self) -> None:
        """Begin a pass."""
        for total in self._sums:
            total[:] = 0.0

    def add(self, part: Moments) -> None:
        """Add one piece's moments."""
        em.add_panels(part)
        for total, values in zip(self._sums, part, strict=True):
            total[0] += values[0]

    def step(self) -> None:
        """End a pass: stop, or maximise. As `em.iterate` does."""
        previous = self.log_likelihood
        self.log_likelihood = float(self._sums.log_likelihood[0])
        rise = abs(self.log_likelihood - previous)
        self.converged = rise < self._rule.tol * self._total_weight
        collapsed = math.isnan(self.log_likelihood)
        self.done = self.converged or collapsed or self.n_iter == self._rule.max_iter
        if not self.done:
            em.maximise(self._sums, self.mixture, self._rule.floor)
            self.n_iter += 1


def fit_by_passes(
    pieces: Iterable[Samples],
    mixtures: Sequence[Mixture],
    total_weight: float,
    rule: Rule,
    threads: int,
) -> list[Fit]:
    """Run expectation–maximisation from all `mixtures` at once, each pass reading the data once.

    Parameters
    ----------
    pieces : iterable of Samples
        Iterated anew for each pass.
    mixtures : sequence of Mixture
        The starts; overwritten.
    total_weight : float
        Of all pieces together.
    rule : Rule
    threads : int
    """
    pending = [_Pending(mixture, total_weight, rule) for mixture in mixtures]
    with spread_over(threads) as spread:
        while active := [fit for fit in pending if not fit.done]:
            for fit in active:
                fit.clear()
            for samples in pieces:
                parts = _moments(samples, active, spread, threads)
                for fit, part in zip(active, parts, strict=True):
                    fit.add(part)
            for fit in active:
                fit.step()
    return [Fit(f.log_likelihood, f.n_iter, f.converged, f.mixture) for f in pending]


def _moments(
    samples: Samples, fits: Sequence[_Pending], spread: Spread, threads: int
) -> list[Moments]:
    """Return the moments of a piece under each mixture; NaN where a covariance collapsed."""
    n_panels = em.panels_of(samples)
    bounds = np.linspace(0, n_panels, min(threads, n_panels) + 1).astype(int).tolist()
    shares = list(pairwise(bounds))
    rooms = [Moments.room_for(n_panels, *fit.mixture.means.shape) for fit in fits]
    only_moments = Rule(np.zeros(fits[0].mixture.means.shape[1]), 0.0, -1)

    def fill(task: tuple[Mixture, Moments, tuple[int, int]]) -> None:
        mixture, moments, share = task
        work = Work.room_for(*mixture.means.shape)
        value, _, _ = em.iterate(samples, mixture, moments, work, *share, 0.0, only_moments)
        if math.isnan(value):
            moments.log_likelihood[share[0]] = math.nan

    each = zip(fits, rooms, strict=True)
    spread(fill, [(fit.mixture, room, share) for fit, room in each for share in shares])
    return rooms
