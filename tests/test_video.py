"""Films: poses are those that were walked, and no machine's missing back end ends a run."""

import pickle
import subprocess
from pathlib import Path

import imageio_ffmpeg
import mujoco
import numpy as np
import pytest
from PIL import Image
from pretend import elsewhere, pretend_walk
from scipy.spatial.transform import Rotation

from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import State
from hector_jax.report import render, video
from hector_jax.report.motion import motion, motions, poses
from hector_jax.report.plots import style
from hector_jax.report.video import VideoConfig, VideoUnavailable, write_film, write_strip
from hector_jax.robot.description import MODEL_PATH
from hector_jax.robot.model import load_robot


@pytest.fixture(scope="module")
def robot():
    return load_robot()


def test_a_drawn_pose_has_the_walked_centre_of_mass_and_attitude(robot):
    euler, position = np.array([[0.1, -0.2, 2.5]]), np.array([[0.3, -0.4, 0.5]])
    state = State(euler, position, np.zeros((1, 3)), np.zeros((1, 3)))
    model = mujoco.MjModel.from_xml_path(str(MODEL_PATH))
    data = mujoco.MjData(model)
    data.qpos = poses(robot, state, np.asarray(robot.standing_joints)[None])[0]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.subtree_com[1], position[0], atol=1e-9)
    expected = Rotation.from_euler("ZYX", euler[0, ::-1]).as_matrix()
    np.testing.assert_allclose(data.xmat[1].reshape(3, 3), expected, atol=1e-9)


def scene_of(robot, walks, times=(0.0,)):
    path = Path("film.mp4")
    scene = video.make_scene(path, robot, motions(robot, walks), VideoConfig(), strip=False)
    return scene._replace(times=np.asarray(times))


def test_a_film_shows_the_state_of_its_time_whatever_the_walks_rate(robot):
    slow, fast = (pretend_walk(seconds=1.0, period=p) for p in (0.01, 0.001))
    one, other = motions(robot, {"a": slow, "b": fast}).values()
    times = 0.04 * np.arange(26)
    assert one.sample_at(times)[[0, 10, 25]].tolist() == [0, 39, 99]
    assert other.sample_at(times)[[0, 10, 25]].tolist() == [0, 399, 999]
    np.testing.assert_allclose(
        one.path[one.sample_at(times)], other.path[other.sample_at(times)], atol=0.01
    )
    trunk = poses(robot, State(*(x[39:40] for x in slow.state)), slow.joints[39:40])
    np.testing.assert_allclose(one.qpos[one.sample_at(times)[10]], trunk[0])
    for each in (one, other):
        assert len(each.path[:: render._spacing(each.period)]) == 50


def test_a_robot_that_fell_stays_where_it_was_last_seen(robot):
    walks = {"a": pretend_walk(seconds=1.0, fall_at=0.5), "b": pretend_walk(seconds=1.0)}
    fell, stood = motions(robot, walks).values()
    assert fell.fall_time == pytest.approx(0.5)
    assert fell.upright == 50
    assert np.isinf(stood.fall_time)
    for values in (fell.qpos, fell.path):
        assert np.isfinite(values).all()
        np.testing.assert_array_equal(values[50], values[-1])


def test_before_and_after_have_one_reference_wherever_the_robots_began(robot):
    walk = pretend_walk(seconds=1.0, turn=1.0)
    one, other = motions(robot, {"a": walk, "b": elsewhere(walk, (0.3, -0.2), 0.4)}).values()
    np.testing.assert_allclose(other.path, one.path, atol=1e-9)
    np.testing.assert_allclose(other.reference, walk.reference.position, atol=1e-9)


@pytest.mark.parametrize("seconds", [0.1, 0.3, 1.7, 4.0])
@pytest.mark.parametrize("tiles", [2, 6])
def test_snapshots_show_as_many_phases_of_the_gait_as_there_are(robot, seconds, tiles):
    times = video._snapshot_times(motion(robot, pretend_walk(seconds=seconds)), seconds, tiles)
    assert (np.diff(times) > 0).all()
    assert times[0] == 0.0
    assert times[-1] <= seconds
    cycle = min(0.4, seconds)
    np.testing.assert_allclose(np.mod(times, cycle) / cycle, np.arange(tiles) / tiles, atol=0.01)


