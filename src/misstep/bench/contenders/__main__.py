"""Measure one contender: jobs come in as lines of JSON, answers go out as lines of JSON.

Arrays travel as ``.npy`` files, named in the job; answers hold lists. Times are taken here, around
the library alone.
"""

import json
import os
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, TextIO, cast

import numpy as np

MOST_SECONDS = 3.0
"""A measurement is not repeated after so long."""


def fit(library: ModuleType, job: dict[str, Any], arrays: dict[str, Any]) -> dict[str, Any]:
    """Time EM from a given start; the answer holds the fitted parameters."""
    X, start = arrays["X"], _start(arrays)
    library.fit(X[: job["warm"]], *_start(arrays), 2)
    models: list[Any] = []

    def run() -> None:
        models[:] = [library.fit(X, *[a.copy() for a in start], job["iterations"])]

    return {"seconds": _times(run, job["repeats"]), "mixture": _listed(library, models[0])}


def scan_from_starts(
    library: ModuleType, job: dict[str, Any], arrays: dict[str, Any]
) -> dict[str, Any]:
    """Time EM from given starts for every K, with the log-likelihood that BIC needs."""
    X = arrays["X"]
    fit_all = getattr(library, "fit_all", partial(_one_by_one, library))

    def starts() -> list[Any]:
        return [_start(arrays, f"_{k}") for k in range(1, job["most"] + 1)]

    fit_all(X[: job["warm"]], starts(), 2)
    fitted: list[tuple[Any, float]] = []

    def run() -> None:
        fitted[:] = fit_all(X, starts(), job["iterations"])

    return {"seconds": _times(run, job["repeats"]), "mixture": _listed(library, fitted[-1][0])}


def scan(library: ModuleType, job: dict[str, Any], arrays: dict[str, Any]) -> dict[str, Any]:
    """Time the choice of K with the library's own defaults."""
    X = arrays["X"]
    library.scan(X[: job["warm"]], 2, job["seed"])
    chosen: list[int] = []
    seconds = _times(
        lambda: chosen.append(int(library.scan(X, job["most"], job["seed"]))), job["repeats"]
    )
    return {"seconds": seconds, "k": chosen[0]}


def query(library: ModuleType, job: dict[str, Any], arrays: dict[str, Any]) -> dict[str, Any]:
    """Time one mode after the other along a path of states, each from the action before."""

    def begin() -> Callable[[Any, Any], Any]:
        made = library.querier(
            _start(arrays), states.shape[1], arrays["scale"], job["k"], job["reach"]
        )
        return cast(Callable[[Any, Any], Any], made)

    states, action = arrays["states"], arrays["action"]
    mode = begin()
    for state in states[: job["warm"]]:
        action = mode(state, action)
    mode, action = begin(), arrays["action"]
    times, modes = [], []
    for state in states:
        started = time.perf_counter_ns()
        action = mode(state, action)
        times.append(time.perf_counter_ns() - started)
        modes.append(action.tolist())
    return {"nanoseconds": times, "modes": modes}


def memory(library: ModuleType, job: dict[str, Any], arrays: dict[str, Any]) -> dict[str, Any]:
    """Return by how many bytes a fit raised the memory that this process holds."""
    X = arrays["X"]
    library.fit(X[: job["warm"]], *_start(arrays), 2)
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    before = _status("VmRSS")
    library.fit(X, *_start(arrays), job["iterations"])
    return {"bytes": _status("VmHWM") - before}


OPERATIONS: dict[str, Callable[..., dict[str, Any]]] = {
    function.__name__: function for function in (fit, scan_from_starts, scan, query, memory)
}


def _start(arrays: dict[str, Any], suffix: str = "") -> list[Any]:
    return [arrays[name + suffix].copy() for name in ("weights", "means", "covariances")]


def _one_by_one(
    library: ModuleType, X: Any, starts: list[Any], iterations: int
) -> list[tuple[Any, float]]:
    models = [library.fit(X, *start, iterations) for start in starts]
    return [(model, library.log_likelihood(model, X)) for model in models]


def _listed(library: ModuleType, model: Any) -> list[Any]:
    return [np.asarray(part, dtype=float).tolist() for part in library.parameters(model)]


def _times(run: Callable[[], object], repeats: int) -> list[float]:
    seconds: list[float] = []
    while len(seconds) < repeats and sum(seconds) < MOST_SECONDS:
        started = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - started)
    return seconds


def _status(name: str) -> int:
    """Return a size that Linux keeps of this process, bytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name + ":"):
            return 1024 * int(line.split()[1])
    raise OSError(f"/proc/self/status does not tell {name}")


def _answer(library: ModuleType, line: str) -> dict[str, Any]:
    job = json.loads(line)
    if not hasattr(library, _NEEDS[job["operation"]]):
        return {"error": "not offered"}
    arrays = {name: np.load(path, allow_pickle=False) for name, path in job["arrays"].items()}
    try:
        return OPERATIONS[job["operation"]](library, job, arrays)
    except Exception as error:  # whatever a library raises is its result
        return {"error": " ".join(f"{type(error).__name__}: {error}".split())[:300]}


_NEEDS = {
    "fit": "fit",
    "scan_from_starts": "fit",
    "scan": "scan",
    "query": "querier",
    "memory": "fit",
}
"""The function of a contender's module that an operation needs."""


def serve(name: str, jobs: TextIO, answers: TextIO) -> None:
    """Answer jobs until there are no more."""
    library = import_module(f".{name}", __package__)
    for line in jobs:
        answers.write(json.dumps(_answer(library, line)) + "\n")
        answers.flush()


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    np.seterr(all="ignore")
    # Libraries print as they please; the answers keep the real stdout to themselves.
    with os.fdopen(os.dup(1), "w") as out, suppress(KeyboardInterrupt):
        os.dup2(2, 1)
        serve(sys.argv[1], sys.stdin, out)
