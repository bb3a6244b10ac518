"""A run: what was shown, every trial since, and the policy that came out; in memory and on disk.

A run folder holds

    run.json              version, command, system, learner, state, seed: all that rebuilds the run
    demonstrations.h5     what the run started from
    policies/trial_000.npz    the policy of each trial, plain arrays
    trials/trial_000.h5       each finished trial

While it is driven, a hidden file is locked (`misstep.locks`), so that a second process is refused.
A trial is finished when its file is there: the file appears in one step, after the policy's. A
process killed at any instant therefore loses at most the trial in flight.
"""

import io
import os
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError, reason_of
from misstep.formats import load_dataset, save_dataset
from misstep.learners import LEARNERS, LearnedPolicy, Learner, Task
from misstep.locks import driven
from misstep.parameters import ParameterValue, build_parameters
from misstep.storage import atomic_write, make_folder, read_json, write_json
from misstep.systems import System
from misstep.systems.gymnasium_adapter import PREFIX
from misstep.systems.recorded import differences, recorded_system
from misstep.trajectory import Dataset, Outcome, Trajectory
from misstep.version import __version__, command_line

CONFIG = "run.json"
DEMONSTRATIONS = "demonstrations.h5"
_LARGEST_POLICY = 64 * 2**20

_CONFIG_KINDS = {
    "system": str,
    "system_parameters": dict,
    "learner": str,
    "learner_parameters": dict,
    "state": list,
    "seed": int,
    "max_trials": int,
    "stop_on_success": bool,
    "version": str,
    "command": list,
}
_JSON_NAMES = {str: "string", dict: "object", list: "array", int: "whole number", bool: "boolean"}

_KINDS = "biufU"
"""Of NumPy's types: truth values, numbers, texts."""
# What zipfile and NumPy raise when an npz file is damaged, depending on where.
_DAMAGE = (
    EOFError,
    KeyError,
    MemoryError,
    NotImplementedError,
    OSError,
    OverflowError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
    struct.error,
    zipfile.BadZipFile,
    zlib.error,
)


@dataclass(frozen=True)
class RunConfig:
    """All that determines a run, apart from its demonstrations."""

    system: str
    system_parameters: Mapping[str, ParameterValue]
    learner: str
    learner_parameters: Mapping[str, ParameterValue]
    state: tuple[str, ...]
    seed: int
    max_trials: int
    stop_on_success: bool
    version: str = __version__
    command: tuple[str, ...] = field(default_factory=command_line)

    def make_system(
        self, given: Mapping[str, ParameterValue] | None = None, *, typed: str = ""
    ) -> System:
        """Build the system that the run drives.

        Parameters
        ----------
        given : mapping, optional
            Parameters of it that are not taken from a file.
        typed : str
            The system that the user names. Simulations need not be named, nor environments of
            Gymnasium; anything else has to be, since the folder may be a stranger's: see
            `recorded_system`.

        Raises
        ------
        MisstepError
            As `recorded_system`, or if the user names another system or gives other values than
            the run was made with.
        """
        if typed and typed != self.system:
            raise MisstepError(f"the run drives {self.system} and not {typed}")
        recorded = self.system_parameters
        named = bool(typed) or self.system.startswith(PREFIX)
        system = recorded_system(self.system, recorded, given, typed=named)
        if different := differences(system, recorded):
            listed = ", ".join(f"{name}={recorded[name]!r}" for name in different)
            raise MisstepError(f"the run was made with {listed}: it goes on with no other values")
        return system

    def make_learner(self) -> Learner:
        """Build the learner with the run's parameters."""
        kind = LEARNERS[self.learner]
        return build_parameters(kind, f"learner {self.learner}", self.learner_parameters)


