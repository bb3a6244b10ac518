"""What people write by hand: studies, runs, mappings, formulas, parameters."""

import io
import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

from fuzzing.cases import Attempt, Case, Target
from fuzzing.damage import (
    a_few,
    damaged,
    damaged_json,
    damaged_text,
    damaged_value,
    hostile_value,
    one_of,
)
from misstep import demonstrate, learn, make_system
from misstep.cli.options import parse_parameters
from misstep.demonstrators import DEMONSTRATORS
from misstep.formats import Episode
from misstep.judges import parse_cost, parse_predicate
from misstep.learners import LEARNERS
from misstep.parameters import build_parameters, parameter_table
from misstep.recordings.mapping import load_mapping, parse_columns
from misstep.runs import load_run
from misstep.study.spec import Study, load_study
from misstep.systems import SYSTEMS
from misstep.trajectory import Column

# Studies

_STUDY = """
[study]
name = "headline"
seeds = 3
max_trials = 20
tests = 4
seed = 0
videos = true

[[case]]
name = "balance"
system = "cartpole"
state = ["theta", "theta_dot"]
set = { force_limit = 10.0 }
test_set = { start_spread = 0.1 }
variants = [{ delay = 0.0 }, { delay = 0.02 }]
demonstrators = ["weak", { name = "noisy", with = { noise = 8.0 } }]
demonstrations = 4
learners = ["fall", { name = "donut", with = { reach = 3.0 }, called = "d" }]
"""
_STUDY_WORDS = (
    *("seeds", "tests", "set", "state", "variants", "with", "learners", "name", "[[case]]"),
    *("cartpole", "flipup", "gym:CartPole-v1", "gym:", "gym:no/such-v0", "weak", "donut", "1e300"),
)


def _open_study(folder: Path) -> Attempt:
    path, plain = folder / "study.toml", tomllib.loads(_STUDY)

    def attempt(case: Case) -> bool:
        rng = case.rng
        if rng.random() < 0.2:
            whole = json.loads(json.dumps(_read_study(path, _STUDY).to_json()))
            Study.from_json(_told(case, damaged_value(rng, whole, _STUDY_WORDS)))
            return True
        text = toml(damaged_value(rng, plain, _STUDY_WORDS))
        if rng.random() < 0.4:
            text = damaged_text(rng, _STUDY, _STUDY_WORDS)
        case.given = {path.name: text}
        _read_study(path, text)
        return True

    return attempt


def _read_study(path: Path, text: str) -> Study:
    path.write_bytes(text.encode("utf-8", "replace"))
    return load_study(path)


def _told(case: Case, value: Any) -> Any:
    case.given = {"value.json": json.dumps(value)}
    return value


def toml(value: Any) -> str:
    """Return a table as TOML, one name a line; what TOML lacks comes out wrong."""
    if not isinstance(value, dict):
        return _inline(value)
    return "\n".join(f"{json.dumps(name)} = {_inline(part)}" for name, part in value.items())


def _inline(value: Any) -> str:
    if isinstance(value, dict):
        parts = (f"{json.dumps(name)} = {_inline(part)}" for name, part in value.items())
        return "{" + ", ".join(parts) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_inline, value)) + "]"
    return repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False)


# Runs


def _open_run(folder: Path) -> Attempt:
    system = make_system("cartpole")
    shown = demonstrate(system, by="weak", n=2, seed=0)
    runs = []
    for learner in ("mean", "random-linear", "fall"):
        path = folder / learner
        options: dict[str, Any] = {"max_trials": 1, "seed": 1, "out": path}
        learn(system, shown, learner, state=("theta", "theta_dot"), **options)
        files = [file for file in sorted(path.rglob("*")) if file.is_file()]
        runs.append((path, {file: file.read_bytes() for file in files}))

    def attempt(case: Case) -> bool:
        path, whole = one_of(case.rng, runs)
        victim = one_of(case.rng, [path / "run.json", path / "run.json", *whole])
        changed = _changed(case.rng, victim, whole[victim])
        case.given = {str(victim.relative_to(folder)): changed}
        try:
            victim.write_bytes(changed)
            run = load_run(path)
            run.policy.reset()
            run.policy(np.zeros(4))
        finally:
            victim.write_bytes(whole[victim])
        return True

    return attempt


