"""Estimators and what is asked of them, with arrays of hostile values, shapes and types.

As scikit-learn wants it, an array that is no table of numbers is refused with a ValueError, in
scikit-learn's or NumPy's own words; and what is of the wrong type altogether, as Python has it,
with a TypeError. Whatever is answered is a number: no density is NaN, and shares sum to one.
"""

import traceback
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

from fuzzing.cases import Attempt, Case, Target
from fuzzing.damage import a_few, one_of
from fuzzing.settings import hostile_array
from misstep.mixture import (
    Conditioner,
    Donut,
    DonutMixture,
    DonutQuery,
    DonutShape,
    GaussianMixture,
    exploration_from_variance,
)

_SCALES = (1.0, 1.0, 1e-300, 1e-12, 1e12, 1e150, 1e300)
_NUMBERS = (0, 1, -1, 2, 0.5, 1e300, np.nan, np.inf, -np.inf, None, True, "1", 10**300)


def points(rng: Generator, d: int) -> Any:
    """Return samples (N, d), or what is not."""
    N = int(rng.integers(0, 25))
    X: Any = rng.normal(size=(N, d)) * one_of(rng, _SCALES) + one_of(rng, (0.0, 0.0, 1.0, 1e9))
    what = rng.random()
    if what < 0.3:
        return X
    if what < 0.4:
        return np.repeat(X[:1], N, axis=0)
    if what < 0.5 and d > 1:
        X[:, 0] = X[:, -1]
        return X
    if what < 0.55:
        return one_of(
            rng,
            (
                None,
                "text",
                7,
                {},
                [],
                [[]],
                [[1.0], [2.0, 3.0]],
                [["a", "b"]] * 9,
                object(),
                {1: 2},
            ),
        )
    if what < 0.6:
        return X.astype(object)
    if what < 0.63:
        return np.array([[{}] * d] * N, dtype=object)
    return hostile_array(rng, X)


def weights(rng: Generator, X: Any) -> Any:
    """Return weights of samples, or what is not."""
    N = np.shape(X)[0] if isinstance(X, np.ndarray) and X.ndim else 3
    w: Any = rng.exponential(size=N) * one_of(rng, _SCALES)
    what = rng.random()
    if what < 0.3:
        return None
    if what < 0.5:
        return w
    if what < 0.6:
        return w * (rng.random(N) < 0.3)
    return one_of(rng, (-w, w[:-1], "x", [None] * N)) if what < 0.7 else hostile_array(rng, w)


def _options(rng: Generator) -> dict[str, Any]:
    options: dict[str, Any] = {
        "n_components": one_of(rng, (None, 1, 2, 3)),
        "max_components": 3,
        "n_init": 1,
        "max_iter": 20,
        "random_state": 0,
        "n_jobs": 1,
    }
    if rng.random() < 0.3:
        names = ("n_components", "max_components", "n_init", "tol", "max_iter", "covariance_floor")
        numbers = [n for n in _NUMBERS if not isinstance(n, float | int) or abs(n) < 1e3 or n != n]
        options[one_of(rng, names)] = one_of(rng, numbers)
    if rng.random() < 0.2:
        name = one_of(rng, ("weights_init", "means_init", "precisions_init"))
        options[name] = hostile_array(rng, np.ones((2, 2)))
    return options


def _is_contract(error: Exception) -> bool:
    """Whether an error is what scikit-learn and NumPy say to what is no table of numbers."""
    if type(error) not in (ValueError, TypeError):
        return False
    frames = traceback.extract_tb(error.__traceback__)
    if any("sklearn/utils" in frame.filename for frame in frames):
        return True
    told_by_numpy = "np." in (frames[-1].line or "")
    return len(str(error).splitlines()) == 1 and (type(error) is TypeError or told_by_numpy)


def _as_contracted(attempt: Attempt) -> Attempt:
    def wrapped(case: Case) -> bool:
        try:
            return attempt(case)
        except Exception as error:
            if _is_contract(error):
                return False
            raise

    return wrapped


def _no_nan(name: str, values: Any) -> None:
    if np.isnan(values).any():
        raise ArithmeticError(f"{name} is NaN")


