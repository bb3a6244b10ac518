import math
import os
import subprocess
import sys

import imageio_ffmpeg
import numpy as np
import pytest

from misstep.demonstrators import demonstrate
from misstep.errors import MisstepError
from misstep.rollout import rollout
from misstep.systems import CartPole, make_system
from misstep.systems.basket_drawing import BasketScene, BasketSketch
from misstep.systems.cartpole_drawing import CartPoleScene, CartPoleSketch
from misstep.systems.flipup_drawing import FlipUpScene, FlipUpSketch
from misstep.systems.offscreen import NoOpenGLError
from misstep.systems.rendering import (
    Painter,
    frames,
    n_frames,
    write_side_by_side,
    write_video,
)
from misstep.trajectory import Column, Provenance, Trajectory

SIZE = (320, 180)


@pytest.fixture(params=[CartPoleScene, CartPoleSketch])
def draw(request):
    """Return a function of x, theta, force that returns a picture as integers."""
    try:
        drawing = request.param({"force_limit": 10.0}, *SIZE)
    except NoOpenGLError as error:
        pytest.skip(f"no OpenGL: {error}")
    yield lambda x=0.0, theta=0.0, force=0.0: drawing.draw(
        {"x": x, "theta": theta}, {"force": force}
    ).astype(int)
    drawing.close()


@pytest.fixture(scope="module")
def trajectory():
    class Idle:
        def reset(self):
            pass

        def __call__(self, observation):
            return np.array([3.0])

    system = CartPole(stop_at_fall=False, duration=1.5)
    return rollout(system, Idle(), seed=1, demonstrator="test", time="")


def arrow(picture):
    """Return the columns of the picture that hold the orange of the arrow."""
    red, green, blue = np.moveaxis(picture, -1, 0)
    return np.flatnonzero(((red - green > 50) & (green - blue > 40)).any(axis=0))


def pole(picture, fallen):
    """Return the columns, one a pixel, of the blue (or red, if fallen) of the pole."""
    red, green, blue = np.moveaxis(picture, -1, 0)
    ours = (red - green > 70) & (green - blue < 40) if fallen else blue - red > 70
    return np.nonzero(ours)[1]


def test_picture_has_the_size_asked_for(draw):
    assert draw().shape == (SIZE[1], SIZE[0], 3)
    assert draw().mean() > 180  # light


@pytest.mark.parametrize("force", [-10.0, -5.0, 5.0, 10.0])
def test_arrow_points_where_the_force_pushes(draw, force):
    columns = arrow(draw(force=force)) - SIZE[0] / 2
    assert len(columns) > 10
    assert np.all(columns * force > 0)


def test_length_of_the_arrow_is_in_proportion_and_capped(draw):
    half, full, beyond = (np.ptp(arrow(draw(force=force))) for force in (5.0, 10.0, 1000.0))
    # 1.5 half-lengths of 5 in the height of the view, a little more in perspective.
    assert full == pytest.approx(1.5 / 5.0 * SIZE[1], rel=0.1)
    assert full == pytest.approx(2 * half, abs=3)
    assert beyond == full
    assert len(arrow(draw(force=0.0))) == 0


@pytest.mark.parametrize("angle", [-0.3, 0.3])
def test_pole_leans_to_its_side(draw, angle):
    columns = pole(draw(theta=angle), fallen=False) - SIZE[0] / 2
    assert np.mean(columns) * angle > 0
    assert len(pole(draw(theta=angle), fallen=True)) == 0


def test_fallen_pole_has_another_colour(draw):
    columns = pole(draw(theta=math.radians(31)), fallen=True)
    assert len(columns) > 50
    assert np.mean(columns) > SIZE[0] / 2
    assert len(pole(draw(theta=math.radians(31)), fallen=False)) == 0


def test_picture_follows_the_cart_along_marks(draw):
    # The marks repeat every 0.5 m and nothing else distinguishes places far from the stops.
    here, half_a_mark_on, one_period_on = draw(x=0.0), draw(x=0.05), draw(x=0.5)
    assert np.abs(here - one_period_on).max() < 60
    assert np.abs(here - one_period_on).mean() < 0.05
    assert np.abs(here - half_a_mark_on).mean() > 0.3
    assert np.abs(here - draw(x=999.5)).mean() > 0.5  # a stop has come into view


def test_environment_renders_what_it_simulates():
    system = CartPole(render_mode="rgb_array", start_angle=0.4, start_spread=0.0, force_limit=10.0)
    system.reset(seed=0)
    system.step(np.array([-10.0]))
    picture = system.render().astype(int)
    assert picture.shape == (360, 640, 3)
    assert np.mean(pole(picture, fallen=False)) > 320
    assert arrow(picture).max() < 320
    system.close()
    assert CartPole().render() is None


@pytest.fixture(scope="module", params=["flipup", "basket"])
def strikes(request):
    """Return a strike that is too slow and one that is too fast."""
    return demonstrate(make_system(request.param), "bracket", n=2, seed=0, time="")