_RUN_WORDS = ("system", "learner", "state", "seed", "theta", "x", "cartpole", "gym:a", "mean")


def _changed(rng: Generator, victim: Path, whole: bytes) -> bytes:
    if victim.suffix == ".json" and rng.random() < 0.8:
        return damaged_json(rng, whole.decode(), _RUN_WORDS).encode("utf-8", "replace")
    if victim.suffix == ".npz" and rng.random() < 0.7:
        with np.load(io.BytesIO(whole), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        name = one_of(rng, list(arrays))
        arrays[name] = hostile_array(rng, arrays[name])
        if rng.random() < 0.1:
            del arrays[name]
        buffer = io.BytesIO()
        one_of(rng, (np.savez, np.savez_compressed))(buffer, allow_pickle=False, **arrays)
        return buffer.getvalue()
    return damaged(rng, whole)


def hostile_array(rng: Generator, like: np.ndarray) -> np.ndarray:
    """Return an array that differs from another one in its values, shape or type."""
    what = rng.random()
    if what < 0.5 and like.size and like.dtype.kind == "f":
        changed = like.copy()
        values = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e308, -1e308, 5e-324, 1e-200, 1e200)
        for _ in range(a_few(rng)):
            changed.ravel()[int(rng.integers(like.size))] = one_of(rng, values)
        return changed
    if what < 0.75:
        shapes = ((), (0,), (1,), (2, 2), (like.size, 1), (1, like.size), (3, 0), (1, 1, 1))
        return np.resize(like, one_of(rng, shapes)) if like.size else np.ones(one_of(rng, shapes))
    if what < 0.8:
        return like * 1e200 if like.dtype.kind == "f" else like
    kinds = ("i8", "f4", "f2", "?", "c16", "U3", "S3", "u1", "M8[s]", ">f8", "f8,f8")
    try:
        return like.astype(one_of(rng, kinds))
    except (TypeError, ValueError):
        return np.zeros(like.shape, "c16")


# Mappings of columns

_MAPPING = """
rate = 1000.0
time = "stamp:ms"
episode = "n"
named = true

[[observations]]
name = "theta"
source = "x"
unit = "deg"
factor = -1.0
offset = 3.0

[[observations]]
name = "x"
source = "1"

[[actions]]
name = "force"
source = "force"
unit = "N"
"""
_COLUMNS = 'theta=x:deg:-1:pi, v=1, "a b"="x", force=force:kN:2'
_MAPPING_WORDS = ("name", "source", "unit", "factor", "offset", "deg", "x", "0", "1", "pi", "nan")


def _open_mapping(folder: Path) -> Attempt:
    path, plain = folder / "mapping.toml", tomllib.loads(_MAPPING)
    attempts = demonstrate(make_system("cartpole"), by="weak", n=1, seed=0)

    def attempt(case: Case) -> bool:
        rng = case.rng
        if rng.random() < 0.3:
            text = damaged_text(rng, _COLUMNS, (*_MAPPING_WORDS, ":", "=", ",", '"'))
            case.given = {"columns.txt": text}
            parse_columns("--columns", text)
            return True
        text = toml(damaged_value(rng, plain, _MAPPING_WORDS))
        if rng.random() < 0.4:
            text = damaged_text(rng, _MAPPING, _MAPPING_WORDS)
        case.given = {path.name: text}
        path.write_bytes(text.encode("utf-8", "replace"))
        mapping = load_mapping(path)
        mapping.options()
        for _ in mapping.apply(Episode.of(attempts[0])).blocks:
            pass
        return True

    return attempt