@dataclass
class Run:
    """A run as it stands.

    Attributes
    ----------
    config : RunConfig
    demonstrations : Dataset
    trials : list of Trajectory
    policies : list of LearnedPolicy
        The policy of each trial.
    computing_seconds : list of float
        Wall-clock time that each policy took to learn, s.
    folder : Path or None
        Where the run is kept.
    """

    config: RunConfig
    demonstrations: Dataset
    trials: list[Trajectory] = field(default_factory=list)
    policies: list[LearnedPolicy] = field(default_factory=list)
    computing_seconds: list[float] = field(default_factory=list)
    folder: Path | None = None

    @property
    def policy(self) -> LearnedPolicy:
        """The policy of the last trial.

        Raises
        ------
        MisstepError
            If there has been no trial.
        """
        if not self.policies:
            raise MisstepError("the run has no trial yet, and so no policy: resume it first")
        return self.policies[-1]

    @property
    def succeeded(self) -> bool:
        """Whether a trial has succeeded."""
        return self.trials_to_success is not None

    @property
    def trials_to_success(self) -> int | None:
        """Number of trials up to and including the first success; None before that."""
        for number, trial in enumerate(self.trials, start=1):
            if trial.outcome is Outcome.SUCCESS:
                return number
        return None

    @property
    def finished(self) -> bool:
        """Whether nothing is left to do."""
        enough = len(self.trials) >= self.config.max_trials
        return enough or (self.config.stop_on_success and self.succeeded)

    @contextmanager
    def driven(self) -> Iterator[None]:
        """Be the only one who adds trials to the run's folder, if it has one.

        Raises
        ------
        MisstepError
            If another process does; or has done since the run was loaded.
        """
        if self.folder is None:
            yield
            return
        with driven(self.folder):
            kept = sum(1 for _ in (self.folder / "trials").glob("trial_*.h5"))
            if kept != len(self.trials):
                raise MisstepError(
                    f"{self.folder} holds {kept} trials, but {len(self.trials)} when it was "
                    "loaded: somebody else has gone on with it; load it again"
                )
            yield

    def add(self, policy: LearnedPolicy, trial: Trajectory, seconds: float) -> None:
        """Append a finished trial, on disk first if the run has a folder.

        Where another version of misstep began the run, the trial says so.

        Raises
        ------
        MisstepError
            If the folder cannot be written, or holds a trial of that number.
        """
        if self.config.version != __version__:
            note = f"made by misstep {__version__}, of a run that {self.config.version} began"
            source = trial.provenance
            trial = replace(trial, provenance=replace(source, notes=(*source.notes, note)))
        if self.folder is not None:
            name = f"trial_{len(self.trials):03d}"
            if (self.folder / "trials" / f"{name}.h5").exists():
                raise MisstepError(
                    f"{self.folder} holds {name} already: somebody else has gone on with it"
                )
            arrays = {**policy.arrays(), "computing_seconds": np.array(seconds)}
            _save_arrays(self.folder / "policies" / f"{name}.npz", arrays)
            save_dataset(Dataset([trial]), self.folder / "trials" / f"{name}.h5")
        self.policies.append(policy)
        self.trials.append(trial)
        self.computing_seconds.append(seconds)

    def keep_in(self, folder: str | os.PathLike[str]) -> Self:
        """Make the run's folder; trials added from now on are kept in it.

        Raises
        ------
        MisstepError
            If there is a run already, the folder holds something else, or cannot be written.
        """
        path = Path(folder)
        if (path / CONFIG).exists():
            raise MisstepError(f"{path} holds a run already: resume it, or choose another folder")
        make_folder(path)
        # What this very function leaves behind when it is killed may stay.
        own = {DEMONSTRATIONS, "policies", "trials"}
        others = {file.name for file in path.glob("[!.]*")} - own
        if others or any((path / "trials").glob("[!.]*")):
            raise MisstepError(f"{path} is not empty: choose a new or an empty folder for the run")
        with driven(path):
            make_folder(path / "policies")
            make_folder(path / "trials")
            save_dataset(self.demonstrations, path / DEMONSTRATIONS)
            # Written last: a folder with a configuration is a run, whole.
            write_json(path / CONFIG, asdict(self.config))
        self.folder = path
        return self


def load_run(folder: str | os.PathLike[str], *, system: System | None = None) -> Run:
    """Load a run from its folder.

    Parameters
    ----------
    folder : path
        As `learn` wrote it with ``out``.
    system : System, optional
        What the run drives. It is needed where that is no simulation: a run may be a stranger's,
        and what its folder says opens no file and no connection.

    Returns
    -------
    Run
        With every finished trial and its policy.

    Raises
    ------
    MisstepError
        If the folder is no run or a file in it is damaged, or the system is needed.
    """
    path = Path(folder)
    config = load_config(path)
    run = Run(config, load_dataset(path / DEMONSTRATIONS), folder=path)
    learner = LEARNERS[config.learner]
    task = Task.of(config.make_system() if system is None else system, config.state).seen_from(
        learner.rung
    )
    files = (path / "trials").glob("trial_*.h5")
    for index, file in enumerate(sorted(files, key=lambda file: (len(file.stem), file.stem))):
        name = f"trial_{index:03d}"
        if file.stem != name:
            raise MisstepError(f"{path}: trials/{name}.h5 is missing, but {file.name} is there")
        arrays = _load_arrays(path / "policies" / f"{name}.npz")
        try:
            run.policies.append(learner.restore(task, arrays))
            run.computing_seconds.append(float(arrays["computing_seconds"]))
        except KeyError as error:
            raise MisstepError(f"{path}: policies/{name}.npz lacks the array {error}") from error
        except (ArithmeticError, IndexError, TypeError, ValueError) as error:
            reason = reason_of(error)
            raise MisstepError(f"{path}: policies/{name}.npz holds no policy: {reason}") from error
        run.trials.append(load_dataset(file)[0])
    return run


def load_config(folder: Path) -> RunConfig:
    """Load what determines the run of a folder; raise MisstepError where it is no run."""
    path = folder / CONFIG
    if not path.exists():
        raise MisstepError(f"{folder} is not a run folder: it has no {CONFIG}")
    values = read_json(path)
    names = set(RunConfig.__dataclass_fields__)
    if not isinstance(values, dict) or set(values) != names:
        raise MisstepError(f"{path} is not a run's configuration: it needs {sorted(names)}")
    for name, kind in _CONFIG_KINDS.items():
        if type(values[name]) is not kind:
            raise MisstepError(f"{path}: {name} must be a JSON {_JSON_NAMES[kind]}")
    lists = {name: tuple(map(str, values[name])) for name in ("state", "command")}
    config = RunConfig(**{**values, **lists})
    if config.seed < 0 or config.max_trials < 1:
        raise MisstepError(
            f"{path}: seed is {config.seed} and max_trials is {config.max_trials}, but they are at "
            f"least 0 and 1"
        )
    return config


def _save_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    atomic_write(path, lambda temporary: temporary.write_bytes(buffer.getvalue()))


def _load_arrays(path: Path) -> dict[str, NDArray[Any]]:
    try:
        if path.stat().st_size > _LARGEST_POLICY:
            raise MisstepError(f"{path} is larger than any policy: {path.stat().st_size} bytes")
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > _LARGEST_POLICY:
                raise MisstepError(f"{path} unpacks to more than any policy holds")
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except MisstepError:
        raise
    except _DAMAGE as error:
        raise MisstepError(f"cannot read {path}: {reason_of(error)}") from error
    for name, array in arrays.items():
        if array.dtype.kind not in _KINDS:
            raise MisstepError(f"{path}: {name} holds {array.dtype}, which no policy is made of")
    return arrays
