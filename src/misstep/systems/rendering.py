"""Pictures and videos of recorded trajectories, drawn from what was observed.

Nothing is simulated again: a picture shows the recorded state and action. Where OpenGL works the
picture is three-dimensional; where it does not, a flat drawing with the same information takes its
place, and one warning says so.
"""

import functools
import math
import os
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Protocol

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from misstep.errors import MisstepError
from misstep.parameters import ParameterValue
from misstep.storage import atomic_write
from misstep.systems.cartpole_drawing import CartPoleScene, CartPoleSketch
from misstep.systems.offscreen import NoOpenGLError
from misstep.trajectory import Trajectory

INK, FAINT = "#2b3442", "#6b7785"


class Drawing(Protocol):
    """Draws the states of one system, of one size."""

    def draw(
        self, observation: Mapping[str, float], action: Mapping[str, float]
    ) -> NDArray[np.uint8]:
        """Return a picture, shape (height, width, 3)."""

    def close(self) -> None:
        """Give back what it holds."""


# By system: with OpenGL, and without.
_DRAWINGS = {"cartpole": (CartPoleScene, CartPoleSketch)}


class Painter:
    """Draws states of one system with a caption: title, angle, force, time.

    A context manager; leaving it gives back what OpenGL holds.

    Parameters
    ----------
    system : str
        Name of a system of which there are drawings: ``"cartpole"``.
    parameters : mapping
        Parameters of the system.
    width, height : int, px
        Even numbers, because videos want them so.
    title : str
        Shown in the upper left.

    Raises
    ------
    MisstepError
        If there is no drawing of such a system, or the size is not even and at least 64.

    Warns
    -----
    RuntimeWarning
        Once, if there is no OpenGL and flat drawings take its place.
    """

    def __init__(
        self,
        system: str,
        parameters: Mapping[str, ParameterValue],
        *,
        width: int = 640,
        height: int = 360,
        title: str = "",
    ) -> None:
        if system not in _DRAWINGS:
            raise MisstepError(
                f"there is no drawing of the system {system!r}; there are: {', '.join(_DRAWINGS)}"
            )
        if width % 2 or height % 2 or min(width, height) < 64:
            raise MisstepError(
                f"the size of a picture is {width} × {height}: both must be even and at least 64"
            )
        self._drawing = _drawing(system, parameters, width, height)
        self._title = title
        self._width = width
        self._scale = height / 360
        self._large, self._small = (
            ImageFont.load_default(size=size * self._scale) for size in (17, 14)
        )

    def paint(
        self, observation: Mapping[str, float], action: Mapping[str, float], time: float
    ) -> NDArray[np.uint8]:
        """Return a picture, shape (height, width, 3).

        Parameters
        ----------
        observation : mapping
            ``x`` [m] and ``theta`` [rad]; others are ignored.
        action : mapping
            ``force`` [N].
        time : float, s
        """
        picture = Image.fromarray(self._drawing.draw(observation, action))
        pen = ImageDraw.Draw(picture)
        s = self._scale
        pen.text((20 * s, 16 * s), self._title, INK, self._large)
        values = [
            ("angle", f"{math.degrees(observation['theta']):+.1f}", "°"),
            ("force", f"{action['force']:+.1f}", "N"),
            ("time", f"{time:.2f}", "s"),
        ]
        for row, (name, value, unit) in enumerate(values):
            y = (16 + 21 * row) * s
            pen.text((self._width - 146 * s, y), name, FAINT, self._small)
            pen.text((self._width - 38 * s, y), value, INK, self._small, anchor="ra")
            pen.text((self._width - 33 * s, y), unit, FAINT, self._small)
        return np.asarray(picture)

    def close(self) -> None:
        """Give back what OpenGL holds."""
        self._drawing.close()

    def __enter__(self) -> "Painter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def frames(
    trajectory: Trajectory,
    fps: float = 20.0,
    width: int = 640,
    height: int = 360,
    title: str = "",
) -> Iterator[NDArray[np.uint8]]:
    """Draw a recorded trajectory, from its first observation to its last.

    Parameters
    ----------
    trajectory : Trajectory
        Must observe ``x`` and ``theta`` and act with ``force``.
    fps : float, 1/s
        Frame k shows the observation at the time k / fps and the action sent then.
    width, height : int, px
    title : str

    Yields
    ------
    ndarray, shape (height, width, 3), uint8
        One frame each; there are as many as ``n_frames`` says.

    Raises
    ------
    MisstepError
        If a column is missing, there is no drawing of the system, or a size or the rate is wrong.
    """
    # Checked here and not in the generator, whose body runs only when the first frame is wanted.
    observations = _columns(trajectory, trajectory.observations, ("x", "theta"))
    actions = _columns(trajectory, trajectory.actions, ("force",))
    shown = _shown_steps(trajectory, fps)
    source = trajectory.provenance
    painter = Painter(source.system, source.parameters, width=width, height=height, title=title)
    return _paint_all(painter, observations, actions, shown, trajectory.dt)


