"""Pictures and films: what is drawn is what was measured, whatever a run or a machine can bring."""

import subprocess

import imageio_ffmpeg
import mujoco
import numpy as np
import pytest
from diagrams import DIAGRAMS
from matplotlib.colors import to_rgb
from model import ROBOT
from pictures import PICTURES, draw_foretold, draw_race
from PIL import Image
from pretend import elsewhere, instead, pretend_history, pretend_walk
from scipy.spatial.transform import Rotation

from hector_jax import PAPER_LOSS, InputError, State
from hector_jax.report import plots
from hector_jax.report.plots.style import SETS, looks_of
from hector_jax.robot.description import MODEL_PATH
from hector_jax.view import video
from hector_jax.view.motion import motion, motions, poses
from hector_jax.view.video import VideoConfig, VideoUnavailable, write_film, write_strip

FOUR = ("nominal", "expert", "without", "with")


@pytest.fixture(scope="module")
def walks():
    made = (pretend_walk(i, 0.02 + 0.01 * i, seconds=1.0, turn=0.5) for i in range(4))
    return dict(zip(FOUR, made, strict=True))


def lines(axes):
    """Data of an axes' lines by their label."""
    return {line.get_label(): np.asarray(line.get_xydata()) for line in axes.lines}


def test_errors_and_paths_do_not_depend_on_where_a_walk_began(tmp_path, drawn, walks):
    one = walks["with"]
    pair = {"with": one, "nominal": elsewhere(one, (0.4, -1.0), 2.0)}
    plots.save_tracking(tmp_path / "a.png", pair)
    caption = plots.save_path(tmp_path / "b.png", pair)
    assert "one reference" in caption
    for axes in [*drawn[0].axes, *drawn[1].axes]:
        found = lines(axes)
        np.testing.assert_allclose(found["with (tuned, net)"], found["nominal"], atol=1e-9)
    reference = lines(drawn[1].axes[0])["reference"]
    np.testing.assert_allclose(reference[0], one.reference.position[0, :2], atol=1e-9)


def test_the_errors_are_along_and_across_the_heading_in_centimetres_and_degrees(tmp_path, drawn):
    walk = pretend_walk(error=0.0, seconds=1.0, turn=1.0)
    yaw = walk.reference.euler[:, 2]
    left = 0.02 * np.stack([-np.sin(yaw), np.cos(yaw), 0 * yaw], axis=1)
    state = State(walk.state.euler + [0.0, 0.1, 0.0], walk.state.position + left, *walk.state[2:])
    plots.save_tracking(tmp_path / "a.png", {"with": walk._replace(state=state)})
    found = {axes.get_ylabel(): axes.lines[0].get_ydata() for axes in drawn[0].axes}
    assert [label.split(" [")[1] for label in found] == ["cm]"] * 3 + ["deg]"] * 3
    expected = [0.0, 2.0, 0.0, 0.0, np.rad2deg(0.1), 0.0]
    for values, level in zip(found.values(), expected, strict=True):
        np.testing.assert_allclose(values, level, atol=1e-9)


def test_lines_end_at_a_fall(tmp_path, drawn, walks):
    fallen = walks | {"without": pretend_walk(2, seconds=1.0, fall_at=0.6)}
    plots.save_tracking(tmp_path / "tracking.png", fallen)
    plots.save_path(tmp_path / "path.png", fallen)
    for axes in [*drawn[0].axes, *drawn[1].axes]:
        up = np.isfinite(lines(axes)["without (tuned, no net)"][:, 1])
        assert up.tolist() == [True] * 60 + [False] * 40


def test_sets_are_not_drawn_alike_and_stay_apart_in_grey():
    every = looks_of([*SETS, *(f"mine {i}" for i in range(5))])
    assert len({look.color for look in every.values()}) == len(every)
    names = ("with", "expert", "without", "nominal")  # from dark to light
    greys = [np.dot(to_rgb(every[name].color), (0.299, 0.587, 0.114)) for name in names]
    assert np.diff(greys).min() > 0.12


def test_the_loss_by_iteration_shows_refused_steps_that_are_no_numbers(tmp_path, drawn):
    histories = {"without": pretend_history(12), "with": pretend_history(8, refused=(3, 5))}
    plots.save_losses(tmp_path / "loss.png", PAPER_LOSS, histories)
    whole = drawn[0].axes[0]
    kept = [0, 1, 2, 4, 6, 7, 8]
    expected = [histories["with"][i].evaluation.loss / 1e6 for i in kept]
    np.testing.assert_allclose(lines(whole)["with (tuned, net)"], np.c_[kept, expected])
    crosses = [line.get_xdata().tolist() for line in whole.lines if line.get_marker() == "x"]
    assert [3, 5] in crosses
    (legend,) = drawn[0].legends
    assert "refused step" in [text.get_text() for text in legend.get_texts()]


@pytest.mark.parametrize("ending", ["png", "svg", "pdf"])
def test_the_same_picture_gives_the_same_bytes(tmp_path, walks, ending):
    one, other = (tmp_path / f"{name}.{ending}" for name in ("one", "other"))
    for path in (one, other):
        plots.save_path(path, walks)
    assert one.read_bytes() == other.read_bytes()


def test_pictures_of_the_pages_are_there_and_small_and_two_are_drawn_again(tmp_path):
    for name, (path, _) in PICTURES.items():
        assert 10_000 < path.stat().st_size < (1_000_000 if name == "film" else 400_000)
    with Image.open(PICTURES["film"][0]) as film:
        assert (film.n_frames, film.width >= 720) == (49, True)  # four seconds
    draw_race(tmp_path / "race.png")
    draw_foretold(tmp_path / "foretold.png")
    for name in ("race", "foretold"):
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000