@pytest.fixture(params=[0, 1], ids=["scene", "sketch"])
def draw_strike(request, strikes):
    """Return a function of a trajectory and a step that returns a picture as integers."""
    kinds = {"flipup": (FlipUpScene, FlipUpSketch), "basket": (BasketScene, BasketSketch)}
    try:
        drawing = kinds[strikes[0].provenance.system][request.param]({}, *SIZE)
    except NoOpenGLError as error:
        pytest.skip(f"no OpenGL: {error}")

    def draw_step(trajectory, step):
        names = [column.name for column in trajectory.observation_columns]
        observation = dict(zip(names, trajectory.observations[step], strict=True))
        return drawing.draw(observation, {"velocity": 0.0}).astype(int)

    yield draw_step
    drawing.close()


def struck_thing(picture, system):
    """Return the columns of the pixels of the block (blue) or of the ball (red)."""
    red, green, blue = np.moveaxis(picture, -1, 0)
    ours = blue - red > 70 if system == "flipup" else (red - green > 90) & (green - blue < 40)
    return np.nonzero(ours)[1]


def test_what_was_struck_is_drawn_where_it_was_seen(strikes, draw_strike):
    system = strikes[0].provenance.system
    start, short, far = (
        struck_thing(draw_strike(*place), system)
        for place in ((strikes[0], 0), (strikes[0], -1), (strikes[1], -1))
    )
    assert min(map(len, (start, short, far))) > 10
    if system == "flipup":
        assert np.mean(short) == pytest.approx(np.mean(start), abs=8)  # it fell back
        assert np.mean(far) < np.mean(start) - 20  # it tipped over, away from the effector
    else:
        assert np.mean(start) < np.mean(short) < np.mean(far)
        assert far.max() < SIZE[0]  # the picture grows to hold it


def test_arrow_of_a_strike_is_there_while_it_moves(strikes, draw_strike):
    resting, moving = draw_strike(strikes[1], 0), draw_strike(strikes[1], -2)
    assert len(arrow(moving)) > len(arrow(resting)) > 0


def test_strikes_are_shown_slowly_and_their_end_for_a_second(strikes):
    trajectory = strikes[1]
    pictures = list(frames(trajectory, fps=20, width=320, height=180))
    assert len(pictures) == n_frames(trajectory, fps=20) == trajectory.n_steps + 1 + 20
    for picture in pictures[-20:]:
        np.testing.assert_array_equal(picture, pictures[-21])
    assert not np.array_equal(pictures[-22], pictures[-21])
    upper_right = pictures[-21][38:50, 240:305].astype(int)
    assert (upper_right[..., 0] - upper_right[..., 1] > 60).any()  # "failure" is written in red


def test_struck_systems_render_what_they_simulate(strikes):
    trajectory = strikes[0]
    system = make_system(trajectory.provenance.system, render_mode="rgb_array")
    system.reset(seed=trajectory.provenance.seed)
    before = system.render()
    for action in trajectory.actions:
        system.step(action)
    assert before.shape == (360, 640, 3)
    assert np.abs(before.astype(int) - system.render()).max() > 100
    system.close()


def test_title_angle_force_and_time_are_written(trajectory):
    def paint(title="", theta=0.1, force=1.0, time=0.0):
        with Painter("cartpole", {}, width=320, height=180, title=title) as painter:
            return painter.paint({"x": 0.0, "theta": theta}, {"force": force}, time)

    plain = paint()
    upper_left, upper_right = np.s_[:40, :110], np.s_[:60, 230:]
    assert not np.array_equal(plain[upper_left], paint(title="attempt 1")[upper_left])
    for change in ({"theta": 0.11}, {"force": 2.0}, {"time": 1.0}):
        assert not np.array_equal(plain[upper_right], paint(**change)[upper_right])


def test_frames_show_the_recorded_observations_from_first_to_last(trajectory):
    pictures = list(frames(trajectory, fps=10, width=320, height=180))
    assert len(pictures) == n_frames(trajectory, fps=10) == 16
    with Painter("cartpole", {}, width=320, height=180) as painter:
        for k in (0, 7, 15):
            step = 5 * k
            observation = {name: trajectory.column(name)[step] for name in ("x", "theta")}
            outcome = trajectory.outcome if k == 15 else ""
            expected = painter.paint(observation, {"force": 3.0}, k / 10, outcome)
            np.testing.assert_array_equal(pictures[k], expected)


@pytest.mark.parametrize(("fps", "count"), [(20, 31), (50, 76), (7, 11), (0.1, 1)])
def test_number_of_frames_is_one_more_than_the_duration_holds(trajectory, fps, count):
    assert n_frames(trajectory, fps) == count