def test_the_camera_goes_beside_the_reference_and_turns_with_the_robot(robot):
    walk = pretend_walk(seconds=4.0, turn=np.pi / 4)
    scene = scene_of(robot, {"a": walk, "b": walk}, 0.1 * np.arange(1, 41))
    cameras = render._cameras(scene, 40.0, 1.0)
    _, top = render._extent(scene)
    assert 0.6 < top < 0.8
    for time, (one, other) in zip(scene.times, cameras, strict=True):
        assert (one.lookat == other.lookat).all()
        (sample,) = scene.motions["a"].sample_at(np.array([time]))
        place = walk.reference.position[sample] * [1.0, 1.0, 0.0] + [0.0, 0.0, top / 2]
        assert np.linalg.norm(one.lookat - place) < 0.05
        assert abs(one.azimuth - render._ASIDE - np.rad2deg(np.pi / 4 * time)) < 15.0
        for height in (0.0, top):  # head and feet are in the image
            point = place * [1.0, 1.0, 0.0] + [0.0, 0.0, height]
            u, v = render._project(one, 40.0, (400, 400), point)
            assert 100.0 < u < 300.0
            assert 0.0 < v < 400.0
    assert len({camera.distance for pair in cameras for camera in pair}) == 1


def test_the_camera_stays_where_a_robot_fell(robot):
    walks = {
        "a": pretend_walk(seconds=2.0, fall_at=0.5),
        "b": pretend_walk(seconds=2.0),
    }
    times = np.array([0.4, 1.0, 2.0])
    cameras = render._cameras(scene_of(robot, walks, times), 40.0, 1.0)
    fell, walked = np.array([[camera.lookat for camera in pair] for pair in cameras]).swapaxes(0, 1)
    np.testing.assert_array_equal(fell[1], fell[2])
    assert np.linalg.norm(walked[2] - walked[1]) > 0.4


def test_a_film_has_the_colours_of_the_weight_sets_by_name_or_title():
    nominal, best = style.rgb_of(["nominal", "best"])
    assert style.rgb_of(style.titled({"nominal": 1, "best": 2})) == [nominal, best]
    assert best == (31, 47, 143)
    assert style.rgb_of(["best", "mine"])[0] == best


@pytest.mark.filterwarnings("ignore:os.fork")  # of the reader used here, not of the writer
def test_films_and_strips_are_written_with_the_promised_size(robot, tmp_path):
    walks = {"nominal": pretend_walk(0, 0.05, 0.2), "with": pretend_walk(1, 0.01, 0.2)}
    walks = motions(robot, walks)
    config = VideoConfig(width=640, height=432, rate=10, tiles=2)
    try:
        write_film(tmp_path / "film.mp4", robot, walks, config)
    except VideoUnavailable as error:
        pytest.skip(str(error))
    frames = imageio_ffmpeg.read_frames(tmp_path / "film.mp4")
    about = next(frames)
    assert about["size"] == (640, 432)
    assert about["fps"] == 10
    pictures = [np.frombuffer(f, np.uint8).reshape(432, 640, 3).astype(int) for f in frames]
    assert len(pictures) == 3
    assert np.ptp(pictures[0][60:300]) > 150
    assert np.abs(pictures[2][:320, :320] - pictures[2][:320, 320:]).mean() > 1
    # the plot below is pale where time has not come yet
    first, _, last = (np.sum(np.ptp(picture[324:], axis=-1) > 60) for picture in pictures)
    assert last > first + 20
    frames = (Image.fromarray(picture.astype(np.uint8)) for picture in pictures)
    render._encode(str(tmp_path / "film.webp"), frames, (640, 432), 10)
    with Image.open(tmp_path / "film.webp") as picture:
        assert (picture.size, picture.n_frames, picture.info["loop"]) == ((640, 432), 3, 0)
    write_strip(tmp_path / "strip.png", robot, walks, config)
    with Image.open(tmp_path / "strip.png") as picture:
        assert picture.size == (2 * 192, 2 * 324)


