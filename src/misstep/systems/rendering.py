"""Pictures and videos of recorded trajectories, drawn from what was observed.

Nothing is simulated again: a picture shows the recorded state and action. Where OpenGL works the
picture is three-dimensional; where it does not, a flat drawing with the same information takes its
place, and one warning says so.
"""

import functools
import math
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from types import TracebackType
from typing import Protocol

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from misstep.errors import MisstepError, reason_of
from misstep.parameters import ParameterValue, parameter_table
from misstep.storage import atomic_write
from misstep.systems import JUDGE_PARAMETERS, SYSTEMS
from misstep.systems.basket_drawing import BasketScene, BasketSketch
from misstep.systems.cartpole_drawing import CartPoleScene, CartPoleSketch
from misstep.systems.drawing import DARK, GREEN, RED
from misstep.systems.flipup_drawing import FlipUpScene, FlipUpSketch
from misstep.systems.offscreen import NoOpenGLError
from misstep.trajectory import Column, Outcome, Trajectory

INK, FAINT = DARK, "#6b7785"
_OUTCOME_COLOURS = {Outcome.SUCCESS: GREEN, Outcome.FAILURE: RED}


class Drawing(Protocol):
    """Draws the states of one system, of one size.

    Attributes
    ----------
    columns : tuple of str
        Observation columns that it needs.
    action_column : str
        Action column that it needs.
    slow_motion : float
        A video plays this much slower than the attempt went.
    hold : float, s
        A video stays on the last picture for this long.
    """

    columns: tuple[str, ...]
    action_column: str
    slow_motion: float
    hold: float

    def __init__(
        self, parameters: Mapping[str, ParameterValue], width: int, height: int, /
    ) -> None: ...

    def caption(
        self, observation: Mapping[str, float], action: Mapping[str, float], time: float, /
    ) -> list[tuple[str, str, str]]:
        """Return name, value and unit of what is written beside the picture."""

    def draw(
        self, observation: Mapping[str, float], action: Mapping[str, float]
    ) -> NDArray[np.uint8]:
        """Return a picture, shape (height, width, 3)."""

    def close(self) -> None:
        """Give back what it holds."""


# By system: with OpenGL, and without. A system that is derived from one of these looks like it.
_DRAWINGS: dict[str, tuple[type[Drawing], type[Drawing]]] = {
    "cartpole": (CartPoleScene, CartPoleSketch),
    "cartpole-rail": (CartPoleScene, CartPoleSketch),
    "cartpole-swingup": (CartPoleScene, CartPoleSketch),
    "flipup": (FlipUpScene, FlipUpSketch),
    "basket": (BasketScene, BasketSketch),
}


