"""What a study runs, as a short TOML file.

    [study]
    name = "headline"
    seeds = 100         # repetitions of everything, each with its own demonstrations
    max_trials = 20
    tests = 20          # starts from which each final policy is tried
    seed = 0            # of the whole
    videos = true       # of first successes

    [[case]]
    name = "balance"
    system = "cartpole"
    state = ["theta", "theta_dot"]             # all columns if left out
    set = { force_limit = 10 }                 # parameters of the system
    test_set = { start_spread = 0.1 }          # other parameters for the tests
    variants = [{ delay = 0 }, { delay = 0.02 }]    # the same again with each of these set
    demonstrators = ["weak", { name = "noisy", with = { noise = 8 } }]
    demonstrations = 4
    learners = ["fall", { name = "donut", with = { reach = 3 } }, { name = "cma-es", seeds = 20 }]

A case may set ``seeds``, ``max_trials`` and ``tests`` for itself, and a learner that takes long
fewer ``seeds`` and ``tests`` than its case: the first of them. Tables show a learner with its
parameters, or as it is ``called``. Of a case only ``name``,
``system``, ``demonstrators`` and ``learners`` are necessary. Everything is built once while the
file is read, so that a mistake is told before anything runs.
"""

import os
import re
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from misstep.demonstrators import DEMONSTRATORS
from misstep.errors import MisstepError
from misstep.learners import LEARNERS, Task
from misstep.parameters import ParameterValue, build_parameters
from misstep.systems import System
from misstep.systems.gymnasium_adapter import PREFIX
from misstep.systems.recorded import recorded_system, system_kind

QUICK, MOST_QUICK_TESTS = 50, 2
"""A quick study makes one repetition in so many, but at least one, and no more tests than this."""

_NAME = re.compile(r"\w[\w .+-]*")
_KINDS = {
    str: "a text",
    int: "a whole number",
    bool: "true or false",
    dict: "a table",
    list: "a list",
}

_LIMITS = {"seeds": 1, "max_trials": 1, "tests": 0, "seed": 0, "demonstrations": 1}
"""The least that each number may be."""
_STUDY: dict[str, type] = {
    "name": str,
    "seeds": int,
    "max_trials": int,
    "tests": int,
    "seed": int,
    "videos": bool,
}
_CASE: dict[str, type] = {
    "name": str,
    "system": str,
    "set": dict,
    "test_set": dict,
    "variants": list,
    "state": list,
    "demonstrators": list,
    "demonstrations": int,
    "learners": list,
    "seeds": int,
    "max_trials": int,
    "tests": int,
}
_DEMONSTRATOR: dict[str, type] = {"name": str, "with": dict}
_LEARNER: dict[str, type] = {**_DEMONSTRATOR, "seeds": int, "tests": int, "called": str}


@dataclass(frozen=True)
class Choice:
    """A demonstrator or a learner, and its parameters where they are not at their defaults."""

    name: str
    parameters: Mapping[str, ParameterValue] = field(default_factory=dict)
    seeds: int | None = None
    """Repetitions with this learner, where they are fewer than the case's."""
    tests: int | None = None
    """Tests of its final policies, likewise."""
    called: str = ""
    """What tables call it, where that is not its name and parameters."""

    @property
    def label(self) -> str:
        """What tables call it."""
        return self.called or self.full_name

    @property
    def full_name(self) -> str:
        """The name, followed by the parameters: ``donut(reach=3)``."""
        return f"{self.name}({settings(self.parameters)})" if self.parameters else self.name


@dataclass(frozen=True)
class Case:
    """One system, seen through one state, with every demonstrator and every learner of a list."""

    group: str
    """Name in the file; variants share it."""
    variant: str
    """What the variant sets, ``pole_mass=0.2``; empty without variants."""
    system: str
    parameters: Mapping[str, ParameterValue]
    test_parameters: Mapping[str, ParameterValue]
    state: tuple[str, ...]
    demonstrators: tuple[Choice, ...]
    demonstrations: int
    learners: tuple[Choice, ...]
    seeds: int
    max_trials: int
    tests: int

    @property
    def name(self) -> str:
        """Name of the case, unique in a study."""
        return f"{self.group} {self.variant}" if self.variant else self.group


