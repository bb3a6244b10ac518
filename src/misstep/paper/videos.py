"""Videos of the first seed: the four demonstrations, the best and the worst exploration."""

from pathlib import Path
from typing import NamedTuple

from misstep.paper.experiments import DEMONSTRATIONS
from misstep.paper.results import Results
from misstep.systems.rendering import write_video
from misstep.trajectory import Trajectory

VIDEOS = DEMONSTRATIONS + 2
WIDTH, HEIGHT, FPS = 480, 270, 12.0


class Video(NamedTuple):
    """One video and what it shows."""

    path: Path
    title: str
    trajectory: Trajectory


def choose_videos(folder: Path, results: Results) -> list[Video]:
    """Return the videos to be written in `folder`."""
    run = results.runs["without-reward"]
    videos = [
        Video(folder / f"demonstration_{i}.mp4", f"Demonstration {i}", t)
        for i, t in enumerate(run.demonstrations, start=1)
    ]
    costs = results.cells["without-reward"][0].exploration_costs[:, 0]
    for word, index in (("best", int(costs.argmin())), ("worst", int(costs.argmax()))):
        title = f"Exploration {index + 1}, the {word}"
        videos.append(Video(folder / f"{word}_exploration.mp4", title, run.trials[index]))
    return videos


def write_video_once(video: Video) -> None:
    """Write a video unless it is there: the same results would only give the same again."""
    if not video.path.exists():
        write_video(
            video.trajectory, video.path, fps=FPS, width=WIDTH, height=HEIGHT, title=video.title
        )
