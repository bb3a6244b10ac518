"""What only misstep does: a trial, a refit, a whole paper."""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from misstep.bench.hardware import least_seconds
from misstep.bench.results import Row
from misstep.demonstrators import demonstrate
from misstep.learners import Evidence, Task
from misstep.learners.donut import DonutLearner
from misstep.rollout import rollout
from misstep.systems import make_system

_STATE = ("theta", "theta_dot")
_PROGRAM = "import sys; from misstep.cli import main; sys.exit(main(sys.argv[1:]))"


def measure_trial_and_refit(repeats: int, seed: int) -> list[Row]:
    """Time one trial of 30 s at 50 Hz under a donut policy, and the fit that leads to it."""
    system = make_system("cartpole", duration=30.0, control_rate=50.0, stop_at_fall=False)
    shown = demonstrate(system, by="noisy", n=4, seed=seed)
    learner = DonutLearner()
    task = Task.of(system, _STATE).seen_from(learner.rung)
    evidence = Evidence.seen_from(learner.rung, shown, ())
    samples = sum(len(t.actions) for t in shown)

    def refit() -> object:
        return learner.policy(task, evidence, np.random.default_rng(seed))

    policy = learner.policy(task, evidence, np.random.default_rng(seed))
    components = len(policy.mixture.weights_)

    def trial() -> object:
        return rollout(system, policy, seed=seed, demonstrator="learner:donut")

    steps, d = round(30.0 * 50.0), len(_STATE) + 1
    return [
        Row(
            "trial",
            "misstep",
            steps,
            d,
            components,
            seconds=least_seconds(trial, repeats),
            repeats=repeats,
        ),
        Row(
            "refit",
            "misstep",
            samples,
            d,
            components,
            seconds=least_seconds(refit, repeats),
            repeats=repeats,
        ),
    ]


def measure_paper(limit: float) -> list[Row]:
    """Time ``misstep reproduce --seeds 1`` twice: the second has all compiled code in its cache."""
    rows = []
    for task in ("paper, first time", "paper"):
        with tempfile.TemporaryDirectory() as folder:
            out = str(Path(folder) / "paper")
            words = (sys.executable, "-c", _PROGRAM, "reproduce", "--seeds", "1", "--out", out)
            started = time.perf_counter()
            try:
                code = subprocess.run(  # noqa: S603 - our own words
                    words,
                    timeout=limit,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    check=False,
                ).returncode
            except subprocess.TimeoutExpired:
                rows.append(Row(task, "misstep", error=f"longer than {limit:.0f} s"))
                continue
            seconds = time.perf_counter() - started
            error = f"ended with {code}" if code else None
            rows.append(Row(task, "misstep", seconds=None if code else seconds, error=error))
    return rows