@dataclass(frozen=True)
class Cell:
    """One run of a study; nothing that it depends on is outside."""

    case: Case
    demonstrator: Choice
    learner: Choice
    repetition: int
    """Counts from 0; the same repetition of all learners starts from the same demonstrations."""
    seed: int
    """Of the whole study."""

    @property
    def key(self) -> tuple[str, str, str, int]:
        """What tells it from all others: case, demonstrator, learner, repetition."""
        return self.case.name, self.demonstrator.label, self.learner.label, self.repetition

    @property
    def tests(self) -> int:
        """Starts from which the final policy is tried."""
        return _fewer(self.case.tests, self.learner.tests)

    @property
    def title(self) -> str:
        """One line that names it."""
        case, demonstrator, learner, repetition = self.key
        return f"{case}, {demonstrator}, {learner}, seed {repetition + 1}"


@dataclass(frozen=True)
class Study:
    """A whole study."""

    name: str
    seed: int
    videos: bool
    cases: tuple[Case, ...]

    @property
    def cells(self) -> list[Cell]:
        """Every run of the study, in the order of the tables."""
        return [
            Cell(case, demonstrator, learner, repetition, self.seed)
            for case in self.cases
            for demonstrator in case.demonstrators
            for learner in case.learners
            for repetition in range(_fewer(case.seeds, learner.seeds))
        ]

    def quick(self) -> "Study":
        """Return the study with one repetition in 50, but at least one, few tests and no videos."""
        cases = (
            replace(
                case, seeds=max(1, case.seeds // QUICK), tests=min(case.tests, MOST_QUICK_TESTS)
            )
            for case in self.cases
        )
        return replace(self, cases=tuple(cases), videos=False)

    def to_json(self) -> dict[str, Any]:
        """Return all of it as plain values."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: Any) -> "Study":
        """Return the study that `to_json` described.

        Raises
        ------
        MisstepError
            If `values` is anything else.
        """
        try:
            return cls(**{**values, "cases": tuple(_case_from_json(c) for c in values["cases"])})
        except (TypeError, KeyError) as error:
            raise MisstepError(f"it describes no study ({error})") from error


def _fewer(of_case: int, of_learner: int | None) -> int:
    return of_case if of_learner is None else min(of_case, of_learner)


def _case_from_json(values: Mapping[str, Any]) -> Case:
    choices = {
        name: tuple(Choice(**choice) for choice in values[name])
        for name in ("demonstrators", "learners")
    }
    return Case(**{**values, **choices, "state": tuple(values["state"])})


def settings(parameters: Mapping[str, ParameterValue]) -> str:
    """Return parameters in one line: ``noise=8, hold=0.2``."""
    return ", ".join(f"{name}={value}" for name, value in parameters.items())


def load_study(path: str | os.PathLike[str]) -> Study:
    """Read a study from a TOML file and check all of it.

    Raises
    ------
    MisstepError
        If the file cannot be read or is no TOML; if a key or a name is unknown, missing or of the
        wrong type, or a number out of range; if a demonstrator does not fit its system.
    """
    try:
        values = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise MisstepError(f"cannot read {path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:  # TOML and UTF-8 alike
        raise MisstepError(f"{path} is not valid TOML: {error}") from error
    with _inside(str(path)):
        return _read_study(values)


def _read_study(values: dict[str, Any]) -> Study:
    _check_table(values, {"study": dict, "case": list}, required=("study", "case"))
    head, cases = values["study"], []
    with _inside("[study]"):
        _check_table(head, _STUDY, required=("name",))
        _check_name(head["name"])
    defaults = {"seeds": 10, "max_trials": 20, "tests": 20}
    defaults |= {name: head[name] for name in defaults if name in head}
    for number, entry in enumerate(_list_of(values, "case", dict), start=1):
        name = entry.get("name")
        with _inside(f"case {name!r}" if isinstance(name, str) else f"case {number}"):
            cases += _read_case({**defaults, **entry})
    _check_distinct("case", [case.name for case in cases])
    return Study(head["name"], head.get("seed", 0), head.get("videos", True), tuple(cases))


def _read_case(entry: dict[str, Any]) -> list[Case]:
    """Return the case, or one case a variant."""
    _check_table(entry, _CASE, required=("name", "system", "demonstrators", "learners"))
    _check_name(entry["name"])
    variants = _list_of(entry, "variants", dict) if "variants" in entry else [{}]
    shown = _choices(entry, "demonstrators", _DEMONSTRATOR)
    case = Case(
        group=entry["name"],
        variant="",
        system=entry["system"],
        parameters=entry.get("set", {}),
        test_parameters=entry.get("test_set", {}),
        state=tuple(_list_of(entry, "state", str)) if "state" in entry else (),
        demonstrators=shown,
        demonstrations=entry.get("demonstrations", 4),
        learners=_choices(entry, "learners", _LEARNER),
        **{name: entry[name] for name in ("seeds", "max_trials", "tests")},
    )
    return [_built(case, variant) for variant in variants]


def simulation(name: str, parameters: Mapping[str, ParameterValue]) -> System:
    """Build a system; raise MisstepError for one that a study, a file, must not name."""
    is_gym = name.startswith(PREFIX)
    if not is_gym and system_kind(name).typed_only != frozenset():
        raise MisstepError(
            f"a study makes its trials in simulations, and {name} may open files or connections"
        )
    return recorded_system(name, parameters, typed=is_gym)


def _built(case: Case, variant: dict[str, ParameterValue]) -> Case:
    """Return a variant of the case after building everything that it names."""
    parameters = {**case.parameters, **variant}
    system = simulation(case.system, parameters)
    with _inside("test_set"):
        simulation(case.system, {**parameters, **case.test_parameters})
    for choice in case.demonstrators:
        kind = DEMONSTRATORS[choice.name]
        build_parameters(kind, f"demonstrator {choice.name}", choice.parameters)
        if not kind.fits(system):
            raise MisstepError(
                f"demonstrator {choice.name} does not fit {case.system}: {kind.needs}"
            )
    for choice in case.learners:
        build_parameters(LEARNERS[choice.name], f"learner {choice.name}", choice.parameters)
    state = Task.of(system, case.state or None).state
    return replace(case, variant=settings(variant), parameters=parameters, state=state)


def _choices(entry: Mapping[str, Any], key: str, keys: Mapping[str, type]) -> tuple[Choice, ...]:
    """Return demonstrators or learners, each a name or a table."""
    choices = []
    for item in entry[key]:
        table = {"name": item} if isinstance(item, str) else item
        if not isinstance(table, dict):
            raise MisstepError(
                f'{key} holds {item!r}: each is a name or {{ name = "...", with = {{ ... }} }}'
            )
        with _inside(key):
            _check_table(table, keys, required=("name",))
        own = {name: table[name] for name in ("seeds", "tests", "called") if name in table}
        if "called" in own:
            with _inside("called"):
                _check_name(own["called"])
        choices.append(Choice(table["name"], table.get("with", {}), **own))
    if not choices:
        raise MisstepError(f"{key} is empty: name at least one")
    _check_distinct(key, [choice.label for choice in choices])
    return tuple(choices)


def _check_table(table: Any, keys: Mapping[str, type], required: Sequence[str]) -> None:
    """Raise unless a table has known keys only, all necessary ones, and values of their types."""
    if not isinstance(table, dict):
        raise MisstepError(f"{table!r} must be a table")
    for key, value in table.items():
        if key not in keys:
            raise MisstepError(f"unknown key {key!r}; the keys are: {', '.join(keys)}")
        if type(value) is not keys[key]:
            raise MisstepError(f"{key} is {value!r} but must be {_KINDS[keys[key]]}")
    for key, least in _LIMITS.items():
        if table.get(key, least) < least:
            raise MisstepError(f"{key} is {table[key]} but must be at least {least}")
    for key in required:
        if key not in table:
            raise MisstepError(f"{key} is missing; the keys are: {', '.join(keys)}")


def _list_of(table: Mapping[str, Any], key: str, kind: type) -> list[Any]:
    for value in table[key]:
        if type(value) is not kind:
            raise MisstepError(f"{key} holds {value!r}, but each must be {_KINDS[kind]}")
    if not table[key]:
        raise MisstepError(f"{key} is empty: give at least one, or leave it out")
    return list(table[key])


def _check_name(name: str) -> None:
    if not _NAME.fullmatch(name):
        raise MisstepError(
            f"name is {name!r}: use letters, digits, spaces, and . _ + -, after a letter or digit"
        )


def _check_distinct(what: str, names: Sequence[str]) -> None:
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise MisstepError(f"{what}: {twice[0]!r} comes twice")


@contextmanager
def _inside(where: str) -> Iterator[None]:
    """Say where in the file something is wrong."""
    try:
        yield
    except MisstepError as error:
        raise MisstepError(f"{where}: {error}") from error
