"""What is asked of the contenders, task by task, and how their answers become rows."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from misstep.bench.hardware import Rates, em_work, query_work
from misstep.bench.peers import MISSTEP, SCIKIT_LEARN, Peer
from misstep.bench.plan import Plan, Size
from misstep.bench.problems import Mixture, draw_path, draw_samples, draw_start
from misstep.bench.random_mixtures import random_mixtures
from misstep.bench.results import Row, count_right
from misstep.bench.worker import Worker
from misstep.errors import MisstepError
from misstep.mixture import Conditioner, DonutMixture, GaussianMixture, exploration_from_variance
from misstep.mixture.donut import DEFAULT_K, DEFAULT_REACH

Array = NDArray[np.float64]
Workers = Mapping[tuple[Peer, int], Worker]
"""By contender and number of threads."""

_WARM = 2_000
"""Samples that a fit or a scan is tried on before it is timed."""
_WARM_QUERIES = 20
_WITHIN = 0.05
"""Of a standard deviation, so far apart may modes be that agree."""
_GROWTH = {"n": 20_000, "k": 5, "d": 5}
"""Samples, components and columns of a fit, where its cost is not followed along them."""
_NOT_OFFERED = "not offered"
"""What a contender answers whose library cannot do it."""

samples_of = lru_cache(maxsize=None)(draw_samples)


class Step(NamedTuple):
    """One measurement to make; no row if the contender does not offer it."""

    title: str
    run: Callable[[], Row | None]


@dataclass
class Measuring:
    """Everything that contenders are asked.

    Parameters
    ----------
    plan : Plan
    peers : sequence of Peer
        Who is there, misstep first: the others' modes are compared with its own.
    workers : mapping
        By contender and number of threads.
    rates : mapping of int to Rates
        By number of threads.
    seed : int
    """

    plan: Plan
    peers: Sequence[Peer]
    workers: Workers
    rates: Mapping[int, Rates]
    seed: int
    _modes: dict[tuple[int, int], Array] = field(default_factory=dict)

    def steps(self) -> Iterator[Step]:
        """Yield all measurements, in order."""
        yield from self._fits()
        yield from self._scans()
        yield from self._queries()
        yield from self._growth()
        yield from self._memory_and_right_k()

    def _fits(self) -> Iterator[Step]:
        K, iterations = self.plan.em_components, self.plan.em_iterations
        for size in self.plan.em_sizes:
            for threads in self.rates:
                for peer in self.peers:
                    row = self._row("em", peer, size, K, threads, iterations)
                    yield Step(_title(row), partial(self._fit, peer, row))

    def _scans(self) -> Iterator[Step]:
        threads, most = max(self.rates), self.plan.most_components
        for size in self.plan.scan_sizes:
            for peer in self.peers:
                if size[0] > self.plan.slow_samples and peer not in (MISSTEP, SCIKIT_LEARN):
                    continue
                row = self._row("em-scan", peer, size, most, threads, self.plan.scan_iterations)
                yield Step(_title(row), partial(self._scan_from_starts, peer, row))
                row = Row("bic-scan", peer.name, *size, threads=threads)
                yield Step(_title(row), partial(self._scan, peer, row))

    def _queries(self) -> Iterator[Step]:
        for d in self.plan.query_columns:
            for K in self.plan.query_components:
                for peer in self.peers:
                    row = Row("query", peer.name, d=d, k=K, threads=1)
                    yield Step(_title(row), partial(self._query, peer, row))

    def _growth(self) -> Iterator[Step]:
        for along, sizes in self.plan.growth.items():
            for size in sizes:
                at = _GROWTH | {along: size}
                for peer in (MISSTEP, SCIKIT_LEARN):
                    row = self._row(
                        f"growth-{along}",
                        peer,
                        (at["n"], at["d"]),
                        at["k"],
                        max(self.rates),
                        self.plan.em_iterations,
                    )
                    yield Step(_title(row), partial(self._fit, peer, row))

    def _memory_and_right_k(self) -> Iterator[Step]:
        for peer in self.peers:
            row = self._row("memory", peer, self.plan.memory_size, self.plan.em_components, 1, 2)
            yield Step(_title(row), partial(self._memory, peer, row))
        for peer in self.peers:
            if self.plan.mixtures.get(peer.name):
                row = Row("right-k", peer.name, threads=max(self.rates))
                yield Step(_title(row), partial(self._right_k, peer, row))

    def _row(self, task: str, peer: Peer, size: Size, K: int, threads: int, iterations: int) -> Row:
        return Row(task, peer.name, *size, K, threads, iterations=iterations)

    def _ask(
        self,
        peer: Peer,
        row: Row,
        operation: str,
        arrays: Mapping[str, Array],
        *,
        warm: int = _WARM,
        **settings: float,
    ) -> dict[str, Any]:
        worker = self.workers[peer, row.threads or 1]
        return worker.ask(operation, arrays, self.plan.limit, warm=warm, **settings)

    def _fit(self, peer: Peer, row: Row) -> Row | None:
        X, components = samples_of(row.n, row.d, self.seed), row.k or 1
        arrays = {"X": X, **_named(draw_start(X, components, self.seed))}
        settings = {"iterations": row.iterations or 1, "repeats": self.plan.repeats}
        answer = self._ask(peer, row, "fit", arrays, **settings)
        return self._timed(row, answer, components, X)

    def _scan_from_starts(self, peer: Peer, row: Row) -> Row | None:
        X, most = samples_of(row.n, row.d, self.seed), self.plan.most_components
        arrays = {"X": X}
        for K in range(1, most + 1):
            arrays |= _named(draw_start(X, K, self.seed), f"_{K}")
        settings = {"iterations": row.iterations or 1, "repeats": self.plan.repeats, "most": most}
        answer = self._ask(peer, row, "scan_from_starts", arrays, **settings)
        return self._timed(row, answer, most * (most + 1) // 2, X)

    def _timed(self, row: Row, answer: dict[str, Any], components: int, X: Array) -> Row | None:
        """Read times and a fitted mixture; `components` were fitted in all."""
        if "error" in answer:
            return _failed(row, answer)
        mixture = [np.array(part) for part in answer["mixture"]]
        mixture[2] = 0.5 * (mixture[2] + mixture[2].transpose(0, 2, 1))
        try:
            log_likelihood = GaussianMixture.from_parameters(*mixture).score(X)
        except MisstepError as error:
            return replace(row, error=str(error))
        work = em_work(len(X), X.shape[1], components, row.iterations or 1)
        return replace(
            row,
            seconds=min(answer["seconds"]),
            repeats=len(answer["seconds"]),
            log_likelihood=log_likelihood,
            bare_seconds=work.seconds(self.rates[row.threads or 1]),
        )

    def _scan(self, peer: Peer, row: Row) -> Row | None:
        arrays = {"X": samples_of(row.n, row.d, self.seed)}
        settings = {"most": self.plan.most_components, "repeats": self.plan.repeats}
        answer = self._ask(peer, row, "scan", arrays, seed=self.seed, **settings)
        if "error" in answer:
            return _failed(row, answer)
        seconds = answer["seconds"]
        return replace(row, k=answer["k"], seconds=min(seconds), repeats=len(seconds))

    def _query(self, peer: Peer, row: Row) -> Row | None:
        d, K = row.d or 2, row.k or 1
        path = draw_path(K, d, self.plan.queries, self.seed)
        count = self.plan.queries if peer == MISSTEP else self.plan.slow_queries
        arrays = {
            **_named(path.mixture),
            "states": path.states[:count],
            "scale": path.scale,
            "action": first_mode(path.mixture, path.states[0], path.scale),
        }
        settings = {"k": DEFAULT_K, "reach": DEFAULT_REACH}
        answer = self._ask(peer, row, "query", arrays, warm=_WARM_QUERIES, **settings)
        if "error" in answer:
            return _failed(row, answer)
        modes = np.array(answer["modes"])
        if peer == MISSTEP:
            self._modes[d, K] = modes
        agreement = None
        if (d, K) in self._modes:  # or misstep's own query has failed
            close = np.abs(modes - self._modes[d, K][:count]) < _WITHIN * path.scale / 0.3
            agreement = float(np.mean(close.all(axis=1)))
        microseconds = 1e-3 * np.array(answer["nanoseconds"], dtype=float)
        return replace(
            row,
            repeats=count,
            p50_us=float(np.percentile(microseconds, 50)),
            p99_us=float(np.percentile(microseconds, 99)),
            agreement=agreement,
            bare_seconds=query_work(d, len(path.scale), K).seconds(self.rates[1]),
        )

    def _memory(self, peer: Peer, row: Row) -> Row | None:
        X = samples_of(row.n, row.d, self.seed)
        arrays = {"X": X, **_named(draw_start(X, row.k or 1, self.seed))}
        # What an earlier job left with the allocator would hide what this one takes.
        self.workers[peer, row.threads or 1].stop()
        answer = self._ask(peer, row, "memory", arrays, iterations=row.iterations or 1)
        return _failed(row, answer) if "error" in answer else replace(row, n_bytes=answer["bytes"])

    def _right_k(self, peer: Peer, row: Row) -> Row | None:
        chosen, true, seconds = [], [], 0.0
        for X, K in random_mixtures(self.plan.mixtures[peer.name], self.seed):
            settings = {"most": self.plan.most_components, "repeats": 1, "seed": self.seed}
            answer = self._ask(peer, row, "scan", {"X": X}, **settings)
            if answer.get("error") == _NOT_OFFERED:
                return None
            chosen.append(answer.get("k", 0))
            true.append(K)
            seconds += sum(answer.get("seconds", ()))
        return count_right(replace(row, seconds=seconds), chosen, true)


def first_mode(mixture: Mixture, state: Array, scale: Array) -> Array:
    """Return the mode from the best analytic candidate: where every contender's path starts."""
    conditional = Conditioner(GaussianMixture.from_parameters(*mixture), range(len(state))).at(
        state
    )
    epsilon = exploration_from_variance(conditional.variance, scale)
    return DonutMixture(conditional, epsilon, DEFAULT_K, DEFAULT_REACH).mode()


def _named(mixture: Mixture, suffix: str = "") -> dict[str, Array]:
    names = ("weights", "means", "covariances")
    return {name + suffix: part for name, part in zip(names, mixture, strict=True)}


def _failed(row: Row, answer: dict[str, Any]) -> Row | None:
    return None if answer["error"] == _NOT_OFFERED else replace(row, error=answer["error"])


def _title(row: Row) -> str:
    sizes = [f"{name} {value:,}" for name in ("n", "d", "k") if (value := getattr(row, name))]
    threads = f"{row.threads} thread{'s' if row.threads != 1 else ''}"
    return f"{row.contender}, {row.task}: {', '.join([*sizes, threads])}"
