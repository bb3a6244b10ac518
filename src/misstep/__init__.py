"""misstep learns a working controller from demonstrations that all failed.

>>> import misstep
>>> system = misstep.make_system("cartpole")
>>> failures = misstep.demonstrate(system, by="weak", n=4, seed=0)
>>> run = misstep.learn(system, failures, "donut", state=("theta", "theta_dot"), max_trials=2)
>>> len(run.trials)
2

Everything public is a name of this package, imported when it is first used: the physics and the
compiled loops take seconds to load, and ``misstep --help`` needs neither; nor may a Ctrl-C meet a
library that is being loaded before there is anybody to catch it.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from misstep.demonstrators import DEMONSTRATORS, demonstrate
    from misstep.errors import MisstepError
    from misstep.formats import FORMATS, append_trajectory, load_dataset, save_dataset
    from misstep.learners import LEARNERS
    from misstep.learning import Evaluation, evaluate, learn, resume
    from misstep.mixture import Donut, DonutMixture, DonutShape, GaussianMixture
    from misstep.rollout import Policy, rollout
    from misstep.runs import Run, load_run
    from misstep.systems import SYSTEMS, System, make_system
    from misstep.trajectory import Column, Dataset, Outcome, Provenance, Trajectory
    from misstep.version import __version__

__all__ = [
    "DEMONSTRATORS",
    "FORMATS",
    "LEARNERS",
    "SYSTEMS",
    "Column",
    "Dataset",
    "Donut",
    "DonutMixture",
    "DonutShape",
    "Evaluation",
    "GaussianMixture",
    "MisstepError",
    "Outcome",
    "Policy",
    "Provenance",
    "Run",
    "System",
    "Trajectory",
    "__version__",
    "append_trajectory",
    "demonstrate",
    "evaluate",
    "learn",
    "load_dataset",
    "load_run",
    "make_system",
    "resume",
    "rollout",
    "save_dataset",
]

_WHEN_USED = {
    "demonstrators": ("DEMONSTRATORS", "demonstrate"),
    "errors": ("MisstepError",),
    "formats": ("FORMATS", "append_trajectory", "load_dataset", "save_dataset"),
    "learners": ("LEARNERS",),
    "learning": ("Evaluation", "evaluate", "learn", "resume"),
    "mixture": ("Donut", "DonutMixture", "DonutShape", "GaussianMixture"),
    "rollout": ("Policy", "rollout"),
    "runs": ("Run", "load_run"),
    "systems": ("SYSTEMS", "System", "make_system"),
    "trajectory": ("Column", "Dataset", "Outcome", "Provenance", "Trajectory"),
    "version": ("__version__",),
}
_MODULE_OF = {name: module for module, names in _WHEN_USED.items() for name in names}

if not TYPE_CHECKING:  # a type checker would take it that every name exists

    def __getattr__(name: str) -> object:
        if name not in _MODULE_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
        globals()[name] = value
        return value


class _Package(ModuleType):
    """A package in which `rollout` stays the function when the module of that name is loaded."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "rollout" and isinstance(value, ModuleType):
            value = value.rollout
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
