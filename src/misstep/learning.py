"""The loop: learn a policy from everything tried so far, try it, judge it, and go on.

demonstrations → policy → trial → judged → evidence → next policy, until a trial succeeds.
"""

import math
import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from misstep.errors import MisstepError
from misstep.learners import Evidence, LearnedPolicy, Task, default_learner
from misstep.parameters import ParameterValue
from misstep.rollout import Policy, rollout
from misstep.runs import Run, RunConfig
from misstep.seeds import Stream, stream_of
from misstep.systems import System
from misstep.trajectory import Dataset, Outcome, column_listing

_Z_95 = 1.959963984540054

OnTrial = Callable[[Run], None]


def learn(
    system: System,
    demonstrations: Dataset,
    learner: str | None = None,
    *,
    state: Sequence[str] | None = None,
    max_trials: int = 20,
    seed: int = 0,
    stop_on_success: bool = True,
    out: str | os.PathLike[str] | None = None,
    on_trial: OnTrial | None = None,
    **learner_parameters: ParameterValue,
) -> Run:
    """Learn from failed demonstrations by trial, until a trial succeeds.

    Parameters
    ----------
    system : System
        What to drive; one of the registry, so that the run can be resumed.
    demonstrations : Dataset
        Recorded on a system with the same columns and control period.
    learner : str, optional
        Name in the registry of learners; see `default_learner` for what is taken if left out.
    state : sequence of str, optional
        Observation columns that the policy may depend on; all of them if left out.
    max_trials : int
        Trials to make at the most.
    seed : int
        Same seed, same run.
    stop_on_success : bool
        End with the first success; otherwise make `max_trials` trials whatever comes of them.
    out : path, optional
        Folder to keep the run in, trial by trial.
    on_trial : callable, optional
        Called with the run after each trial.
    **learner_parameters
        The learner's own.

    Returns
    -------
    Run

    Raises
    ------
    MisstepError
        If there is no such learner, parameter or column, the demonstrations do not fit the system,
        or the folder cannot be used.

    Notes
    -----
    The outer loop of the paper's listing (section IV). Its inner loop ends when an action is zero;
    a pendulum's force passes through zero on the way, so a trial here ends when the system says so.
    """
    run = begin(
        system,
        demonstrations,
        learner,
        state=state,
        max_trials=max_trials,
        seed=seed,
        stop_on_success=stop_on_success,
        **learner_parameters,
    )
    with kept_in(run, out):
        return resume(run, system=system, on_trial=on_trial)


def begin(
    system: System,
    demonstrations: Dataset,
    learner: str | None = None,
    *,
    state: Sequence[str] | None = None,
    max_trials: int = 20,
    seed: int = 0,
    stop_on_success: bool = True,
    **learner_parameters: ParameterValue,
) -> Run:
    """Return a run without a trial yet; parameters and errors are those of `learn`."""
    if max_trials < 1:
        raise MisstepError(f"max_trials is {max_trials}: at least one trial is needed")
    if seed < 0:
        raise MisstepError(f"seed is {seed}: it must not be negative")
    task = Task.of(system, state)
    if learner is None:
        learner = default_learner(task, demonstrations)[0]
    config = RunConfig(
        system=system.system_id,
        system_parameters=dict(system.parameters),
        learner=learner,
        learner_parameters=dict(learner_parameters),
        state=task.state,
        seed=int(seed),
        max_trials=int(max_trials),
        stop_on_success=stop_on_success,
    )
    config.make_learner()
    _check_fit(system, demonstrations)
    return Run(config, demonstrations)


def resume(run: Run, *, system: System | None = None, on_trial: OnTrial | None = None) -> Run:
    """Go on with a run until it is finished; the result is that of an uninterrupted run.

    Parameters
    ----------
    run : Run
        Changed in place; `load_run` brings one back from its folder.
    system : System, optional
        The run's own system, if it has been built already.
    on_trial : callable, optional
        Called with the run after each trial.
    """
    system = run.config.make_system() if system is None else system
    task = Task.of(system, run.config.state)
    with run.driven():
        while not run.finished:
            proposal = propose(run, task)
            trial = rollout(
                system, proposal.policy, seed=proposal.seed, demonstrator=proposal.demonstrator
            )
            run.add(proposal.policy, trial, proposal.seconds)
            if on_trial is not None:
                on_trial(run)
    return run