def _open_mixture(folder: Path) -> Attempt:
    def attempt(case: Case) -> bool:
        rng = case.rng
        d = int(rng.integers(1, 4))
        X, options = points(rng, d), _options(rng)
        w = weights(rng, X)
        case.given = {"call.txt": f"GaussianMixture(**{options}).fit({X!r}, sample_weight={w!r})"}
        mixture = GaussianMixture(**options).fit(X, sample_weight=w)
        for name in ("weights_", "means_", "covariances_"):
            if not np.isfinite(getattr(mixture, name)).all():
                raise ArithmeticError(f"{name} is not finite")
        asked = X if rng.random() < 0.5 else points(rng, d)
        case.given["call.txt"] += f"\nasked for {asked!r}"
        _no_nan("score_samples", mixture.score_samples(asked))
        shares = mixture.predict_proba(asked)
        if not np.allclose(shares.sum(axis=1), 1.0):
            raise ArithmeticError("predict_proba does not sum to 1")
        mixture.predict(asked)
        mixture.score(asked)
        mixture.bic(asked)
        return True

    return _as_contracted(attempt)


def _open_donut(folder: Path) -> Attempt:
    rng = np.random.default_rng(0)
    joint = [
        GaussianMixture(K, random_state=0, n_jobs=1).fit(rng.normal(size=(60, d)))
        for K, d in ((1, 2), (3, 3), (2, 4))
    ]

    def attempt(case: Case) -> bool:
        rng = case.rng
        mixture = one_of(rng, joint)
        width = mixture.means_.shape[1]
        given = list(range(width - 1)) if rng.random() < 0.8 else _indices(rng, width)
        state = _vector(rng, width - 1)
        numbers = {"k": 2.0, "reach": 2.0, "exploration": float(rng.random())}
        if rng.random() < 0.3:
            numbers[one_of(rng, list(numbers))] = one_of(rng, _NUMBERS)
        asked = points(rng, 1)
        case.given = {"call.txt": f"given {given!r}, at {state!r}, {numbers}, asked {asked!r}"}
        conditioner = Conditioner(mixture, given)
        conditional = conditioner.at(state)
        _no_nan("mean", conditional.mean)
        _no_nan("variance", conditional.variance)
        donuts = DonutMixture(conditional, **numbers)
        _no_nan("mode", donuts.mode(_vector(rng, 1) if rng.random() < 0.5 else None))
        _no_nan("log_pdf", donuts.log_pdf(asked))
        _no_nan("gradient", donuts.gradient(asked))
        exploration_from_variance(conditional.variance, _vector(rng, 1))
        scale, states = _vector(rng, 1), points(rng, width - 1)
        case.given["call.txt"] += f"\nscale {scale!r}, states {states!r}"
        actions, explorations = DonutQuery(conditioner, scale).modes(states)
        _no_nan("modes", actions)
        _no_nan("explorations", explorations)
        return True

    return _as_contracted(attempt)


def _open_one_donut(folder: Path) -> Attempt:
    def attempt(case: Case) -> bool:
        rng = case.rng
        d = int(rng.integers(1, 4))
        mean, covariance = _vector(rng, d), _matrix(rng, d)
        family = [one_of(rng, (0.0, 0.5, 1.0, 1e-9)), d, 2.0, 2.0]
        if rng.random() < 0.3:
            family[int(rng.integers(4))] = one_of(rng, _NUMBERS)
        asked = points(rng, d)
        case.given = {"call.txt": f"Donut({mean!r}, {covariance!r}, {family}), asked {asked!r}"}
        donut = Donut(mean, covariance, DonutShape.of(*family))
        _no_nan("log_pdf", donut.log_pdf(asked))
        _no_nan("gradient", donut.gradient(asked))
        _no_nan("ridge_radius", donut.ridge_radius)
        return True

    return _as_contracted(attempt)


def _indices(rng: Generator, width: int) -> Any:
    values = (0, 1, -1, width, 2**40, 0.5, "0", None)
    return [one_of(rng, values) for _ in range(a_few(rng))]


def _vector(rng: Generator, d: int) -> Any:
    plain = rng.normal(size=d) * one_of(rng, _SCALES)
    what = rng.random()
    if what < 0.6:
        return np.abs(plain)
    if what < 0.65:
        return one_of(rng, (None, "x", [], {}, [None] * d, [[1.0]] * d))
    return hostile_array(rng, plain)


def _matrix(rng: Generator, d: int) -> Any:
    factor = rng.normal(size=(d, d))
    plain = (factor @ factor.T + 0.1 * np.eye(d)) * one_of(rng, (1.0, 1.0, 1e-200, 1e200, -1.0))
    return plain if rng.random() < 0.6 else hostile_array(rng, plain)


TARGETS = (
    Target("mixture", 40_000, _open_mixture),
    Target("donut-mixture", 60_000, _open_donut),
    Target("donut", 60_000, _open_one_donut),
)
