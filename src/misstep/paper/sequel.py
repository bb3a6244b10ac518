"""What the paper leaves open: from the same kind of four failed demonstrations to a balance.

Not the paper's experiment: the harder `cartpole-rail`, on which reaching the end of a short rail is
a failure too, and the learner `fall`, which is told when each attempt failed.
"""

from pathlib import Path
from typing import Any

import numpy as np

from misstep.demonstrators import demonstrate
from misstep.learning import learn, resume
from misstep.paper.experiments import DEMONSTRATIONS
from misstep.runs import CONFIG, Run, load_run
from misstep.systems import make_system
from misstep.systems.rendering import write_side_by_side

LEARNER = "fall"
SYSTEM = "cartpole-rail"
MAX_TRIALS = 20
# Of the balance; it goes on for the whole minute.
VIDEO_SECONDS = 12.0


def keep_sequel(folder: Path, seed: int) -> None:
    """Run the sequel in its folder, from wherever it was left."""
    if (folder / CONFIG).exists():
        resume(load_run(folder))
        return
    system = make_system(SYSTEM)
    stream = np.random.SeedSequence(seed, spawn_key=(7,)).generate_state(2)
    demonstrations = demonstrate(system, "noisy", n=DEMONSTRATIONS, seed=int(stream[0]))
    learn(
        system,
        demonstrations,
        LEARNER,
        max_trials=MAX_TRIALS,
        seed=int(stream[1]),
        out=folder,
    )


def write_sequel_video(path: Path, run: Run) -> None:
    """Write the first fall and the last trial side by side, unless the video is there."""
    if path.exists():
        return
    last = run.trials[-1]
    steps = min(last.n_steps, round(VIDEO_SECONDS / last.dt))
    shown = [run.demonstrations[0], last.cut(steps)]
    titles = ["The first demonstration", f"Trial {len(run.trials)}"]
    write_side_by_side(shown, path, titles=titles, fps=15.0, width=480, height=270)


def summary(run: Run) -> dict[str, Any]:
    """Return what came of it, as JSON can hold it."""
    return {
        "system": run.config.system,
        "learner": run.config.learner,
        "state": list(run.config.state),
        "demonstrations_failed_at_s": [t.failure_time for t in run.demonstrations],
        "trials_lasted_s": [
            t.duration if t.failure_time is None else t.failure_time for t in run.trials
        ],
        "succeeded": run.succeeded,
    }