class Painter:
    """Draws states of one system with a caption: title, what was seen and done, time, outcome.

    A context manager; leaving it gives back what OpenGL holds.

    Parameters
    ----------
    system : str
        Name of a system of which there are drawings: ``"cartpole"``, ``"flipup"``, ``"basket"``.
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
        _drawings_of(system)
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
        self,
        observation: Mapping[str, float],
        action: Mapping[str, float],
        time: float,
        outcome: str = "",
    ) -> NDArray[np.uint8]:
        """Return a picture, shape (height, width, 3).

        Parameters
        ----------
        observation : mapping
            What the drawing needs, in the system's units: of a cart-pole ``x`` and ``theta``;
            others are ignored.
        action : mapping
            Likewise: ``force`` of a cart-pole, ``velocity`` of an effector.
        time : float, s
        outcome : str
            ``"success"`` or ``"failure"`` to have it written below the time.
        """
        picture = Image.fromarray(self._drawing.draw(observation, action))
        pen = ImageDraw.Draw(picture)
        s = self._scale
        pen.text((20 * s, 16 * s), self._title, INK, self._large)
        values = self._drawing.caption(observation, action, time)
        for row, (name, value, unit) in enumerate(values):
            y = (16 + 21 * row) * s
            pen.text((self._width - 146 * s, y), name, FAINT, self._small)
            pen.text((self._width - 38 * s, y), value, INK, self._small, anchor="ra")
            pen.text((self._width - 33 * s, y), unit, FAINT, self._small)
        if outcome:
            colour = _OUTCOME_COLOURS[Outcome(outcome)]
            y = (16 + 21 * len(values)) * s
            pen.text((self._width - 38 * s, y), outcome, colour, self._small, anchor="ra")
        return np.asarray(picture)

    def paint_step(self, trajectory: Trajectory, step: int) -> NDArray[np.uint8]:
        """Return the picture, shape (height, width, 3), of a trajectory after `step` actions.

        Raises
        ------
        MisstepError
            If a column that the drawing needs is missing.
        """
        seen = [column.name for column in trajectory.observation_columns]
        done = [column.name for column in trajectory.action_columns]
        acted = min(step, trajectory.n_steps - 1)
        try:
            return self.paint(
                dict(zip(seen, trajectory.observations[step].tolist(), strict=True)),
                dict(zip(done, trajectory.actions[acted].tolist(), strict=True)),
                float(step * trajectory.dt),
            )
        except KeyError as error:
            raise MisstepError(
                f"a picture of {trajectory.provenance.system} needs the column {error}"
            ) from None

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

    The strikes of flip-up and basket last a tenth of a second: they are shown ten times slower than
    they went, and their end, where the outcome is written, for a second.

    Parameters
    ----------
    trajectory : Trajectory
        Must observe and act with what the drawing of its system needs: a cart-pole's ``x``,
        ``theta`` and ``force``, every column of the others.
    fps : float, 1/s
        Frame k shows the observation at the time k / fps, slowed down, and the action sent then.
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
    source = trajectory.provenance
    drawing, _ = _drawings_of(source.system)
    observations = _columns(
        "observation", trajectory.observation_columns, trajectory.observations, drawing.columns
    )
    actions = _columns(
        "action", trajectory.action_columns, trajectory.actions, (drawing.action_column,)
    )
    shown = _shown_steps(trajectory, fps)
    painter = Painter(source.system, source.parameters, width=width, height=height, title=title)
    return _paint_all(painter, trajectory, observations, actions, shown)


def n_frames(trajectory: Trajectory, fps: float = 20.0) -> int:
    """Return the number of frames of a trajectory: its start, and one every 1 / fps seconds.

    Seconds of the video, that is, in which strikes are shown slowed down.
    """
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
        As for `frames`.
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
    _check_ending(path)
    pictures = frames(trajectory, fps, width, height, title)
    atomic_write(path, lambda temporary: _encode(pictures, temporary, fps, (width, height)))


def write_side_by_side(
    trajectories: Sequence[Trajectory],
    path: str | os.PathLike[str],
    *,
    titles: Sequence[str],
    fps: float = 20.0,
    width: int = 640,
    height: int = 360,
) -> None:
    """Write trajectories into one video, beside each other; the shorter ones hold their end.

    Parameters
    ----------
    trajectories : sequence of Trajectory
        As for `frames`.
    path : path
        Ends in ``.mp4``.
    titles : sequence of str
        One each.
    fps : float, 1/s
    width, height : int, px
        Of each.

    Raises
    ------
    MisstepError
        As `write_video`.
    """
    _check_ending(path)
    sides = [
        frames(trajectory, fps, width, height, title)
        for trajectory, title in zip(trajectories, titles, strict=True)
    ]
    size = (width * len(sides), height)
    atomic_write(path, lambda temporary: _encode(_beside(sides), temporary, fps, size))


def _check_ending(path: str | os.PathLike[str]) -> None:
    if Path(path).suffix.lower() != ".mp4":
        raise MisstepError(f"cannot write {path}: a video is an MP4 file, name it NAME.mp4")


def _beside(sides: Sequence[Iterator[NDArray[np.uint8]]]) -> Iterator[NDArray[np.uint8]]:
    """Join the pictures of all sides until the last has ended."""
    shown: list[NDArray[np.uint8]] = []
    for pictures in zip_longest(*sides):
        shown = [new if new is not None else shown[k] for k, new in enumerate(pictures)]
        yield np.concatenate(shown, axis=1)


def _drawings_of(system: str) -> tuple[type[Drawing], type[Drawing]]:
    """Return how the system is drawn with OpenGL, and without."""
    ancestors = SYSTEMS[system].__mro__ if system in SYSTEMS else ()
    for ancestor in ancestors:
        drawings = _DRAWINGS.get(getattr(ancestor, "system_id", ""))
        if drawings is not None:
            return drawings
    raise MisstepError(
        f"there is no drawing of the system {system!r}; there are: {', '.join(_DRAWINGS)}"
    )


def _drawing(
    system: str, parameters: Mapping[str, ParameterValue], width: int, height: int
) -> Drawing:
    with_opengl, without = _drawings_of(system)
    shown = _shown_parameters(system, parameters)
    try:
        try:
            return with_opengl(shown, width, height)
        except NoOpenGLError as error:
            _tell_flat(str(error))
            return without(shown, width, height)
    except MisstepError:
        raise
    except (ArithmeticError, ValueError) as error:  # a file may state a radius of 10⁻⁹ m
        raise MisstepError(
            f"{system} cannot be drawn with its parameters: {reason_of(error)}"
        ) from error


def _shown_parameters(
    system: str, parameters: Mapping[str, ParameterValue]
) -> dict[str, ParameterValue]:
    """Return the system's own parameters, defaults included; how it is judged is not seen."""
    defaults = {row.name: row.default for row in parameter_table(SYSTEMS[system].parameters_type)}
    judges = {row.name for row in JUDGE_PARAMETERS}
    own = {name: value for name, value in parameters.items() if name not in judges}
    return {**defaults, **own}