def n_frames(trajectory: Trajectory, fps: float = 20.0) -> int:
    """Return the number of frames of a trajectory: its start, and one every 1 / fps seconds."""
    return len(_shown_steps(trajectory, fps))


def write_video(
    trajectory: Trajectory,
    path: str | os.PathLike[str],
    *,
    fps: float = 20.0,
    width: int = 640,
    height: int = 360,
    title: str = "",
) -> None:
    """Write a trajectory as an MP4 video (H.264), in a single step.

    Parameters
    ----------
    trajectory : Trajectory
        Must observe ``x`` and ``theta`` and act with ``force``.
    path : path
        Ends in ``.mp4``.
    fps : float, 1/s
    width, height : int, px
        Even.
    title : str

    Raises
    ------
    MisstepError
        As `frames`; and if the path does not end in ``.mp4`` or cannot be written.
    """
    if Path(path).suffix.lower() != ".mp4":
        raise MisstepError(f"cannot write {path}: a video is an MP4 file, name it NAME.mp4")
    pictures = frames(trajectory, fps, width, height, title)
    atomic_write(path, lambda temporary: _encode(pictures, temporary, fps, (width, height)))


def _drawing(
    system: str, parameters: Mapping[str, ParameterValue], width: int, height: int
) -> Drawing:
    with_opengl, without = _DRAWINGS[system]
    try:
        return with_opengl(parameters, width, height)
    except NoOpenGLError as error:
        _tell_flat(str(error))
        return without(parameters, width, height)


@functools.cache
def _tell_flat(reason: str) -> None:
    """Warn, once for each reason."""
    warnings.warn(
        f"pictures are flat drawings, because OpenGL does not work here: {reason}",
        RuntimeWarning,
        stacklevel=2,
    )


def _columns(
    trajectory: Trajectory, table: NDArray[np.float64], names: tuple[str, ...]
) -> dict[str, NDArray[np.float64]]:
    """Return the columns `names` of the observations or actions by name."""
    acting = table is trajectory.actions
    columns = trajectory.action_columns if acting else trajectory.observation_columns
    known = [column.name for column in columns]
    for name in names:
        if name not in known:
            raise MisstepError(
                f"a picture needs the {'action' if acting else 'observation'} column {name!r}; "
                f"the trajectory has: {', '.join(known)}"
            )
    return {name: table[:, known.index(name)] for name in names}


def _shown_steps(trajectory: Trajectory, fps: float) -> NDArray[np.intp]:
    """Return the index of the observation that each frame shows."""
    if not (math.isfinite(fps) and fps > 0):
        raise MisstepError(f"fps is {fps}: it must be a positive number of frames per second")
    # The margin keeps a frame that falls on an observation there, in floating point.
    count = math.floor(trajectory.duration * fps + 1e-6) + 1
    steps = np.floor(np.arange(count) / fps / trajectory.dt + 1e-6).astype(np.intp)
    return np.minimum(steps, trajectory.n_steps)


def _paint_all(
    painter: Painter,
    observations: Mapping[str, NDArray[np.float64]],
    actions: Mapping[str, NDArray[np.float64]],
    shown: NDArray[np.intp],
    dt: float,
) -> Iterator[NDArray[np.uint8]]:
    with painter:
        for step in shown:
            last_action = len(actions["force"]) - 1
            yield painter.paint(
                {name: float(column[step]) for name, column in observations.items()},
                {name: float(column[min(step, last_action)]) for name, column in actions.items()},
                step * dt,
            )


def _encode(
    pictures: Iterator[NDArray[np.uint8]], path: Path, fps: float, size: tuple[int, int]
) -> None:
    writer = imageio_ffmpeg.write_frames(
        str(path),
        size,
        fps=fps,
        codec="libx264",
        pix_fmt_out="yuv420p",
        macro_block_size=2,
        output_params=["-crf", "28", "-preset", "veryfast", "-movflags", "+faststart"],
    )
    writer.send(None)
    try:
        for picture in pictures:
            writer.send(np.ascontiguousarray(picture))
    finally:
        writer.close()
