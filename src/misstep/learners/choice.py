"""Which learner to take when nobody says: the highest rung whose feedback is there.

Rung 3 is left out. Told when each attempt failed, `fall` needs fewer trials than `power` or
`cma-es`, which are told what each step cost.
"""

from collections.abc import Iterable

from misstep.learners.learner import Task
from misstep.trajectory import Outcome, Trajectory


def default_learner(task: Task, demonstrations: Iterable[Trajectory]) -> tuple[str, str]:
    """Return the name of the learner to take, and why, in a few words."""
    shown = list(demonstrations)
    if task.cost is not None:
        return "dynamics", "rung 4: the system has a cost as a function"
    if any(t.failure_step is not None for t in shown):
        return "fall", "rung 2: it is known when attempts failed"
    if any(t.outcome is not Outcome.UNKNOWN for t in shown):
        return "balanced-mean", "rung 1: it is known whether attempts succeeded"
    return "mean", "rung 0: nothing is known of the attempts"