def test_no_back_end_costs_one_line(robot, tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "crayon")
    walks = dict.fromkeys("ab", motion(robot, pretend_walk(seconds=0.1)))
    with pytest.raises(VideoUnavailable, match="no film: .*crayon") as caught:
        write_film(tmp_path / "film.mp4", robot, walks)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("count", [1, 5])
def test_the_plot_of_a_frame_is_pale_where_time_has_not_come_yet(robot, count):
    walks = {"a": pretend_walk(seconds=1.0), "b": pretend_walk(seconds=1.0)}
    scene = scene_of(robot, walks, np.linspace(0.0, 1.0, 5)[:count])
    box = (20, 10, 120, 40)
    black = np.zeros((60, 140, 3), np.uint8)
    half = np.zeros((100, 70, 3), np.uint8)
    for k in range(count):
        below = np.asarray(render._frame(scene, black, box, [half, half], k))[100:, :, 0]
        assert below.shape == (60, 140)
        past = below[10:40, 20:121].max(axis=0) == 0
        assert past.tolist() == [True] * (25 * k) + [False] * (101 - 25 * k)
        assert not np.delete(below, np.s_[10:40], axis=0).any()


def test_a_back_end_that_fails_is_told_by_its_first_fault(tmp_path, monkeypatch):
    text = (
        "warning\nTraceback (most recent call last):\n  File a\nKeyError: 'sky'\n"
        "Exception ignored in: x\nTraceback (most recent call last):\n  File b\nEGLError: (\n)\n"
    )
    done = subprocess.CompletedProcess([], 1, "", text)
    monkeypatch.setattr(video.subprocess, "run", lambda *args, **rest: done)
    assert video._draw_in_child(tmp_path, "egl") == "KeyError: 'sky'"


@pytest.mark.parametrize("name", ["film.mp4", "film.webp"])
def test_back_ends_are_tried_in_turn_until_one_draws(robot, tmp_path, monkeypatch, name):
    tried = []
    drawn = f"drawn{Path(name).suffix}"

    def draw(folder, back_end):
        tried.append(back_end)
        if back_end == "egl":
            return "no device"
        scene = pickle.loads((folder / "scene.pickle").read_bytes())
        assert str(scene.file) == drawn
        (folder / drawn).write_bytes(b"film")
        return ""

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(video, "_draw_in_child", draw)
    walks = dict.fromkeys("ab", motion(robot, pretend_walk(seconds=0.1)))
    assert write_film(tmp_path / name, robot, walks) == "osmesa"
    assert tried == ["egl", "osmesa"]
    assert (tmp_path / name).read_bytes() == b"film"


def test_a_film_shows_two_walks(robot, tmp_path):
    with pytest.raises(ValueError, match="two walks side by side, got 1"):
        write_film(tmp_path / "film.mp4", robot, {"a": motion(robot, pretend_walk(seconds=0.1))})


def test_the_child_process_finds_the_module_that_draws(robot, tmp_path, monkeypatch):
    """Whatever back ends there are: it gets as far as the scene that is missing."""
    monkeypatch.setenv("PYTHONPATH", "")
    assert "scene.pickle" in video._draw_in_child(tmp_path, "disable")


def test_a_film_of_another_ending_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"must end in .mp4, .webp, .gif, .png, got film.avi"):
        video.check_film(tmp_path / "film.avi")


@pytest.mark.parametrize("wrong", [{"width": 642}, {"height": 33}, {"rate": 0}])
def test_sizes_that_cannot_be_encoded_are_refused(wrong):
    with pytest.raises(ValueError, match=f"VideoConfig.{next(iter(wrong))} must be"):
        VideoConfig(**wrong)