@pytest.mark.parametrize("name", DIAGRAMS)
def test_a_diagram_is_what_the_code_says_now(tmp_path, name):
    DIAGRAMS[name](tmp_path / "again.svg")
    assert (tmp_path / "again.svg").read_bytes() == PICTURES[name][0].read_bytes()
    assert PICTURES[name][0].stat().st_size < 100_000


def test_a_film_shows_the_pose_of_its_time_as_it_was_walked_and_after_a_fall_the_last_one():
    euler, position = np.array([[0.1, -0.2, 2.5]]), np.array([[0.3, -0.4, 0.5]])
    state = State(euler, position, np.zeros((1, 3)), np.zeros((1, 3)))
    model = mujoco.MjModel.from_xml_path(str(MODEL_PATH))
    data = mujoco.MjData(model)
    data.qpos = poses(ROBOT, state, np.asarray(ROBOT.standing_joints)[None])[0]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.subtree_com[1], position[0], atol=1e-9)
    expected = Rotation.from_euler("ZYX", euler[0, ::-1]).as_matrix()
    np.testing.assert_allclose(data.xmat[1].reshape(3, 3), expected, atol=1e-9)
    slow, fast = (pretend_walk(seconds=1.0, period=p, fall_at=0.5) for p in (0.01, 0.001))
    one, other = motions(ROBOT, {"a": slow, "b": fast}).values()
    times = 0.04 * np.arange(26)
    assert one.sample_at(times)[[0, 10, 25]].tolist() == [0, 39, 99]
    assert other.sample_at(times)[[0, 10, 25]].tolist() == [0, 399, 999]
    trunk = poses(ROBOT, State(*(x[39:40] for x in slow.state)), slow.joints[39:40])
    np.testing.assert_allclose(one.qpos[39], trunk[0])
    assert one.fall_time == pytest.approx(0.5)
    for values in (one.qpos, one.path):
        assert np.isfinite(values).all()
        np.testing.assert_array_equal(values[50], values[-1])


@pytest.mark.filterwarnings("ignore:os.fork")  # of the reader used here, not of the writer
def test_films_and_strips_are_written_with_the_promised_size(tmp_path):
    walks = {"nominal": pretend_walk(0, 0.05, 0.2), "with": pretend_walk(1, 0.01, 0.2)}
    walks = motions(ROBOT, walks)
    config = VideoConfig(width=640, height=432, rate=10, tiles=2)
    try:
        write_film(tmp_path / "film.mp4", ROBOT, walks, config)
    except VideoUnavailable as error:
        pytest.skip(str(error))
    frames = imageio_ffmpeg.read_frames(tmp_path / "film.mp4")
    about = next(frames)
    assert (about["size"], about["fps"]) == ((640, 432), 10)
    pictures = [np.frombuffer(f, np.uint8).reshape(432, 640, 3).astype(int) for f in frames]
    assert len(pictures) == 3
    assert np.ptp(pictures[0][60:300]) > 150
    assert np.abs(pictures[2][:320, :320] - pictures[2][:320, 320:]).mean() > 1
    # the plot below is pale where time has not come yet
    first, _, last = (np.sum(np.ptp(picture[324:], axis=-1) > 60) for picture in pictures)
    assert last > first + 20
    write_film(tmp_path / "film.webp", ROBOT, walks, config, strip=tmp_path / "both.png")
    with Image.open(tmp_path / "film.webp") as picture:
        assert (picture.size, picture.n_frames, picture.info["loop"]) == ((640, 432), 3, 0)
    write_strip(tmp_path / "strip.png", ROBOT, walks, config)
    assert (tmp_path / "strip.png").read_bytes() == (tmp_path / "both.png").read_bytes()
    with Image.open(tmp_path / "strip.png") as picture:
        assert picture.size == (2 * 192, 2 * 324)


def test_back_ends_are_tried_in_turn_and_none_is_one_line(tmp_path, monkeypatch):
    said = (
        "warning\nTraceback (most recent call last):\n  File a\nKeyError: 'sky'\n"
        "Exception ignored in: x\nTraceback (most recent call last):\n  File b\nEGLError: (\n)\n"
    )
    works = {"osmesa"}

    def child(words, *, cwd, env, **options):
        if env["MUJOCO_GL"] not in works:
            return subprocess.CompletedProcess(words, 1, "", said)
        (cwd / "drawn.mp4").write_bytes(b"film")
        return subprocess.CompletedProcess(words, 0, "", "")

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    instead(monkeypatch, video.subprocess, "run", child)
    walks, film = dict.fromkeys("ab", motion(ROBOT, pretend_walk(seconds=0.1))), tmp_path / "a.mp4"
    assert write_film(film, ROBOT, walks) == "osmesa"
    assert film.read_bytes() == b"film"
    works.clear()
    film.unlink()
    line = r"no film: .*\(egl: KeyError: 'sky'; osmesa: .*"
    with pytest.raises(VideoUnavailable, match=line) as told:
        write_film(film, ROBOT, walks)
    assert "\n" not in str(told.value)
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_filmed_is_refused(tmp_path):
    with pytest.raises(ValueError, match="two walks side by side, got 1"):
        write_film(tmp_path / "film.mp4", ROBOT, {"a": motion(ROBOT, pretend_walk(seconds=0.1))})
    with pytest.raises(InputError, match=r"must end in .mp4, .webp, .gif, .png, got film.avi"):
        video.check_film(tmp_path / "film.avi")