def decode(path, size):
    """Return the frames of a video, and what ffmpeg says about it."""
    ffmpeg = imageio_ffmpeg.get_ffmpeg_exe()
    command = [ffmpeg, "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(command, capture_output=True, check=True)
    pixels = np.frombuffer(done.stdout, np.uint8).reshape(-1, size[1], size[0], 3)
    return pixels, done.stderr.decode()


def test_video_holds_the_frames(trajectory, tmp_path):
    path = tmp_path / "attempt.mp4"
    write_video(trajectory, path, fps=20, width=320, height=180, title="attempt 1")
    assert [p.name for p in tmp_path.iterdir()] == ["attempt.mp4"]
    assert path.stat().st_size < 50_000
    decoded, about = decode(path, (320, 180))
    assert "Video: h264" in about
    assert "yuv420p" in about
    assert "320x180" in about
    assert "20 fps" in about
    assert "Duration: 00:00:01.55" in about  # 31 frames
    pictures = list(frames(trajectory, fps=20, width=320, height=180, title="attempt 1"))
    assert len(decoded) == len(pictures) == 31
    for shown, drawn in zip(decoded, pictures, strict=True):
        assert np.abs(shown.astype(int) - drawn).mean() < 5


def run_python(code, **environment):
    return subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=True,
    )


def test_without_opengl_a_flat_drawing_and_one_line_take_its_place():
    done = run_python(
        "from misstep.systems.rendering import Painter\n"
        "for _ in range(2):\n"
        "    with Painter('cartpole', {}) as painter:\n"
        "        print(painter.paint({'x': 0.0, 'theta': 0.1}, {'force': 5.0}, 0.0).shape)\n",
        MUJOCO_GL="disable",
    )
    assert done.stdout.splitlines() == ["(360, 640, 3)"] * 2
    assert done.stderr.count("RuntimeWarning") == 1
    assert "pictures are flat drawings, because OpenGL does not work here" in done.stderr


def test_opengl_left_open_says_nothing_at_exit():
    done = run_python(
        "import weakref\n"
        "from misstep.systems import CartPole\n"
        "import numpy as np\n"
        "system = CartPole(render_mode='rgb_array')\n"
        "weakref.finalize(system, print, 'gone')\n"
        "system.reset(seed=0)\n"
        "print(system.render().shape)\n"
    )
    assert done.stdout.splitlines() == ["(360, 640, 3)", "gone"]
    assert "Error" not in done.stderr
    assert "exception" not in done.stderr.lower()


def other_columns(trajectory, observations, actions, system="cartpole"):
    return Trajectory(
        trajectory.observations[:, : len(observations)],
        trajectory.actions,
        trajectory.dt,
        tuple(Column(name, "") for name in observations),
        tuple(Column(name, "") for name in actions),
        Provenance(system, {}, "test", None, ""),
    )


@pytest.mark.parametrize(
    ("changed", "line"),
    [
        ((["x"], ["force"]), "needs the observation column 'theta'; the trajectory has: x"),
        ((["x", "theta"], ["push"]), "needs the action column 'force'; the trajectory has: push"),
        ((["x", "theta"], ["force"], "robot"), "no drawing of the system 'robot'; .*cartpole"),
    ],
)
def test_trajectories_that_cannot_be_drawn_are_told(trajectory, tmp_path, changed, line):
    with pytest.raises(MisstepError, match=line):
        write_video(other_columns(trajectory, *changed), tmp_path / "v.mp4")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ({"fps": 0}, "fps is 0: it must be a positive number"),
        ({"fps": math.nan}, "fps is nan"),
        ({"width": 321}, "the size of a picture is 321 × 360: both must be even"),
        ({"height": 10}, "both must be even and at least 64"),
    ],
)
def test_wrong_arguments_are_told(trajectory, tmp_path, arguments, line):
    with pytest.raises(MisstepError, match=line):
        write_video(trajectory, tmp_path / "v.mp4", **arguments)
    assert list(tmp_path.iterdir()) == []


def test_wrong_paths_are_told(trajectory, tmp_path):
    with pytest.raises(MisstepError, match=r"v\.avi: a video is an MP4 file"):
        write_video(trajectory, tmp_path / "v.avi")
    with pytest.raises(MisstepError, match="No such file or directory"):
        write_video(trajectory, tmp_path / "nowhere" / "v.mp4", width=64, height=64)


def test_side_by_side_holds_the_end_of_the_shorter(tmp_path):
    system = CartPole(start_angle=0.3, start_spread=0.0)
    push = demonstrate(system, "weak", n=1, seed=0)[0]
    short = push.cut(max(1, push.n_steps // 3))
    path = tmp_path / "both.mp4"
    write_side_by_side([short, push], path, titles=["a", "b"], fps=10.0, width=160, height=90)
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(path)]
    raw = subprocess.run(
        [*command, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"], capture_output=True, check=True
    ).stdout
    pictures = np.frombuffer(raw, np.uint8).reshape(-1, 90, 320, 3).astype(int)
    assert len(pictures) == n_frames(push, 10.0)
    left, right = pictures[-1][:, :160], pictures[-1][:, 160:]
    held = pictures[n_frames(short, 10.0) - 1][:, :160]
    assert np.abs(left - held).mean() < 3.0
    assert np.abs(left - right).mean() > np.abs(left - held).mean()