@dataclass(frozen=True)
class Proposal:
    """What to try next, by whomever it is tried."""

    policy: LearnedPolicy
    seed: int
    """Of the trial's start."""
    demonstrator: str
    """For the trial's provenance."""
    seconds: float
    """Wall-clock time that the policy took to learn, s."""


def propose(run: Run, task: Task) -> Proposal:
    """Learn the policy of the next trial from everything that a run has tried.

    It depends on nothing but the run as it stands: whoever tries it and adds the trial, here or on
    a robot, gets the same next proposal.

    Parameters
    ----------
    run : Run
        Left as it is.
    task : Task
        Of the run's system and state.

    Raises
    ------
    MisstepError
        If there is nothing that the learner can learn from.
    """
    learner = run.config.make_learner()
    stream = np.random.SeedSequence(run.config.seed, spawn_key=(len(run.trials),))
    learning, acting = stream.spawn(2)
    started = time.perf_counter()
    evidence = Evidence.seen_from(
        learner.rung, run.demonstrations, run.trials, run.policies, run.config.seed
    )
    policy = learner.policy(task.seen_from(learner.rung), evidence, np.random.default_rng(learning))
    return Proposal(
        policy,
        seed=int(acting.generate_state(1)[0]),
        demonstrator=f"learner:{run.config.learner}",
        seconds=time.perf_counter() - started,
    )


@contextmanager
def kept_in(run: Run, out: str | os.PathLike[str] | None) -> Iterator[None]:
    """Keep the run in `out`, and take a new folder away again if there is no first trial."""
    is_new = out is not None and not Path(out).exists()
    if out is not None:
        run.keep_in(out)
    try:
        yield
    except MisstepError:
        if is_new and run.folder is not None and not run.trials:
            shutil.rmtree(run.folder, ignore_errors=True)  # as far as rights allow
        raise


@dataclass(frozen=True)
class Evaluation:
    """How often a policy succeeds."""

    episodes: int
    successes: int
    costs: tuple[float | None, ...]
    """Mean cost of a step of each episode, in the system's unit of cost."""

    @property
    def success_rate(self) -> float:
        """Successes per episode."""
        return self.successes / self.episodes

    @property
    def interval_95(self) -> tuple[float, float]:
        """Wilson's 95 % confidence interval of the success rate."""
        return wilson_interval(self.successes, self.episodes)


def evaluate(system: System, policy: Policy, *, episodes: int = 100, seed: int = 0) -> Evaluation:
    """Run a policy from many starts and count its successes.

    Parameters
    ----------
    system : System
    policy : Policy
        For example the `policy` of a run.
    episodes : int
    seed : int
        Same seed, same starts.

    Raises
    ------
    MisstepError
        If `episodes` is below 1 or `seed` below 0.
    """
    if episodes < 1:
        raise MisstepError(f"episodes is {episodes}: at least one is needed")
    if seed < 0:
        raise MisstepError(f"seed is {seed}: it must not be negative")
    successes, costs = 0, []
    for stream in stream_of(seed, Stream.TEST).spawn(episodes):
        start = int(stream.generate_state(1)[0])
        trial = rollout(system, policy, seed=start, demonstrator="evaluation")
        successes += trial.outcome is Outcome.SUCCESS
        costs.append(trial.mean_cost)
    return Evaluation(episodes, successes, tuple(costs))


def wilson_interval(successes: int, n: int) -> tuple[float, float]:
    """Return Wilson's 95 % confidence interval of a rate, from `successes` of `n`."""
    rate, z2 = successes / n, _Z_95**2
    centre = (rate + z2 / (2 * n)) / (1 + z2 / n)
    half = _Z_95 / (1 + z2 / n) * math.sqrt(rate * (1 - rate) / n + z2 / (4 * n * n))
    return max(0.0, centre - half), min(1.0, centre + half)


def _check_fit(system: System, demonstrations: Dataset) -> None:
    for kind in ("observation_columns", "action_columns"):
        shown, driven = getattr(demonstrations, kind), getattr(system, kind)
        if shown != driven:
            raise MisstepError(
                f"the demonstrations have the {kind.replace('_', ' ')} "
                f"{column_listing(shown)}, but {system.system_id} has {column_listing(driven)}"
            )
    if not math.isclose(demonstrations.dt, system.dt, rel_tol=1e-9):
        raise MisstepError(
            f"the demonstrations have one step every {demonstrations.dt:g} s, but "
            f"{system.system_id} takes one every {system.dt:g} s: set its control_rate"
        )
