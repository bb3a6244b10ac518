"""Videos of the first seed: the four demonstrations, the best and the worst exploration."""

from concurrent.futures import Executor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from misstep.paper.results import Results
from misstep.runs import make_folder
from misstep.systems.rendering import write_video
from misstep.trajectory import Trajectory

WIDTH, HEIGHT, FPS = 480, 270, 20.0


class Video(NamedTuple):
    """One video and what it shows."""

    path: Path
    caption: str


def write_videos(folder: Path, results: Results, pool: Executor) -> list[Video]:
    """Write the six videos, side by side in the pool's processes; those that are there stay."""
    make_folder(folder)
    videos, jobs = [], []
    for name, title, trajectory in _chosen(results):
        path = folder / f"{name}.mp4"
        cost = float(np.mean(trajectory.costs)) if trajectory.costs is not None else 0.0
        videos.append(Video(path, f"{title}: {cost:.0f}° over 30 s"))
        if not path.exists():
            jobs.append(pool.submit(_write, trajectory, path, title))
    for job in jobs:
        job.result()
    return videos


def _chosen(results: Results) -> list[tuple[str, str, Trajectory]]:
    run = results.runs["without-reward"]
    costs = results.cells["without-reward"][0].exploration_costs[:, 0]
    chosen = [
        (f"demonstration_{i}", f"Demonstration {i}", t)
        for i, t in enumerate(run.demonstrations, start=1)
    ]
    for word, index in (("best", int(costs.argmin())), ("worst", int(costs.argmax()))):
        chosen.append(
            (f"{word}_exploration", f"Exploration {index + 1}, the {word}", run.trials[index])
        )
    return chosen


def _write(trajectory: Trajectory, path: Path, title: str) -> None:
    write_video(trajectory, path, fps=FPS, width=WIDTH, height=HEIGHT, title=title)