@functools.cache
def _tell_flat(reason: str) -> None:
    """Warn, once for each reason."""
    warnings.warn(
        f"pictures are flat drawings, because OpenGL does not work here: {reason}",
        RuntimeWarning,
        stacklevel=2,
    )


def _columns(
    kind: str, columns: Sequence[Column], table: NDArray[np.float64], names: tuple[str, ...]
) -> dict[str, NDArray[np.float64]]:
    """Return the columns `names` of a table of observations or actions by name."""
    known = [column.name for column in columns]
    for name in names:
        if name not in known:
            raise MisstepError(
                f"a picture needs the {kind} column {name!r}; the trajectory has: "
                f"{', '.join(known)}"
            )
    return {name: table[:, known.index(name)] for name in names}


def _shown_steps(trajectory: Trajectory, fps: float) -> NDArray[np.intp]:
    """Return the index of the observation that each frame shows."""
    if not (math.isfinite(fps) and fps > 0):
        raise MisstepError(f"fps is {fps}: it must be a positive number of frames per second")
    # The margin keeps a frame that falls on an observation there, in floating point.
    drawing, _ = _drawings_of(trajectory.provenance.system)
    rate = fps * drawing.slow_motion
    count = math.floor(trajectory.duration * rate + 1e-6) + 1
    steps = np.floor(np.arange(count) / rate / trajectory.dt + 1e-6).astype(np.intp)
    held = np.full(math.floor(drawing.hold * fps), trajectory.n_steps, np.intp)
    return np.concatenate([np.minimum(steps, trajectory.n_steps), held])


def _paint_all(
    painter: Painter,
    trajectory: Trajectory,
    observations: Mapping[str, NDArray[np.float64]],
    actions: Mapping[str, NDArray[np.float64]],
    shown: NDArray[np.intp],
) -> Iterator[NDArray[np.uint8]]:
    with painter:
        for step in shown:
            acted = min(step, trajectory.n_steps - 1)
            yield painter.paint(
                {name: float(column[step]) for name, column in observations.items()},
                {name: float(column[acted]) for name, column in actions.items()},
                step * trajectory.dt,
                _verdict(trajectory, step),
            )


def _verdict(trajectory: Trajectory, step: int) -> str:
    """Return the outcome at the last observation; empty before, and where nobody knows it."""
    over = step == trajectory.n_steps and trajectory.outcome is not Outcome.UNKNOWN
    return str(trajectory.outcome) if over else ""


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
