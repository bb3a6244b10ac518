"""The list of attempts as the page is told of it, and which learners can be taken with it."""

from collections.abc import Iterable
from typing import Any

from misstep.learners import LEARNERS
from misstep.live.attempts import Kept
from misstep.live.narration import tell_end
from misstep.live.picture import show_summary
from misstep.systems import System
from misstep.trajectory import Trajectory


class Listing:
    """One line for each attempt; each is made once, as hundreds are told again and again."""

    def __init__(self) -> None:
        self._made: dict[int, tuple[Trajectory, dict[str, Any]]] = {}

    def show(self, attempts: Iterable[Kept]) -> list[dict[str, Any]]:
        """Return the lines."""
        self._made = {kept.id: self._line(kept) for kept in attempts}
        return [line for _, line in self._made.values()]

    def _line(self, kept: Kept) -> tuple[Trajectory, dict[str, Any]]:
        trajectory, line = self._made.get(kept.id, (None, {}))
        if trajectory is not kept.trajectory:
            line = {"id": kept.id, **show_summary(kept.trajectory)}
        return kept.trajectory, line


def show_pending(pending: Trajectory | None, system: System) -> dict[str, Any] | None:
    """Return what is told of an attempt that waits to be kept."""
    if pending is None:
        return None
    return {**show_summary(pending), "sentence": tell_end(pending, system)}


def unfit_learners(attempts: Iterable[Kept], system: System) -> dict[str, str]:
    """Return why learners cannot be taken now, by name."""
    trajectories = [kept.trajectory for kept in attempts]
    failed = any(trajectory.failure_step is not None for trajectory in trajectories)
    reasons = {}
    for name, kind in LEARNERS.loaded()[0].items():
        if not trajectories:
            reasons[name] = "keep at least one failed attempt first"
        elif kind.rung >= 4 and system.cost is None:
            reasons[name] = "this system has no cost as a function"
        elif kind.rung == 2 and not failed:
            reasons[name] = "no attempt has a failure time: mark one"
    return reasons