# Formulas

_FORMULAS = (
    "abs(theta) > 30deg and not (-2.4 < x < 2.4m)",
    "min(x, 2 cm, -theta_dot*3) + sqrt(abs(x)) / (theta - 1)",
    "x**2 + sin(theta) * 57.3 - cos(30 deg) <= 1e-3 or x_dot != 0",
)
_FORMULA_WORDS = (
    *("abs", "min", "max", "sin", "cos", "sqrt", "and", "or", "not", "(", ")", "<", "<=", "=="),
    *("+", "-", "*", "/", "x", "theta", "deg", "rad", "m", "cm", "s", "N", "1e400", "0", "0.0"),
    *("__import__('os')", "lambda: 0", "x.__class__", "python:f", "1if 1else 2", "exec", "**"),
)
_COLUMNS_OF = (
    Column("x", "m"),
    Column("x_dot", "m/s"),
    Column("theta", "rad"),
    Column("theta_dot", "rad/s"),
    Column("and", ""),
    Column("a.b", "furlong"),
)
_VALUES = (0.0, -0.0, 1.0, np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324)


def _open_formula(folder: Path) -> Attempt:
    def attempt(case: Case) -> bool:
        rng = case.rng
        text = damaged_text(rng, one_of(rng, _FORMULAS), _FORMULA_WORDS)
        if rng.random() < 0.2:
            text = " ".join(one_of(rng, _FORMULA_WORDS) for _ in range(int(rng.integers(1, 60))))
        case.given = {"formula.txt": text}
        parse = one_of(rng, (parse_predicate, parse_cost))
        formula = parse(text, _COLUMNS_OF)
        for _ in range(3):
            result = formula(np.array([one_of(rng, _VALUES) for _ in _COLUMNS_OF]))
            if not isinstance(result, bool if parse is parse_predicate else int | float):
                raise TypeError(f"a formula returns {type(result).__name__}")
        return True

    return attempt


# Parameters

_SETTINGS = ("pole_mass=0.2", "delay=0.02", "force_limit=10", "success=abs(x) < 1m", "duration=1e1")


def _open_set(folder: Path) -> Attempt:
    owners: list[tuple[str, Callable[..., Any], list[str]]] = [
        (f"system {name}", lambda name=name, **given: make_system(name, **given), names)
        for name, names in (
            (name, [row.name for row in parameter_table(kind.parameters_type)])
            for name, kind in SYSTEMS.items()
            if hasattr(kind, "parameters_type")
        )
    ]
    owners.append(("system", lambda **given: make_system("cartpole", **given), ["pole_mass"]))
    for registry in (LEARNERS, DEMONSTRATORS):
        for name, kind in registry.items():
            names = [row.name for row in parameter_table(kind)]
            owners.append((name, _builder(kind, name), names or ["x"]))

    def attempt(case: Case) -> bool:
        rng = case.rng
        what, build, names = one_of(rng, owners)
        if rng.random() < 0.5:
            texts = [damaged_text(rng, one_of(rng, _SETTINGS), (*names, "=", "1", "true", "nan"))]
            texts += [f"{one_of(rng, names)}={one_of(rng, ('1', 'nan', '1e400', 'x', '-1'))}"]
            given: dict[str, Any] = dict(parse_parameters("--set", texts))
        else:
            given = {one_of(rng, names): hostile_value(rng) for _ in range(a_few(rng))}
        case.given = {f"{what}.json": json.dumps(given, default=str)}
        build(**given)
        return True

    return attempt


def _builder(kind: type, name: str) -> Callable[..., Any]:
    return lambda **given: build_parameters(kind, name, given)


TARGETS = (
    Target("study", 40_000, _open_study),
    Target("run", 40_000, _open_run),
    Target("mapping", 60_000, _open_mapping),
    Target("formula", 100_000, _open_formula),
    Target("parameters", 60_000, _open_set),
)
